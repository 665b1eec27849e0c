"""The frozen records that cross boundaries between the parts of the system."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

UNKNOWN_SIGNATURE = -1


@dataclass(frozen=True, eq=False, kw_only=True)
class Sightings:
    """The landmarks seen from one pose.

    z: what was measured, shape (s, 2): range (m) and bearing (rad, left positive, 0 ahead).
    cov: its noise covariance Z, shape (s, 2, 2), positive definite.
    signature: what identifies the landmark, shape (s,), at least 0, or UNKNOWN_SIGNATURE.
    """

    z: Floats
    cov: Floats
    signature: Ints

    @staticmethod
    def none() -> "Sightings":
        return Sightings(z=np.empty((0, 2)), cov=np.empty((0, 2, 2)), signature=np.empty(0, np.int64))


@dataclass(frozen=True, eq=False, kw_only=True)
class Reading:
    """One step of one vehicle: a motion, then what is seen from where it ends.

    time_s: the vehicle's own time, s; must grow from reading to reading.
    odometry: pose increment (dx m, dy m, dtheta rad) in the frame of the pose it leaves, shape (3,).
    odometry_cov: its covariance, shape (3, 3), positive definite.
    """

    time_s: float
    odometry: Floats
    odometry_cov: Floats
    sightings: Sightings
