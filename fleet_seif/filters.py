"""What every filter offers, and what it says about a step.

1. A filter works in the coordinates of one frame, which starts at pose (0, 0, 0); nothing of the world enters.
2. Landmarks are numbered 0, 1, ... in the order they are first seen; a signature names one landmark.
3. A step that is refused leaves the filter as it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fleet_seif.errors import ReadingRefused
from fleet_seif.information import FrameDelta
from fleet_seif.records import Floats, Ints, Reading, Sightings


@dataclass(frozen=True, eq=False, slots=True)
class StepResult:
    """What a step changed.

    delta: change of the frame's (H, b); nothing for a filter that keeps no information form.
    new: signatures of the landmarks numbered from `first_new` on.
    innovation: sum of squared normalised innovations; sightings: how many it comes from (two degrees of freedom each).
    refused: sightings beyond the gate, or beyond the neighbours that a landmark may have.
    active: landmarks linked to the pose after the step; more than `active_max` only where ESEIF could not relocate.
    """

    delta: FrameDelta
    first_new: int
    new: tuple[int, ...]
    innovation: float
    sightings: int
    refused: int
    active: int


class Filter(Protocol):
    """A filter of one vehicle: `start` once, then `step` for every reading."""

    @property
    def signatures(self) -> list[int]:
        """Signatures by landmark number."""

    @property
    def pose(self) -> Floats:
        """Mean pose in the frame, (x m, y m, theta rad), shape (3,)."""

    @property
    def landmarks(self) -> Floats:
        """Mean landmarks in the frame, m, shape (n, 2), by number."""

    def start(self, sightings: Sightings) -> StepResult:
        """What is seen before any motion."""

    def step(self, reading: Reading) -> StepResult:
        """One reading: motion, then sightings. Raises ReadingRefused or NumericalError."""

    def mean(self) -> Floats:
        """Pose, then landmarks by number, shape (3 + 2 n,)."""

    def covariance_of(self, numbers: Sequence[int]) -> Floats:
        """Joint covariance of the pose and these landmarks in this order, shape (3 + 2 k, 3 + 2 k), m and rad."""


class Names:
    """Which number a signature has."""

    def __init__(self) -> None:
        self.signatures: list[int] = []
        self._number: dict[int, int] = {}

    def numbers(self, signatures: Ints) -> tuple[Ints, list[int]]:
        """Landmark number of each sighting, and the signatures that are new; nothing is changed."""
        new: dict[int, int] = {}
        numbers = []
        known = self._number
        for signature in signatures.tolist():
            number = known.get(signature)
            if number is None:
                if signature < 0:
                    raise ReadingRefused(
                        f"reading refused: a sighting has signature {signature}, which names no landmark: give each a"
                        " signature of at least 0, or have the vehicle find out by itself: filter.identities ="
                        ' "associated"'
                    )
                number = new.setdefault(signature, len(known) + len(new))
            numbers.append(number)
        return np.array(numbers, np.int64), list(new)

    def add(self, new: list[int]) -> None:
        """Take new signatures for good."""
        for signature in new:
            self._number[signature] = len(self.signatures)
            self.signatures.append(signature)


def checked_reading(
    odometry: Floats, odometry_cov: Floats, seen: Sightings
) -> tuple[Floats, Floats, Floats, Floats, Ints]:
    """A reading's arrays, copied into the one layout that kernels are compiled for. Raises ReadingRefused."""
    u, cov, z, Z = (np.array(array, np.float64, order="C") for array in (odometry, odometry_cov, seen.z, seen.cov))
    signature = np.array(seen.signature)
    if signature.ndim != 1 or (len(signature) and signature.dtype.kind not in "iu"):
        raise ReadingRefused("reading refused: signatures must be a flat array of integers")
    count = len(signature)
    if u.shape != (3,) or cov.shape != (3, 3) or z.shape != (count, 2) or Z.shape != (count, 2, 2):
        raise ReadingRefused(
            f"reading refused: odometry {u.shape}, its covariance {cov.shape}, sightings z {z.shape}, their"
            f" covariances {Z.shape} for {count} signatures; expected (3,), (3, 3), (s, 2), (s, 2, 2)"
        )
    return u, cov, z, Z, signature
