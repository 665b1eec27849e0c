"""The MR.CLAM loader, against a small world of our own with known truth, and against the real data if present."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from fleet_seif.geometry import act_inverse, compose, compose_jacobians, wrap
from fleet_seif.records import Floats
from scenarios.config import load_scenario
from scenarios.mrclam import DatasetSettings, increments, load
from scenarios.mrclam_files import DatasetError
from scenarios.recording import Log, Recording
from scenarios.source import record
from tests import real_data

T0_MS = 1_600_000_000_000  # Unix time of the small world's origin
DURATION_MS = 30_000
START_MS = {1: 0, 2: 1_300}
START_POSE = {1: (0.5, -1.0, 2.9), 2: (-2.0, 1.5, -0.4)}
LANDMARKS = {6: (3.0, 0.5), 7: (-1.0, 4.0), 8: (0.0, -3.5), 9: (-4.0, -1.0)}
BARCODES = {1: 5, 2: 14, 6: 72, 7: 18, 8: 36, 9: 61}
STRAY_BARCODE = 99


@dataclass(frozen=True)
class World:
    """Files as lists of rows, by name without ".dat"; times in whole milliseconds from the origin."""

    tables: dict[str, list[tuple[float, ...]]]

    def write(self, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.tables.items():
            timed = name.startswith("Robot")
            lines = [" \t ".join([stamp(row[0]) if timed else f"{row[0]:3d}", *map(str, row[1:])]) for row in rows]
            (folder / f"{name}.dat").write_text("\n".join(["# made by test_mrclam.py", *lines]) + "\n")
        return folder

    def change(self, name: str, change: Callable[[list[tuple[float, ...]]], list[tuple[float, ...]]]) -> "World":
        return replace(self, tables={**self.tables, name: change(self.tables[name])})

    def without(self, *names: str) -> "World":
        return replace(self, tables={name: rows for name, rows in self.tables.items() if name not in names})


def stamp(time_ms: float) -> str:
    return f"{(T0_MS + int(time_ms)) // 1000}.{(T0_MS + int(time_ms)) % 1000:03d}"


def command(robot: int, row: int) -> tuple[float, float]:
    """Invented velocities (m/s, rad/s): straights, bends to both sides, turns on the spot, standstills."""
    cycle = [(0.3, 0.0), (0.25, 0.5), (0.0, 0.0), (0.2, -0.7), (0.0, 0.9), (0.15, 0.05)]
    return cycle[(row // 40 + robot) % len(cycle)]


def drive(pose: Floats, v: float, w: float, dt: float) -> Floats:
    """The textbook arc: radius v / w about a centre to the left."""
    x, y, theta = pose
    if w == 0.0:
        return np.array([x + v * dt * math.cos(theta), y + v * dt * math.sin(theta), theta])
    end = theta + w * dt
    radius = v / w
    return np.array(
        [x + radius * (math.sin(end) - math.sin(theta)), y - radius * (math.cos(end) - math.cos(theta)), end]
    )


def simulate(delay_ms: int = 0, lost: float = 0.0) -> World:
    """A noiseless world; odometry rows stand `delay_ms` before the motion they cause."""
    tables: dict[str, list[tuple[float, ...]]] = {
        "Barcodes": list(BARCODES.items()),
        "Landmark_Groundtruth": [(s, *LANDMARKS[s], 0.001, 0.001) for s in (8, 6, 9, 7)],
    }
    for robot, start_ms in START_MS.items():
        pose, v, w = np.array(START_POSE[robot]), 0.0, 0.0
        odometry: list[tuple[float, ...]] = []
        seen: list[tuple[float, ...]] = []
        track: list[tuple[float, ...]] = []
        for t in range(start_ms, DURATION_MS + 1):
            since = t - start_ms
            if since % 17 == 0:
                odometry.append((t, *command(robot, since // 17)))
            if since >= delay_ms and (since - delay_ms) % 17 == 0:
                v, w = command(robot, (since - delay_ms) // 17)
                v = max(v - lost * abs(w), 0.0)
            track.append((t, pose[0], pose[1], wrap(pose[2])))
            if since % 241 == 100:
                for barcode in (72, 18, 36, 61, 5 if robot == 2 else 14, STRAY_BARCODE):
                    seen.append((t, barcode, *look(pose, barcode)))
            pose = drive(pose, v, w, 0.001)
        tables[f"Robot{robot}_Odometry"] = odometry
        tables[f"Robot{robot}_Measurement"] = seen
        tables[f"Robot{robot}_Groundtruth"] = track
    return World(tables)


def look(pose: Floats, barcode: int) -> tuple[float, float]:
    """Range and bearing to a landmark; robots and strays are seen somewhere."""
    place = {BARCODES[s]: LANDMARKS[s] for s in LANDMARKS}.get(barcode, (9.0, 9.0))
    x, y = act_inverse(pose, np.array(place))
    return math.hypot(x, y), math.atan2(y, x)


@pytest.fixture(scope="module")
def world() -> World:
    return simulate()


@pytest.fixture(scope="module")
def folder(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return world.write(tmp_path_factory.mktemp("mrclam_tiny"))


def settings(path: Path | None, **changes: float | None) -> DatasetSettings:
    """No correction of any reading, unless a test asks for one."""
    plain = {"odometry_delay_s": 0.0, "forward_lost_m_per_rad": 0.0}
    plain |= {"range_bias_m": 0.0, "range_bias_per_m": 0.0, "bearing_bias_rad": 0.0}
    return DatasetSettings.model_validate({"kind": "mrclam", "path": path, **plain, **changes})


def dead_reckoning(log: Log) -> Floats:
    """Poses from the start pose by composing the increments, shape (T+1, 3)."""
    poses = [log.start_pose]
    for move in log.odometry:
        poses.append(compose(poses[-1], move))
    return np.array(poses)


def same_log(a: Log, b: Log) -> bool:
    return all(np.array_equal(getattr(a, f), getattr(b, f), equal_nan=f == "truth_pose") for f in vars(a))


def rows_of(world: World, robots: tuple[int, ...] = (1, 2)) -> int:
    return sum(len(world.tables[f"Robot{r}_Measurement"]) for r in robots)


def kept(recording: Recording) -> int:
    return sum(len(log.sighting_step) for log in recording.logs.values())


def largest_pose_error(log: Log) -> float:
    error = dead_reckoning(log) - log.truth_pose
    error[:, 2] = np.remainder(error[:, 2] + np.pi, 2 * np.pi) - np.pi
    return float(np.abs(error).max())


@pytest.mark.parametrize("step_s", [0.05, 0.2, 5.0])
def test_odometry_composed_from_the_start_pose_is_the_true_path(folder: Path, step_s: float) -> None:
    for log in load(settings(folder, step_s=step_s)).logs.values():
        assert largest_pose_error(log) < 1e-5


def test_delay_and_loss_of_speed_in_bends_are_taken_out_of_the_odometry(tmp_path: Path) -> None:
    late = simulate(delay_ms=200, lost=0.1).write(tmp_path)
    right = load(settings(late, odometry_delay_s=0.2, forward_lost_m_per_rad=0.1))
    only_delay = load(settings(late, odometry_delay_s=0.2))
    only_loss = load(settings(late, forward_lost_m_per_rad=0.1))
    for name, log in right.logs.items():
        assert largest_pose_error(log) < 1e-5
        assert largest_pose_error(only_delay.logs[name]) > 0.05
        assert largest_pose_error(only_loss.logs[name]) > 0.05


def test_barcodes_can_be_hidden_from_all_but_the_score(folder: Path) -> None:
    settings = (f"dataset.path={folder}", "detection.signatures=none", "filter.identities=associated")
    known, hidden = (record(load_scenario("mrclam", chosen)) for chosen in (settings[:1], settings))
    assert list(hidden.logs) == list(known.logs)
    for name, log in hidden.logs.items():
        assert set(log.sighting_signature.tolist()) == {-1}
        order = [np.lexsort((*each.sighting_z.T, each.sighting_step)) for each in (log, known.logs[name])]
        named = replace(log.chosen(order[0]), sighting_signature=known.logs[name].sighting_signature[order[1]])
        assert same_log(named, known.logs[name].chosen(order[1]))
        assert same_log(record(load_scenario("mrclam", settings), name).logs[name], log)


def test_every_sighting_is_that_of_its_landmark_from_its_true_pose(folder: Path) -> None:
    recording = load(settings(folder))
    assert recording.landmarks.tolist() == [list(LANDMARKS[s]) for s in (6, 7, 8, 9)]
    for log in recording.logs.values():
        assert len(log.sighting_step) > 400
        for step, z, barcode, truth in zip(
            log.sighting_step, log.sighting_z, log.sighting_signature, log.sighting_truth
        ):
            x, y = act_inverse(log.truth_pose[step], recording.landmarks[truth])
            assert barcode == BARCODES[6 + truth]
            assert z[0] == pytest.approx(math.hypot(x, y), abs=1e-5)
            assert wrap(z[1] - math.atan2(y, x)) == pytest.approx(0.0, abs=1e-5)


def test_biases_are_taken_out_of_sightings(folder: Path, world: World, tmp_path: Path) -> None:
    biased = world
    for robot in (1, 2):
        biased = biased.change(
            f"Robot{robot}_Measurement",
            lambda rows: [(t, barcode, 0.05 + 0.9 * r, bearing + 0.02) for t, barcode, r, bearing in rows],
        )
    biased.write(tmp_path)
    undone = load(settings(tmp_path, range_bias_m=0.05, range_bias_per_m=-0.1, bearing_bias_rad=0.02))
    for name, log in load(settings(folder)).logs.items():
        np.testing.assert_allclose(undone.logs[name].sighting_z, log.sighting_z, atol=1e-12)


def test_range_noise_grows_with_range(folder: Path) -> None:
    log = load(settings(folder, range_std_m=0.3, range_std_per_m=0.1, bearing_std_rad=0.02)).logs["robot1"]
    np.testing.assert_allclose(log.sighting_cov[:, 0, 0], 0.09 + 0.01 * log.sighting_z[:, 0] ** 2)
    np.testing.assert_allclose(log.sighting_cov[:, 1, 1], 0.0004)
    assert (log.sighting_cov[:, 0, 1] == 0).all()


def test_steps_are_positive_and_never_longer_than_asked(folder: Path) -> None:
    for step_s in (0.01, 0.1, 1.0):
        for log in load(settings(folder, step_s=step_s)).logs.values():
            assert np.diff(log.time_s).min() > 0
            assert np.diff(log.time_s).max() <= step_s + 1e-9


def test_sightings_are_made_from_poses_at_their_own_time(folder: Path, world: World) -> None:
    for robot in (1, 2):
        log = load(settings(folder)).logs[f"robot{robot}"]
        stamps = [
            t / 1000 for t, barcode, *_ in world.tables[f"Robot{robot}_Measurement"] if barcode in (72, 18, 36, 61)
        ]
        np.testing.assert_allclose(log.time_s[log.sighting_step], stamps, atol=1e-6)


def test_stamps_a_millisecond_apart_are_one_instant(folder: Path, world: World, tmp_path: Path) -> None:
    jittered = world.change(
        "Robot1_Measurement", lambda rows: [(t + (barcode == 36), barcode, *z) for t, barcode, *z in rows]
    )
    expected = load(settings(folder)).logs["robot1"]
    got = load(settings(jittered.write(tmp_path))).logs["robot1"]
    np.testing.assert_array_equal(got.time_s, expected.time_s)
    np.testing.assert_array_equal(got.sighting_step, expected.sighting_step)


def test_all_robots_share_the_origin_of_the_earliest_first_odometry_row(folder: Path) -> None:
    logs = load(settings(folder)).logs
    assert logs["robot1"].time_s[0] == 0.0
    assert logs["robot2"].time_s[0] == pytest.approx(1.3, abs=1e-6)


def test_one_robot_alone_is_loaded_as_among_all(folder: Path) -> None:
    everyone = load(settings(folder))
    alone = load(settings(folder), only="robot2")
    assert list(everyone.logs) == ["robot1", "robot2"]
    assert list(alone.logs) == ["robot2"]
    assert same_log(alone.logs["robot2"], everyone.logs["robot2"])
    np.testing.assert_array_equal(alone.landmarks, everyone.landmarks)


def test_every_row_is_either_a_sighting_or_counted_as_skipped(world: World, tmp_path: Path) -> None:
    odd = world.change("Robot1_Measurement", lambda rows: [*rows, (-50, 72, 1.0, 0.0), (31_000, 72, 1.0, 0.0)])
    odd = odd.change("Robot2_Measurement", lambda rows: [*rows, (5_000, 72, 0.0, 0.0)])
    odd.write(tmp_path)
    looks = {r: len({t for t, *_ in world.tables[f"Robot{r}_Measurement"]}) for r in (1, 2)}
    plain = load(settings(tmp_path))
    assert plain.skipped == {
        "other robots": looks[1] + looks[2],
        "barcode not in the table": looks[1] + looks[2],
        "before the first odometry": 1,
        "after the last odometry": 1,
        "range not positive": 1,
    }
    assert kept(plain) + sum(plain.skipped.values()) == rows_of(odd)
    cut = load(settings(tmp_path, duration_s=10.0, range_max_m=4.0))
    assert cut.skipped["after duration_s"] > 0
    assert cut.skipped["beyond range_max_m"] > 0
    assert kept(cut) + sum(cut.skipped.values()) == rows_of(odd)
    assert all(log.time_s[-1] == 10.0 for log in cut.logs.values())
    assert all(log.sighting_z[:, 0].max() <= 4.0 for log in cut.logs.values())


def test_a_robot_without_odometry_is_left_out_and_its_sightings_counted(
    world: World, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = world.without("Robot2_Odometry").write(tmp_path)
    recording = load(settings(path))
    assert list(recording.logs) == ["robot1"]
    assert recording.skipped["no Robot2_Odometry.dat"] == rows_of(world, (2,))
    assert kept(recording) + sum(recording.skipped.values()) == rows_of(world)
    assert "vehicle=robot2 missing=Robot2_Odometry.dat" in caplog.text
    with pytest.raises(
        DatasetError, match=r"cannot give robot2: usable are \[robot1\]; .*robot2 lacks Robot2_Odometry"
    ):
        load(settings(path), only="robot2")


def test_the_order_of_rows_does_not_matter(folder: Path, world: World, tmp_path: Path) -> None:
    shuffled = world.change("Robot1_Odometry", lambda rows: [rows[0], *rows[:0:-1]])
    shuffled = shuffled.change("Robot1_Groundtruth", lambda rows: rows[::-1])
    got = load(settings(shuffled.write(tmp_path)))
    assert same_log(got.logs["robot1"], load(settings(folder)).logs["robot1"])


def test_of_odometry_rows_with_equal_times_the_last_counts(folder: Path, world: World, tmp_path: Path) -> None:
    repeated = world.change("Robot1_Odometry", lambda rows: [r for row in rows for r in ((row[0], 9.0, 9.0), row)])
    got = load(settings(repeated.write(tmp_path)))
    assert same_log(got.logs["robot1"], load(settings(folder)).logs["robot1"])


def test_the_last_velocity_holds_through_a_gap_in_the_odometry(world: World, tmp_path: Path) -> None:
    gap = world.change("Robot1_Odometry", lambda rows: [row for row in rows if not 100 < row[0] < 600])
    log = load(settings(gap.write(tmp_path))).logs["robot1"]
    assert command(1, 0) == command(1, 600 // 17)  # so that the path must not change
    assert largest_pose_error(log) < 1e-5


def test_truth_is_unknown_in_gaps_of_the_track_and_outside_it(world: World, tmp_path: Path) -> None:
    holes = world.change(
        "Robot1_Groundtruth",
        lambda rows: [r for r in rows if not (3_000 < r[0] < 3_500 or 9_000 < r[0] < 9_090)][:20_000],
    )
    log = load(settings(holes.write(tmp_path))).logs["robot1"]
    last_s = holes.tables["Robot1_Groundtruth"][-1][0] / 1000
    unknown = np.isnan(log.truth_pose[:, 0])
    expected = ((log.time_s > 3.0) & (log.time_s < 3.5)) | (log.time_s > last_s)
    np.testing.assert_array_equal(unknown, expected)
    assert expected.any()
    assert not expected.all()


def test_headings_are_interpolated_the_short_way(world: World, tmp_path: Path) -> None:
    coarse = world.change("Robot1_Groundtruth", lambda rows: rows[::40])
    crossings = np.abs(np.diff([row[3] for row in coarse.tables["Robot1_Groundtruth"]])) > math.pi
    assert crossings.any()
    log = load(settings(coarse.write(tmp_path), step_s=0.02)).logs["robot1"]
    known = ~np.isnan(log.truth_pose[:, 2])
    assert np.abs(np.diff(log.truth_pose[known, 2])).max() < 0.05


def test_the_start_pose_is_the_true_one_with_the_declared_spread(folder: Path) -> None:
    given = load(settings(folder)).logs["robot2"]
    np.testing.assert_allclose(given.start_pose, START_POSE[2], atol=1e-6)
    assert not given.start_pose_cov.any()
    vague = load(settings(folder, start_std_m=0.1, start_std_rad=0.2)).logs["robot2"]
    np.testing.assert_allclose(vague.start_pose_cov, np.diag([0.01, 0.01, 0.04]))


def test_swapped_barcodes_are_put_right_in_data_set_1_only(world: World, tmp_path: Path) -> None:
    swapped = world.change(
        "Barcodes", lambda rows: [(subject, {18: 61, 61: 18}.get(int(code), code)) for subject, code in rows]
    )
    for name, of_18 in (("MRCLAM_Dataset1", 7 - 6), ("MRCLAM_Dataset7", 9 - 6)):
        log = load(settings(swapped.write(tmp_path / name))).logs["robot1"]
        assert set(log.sighting_truth[log.sighting_signature == 18]) == {of_18}


def some_odometry(rng: np.random.Generator) -> Floats:
    time_s = np.cumsum(rng.uniform(0.01, 0.05, 60))
    return np.column_stack([time_s, rng.uniform(0, 0.3, 60), rng.uniform(-1, 1, 60)])


@pytest.mark.parametrize("seed", range(5))
def test_covariances_of_steps_chained_by_the_compose_jacobians_give_that_of_one_step(seed: int) -> None:
    """U_13 = J_13_12 U_12 J_13_12' + J_13_23 U_23 J_13_23', when steps end where pieces of motion do."""
    rng = np.random.default_rng(seed)
    odometry = some_odometry(rng)
    a, b, c = odometry[[3, int(rng.integers(10, 50)), 57], 0]
    noise = settings(None)
    T, U = increments(noise, odometry, np.array([a, b, c]))
    T_13, U_13 = increments(noise, odometry, np.array([a, c]))
    J_13_12, J_13_23 = compose_jacobians(T[0], T[1])
    np.testing.assert_allclose(compose(T[0], T[1]), T_13[0], atol=1e-12)
    chained = J_13_12 @ U[0] @ J_13_12.T + J_13_23 @ U[1] @ J_13_23.T
    np.testing.assert_allclose(chained, U_13[0], rtol=1e-4, atol=5e-8)


def test_declared_covariance_is_the_spread_of_noisy_drives() -> None:
    """A robot is driven 4000 times with white velocity noise of the declared strength, in pieces of 10 ms."""
    rng = np.random.default_rng(1)
    v, w, dt, pieces, runs = 0.3, 0.8, 0.01, 100, 4000
    noise = settings(None, sideways_var_m2_per_m=2e-3)
    per_s = [noise.forward_var_m2_per_s, noise.sideways_var_m2_per_s, noise.turn_var_rad2_per_s]
    per_m = [noise.forward_var_m2_per_m, noise.sideways_var_m2_per_m, noise.turn_var_rad2_per_m]
    per_rad = [noise.forward_var_m2_per_rad, 0.0, noise.turn_var_rad2_per_rad]
    std = np.sqrt((np.array(per_s) + np.array(per_m) * v + np.array(per_rad) * w) * dt)
    ends = np.empty((runs, 3))
    for i, errors in enumerate(rng.standard_normal((runs, pieces, 3)) * std):
        pose = np.zeros(3)
        for error in errors:
            pose = compose(pose, np.array([v * dt, 0.0, w * dt]) + error)
        ends[i] = pose
    odometry = np.column_stack([np.arange(pieces) * dt, np.full(pieces, v), np.full(pieces, w)])
    _, U = increments(noise, odometry, np.array([0.0, pieces * dt]))
    spread = np.cov(ends.T)
    scale = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(U[0] / np.outer(scale, scale), spread / np.outer(scale, scale), atol=0.1)


def test_covariance_is_positive_definite_even_at_a_standstill_and_without_noise() -> None:
    silent = {f"{a}_var_m2_per_{b}": 0.0 for a in ("forward", "sideways") for b in ("s", "m")}
    silent |= {f"turn_var_rad2_per_{b}": 0.0 for b in ("s", "m", "rad")} | {"forward_var_m2_per_rad": 0.0}
    standing = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    turning = some_odometry(np.random.default_rng(2))
    for odometry in (standing, turning):
        for noise in (settings(None), settings(None, **silent)):
            _, U = increments(noise, odometry, np.array([odometry[0, 0], odometry[0, 0] + 1e-6, odometry[-1, 0]]))
            assert np.linalg.eigvalsh(U).min() > 0.5e-8
            np.testing.assert_array_equal(np.round(U, 15), np.round(U.transpose(0, 2, 1), 15))


def test_a_missing_path_or_folder_says_what_to_give(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"--set dataset\.path=DIR, where DIR contains Barcodes\.dat"):
        load(settings(None))
    with pytest.raises(DatasetError, match=r"no folder .*nowhere: --set dataset\.path=DIR"):
        load(settings(tmp_path / "nowhere"))
    with pytest.raises(DatasetError, match=r"usable are \[\]; robot1 lacks Robot1_Odometry\.dat and Robot1_Meas"):
        load(settings(tmp_path))


@pytest.mark.parametrize("name", ["Barcodes", "Landmark_Groundtruth", "Robot1_Groundtruth"])
def test_a_missing_file_is_named(world: World, tmp_path: Path, name: str) -> None:
    with pytest.raises(DatasetError, match=rf"{name}\.dat is missing"):
        load(settings(world.without(name).write(tmp_path)))


def test_a_track_that_begins_after_the_odometry_is_refused_for_want_of_a_start_pose(
    world: World, tmp_path: Path
) -> None:
    late = world.change("Robot1_Groundtruth", lambda rows: rows[500:]).write(tmp_path)
    with pytest.raises(DatasetError, match=r"Robot1_Groundtruth\.dat has no pose .* start pose"):
        load(settings(late))


@pytest.mark.parametrize("line", ["1600000001.5 0.1", "1600000001.5 0.1 zero", "1600000001.5 nan 0", "1 2 3 4"])
def test_a_malformed_row_is_named_by_file_and_line(world: World, tmp_path: Path, line: str) -> None:
    path = world.write(tmp_path) / "Robot2_Odometry.dat"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:41], line, *lines[41:]]))
    with pytest.raises(DatasetError, match=rf"Robot2_Odometry\.dat, line 42: expected 3 numbers .*got '{line}'"):
        load(settings(tmp_path))


@pytest.mark.parametrize("barcode", [7.5, -1])
def test_a_barcode_that_is_not_a_whole_number_is_refused(world: World, tmp_path: Path, barcode: float) -> None:
    odd = world.change("Robot1_Measurement", lambda rows: [(10, barcode, 1.0, 0.0), *rows])
    with pytest.raises(DatasetError, match=r"Robot1_Measurement\.dat, line 2: expected 4 numbers"):
        load(settings(odd.write(tmp_path)))


def test_a_barcode_with_two_subjects_is_refused(world: World, tmp_path: Path) -> None:
    odd = world.change("Barcodes", lambda rows: [*rows, (10, 72)])
    with pytest.raises(DatasetError, match="a barcode stands twice"):
        load(settings(odd.write(tmp_path)))


def test_an_empty_measurement_file_gives_a_log_without_sightings_and_other_empty_files_are_refused(
    world: World, tmp_path: Path
) -> None:
    blind = world.change("Robot1_Measurement", lambda rows: [])
    assert len(load(settings(blind.write(tmp_path / "blind"))).logs["robot1"].sighting_step) == 0
    still = world.change("Robot1_Odometry", lambda rows: [])
    with pytest.raises(DatasetError, match=r"Robot1_Odometry\.dat has no rows"):
        load(settings(still.write(tmp_path / "still")))


def test_a_duration_that_ends_before_a_robot_starts_is_refused(folder: Path) -> None:
    with pytest.raises(DatasetError, match=r"no motion of robot2 .* larger dataset\.duration_s"):
        load(settings(folder, duration_s=1.0))


def test_a_stamp_far_off_is_refused_rather_than_filled_with_steps(world: World, tmp_path: Path) -> None:
    odd = world.change("Robot1_Odometry", lambda rows: [*rows, (1_000_000_000, 0.0, 0.0)])
    with pytest.raises(DatasetError, match="steps of at most"):
        load(settings(odd.write(tmp_path)))


def test_settings_refuse_unknown_keys_and_values_out_of_range() -> None:
    for wrong in ({"range_sigma": 1.0}, {"step_s": 0.0}, {"bearing_std_rad": 0.0}, {"range_bias_per_m": -1.0}):
        with pytest.raises(ValidationError):
            settings(None, **wrong)


@pytest.fixture(scope="module", params=[2, 6])
def real(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[int, Path]:
    return request.param, real_data.mrclam(request.param, tmp_path_factory)


def test_real_data_hold_the_published_number_of_sightings(real: tuple[int, Path]) -> None:
    number, path = real
    recording = load(settings(path))
    published = {2: [6852, 6309, 8695, 4011, 11483], 6: [1534, 3239, 4348, 2023, 4239]}[number]
    assert [len(log.sighting_step) for log in recording.logs.values()] == published
    assert recording.skipped["barcode not in the table"] == {2: 11, 6: 6}[number]
    assert recording.landmarks.shape == (15, 2)


def test_real_odometry_strays_from_the_truth_as_others_found(real: tuple[int, Path]) -> None:
    number, path = real
    log = load(settings(path, duration_s=60.0), only="robot1").logs["robot1"]
    error = dead_reckoning(log)[-1, :2] - log.truth_pose[-1, :2]
    assert np.hypot(*error) == pytest.approx({2: 0.54, 6: 0.21}[number], abs=0.02)


def test_declared_noise_of_real_sightings_is_about_what_truth_shows(real: tuple[int, Path]) -> None:
    recording = load(DatasetSettings(kind="mrclam", path=real[1]))
    squares = []
    for log in recording.logs.values():
        pose = log.truth_pose[log.sighting_step]
        offset = recording.landmarks[log.sighting_truth] - pose[:, :2]
        bearing = np.arctan2(offset[:, 1], offset[:, 0]) - pose[:, 2]
        error = log.sighting_z - np.column_stack([np.hypot(offset[:, 0], offset[:, 1]), bearing])
        error[:, 1] = np.remainder(error[:, 1] + np.pi, 2 * np.pi) - np.pi
        squares.append(error**2 / np.diagonal(log.sighting_cov, axis1=1, axis2=2))
    square = np.concatenate(squares)
    square = square[np.isfinite(square).all(axis=1)]
    inlier = square.sum(axis=1) < 30
    assert inlier.mean() > 0.998
    assert 0.7 < square[inlier, 0].mean() < 1.1
    assert 0.3 < square[inlier, 1].mean() < 1.1
