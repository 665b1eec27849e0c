"""A long world for the question whether a step's cost follows the map's size: every step looks the same.

1. One pass over N landmarks. Pose k (0 .. N - 6) sees landmarks k .. k+5, so that every pose has six sightings and each
   of steps 1 .. N - 6 one new landmark. A landmark is seen from six poses in a row, but for the five at either end.
2. The path mows a square: straight rows, joined by half circles to the left and to the right in turn. Steps have one
   length throughout, so a turn is a few steps like any others.
3. Landmarks lie beside the path, to either side, 0.06 m to 0.2 m from every pose that sees them: the sensor range of
   the paper's world. Rows are so far apart that nothing of another row comes as close.
4. Readings are made in blocks as they are asked for; nothing of the world is kept. Same seed, same readings.

Coordinates are those of the frame that starts at pose 0, (0, 0, 0), heading along the first row.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from fleet_seif.records import Floats, Ints, Reading, Sightings
from scenarios.experiments.worlds import MILD_NOISE
from scenarios.world import NoiseSettings, noisy_sightings

SEEN: Final = 6
"""Landmarks seen from a pose, and poses that see a landmark."""
STEP_M: Final = 0.05
STEP_S: Final = 0.1
TURN_STEPS: Final = 12
TURN_RAD: Final = math.pi / TURN_STEPS
ROW_SPACING_M: Final = STEP_M / math.tan(TURN_RAD / 2.0)
"""Between rows: the sum of TURN_STEPS chords of STEP_M, each turned by TURN_RAD, across the row. 0.38 m."""
ASIDE_M: Final = (0.07, 0.12)
"""A landmark's distance from the path."""
ALONG_M: Final = 0.004
"""Most that a landmark is off the middle of the poses that see it, along the path."""
BLOCK: Final = 4096
"""Poses made at a time."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Block:
    """Consecutive poses and what they read.

    first: number of the first pose. poses (n, 3): truth. landmarks (n + 5, 2): truth, from number `first` on.
    odometry (n, 3): increments to each pose from the one before it. z (n, 6, 2): pose k's sightings of k .. k+5.
    """

    first: int
    poses: Floats
    landmarks: Floats
    odometry: Floats
    z: Floats


class Strip:
    """The world of `landmarks` landmarks. `start`, then `readings`."""

    def __init__(self, landmarks: int, *, seed: int = 0, noise: NoiseSettings = MILD_NOISE) -> None:
        """Raises ValueError for fewer landmarks than a pose sees."""
        if landmarks < SEEN:
            raise ValueError(f"a strip of {landmarks} landmarks: expected at least {SEEN}, as many as a pose sees")
        self.landmarks = landmarks
        self.steps = landmarks - SEEN
        self._seed = seed
        self._odometry_std = np.array([noise.forward_std_m, noise.sideways_std_m, noise.turn_std_rad])
        self._sighting_cov = np.tile(np.diag([noise.range_std_m**2, noise.bearing_std_rad**2]), (SEEN, 1, 1))
        self._noise = noise
        self._circuit = _circuit(max(1, round(math.sqrt(landmarks * ROW_SPACING_M / STEP_M))))

    def poses(self, numbers: Ints) -> Floats:
        """True poses (x m, y m, theta rad) of these numbers, which may also lie before 0; headings are 0 .. pi."""
        laps, places = np.divmod(numbers, len(self._circuit))
        poses: Floats = self._circuit[places]
        poses[:, 1] += 2.0 * ROW_SPACING_M * laps
        return poses

    def blocks(self) -> Iterator[Block]:
        """The whole world, a few thousand poses at a time."""
        for_landmarks, for_odometry, for_sightings = (
            np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(key,))) for key in range(3)
        )
        landmarks = self._place(np.arange(SEEN - 1), for_landmarks)
        for first in range(0, self.steps + 1, BLOCK):
            numbers = np.arange(first, min(first + BLOCK, self.steps + 1))
            poses = self.poses(numbers)
            landmarks = np.concatenate([landmarks[1 - SEEN :], self._place(numbers + SEEN - 1, for_landmarks)])
            window = np.arange(len(numbers))[:, None] + np.arange(SEEN)
            z = noisy_sightings(np.repeat(poses, SEEN, axis=0), landmarks[window.ravel()], self._noise, for_sightings)
            odometry = np.zeros((len(numbers), 3))
            odometry[:, 0] = STEP_M
            odometry[:, 2] = poses[:, 2] - self.poses(numbers - 1)[:, 2]
            odometry += self._odometry_std * for_odometry.standard_normal(odometry.shape)
            yield Block(first=first, poses=poses, landmarks=landmarks, odometry=odometry, z=z.reshape(-1, SEEN, 2))

    def start(self) -> Sightings:
        """What pose 0 sees."""
        return self._sightings(0, next(self.blocks()).z[0])

    def readings(self) -> Iterator[Reading]:
        """Steps 1 .. N - 6."""
        odometry_cov = np.diag(self._odometry_std**2)
        for block in self.blocks():
            for i in range(1 if block.first == 0 else 0, len(block.z)):
                yield Reading(
                    time_s=STEP_S * (block.first + i),
                    odometry=block.odometry[i],
                    odometry_cov=odometry_cov,
                    sightings=self._sightings(block.first + i, block.z[i]),
                )

    def _sightings(self, pose: int, z: Floats) -> Sightings:
        """Signatures are the landmarks' numbers."""
        return Sightings(z=z, cov=self._sighting_cov, signature=np.arange(pose, pose + SEEN))

    def _place(self, numbers: Ints, rng: np.random.Generator) -> Floats:
        """Landmarks of these numbers (m, 2), with three draws each: off the middle of the six poses, aside, which side.

        Poses n-5 .. n see landmark n; their middle is on the chord from pose n-3 to n-2, which has the heading of n-3.
        """
        draws = rng.random((len(numbers), 3))
        along = 0.5 * STEP_M + ALONG_M * (2.0 * draws[:, 0] - 1.0)
        aside = ASIDE_M[0] + (ASIDE_M[1] - ASIDE_M[0]) * draws[:, 1]
        aside[draws[:, 2] < 0.5] *= -1.0
        x, y, theta = self.poses(numbers - SEEN // 2).T
        c, s = np.cos(theta), np.sin(theta)
        return np.column_stack([x + c * along - s * aside, y + s * along + c * aside])


def _circuit(row_steps: int) -> Floats:
    """Poses of two rows and their turns, after which the path repeats itself two row spacings further.

    A step goes straight ahead, then turns: left at the first row's end, right at the second's. Headings are made from
    whole numbers of turns, so they do not drift.
    """
    straight, left = np.zeros(row_steps, np.int64), np.ones(TURN_STEPS, np.int64)
    turns = np.cumsum(np.concatenate([straight, left, straight, -left]))
    heading = TURN_RAD * np.concatenate([[0], turns[:-1]])
    chords = STEP_M * np.column_stack([np.cos(heading), np.sin(heading)])
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(chords, axis=0)[:-1]])
    return np.column_stack([places, heading])
