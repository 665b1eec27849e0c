"""What lies around the pose of a vehicle that has one filter for all, from the filter's own neighbourhood.

The landmarks nearest to the pose, as seen from it, with the joint covariance of the combined Markov blanket
(Seif.blanket_covariance): what OwnMap.around is for a vehicle of several frames. The cost is bounded by how many
landmarks are asked for and how many neighbours they have; to find the nearest, the distance of each is looked at.
"""

import numpy as np

from fleet_seif.jit import one_thread
from fleet_seif.local_map import LocalMap, seen_from
from fleet_seif.own_map import nearest
from fleet_seif.records import Ints
from fleet_seif.seif import Seif


@one_thread
def around_pose(filter: Seif, numbers: Ints, most: int, reach_m: float) -> tuple[LocalMap, float]:
    """At most so many of these landmarks, the nearest, and how far from here they are all there are, m.

    reach_m: as in `nearest`. Raises NumericalError where the filter's matrix is not positive definite.
    """
    pose, landmarks = filter.pose, filter.landmarks[numbers]
    chosen, travel_max_m = nearest(landmarks, pose, most, reach_m)
    P = filter.blanket_covariance(numbers[chosen].tolist())
    return seen_from(pose, landmarks[chosen], P, np.ascontiguousarray(numbers[chosen])), travel_max_m
