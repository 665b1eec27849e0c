"""`fleet-seif evaluate`: what it says of a finished run, of the batch beside it, and of folders that are none."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenarios import batch, evaluate, output
from scenarios.batch import solve_batch
from scenarios.evaluate import fused_map, map_errors, pose_errors, ratio_to_batch, score_run, score_with_batch
from scenarios.report import FinishedRun, write_folder
from scenarios.report import evaluate as evaluate_run
from scenarios.stored_run import read_run
from tests.fleets import run_virtual
from tests.processes import invoke, refused

SETTINGS = ("fleet.vehicles=2", "world.steps=60", "world.landmarks=15", 'filter.frames="adaptive"')
FRAME_STEPS = 25


@pytest.fixture(scope="module")
def run() -> FinishedRun:
    return run_virtual("fleet", *SETTINGS)


@pytest.fixture(scope="module")
def folder(run: FinishedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a virtual run leaves."""
    made = tmp_path_factory.mktemp("run")
    output.prepare_folder(made)
    write_folder(made, run, evaluate_run(run))
    return made


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """One to break."""
    return Path(shutil.copytree(folder, tmp_path / "run"))


def test_a_folder_is_read_as_the_run_that_wrote_it(folder: Path, run: FinishedRun) -> None:
    stored = read_run(folder)
    np.testing.assert_array_equal(stored.recording.landmarks, run.recording.landmarks)
    assert list(stored.recording.logs) == list(run.recording.logs)
    for name, log in run.recording.logs.items():
        for field, value in vars(log).items():
            np.testing.assert_array_equal(getattr(stored.recording.logs[name], field), value, err_msg=field)
        np.testing.assert_array_equal(stored.assigned[name], run.drives[name].assigned)
        track, pose = stored.tracks[name], run.drives[name].pose
        np.testing.assert_allclose(track[:, :2], pose[:, :2], atol=1e-8)
        np.testing.assert_allclose(np.exp(1j * track[:, 2]), np.exp(1j * pose[:, 2]), atol=1e-7)


def test_the_scores_are_those_of_the_report(folder: Path) -> None:
    scored, report = score_run(read_run(folder)), json.loads((folder / "report.json").read_text())
    assert scored["map"]["landmarks"] == report["matched_landmarks"]
    assert scored["map"]["rmse_m"] == pytest.approx(report["landmark_rmse_m"], rel=1e-12)
    assert scored["map"]["rmse_aligned_m"] == pytest.approx(report["landmark_rmse_aligned_m"], rel=1e-12)
    assert scored["map"]["nees_per_dof"] == pytest.approx(report["nees_per_dof"], rel=1e-6)
    for name, row in report["vehicles"].items():
        assert {field: scored["vehicles"][name][field] for field in ASSOCIATION} == {f: row[f] for f in ASSOCIATION}
        assert scored["vehicles"][name]["live_rmse_m"] == pytest.approx(row["pose_rmse_m"], rel=1e-6)
        assert scored["vehicles"][name]["own_map_rmse_m"] == row["landmark_rmse_m"]
    mean = np.mean([row["bytes_per_step_mean"] for row in report["vehicles"].values()])
    assert scored["bytes_per_step_mean"] == pytest.approx(mean)


def test_a_folder_from_before_association_is_scored_without_it(copy: Path) -> None:
    path = copy / "readings" / "v1.npz"
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files if name != "sighting_assigned"}
    np.savez_compressed(path, **fields)
    scored = score_run(read_run(copy))
    assert scored["vehicles"]["v1"]["association_precision"] is None
    assert scored["vehicles"]["v2"]["association_precision"] == scored["association_precision"] == 1.0


def test_steps_that_a_killed_process_has_not_told_of_stay_unknown(copy: Path) -> None:
    path = copy / "trajectory" / "v1.tum"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:10] + lines[25:]) + "\n")
    track = read_run(copy).tracks["v1"]
    assert np.flatnonzero(np.isnan(track).all(axis=1)).tolist() == list(range(10, 25))
    assert score_run(read_run(copy))["vehicles"]["v1"]["live_rmse_m"] is not None


def test_joint_poses_are_those_of_the_steps_at_which_frames_end(folder: Path, run: FinishedRun) -> None:
    stored, solution = read_run(folder), evaluate_run(run).solution
    for name, log in run.recording.logs.items():
        poses = stored.joint_poses[name]
        held = np.flatnonzero(np.isfinite(poses).all(axis=1))
        assert held[-1] == log.steps
        assert np.all(np.diff(held, prepend=0) <= FRAME_STEPS)
        of_vehicle = [
            pose for pose, (vehicle, _, _) in zip(solution.pose_mean, solution.poses, strict=True) if vehicle == name
        ]
        np.testing.assert_allclose(poses[held], of_vehicle, atol=1e-9)
        off = np.hypot(*(poses[held, :2] - log.truth_pose[held, :2]).T)
        assert np.max(off) < 0.5 * np.median(np.hypot(*np.diff(log.truth_pose[held, :2], axis=0).T))
    assert score_run(stored)["trajectory"]["poses"] == len(solution.poses)


def test_a_pose_whose_message_is_gone_is_not_compared(copy: Path) -> None:
    with np.load(copy / "map.npz") as file:
        arrays = dict(file)
    arrays["pose_time_s"][0] = np.nan
    np.savez_compressed(copy / "map.npz", **arrays)
    assert score_run(read_run(copy))["trajectory"]["poses"] == len(arrays["pose_time_s"]) - 1


def test_alignment_takes_out_a_rotation_and_a_translation_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    truth = rng.normal(size=(40, 3))
    c, s = math.cos(0.7), math.sin(0.7)
    moved = truth.copy()
    moved[:, :2] = truth[:, :2] @ np.array([[c, s], [-s, c]]) + [3.0, -2.0]
    moved[5], truth[6] = np.nan, np.nan
    errors = pose_errors([moved[:15], moved[15:]], [truth[:15], truth[15:]])
    assert errors.poses == 38
    assert errors.rmse_m is not None
    assert errors.rmse_m > 1.0
    assert errors.rmse_aligned_m == pytest.approx(0.0, abs=1e-12)
    assert pose_errors([2.0 * moved], [truth]).rmse_aligned_m != pytest.approx(0.0, abs=0.1)
    assert pose_errors([moved], [np.full_like(truth, np.nan)]).rmse_m is None


def test_landmarks_without_truth_are_not_scored(run: FinishedRun) -> None:
    ours = fused_map(run)
    unknown = replace(ours, truth=np.full_like(ours.truth, -1))
    errors = map_errors(unknown, run.recording.landmarks)
    assert (errors.landmarks, errors.rmse_m, errors.nees_per_dof, errors.nees_low) == (0, None, None, None)
    some = map_errors(ours, run.recording.landmarks, only={0, 1, 2})
    assert some.landmarks == len({0, 1, 2} & set(ours.truth.tolist()))


def test_the_band_is_that_of_chi_square(run: FinishedRun) -> None:
    errors = map_errors(fused_map(run), run.recording.landmarks)
    assert errors.nees_low is not None
    assert errors.nees_high is not None
    draws = np.random.default_rng(2).normal(size=(20_000, 2 * errors.landmarks))
    nees = np.mean(draws**2, axis=1)
    assert np.mean((errors.nees_low < nees) & (nees < errors.nees_high)) == pytest.approx(0.95, abs=0.01)


def test_the_batch_stands_beside_a_run(folder: Path, run: FinishedRun) -> None:
    pytest.importorskip("gtsam")
    scored = score_with_batch(read_run(folder))
    found = ratio_to_batch(run)
    assert scored["ratio"]["map_rmse"] == pytest.approx(found.ratio, rel=1e-4)
    assert scored["ratio"]["map_rmse_aligned"] == pytest.approx(found.ratio_aligned, rel=1e-4)
    assert found.ratio == ratio_to_batch(run, solve_batch(run.recording)).ratio
    assert scored["batch"]["map"]["rmse_m"] == pytest.approx(found.batch.rmse_m, rel=1e-4)
    assert scored["batch"]["chi_square_per_dof"] == pytest.approx(1.0, abs=0.3)
    for name, row in scored["ratio"]["vehicles"].items():
        ours, theirs = scored["vehicles"][name], scored["batch"]["vehicles"][name]
        for kind in ("live_rmse", "live_rmse_aligned", "joint_rmse", "joint_rmse_aligned"):
            assert row[kind] == pytest.approx(ours[f"{kind}_m"] / theirs[f"{kind}_m"])
    assert scored["batch"]["trajectory"]["poses"] == scored["trajectory"]["poses"] > 2
    ours_m, theirs_m = scored["trajectory"]["rmse_m"], scored["batch"]["trajectory"]["rmse_m"]
    assert scored["ratio"]["trajectory_rmse"] == pytest.approx(ours_m / theirs_m)


ASSOCIATION = {"association_precision", "association_recall", "duplicate_landmarks", "spurious_landmarks"}
SCORES = {"format", "scenario", "seed", "map", "trajectory", "vehicles", "bytes_per_step_mean", *ASSOCIATION}


def test_the_command_prints_a_table_or_json_and_needs_no_gtsam(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(batch, "import_module", missing)
    said = invoke("evaluate", str(folder))
    assert said.exit_code == 0, said.stderr
    for word in ("fused", "NEES per dof", "95% band", "v1", "v2", "bytes a step", "live pose", "joint pose"):
        assert word in said.stdout
    assert "ratio" not in said.stdout
    as_json = invoke("evaluate", str(folder), "--json")
    assert set(json.loads(as_json.stdout)) == SCORES
    for option in ("--batch", "--robust"):
        assert "pip install 'fleet-seif[bench]'" in refused(1, "evaluate", str(folder), option)


def test_the_command_sets_the_batch_beside(folder: Path) -> None:
    pytest.importorskip("gtsam")
    beside = invoke("evaluate", str(folder), "--batch")
    assert beside.exit_code == 0, beside.stderr
    for word in ("batch", "ratio", "chi-square per dof"):
        assert word in beside.stdout
    as_json = invoke("evaluate", str(folder), "--robust", "--json")
    assert as_json.exit_code == 0, as_json.stderr
    scored = json.loads(as_json.stdout)
    assert scored["batch"]["robust"] is True
    assert set(scored) == {*SCORES, "batch", "ratio"}


def test_a_batch_that_does_not_fit_says_what_to_do(folder: Path) -> None:
    pytest.importorskip("gtsam")
    scored = score_with_batch(read_run(folder))
    assert "--robust" not in evaluate._remarks(scored)
    scored["batch"]["chi_square_per_dof"] = 2.0
    assert "--robust" in evaluate._remarks(scored)


def test_a_folder_without_a_finished_run_is_refused_in_a_sentence(tmp_path: Path) -> None:
    for each in (tmp_path, tmp_path / "missing"):
        said = refused(1, "evaluate", str(each))
        assert "no report.json" in said
        assert "fleet-seif run SCENARIO --out" in said


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("report.json", b"{"),
        ("report.json", b"[]"),
        ("report.json", b'{"format": 1}'),
        ("report.json", b'{"format": 99}'),
        ("map.npz", None),
        ("map.npz", b"PK\x03\x04"),
        ("truth.npz", b""),
        ("readings/v2.npz", None),
        ("readings/v1.npz", b"nothing of the kind"),
        ("trajectory/v1.tum", None),
        ("trajectory/v1.tum", b"1 2 3\n"),
    ],
)
def test_a_damaged_folder_is_refused_in_a_sentence(copy: Path, name: str, content: bytes | None) -> None:
    if content is None:
        (copy / name).unlink()
    else:
        (copy / name).write_bytes(content)
    assert str(copy / name) in refused(1, "evaluate", str(copy))


def test_readings_with_a_part_missing_are_refused(copy: Path) -> None:
    path = copy / "readings" / "v1.npz"
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files if name != "odometry_cov"}
    np.savez_compressed(path, **fields)
    assert "odometry_cov" in refused(1, "evaluate", str(copy))
