"""The strip: every step looks the same, and what is read is what the truth says."""

import itertools
import math

import numpy as np
import pytest

from fleet_seif.records import Floats
from scenarios.experiments.strip import BLOCK, ROW_SPACING_M, SEEN, STEP_M, TURN_RAD, TURN_STEPS, Strip
from scenarios.world import NoiseSettings
from tests import reference

EXACT = NoiseSettings(
    forward_std_m=1e-12, sideways_std_m=1e-12, turn_std_rad=1e-12, range_std_m=1e-12, bearing_std_rad=1e-12
)


def truth(strip: Strip) -> tuple[Floats, Floats]:
    """Poses and landmarks, all of them."""
    blocks = list(strip.blocks())
    landmarks = [blocks[0].landmarks[: SEEN - 1], *(block.landmarks[SEEN - 1 :] for block in blocks)]
    return np.concatenate([block.poses for block in blocks]), np.concatenate(landmarks)


def test_every_pose_sees_six_landmarks_and_each_is_seen_six_times_in_a_row() -> None:
    strip = Strip(BLOCK + 100)
    seen = [strip.start(), *(reading.sightings for reading in strip.readings())]
    assert len(seen) == strip.steps + 1 == BLOCK + 95
    for k, sightings in enumerate(seen):
        assert sightings.signature.tolist() == list(range(k, k + 6))
        assert sightings.z.shape == (6, 2)
        assert sightings.cov.shape == (6, 2, 2)
    assert seen[-1].signature[-1] == strip.landmarks - 1


def test_without_noise_readings_are_what_the_truth_says() -> None:
    strip = Strip(400, noise=EXACT, seed=3)
    poses, landmarks = truth(strip)
    assert (len(poses), len(landmarks)) == (strip.steps + 1, strip.landmarks)
    np.testing.assert_array_equal(poses[0], 0.0)
    for before, pose, reading in zip(poses, poses[1:], strip.readings(), strict=False):
        moved = reference.moved(0, before, reading.odometry)
        np.testing.assert_allclose(moved, pose, atol=1e-10)
        for z, signature in zip(reading.sightings.z, reading.sightings.signature, strict=True):
            difference = reference.difference(0, z, reference.expected(0, pose, landmarks[signature]))
            np.testing.assert_allclose(difference, 0.0, atol=1e-10)


def test_ranges_are_those_of_the_papers_sensor_also_in_the_turns() -> None:
    strip = Strip(20_000, noise=EXACT, seed=4)
    ranges = np.concatenate([block.z[:, :, 0] for block in strip.blocks()])
    assert ranges.min() > 0.06
    assert ranges.max() < 0.2


def test_nothing_of_another_row_is_in_range() -> None:
    """What lies within 0.2 m of a pose was or will be in view at most a turn away."""
    poses, landmarks = truth(Strip(6000, seed=5))
    for k in range(0, len(poses), 7):
        near = np.flatnonzero(np.hypot(*(landmarks - poses[k, :2]).T) < 0.2)
        assert np.abs(near - k).max() <= TURN_STEPS + SEEN


def test_steps_have_one_length_and_coordinates_stay_small() -> None:
    strip = Strip(1_000_000)
    poses = strip.poses(np.arange(strip.steps + 1))
    moves = np.diff(poses, axis=0)
    np.testing.assert_allclose(np.hypot(moves[:, 0], moves[:, 1]), STEP_M, atol=1e-9)
    assert np.abs(moves[:, 2]).max() < TURN_RAD + 1e-9
    assert np.abs(poses[:, :2]).max() < 150.0
    row = round(math.sqrt(strip.landmarks * ROW_SPACING_M / STEP_M)) + TURN_STEPS
    np.testing.assert_allclose(
        poses[row] - poses[0], [row * STEP_M - (TURN_STEPS - 1) * STEP_M, ROW_SPACING_M, math.pi], atol=1e-9
    )


def test_the_same_seed_gives_the_same_readings_and_another_seed_others() -> None:
    def head(seed: int) -> list[bytes]:
        some = itertools.islice(Strip(100, seed=seed).readings(), 20)
        return [each.odometry.tobytes() + each.sightings.z.tobytes() for each in some]

    assert head(1) == head(1)
    assert all(a != b for a, b in zip(head(1), head(2), strict=True))


def test_too_few_landmarks_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 6"):
        Strip(5)
