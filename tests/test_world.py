"""Laws of the simulated world: where vehicles fly, what they see, and how noisy it is."""

import math
from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import chi2

from fleet_seif.geometry import between, compose
from fleet_seif.records import Floats, Ints
from scenarios import meetings
from scenarios.recording import Log, Recording
from scenarios.routes import NEVER, first_shared_step
from scenarios.world import NoiseSettings, WorldSettings, place_landmarks, simulate

TRIO = ["a", "b", "c"]
SEEDS = range(20)
# (landmarks, seed): the paper's world, a small one and a large one.
MEETINGS = [(50, seed) for seed in SEEDS] + [(m, seed) for m in (30, 80) for seed in range(4)]
SURE = 1e-6  # probability that a right implementation fails a chi-square test; the seed is fixed anyway


@cache
def meeting(landmarks: int, seed: int) -> Recording:
    return simulate(WorldSettings(landmarks=landmarks), NoiseSettings(), TRIO, seed)


@cache
def coverage(vehicles: int, landmarks: int) -> Recording:
    world = WorldSettings(landmarks=landmarks, routes="coverage")
    return simulate(world, NoiseSettings(), [f"v{i}" for i in range(vehicles)], 7)


def first_seen(log: Log, landmarks: int) -> Ints:
    first = np.full(landmarks, NEVER)
    np.minimum.at(first, log.sighting_truth, log.sighting_step)
    return first


def shared_at(recording: Recording, a: str, b: str) -> int:
    landmarks = len(recording.landmarks)
    return first_shared_step(first_seen(recording.logs[a], landmarks), first_seen(recording.logs[b], landmarks))


def same(a: Log, b: Log) -> bool:
    return all(np.array_equal(getattr(a, field), getattr(b, field)) for field in Log.__dataclass_fields__)


def true_sightings(log: Log, landmarks: Floats) -> Floats:
    """Range and bearing of every sighting without noise, by plain loops."""
    rows = []
    for step, landmark in zip(log.sighting_step, log.sighting_truth, strict=True):
        dx, dy = landmarks[landmark] - log.truth_pose[step, :2]
        bearing = math.atan2(dy, dx) - log.truth_pose[step, 2]
        rows.append((math.sqrt(dx * dx + dy * dy), math.remainder(bearing, 2 * math.pi)))
    return np.array(rows)


def assert_chi_square(normalised: Floats) -> None:
    """The sum of squares of independent standard normal values lies where it almost always does, and so their mean."""
    total = float(np.sum(normalised**2))
    assert SURE / 2 < chi2.cdf(total, normalised.size) < 1 - SURE / 2
    assert abs(np.mean(normalised)) * math.sqrt(normalised.size) < 5.0


@pytest.mark.parametrize(("landmarks", "seed"), MEETINGS)
def test_vehicles_zero_and_one_first_share_landmarks_at_steps_62_to_64(landmarks: int, seed: int) -> None:
    assert 62 <= shared_at(meeting(landmarks, seed), "a", "b") <= 64


@pytest.mark.parametrize(("landmarks", "seed"), MEETINGS)
def test_vehicles_one_and_two_first_share_landmarks_at_steps_85_to_89(landmarks: int, seed: int) -> None:
    assert 85 <= shared_at(meeting(landmarks, seed), "b", "c") <= 89


@pytest.mark.parametrize(("landmarks", "seed"), MEETINGS)
def test_vehicles_zero_and_two_share_nothing_before_the_second_meeting(landmarks: int, seed: int) -> None:
    assert shared_at(meeting(landmarks, seed), "a", "c") >= 85


@pytest.mark.parametrize(("landmarks", "seed"), MEETINGS)
def test_the_three_vehicles_together_sight_every_landmark(landmarks: int, seed: int) -> None:
    seen = [log.sighting_truth for log in meeting(landmarks, seed).logs.values()]
    assert set(np.concatenate(seen).tolist()) == set(range(landmarks))


@pytest.mark.parametrize("seed", SEEDS)
def test_each_vehicle_sights_landmarks_of_its_own_before_it_meets_another(seed: int) -> None:
    for log in meeting(50, seed).logs.values():
        assert np.count_nonzero(first_seen(log, 50) < 62) >= 3


@pytest.mark.parametrize("seed", SEEDS)
def test_vehicles_keep_returning_to_landmarks_they_know(seed: int) -> None:
    for log in meeting(50, seed).logs.values():
        late = set(log.sighting_truth[log.sighting_step > 350].tolist())
        early = set(log.sighting_truth[log.sighting_step < 150].tolist())
        assert len(late & early) >= len(early) / 2


@pytest.mark.parametrize(("vehicles", "landmarks"), [(1, 50), (2, 50), (3, 60), (7, 120)])
def test_coverage_routes_sight_every_landmark(vehicles: int, landmarks: int) -> None:
    seen = [log.sighting_truth for log in coverage(vehicles, landmarks).logs.values()]
    assert set(np.concatenate(seen).tolist()) == set(range(landmarks))


def test_coverage_routes_link_all_vehicles_by_shared_landmarks() -> None:
    seen = [set(log.sighting_truth.tolist()) for log in coverage(7, 120).logs.values()]
    linked, others = seen[0], seen[1:]
    for _ in range(len(seen)):
        linked = linked.union(*(landmarks for landmarks in others if landmarks & linked))
    assert all(landmarks & linked for landmarks in others)


def test_coverage_vehicles_start_in_parts_of_their_own() -> None:
    starts = np.array([log.start_pose[:2] for log in coverage(7, 120).logs.values()])
    pairs = np.linalg.norm(starts[:, None] - starts[None, :], axis=2)[np.triu_indices(7, 1)]
    assert pairs.min() > 0.1


RUNS = [*(partial(meeting, 50, seed) for seed in SEEDS), partial(meeting, 30, 0), partial(coverage, 7, 120)]


@pytest.mark.parametrize("recorded", RUNS)
def test_vehicles_stay_inside_the_square_and_turn_within_the_limit(recorded: Callable[[], Recording]) -> None:
    run = recorded()
    side = math.sqrt(len(run.landmarks) / 50)
    for log in run.logs.values():
        assert log.truth_pose[:, :2].min() >= 0.0
        assert log.truth_pose[:, :2].max() <= side
        assert np.abs(np.diff(log.truth_pose[:, 2])).max() <= 0.6 + 1e-12


def test_a_true_step_leads_straight_ahead_and_then_turns() -> None:
    for log in meeting(50, 0).logs.values():
        steps = np.array([between(log.truth_pose[k], log.truth_pose[k + 1]) for k in range(log.steps)])
        np.testing.assert_allclose(steps[:, :2], np.tile([0.05, 0.0], (log.steps, 1)), atol=1e-12)


def test_landmarks_lie_in_the_square_and_keep_their_distance() -> None:
    landmarks = meeting(50, 3).landmarks
    apart = np.linalg.norm(landmarks[:, None] - landmarks[None, :], axis=2)[np.triu_indices(50, 1)]
    assert apart.min() >= 0.05
    assert landmarks.min() >= 0.0
    assert landmarks.max() <= 1.0


def test_landmarks_of_a_layout_without_close_pairs_are_those_of_one_dart_after_another() -> None:
    rng = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(0,)))
    placed: list[Floats] = []
    while len(placed) < 50:
        dart = rng.uniform(0.0, 1.0, 2)
        if all(math.dist(dart, other) >= 0.05 for other in placed):
            placed.append(dart)
    np.testing.assert_array_equal(meeting(50, 3).landmarks, placed)


def test_a_grid_looks_the_same_from_each_of_its_landmarks() -> None:
    grid = place_landmarks(WorldSettings(landmarks=49, layout="grid"), 0)
    side = math.sqrt(49 / 50)
    assert grid.shape == (49, 2)
    for axis in grid.T:
        np.testing.assert_allclose(np.unique(np.round(axis, 12)), (np.arange(7) + 0.5) * side / 7, atol=1e-11)
    assert len({tuple(place) for place in np.round(grid, 9).tolist()}) == 49


def test_close_pairs_stand_closer_than_others_may_and_each_landmark_is_in_one_at_most() -> None:
    settings = {"landmarks": 50, "close_pairs": 8, "close_pair_m": 0.015}
    landmarks = place_landmarks(WorldSettings.model_validate(settings), 4)
    apart = np.linalg.norm(landmarks[:, None] - landmarks[None, :], axis=2)
    close = np.argwhere(np.triu(apart < 0.05, 1))
    assert len(close) == 8
    assert len(set(close.ravel().tolist())) == 16
    assert apart[*close.T].max() <= 0.015
    assert set(close[:, 1].tolist()) == set(range(42, 50))
    assert landmarks.min() >= 0.0
    assert landmarks.max() <= 1.0


def test_sightings_are_exactly_the_landmarks_in_range_by_step_then_index() -> None:
    run = meeting(50, 1)
    for log in run.logs.values():
        expected = [
            (k, j)
            for k, pose in enumerate(log.truth_pose)
            for j, landmark in enumerate(run.landmarks)
            if 0.06 <= math.dist(pose[:2], landmark) <= 0.2
        ]
        assert list(zip(log.sighting_step.tolist(), log.sighting_truth.tolist(), strict=True)) == expected
        np.testing.assert_array_equal(log.sighting_signature, log.sighting_truth)


def test_noiseless_odometry_composes_to_the_truth_and_noiseless_sightings_are_true() -> None:
    tiny = 1e-12
    noise = NoiseSettings(
        forward_std_m=tiny, sideways_std_m=tiny, turn_std_rad=tiny, range_std_m=tiny, bearing_std_rad=tiny
    )
    run = simulate(WorldSettings(), noise, TRIO, 2)
    for log in run.logs.values():
        pose = log.start_pose
        for k in range(log.steps):
            pose = compose(pose, log.odometry[k])
            np.testing.assert_allclose(pose, log.truth_pose[k + 1], atol=1e-9)
        np.testing.assert_allclose(log.sighting_z, true_sightings(log, run.landmarks), atol=1e-9)


def test_odometry_noise_has_the_declared_covariance() -> None:
    for log in meeting(50, 4).logs.values():
        truth = np.array([between(log.truth_pose[k], log.truth_pose[k + 1]) for k in range(log.steps)])
        stds = np.sqrt(np.diagonal(log.odometry_cov, axis1=1, axis2=2))
        np.testing.assert_allclose(stds, np.tile([0.01, 1e-4, 0.1], (log.steps, 1)), rtol=1e-12)
        for component in ((log.odometry - truth) / stds).T:
            assert_chi_square(component)


def test_sighting_noise_has_the_declared_covariance() -> None:
    run = meeting(50, 4)
    for log in run.logs.values():
        truth = true_sightings(log, run.landmarks)
        residual = log.sighting_z - truth
        residual[:, 1] = [math.remainder(angle, 2 * math.pi) for angle in residual[:, 1]]
        stds = np.sqrt(np.diagonal(log.sighting_cov, axis1=1, axis2=2))
        np.testing.assert_allclose(stds**2, np.tile([0.002, 0.003], (len(stds), 1)), rtol=1e-12)
        # Nearer ranges are sometimes drawn again, which makes their noise not quite normal.
        far = truth[:, 0] > 3.5 * stds[0, 0]
        assert_chi_square((residual / stds)[far, 0])
        assert_chi_square((residual / stds)[:, 1])


def test_ranges_are_positive_and_bearings_wrapped() -> None:
    noisy = simulate(WorldSettings(), NoiseSettings(range_std_m=0.2, bearing_std_rad=2.0), TRIO, 0)
    for log in noisy.logs.values():
        assert log.sighting_z[:, 0].min() > 1e-3
        assert np.abs(log.sighting_z[:, 1]).max() <= math.pi


def test_a_log_starts_at_the_true_pose_known_without_doubt_and_its_clock_ticks_by_step() -> None:
    for log in meeting(50, 0).logs.values():
        np.testing.assert_array_equal(log.start_pose, log.truth_pose[0])
        np.testing.assert_array_equal(log.start_pose_cov, np.zeros((3, 3)))
        np.testing.assert_allclose(log.time_s, np.linspace(0.0, 50.0, 501), atol=1e-9)
        assert (log.steps, len(log.truth_pose)) == (500, 501)


def test_the_same_arguments_give_the_same_run_to_the_bit_and_another_seed_another() -> None:
    again = simulate(WorldSettings(), NoiseSettings(), TRIO, 5)
    assert all(same(log, again.logs[name]) for name, log in meeting(50, 5).logs.items())
    np.testing.assert_array_equal(again.landmarks, meeting(50, 5).landmarks)
    assert not np.array_equal(again.landmarks, meeting(50, 6).landmarks)


def test_louder_noise_changes_neither_landmarks_nor_routes() -> None:
    loud = simulate(WorldSettings(), NoiseSettings(range_std_m=0.1, turn_std_rad=0.3), TRIO, 5)
    np.testing.assert_array_equal(loud.landmarks, meeting(50, 5).landmarks)
    for name, log in loud.logs.items():
        np.testing.assert_array_equal(log.truth_pose, meeting(50, 5).logs[name].truth_pose)


def test_a_vehicles_odometry_noise_does_not_depend_on_the_size_of_the_fleet() -> None:
    def noise_of_first(vehicles: list[str]) -> Floats:
        log = simulate(WorldSettings(routes="coverage", steps=50), NoiseSettings(), vehicles, 0).logs["a"]
        return log.odometry[:, 2] - np.diff(log.truth_pose[:, 2])

    np.testing.assert_allclose(noise_of_first(["a"]), noise_of_first(TRIO), atol=1e-12)


@pytest.mark.parametrize(
    "bad",
    [
        {"landmarks": 0},
        {"side_m": -1.0},
        {"step_m": 0.0},
        {"range_min_m": 0.3},
        {"turn_max_rad": 0.1},
        {"side_m": 0.1},
        {"routes": "wander"},
        {"speed": 1.0},
        {"layout": "ring"},
        {"layout": "grid"},
        {"layout": "grid", "landmarks": 49, "close_pairs": 2},
        {"close_pairs": 26},
    ],
)
def test_bad_world_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        WorldSettings.model_validate(bad)


def test_noise_without_spread_is_refused() -> None:
    with pytest.raises(ValidationError):
        NoiseSettings(sideways_std_m=0.0)


@pytest.mark.parametrize(
    ("world", "vehicles", "message"),
    [
        (WorldSettings(), ["a", "b"], "meetings are for 3 vehicles"),
        (WorldSettings(), ["a", "a", "b"], "unique names"),
        (WorldSettings(routes="coverage"), [], "unique names"),
        (WorldSettings(min_distance_m=0.5), TRIO, "no room for landmark"),
        (WorldSettings(layout="grid", landmarks=49, min_distance_m=0.2), TRIO, "no room for landmark"),
        (WorldSettings(steps=80), TRIO, "before the meetings"),
        (WorldSettings(side_m=0.5), TRIO, "leaves 0.050 m for a pen"),
    ],
)
def test_runs_that_cannot_be_are_refused_with_the_reason(
    world: WorldSettings, vehicles: list[str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        simulate(world, NoiseSettings(), vehicles, 0)


def test_a_search_for_routes_that_finds_none_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meetings, "VISITS_MAX", 3)
    with pytest.raises(ValueError, match="no routes meet"):
        simulate(WorldSettings(landmarks=1, side_m=1.0), NoiseSettings(), TRIO, 0)
