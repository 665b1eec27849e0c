"""gtsam's iSAM2 on the readings of one vehicle: the peer that our times and maps are set beside.

Kaess et al., iSAM2, IJRR 31(2), 2012. It keeps the whole path and relinearises; our filters keep the newest pose only.
Pose k of the path is x_k, landmark n is l_n; both in the frame that starts at pose (0, 0, 0).
"""

import math
from importlib import import_module
from types import ModuleType
from typing import Any, Final, Literal

import numpy as np

from fleet_seif.errors import NumericalError, RunError
from fleet_seif.filters import Names, checked_reading
from fleet_seif.geometry import compose
from fleet_seif.models import RANGE_BEARING, place
from fleet_seif.records import Floats, Ints, Reading, Sightings

Factorization = Literal["CHOLESKY", "QR"]
RELINEARIZE_SKIP: Final = 10
RELINEARIZE_THRESHOLD: Final = 0.05


def import_gtsam() -> ModuleType:
    """Raises RunError where it is not installed."""
    try:
        return import_module("gtsam")
    except ImportError as error:
        raise RunError("iSAM2 needs gtsam, which is not installed; remedy: pip install 'fleet-seif[bench]'") from error


def is_installed() -> bool:
    """Whether iSAM2 can be run here."""
    try:
        import_gtsam()
    except RunError:
        return False
    return True


class Isam2:
    """`start` once, then `step` for every reading, as with our filters; nothing is refused.

    A step is one update of iSAM2 with the step's factors, then a query of the newest pose. Where iSAM2 meets a linear
    system that it cannot solve, NumericalError is raised and this object is of no more use.
    """

    def __init__(self, start_information: float, factorization: Factorization = "CHOLESKY") -> None:
        """Cholesky is gtsam's default and twice as fast as QR, but gives up sooner on the paper's noise."""
        self._gtsam = import_gtsam()
        parameters = self._gtsam.ISAM2Params()
        parameters.setFactorization(factorization)
        parameters.relinearizeSkip = RELINEARIZE_SKIP
        parameters.setRelinearizeThreshold(RELINEARIZE_THRESHOLD)
        self._isam = self._gtsam.ISAM2(parameters)
        self._names = Names()
        self.signatures = self._names.signatures
        self._start_information = start_information
        self._newest = 0
        self._pose = np.zeros(3)

    @property
    def pose(self) -> Floats:
        """Newest pose in the frame, (x m, y m, theta rad), heading wrapped, shape (3,)."""
        return self._pose.copy()

    @property
    def landmarks(self) -> Floats:
        """Estimated landmarks in the frame, m, shape (N, 2), by number; solves for the whole map."""
        estimate = self._isam.calculateEstimate()
        points = [estimate.atPoint2(self._landmark(number)) for number in range(len(self.signatures))]
        return np.array(points).reshape(-1, 2)

    def bytes_used(self) -> int:
        """Of the numbers in the Bayes tree alone, 8 bytes each; factors, values and indices come on top."""
        return 8 * int(self._isam.treeNnz())

    def start(self, sightings: Sightings) -> None:
        """What is seen before any motion, with the prior on the first pose."""
        gtsam, factors, values = self._gtsam, self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        prior = gtsam.noiseModel.Isotropic.Sigma(3, 1.0 / math.sqrt(self._start_information))
        factors.add(gtsam.PriorFactorPose2(self._at(0), gtsam.Pose2(), prior))
        values.insert(self._at(0), gtsam.Pose2())
        self._see(factors, values, self._pose, sightings.z, sightings.cov, sightings.signature)

    def step(self, reading: Reading) -> None:
        """One reading: motion, sightings, the newest pose.

        A between factor measures its error in the frame of the pose it reaches, our covariance belongs to the frame of
        the pose it leaves: cov' = R(-dtheta) cov R(dtheta) on the position.
        """
        u, cov, z, Z, signature = checked_reading(reading.odometry, reading.odometry_cov, reading.sightings)
        gtsam, factors, values = self._gtsam, self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        turn, back = gtsam.Pose2(*u), np.eye(3)
        back[:2, :2] = turn.rotation().matrix().T
        noise = gtsam.noiseModel.Gaussian.Covariance(back @ cov @ back.T)
        predicted = compose(self._pose, u)
        self._newest += 1
        factors.add(gtsam.BetweenFactorPose2(self._at(self._newest - 1), self._at(self._newest), turn, noise))
        values.insert(self._at(self._newest), gtsam.Pose2(*predicted))
        self._see(factors, values, predicted, z, Z, signature)

    def _see(self, factors: Any, values: Any, pose: Floats, z: Floats, Z: Floats, signatures: Ints) -> None:
        """Add the sightings from the newest pose, new landmarks where `pose` sees them; update; query the newest pose.

        gtsam measures (bearing, range), our sightings are (range, bearing).
        """
        gtsam, newest = self._gtsam, self._at(self._newest)
        numbers, new = self._names.numbers(signatures)
        next_new = len(self.signatures)
        for number, sighting, cov in zip(numbers.tolist(), z, Z, strict=True):
            if number == next_new:
                values.insert(self._landmark(number), place(RANGE_BEARING, pose, sighting))
                next_new += 1
            bearing, noise = gtsam.Rot2(sighting[1]), gtsam.noiseModel.Gaussian.Covariance(cov[::-1, ::-1])
            factors.add(gtsam.BearingRangeFactor2D(newest, self._landmark(number), bearing, sighting[0], noise))
        self._names.add(new)
        try:
            self._isam.update(factors, values)
            estimate = self._isam.calculateEstimatePose2(newest)
        except RuntimeError as error:
            raise NumericalError(f"iSAM2 gave up at step {self._newest}: {str(error).strip()}") from error
        self._pose = np.array([estimate.x(), estimate.y(), estimate.theta()])

    def _at(self, pose: int) -> int:
        return int(self._gtsam.symbol("x", pose))

    def _landmark(self, number: int) -> int:
        return int(self._gtsam.symbol("l", number))
