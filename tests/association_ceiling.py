"""What is left to association where pose and map are the true ones: the most that any vehicle can be asked for."""

import numpy as np

from fleet_seif.association import associate
from fleet_seif.associator import REACH_SIGMAS
from fleet_seif.config import AssociationSettings
from fleet_seif.local_map import expected, in_reach
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats
from scenarios.association import Association
from scenarios.recording import Log, Recording

TRUTH_VARIANCE_M2 = 1e-9
"""Of the true landmarks; the true poses are certain."""


def ceiling(recording: Recording, settings: AssociationSettings) -> Association:
    """Counts for all vehicles together, each step by itself."""
    logs = recording.logs.values()
    return sum((_ceiling(log, recording.landmarks, settings) for log in logs), Association())


def _ceiling(log: Log, landmarks: Floats, settings: AssociationSettings) -> Association:
    P = np.zeros((3 + 2 * len(landmarks), 3 + 2 * len(landmarks)))
    P[3:, 3:] = TRUTH_VARIANCE_M2 * np.eye(2 * len(landmarks))
    assigned = right = 0
    for step in range(log.steps + 1):
        seen = log.sightings_at(step)
        if not len(seen.z):
            continue
        low, high = np.searchsorted(log.sighting_step, [step, step + 1])
        truth = log.sighting_truth[low:high]
        mean = np.concatenate([log.truth_pose[step], landmarks.ravel()])
        farthest_m = float(np.max(seen.z[:, 0] + REACH_SIGMAS * np.sqrt(seen.cov[:, 0, 0])))
        near = in_reach(mean, P, farthest_m, REACH_SIGMAS)
        h, C = expected(RANGE_BEARING, mean, P, near)
        found = associate(seen.z, seen.cov, h, C, settings).assignment
        paired = found >= 0
        assigned += int(np.count_nonzero(paired))
        right += int(np.count_nonzero(near[found[paired]] == truth[paired]))
    return Association(assigned=assigned, right=right, true=int(np.count_nonzero(log.sighting_truth >= 0)), found=right)
