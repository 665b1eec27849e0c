"""Laws of what sensors show besides landmarks, what they miss, and what is hidden."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import binom, kstest, poisson

from scenarios.config import load_scenario
from scenarios.detection import DetectionSettings, detected, walk, without_signatures
from scenarios.recording import Log, Recording
from scenarios.source import record
from scenarios.world import NoiseSettings, WorldSettings, simulate, stream

WORLD, NOISE = WorldSettings(), NoiseSettings()
TRIO = ("a", "b", "c")
SEED = 3
PLAIN = simulate(WORLD, NOISE, TRIO, SEED)
SURE = 1e-6  # probability that a right implementation fails a statistical test; the seed is fixed anyway


def seen_with(**settings: object) -> Recording:
    return detected(PLAIN, WORLD, NOISE, DetectionSettings.model_validate(settings), SEED)


def rows(log: Log) -> set[tuple[float, ...]]:
    """Every sighting as one tuple."""
    columns = (log.sighting_step, *log.sighting_z.T, log.sighting_signature, log.sighting_truth)
    return set(zip(*(column.tolist() for column in columns), strict=True))


def same(a: Log, b: Log) -> bool:
    return all(np.array_equal(getattr(a, field), getattr(b, field)) for field in Log.__dataclass_fields__)


def test_the_defaults_leave_a_recording_as_it_is_to_the_bit() -> None:
    shown = seen_with()
    assert all(same(log, shown.logs[name]) for name, log in PLAIN.logs.items())
    np.testing.assert_array_equal(shown.landmarks, PLAIN.landmarks)


def test_missed_sightings_are_left_out_and_the_others_stay_as_they_were() -> None:
    for name, log in seen_with(missed_share=0.1).logs.items():
        plain = PLAIN.logs[name]
        assert rows(log) < rows(plain)
        count = len(plain.sighting_step) - len(log.sighting_step)
        assert SURE < binom.cdf(count, len(plain.sighting_step), 0.1) < 1 - SURE
        np.testing.assert_array_equal(log.odometry, plain.odometry)


def test_nothing_is_seen_where_everything_is_missed() -> None:
    shown = seen_with(signatures="none", missed_share=1.0, movers=5)
    assert all(len(log.sighting_step) == 0 for log in shown.logs.values())


def test_clutter_comes_beside_the_true_sightings_at_its_rate() -> None:
    for name, log in seen_with(signatures="none", clutter_share=0.3).logs.items():
        plain, false = PLAIN.logs[name], log.sighting_truth < 0
        assert rows(log.chosen(np.flatnonzero(~false))) == rows(plain)
        assert SURE < poisson.cdf(np.count_nonzero(false), 0.3 * len(plain.sighting_step)) < 1 - SURE
        assert np.all(np.diff(log.sighting_step) >= 0)
        assert set(log.sighting_signature[false].tolist()) == {-1}


def test_clutter_fills_the_ring_of_the_sensor_evenly_and_does_not_depend_on_what_is_seen() -> None:
    logs = seen_with(signatures="none", clutter_share=2.0).logs.values()
    false = np.concatenate([log.sighting_z[log.sighting_truth < 0] for log in logs])
    area = (false[:, 0] ** 2 - 0.06**2) / (0.2**2 - 0.06**2)
    for share in (area, false[:, 1] / (2 * math.pi) + 0.5):
        assert kstest(share, "uniform").pvalue > SURE
    steps = np.concatenate([log.sighting_step[log.sighting_truth < 0] for log in logs])
    assert kstest((steps + stream(0, 99).random(len(steps))) / 501, "uniform").pvalue > SURE


def test_each_kind_draws_numbers_of_its_own() -> None:
    """What is missed and what is clutter is the same with and without the other, and with and without movers."""
    both = seen_with(signatures="none", missed_share=0.2, clutter_share=0.3, movers=2).logs["b"]
    missed, clutter = seen_with(missed_share=0.2).logs["b"], seen_with(signatures="none", clutter_share=0.3).logs["b"]
    movers = seen_with(signatures="none", missed_share=0.2, movers=2).logs["b"]
    false = rows(clutter) - rows(PLAIN.logs["b"])
    moving = rows(movers) - rows(missed)
    assert moving
    assert rows(both) == rows(missed) | false | moving


def test_moving_objects_walk_smoothly_and_stay_in_the_square() -> None:
    settings = DetectionSettings(signatures="none", movers=7, mover_step_m=0.03)
    paths = walk(settings, 1.0, 2000, stream(1, 5))
    assert paths.shape == (2001, 7, 2)
    assert paths.min() >= 0.0
    assert paths.max() <= 1.0
    moves = np.diff(paths, axis=0)
    length = np.hypot(*np.moveaxis(moves, 2, 0))
    assert length.max() <= 0.03 + 1e-12
    inside = np.all((paths[:-1] > 0.03) & (paths[:-1] < 0.97), axis=2)
    np.testing.assert_allclose(length[inside], 0.03, atol=1e-12)
    heading = np.arctan2(moves[..., 1], moves[..., 0])
    turn = np.abs(
        [math.remainder(a, math.tau) for a in (heading[1:] - heading[:-1])[inside[:-1] & inside[1:]].tolist()]
    )
    assert np.median(turn) < 0.2
    assert np.all(np.std(paths, axis=0) > 0.1)


def test_moving_objects_are_sighted_where_they_are_by_every_vehicle() -> None:
    settings = {"signatures": "none", "movers": 4, "mover_step_m": 0.02}
    paths = walk(DetectionSettings.model_validate(settings), 1.0, 500, stream(SEED, 5))
    seen = 0
    for name, log in seen_with(**settings).logs.items():
        truth = log.truth_pose
        expected = [
            (k, math.dist(pose[:2], place), math.atan2(*(place - pose[:2])[::-1]) - pose[2])
            for k, pose in enumerate(truth)
            for place in paths[k]
            if 0.06 <= math.dist(pose[:2], place) <= 0.2
        ]
        moving = log.chosen(np.flatnonzero(log.sighting_truth < 0))
        assert moving.sighting_step.tolist() == [k for k, _, _ in expected]
        z = np.array([(r, b) for _, r, b in expected])
        bearing_off = [math.remainder(a, math.tau) for a in (moving.sighting_z[:, 1] - z[:, 1]).tolist()]
        assert np.std(moving.sighting_z[:, 0] - z[:, 0]) < 1.5 * NOISE.range_std_m
        assert np.std(bearing_off) < 1.5 * NOISE.bearing_std_rad
        np.testing.assert_array_equal(moving.sighting_cov, np.tile(PLAIN.logs[name].sighting_cov[0], (len(z), 1, 1)))
        seen += len(z)
    assert seen > 100


def test_hidden_signatures_leave_the_same_sightings_shuffled_within_each_step() -> None:
    hidden = without_signatures(PLAIN, TRIO, SEED)
    for name, log in hidden.logs.items():
        plain = PLAIN.logs[name]
        assert set(log.sighting_signature.tolist()) == {-1}
        np.testing.assert_array_equal(log.sighting_step, plain.sighting_step)
        assert rows(replace(log, sighting_signature=log.sighting_truth)) == rows(plain)
        pairs = log.sighting_step[1:] == log.sighting_step[:-1]
        ascending = np.count_nonzero((np.diff(log.sighting_truth) > 0)[pairs])
        assert SURE < binom.cdf(ascending, np.count_nonzero(pairs), 0.5) < 1 - SURE


def test_a_vehicle_is_shown_the_same_alone_as_in_its_fleet() -> None:
    alone = without_signatures(replace(PLAIN, logs={"b": PLAIN.logs["b"]}), TRIO, SEED)
    assert same(alone.logs["b"], without_signatures(PLAIN, TRIO, SEED).logs["b"])


def test_the_same_seed_shows_the_same_and_another_seed_something_else() -> None:
    settings = DetectionSettings(signatures="none", missed_share=0.1, clutter_share=0.1, movers=3)
    one, again, other = (detected(PLAIN, WORLD, NOISE, settings, seed).logs["a"] for seed in (1, 1, 2))
    assert same(one, again)
    assert not same(one, other)


def test_a_scenario_shows_each_vehicle_the_same_alone_as_with_all() -> None:
    scenario = load_scenario("three_air_vehicles_unknown", ("world.steps=100", "detection.movers=2"))
    together = record(scenario)
    assert all(same(record(scenario, name).logs[name], log) for name, log in together.logs.items())
    assert all(set(log.sighting_signature.tolist()) == {-1} for log in together.logs.values())
    known = record(load_scenario("three_air_vehicles_mild", ("world.steps=100",)))
    np.testing.assert_array_equal(known.landmarks, together.landmarks)
    for name, log in together.logs.items():
        true = log.chosen(np.flatnonzero(log.sighting_truth >= 0))
        assert rows(replace(true, sighting_signature=true.sighting_truth)) < rows(known.logs[name])


@pytest.mark.parametrize(
    "bad",
    [
        {"clutter_share": 0.1},
        {"movers": 1},
        {"signatures": "some"},
        {"missed_share": 1.1},
        {"signatures": "none", "clutter_share": -0.1},
        {"signatures": "none", "movers": -1},
    ],
)
def test_bad_detection_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        DetectionSettings.model_validate(bad)
