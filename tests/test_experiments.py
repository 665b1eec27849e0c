"""Experiments: what they measure is right, and every one of them leaves a figure, a CSV and a summary."""

import csv
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from fleet_seif.errors import NumericalError
from fleet_seif.geometry import act_all, compose, compose_jacobians
from fleet_seif.jit import one_thread
from fleet_seif.models import COMPASS_XY
from fleet_seif.records import Floats
from scenarios.experiments.association import likelihood_errors
from scenarios.experiments.confidence import LINEAR, eseif
from scenarios.experiments.correlation import along_the_map, normalised, strengths
from scenarios.experiments.measures import (
    EIF,
    EKF,
    ONE_FRAME,
    Candidate,
    Outcome,
    compare,
    drive,
    log_det,
    map_error_m,
    nees_per_dof,
    outcome,
    relative_map,
    seif,
)
from scenarios.experiments.names import EXPERIMENTS, find_experiment, run_experiment
from scenarios.experiments.study import Row, csv_of, png_of, summary_of, write_csv, write_summary
from scenarios.experiments.worlds import World, compass_world, paper_world
from scenarios.score import chi_square_band
from tests.blankets import compared
from tests.processes import invoke, refused
from tests.strategies import settled

LANDMARKS, STEPS = 15, 120
SLOW = [pytest.mark.slow]
QUICKLY = [pytest.param(name, marks=[*SLOW, pytest.mark.alone] if name == "cost" else []) for name in EXPERIMENTS]
AGAIN = [pytest.param(name, marks=[] if name == "correlation" else SLOW) for name in EXPERIMENTS]
angles = st.floats(-3.0, 3.0)
metres = st.floats(-5.0, 5.0)


@cache
def small_world() -> World:
    return paper_world(LANDMARKS, 1, steps=STEPS)


def covariance(rows: int, rng: np.random.Generator) -> Floats:
    A = rng.standard_normal((rows, rows + 4))
    P: Floats = A @ A.T / rows
    return P


# What is measured.


@settled
@given(x=st.tuples(metres, metres, angles), seed=st.integers(0, 1000))
def test_the_jacobian_of_the_relative_map_predicts_a_small_change(x: tuple[float, float, float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, y = np.array(x), rng.uniform(-3, 3, (4, 2))
    d = 1e-6 * rng.standard_normal(11)
    q, J = relative_map(pose, y)
    moved, _ = relative_map(pose + d[:3], y + d[3:].reshape(-1, 2))
    assert_allclose((moved - q).ravel(), J @ d, atol=1e-10)


@settled
@given(T=st.tuples(metres, metres, angles), seed=st.integers(0, 1000))
def test_relative_nees_does_not_change_when_the_whole_frame_is_moved(T: tuple[float, float, float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, P = rng.uniform(-2, 2, 3), rng.uniform(-2, 2, (5, 2)), covariance(13, rng)
    true_x, true_y = x + 0.1 * rng.standard_normal(3), y + 0.1 * rng.standard_normal((5, 2))
    T_new_old = np.array(T)
    _, J_x = compose_jacobians(T_new_old, x)
    J_moved = np.kron(np.eye(5), J_x[:2, :2])
    J_all = np.block([[J_x, np.zeros((3, 10))], [np.zeros((10, 3)), J_moved]])

    def relative_nees(x: Floats, y: Floats, true_x: Floats, true_y: Floats, P: Floats) -> float:
        q, J = relative_map(x, y)
        return nees_per_dof(q - relative_map(true_x, true_y)[0], J @ P @ J.T)

    here = relative_nees(x, y, true_x, true_y, P)
    there = relative_nees(
        compose(T_new_old, x), act_all(T_new_old, y), compose(T_new_old, true_x), act_all(T_new_old, true_y),
        J_all @ P @ J_all.T,
    )  # fmt: skip
    assert_allclose(there, here, rtol=1e-6)


def test_nees_of_errors_drawn_with_the_claimed_covariance_is_near_one() -> None:
    rng = np.random.default_rng(7)
    P = covariance(20, rng)
    errors = rng.multivariate_normal(np.zeros(20), P, 500)
    low, high = chi_square_band(500 * 20)
    assert low < np.mean([nees_per_dof(error, P) for error in errors]) < high
    assert nees_per_dof(errors[0], P / 4) == pytest.approx(4 * nees_per_dof(errors[0], P))


def test_log_det_is_that_of_the_matrix_and_refuses_one_that_is_no_covariance() -> None:
    P = covariance(12, np.random.default_rng(3))
    assert log_det(P) == pytest.approx(np.linalg.slogdet(P)[1])
    with pytest.raises(NumericalError, match="not positive definite"):
        log_det(-P)


def test_the_band_holds_the_chi_square_mean_with_its_probability() -> None:
    rng = np.random.default_rng(5)
    low, high = chi_square_band(40)
    means = rng.chisquare(40, 20_000) / 40
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.01)


def test_normalised_entries_are_correlations_and_do_not_depend_on_units() -> None:
    rng = np.random.default_rng(2)
    P, scale = covariance(11, rng), np.exp(rng.standard_normal(11))
    assert_allclose(np.diag(normalised(P)), 1.0)
    assert_allclose(normalised(P * scale[:, None] * scale), normalised(P))
    assert_allclose(strengths(P), strengths(P).T)
    assert sorted(along_the_map(rng.uniform(0, 1, (23, 2))).tolist()) == list(range(23))


# Worlds and filters.


def test_the_frame_of_a_world_starts_at_its_first_pose_and_every_landmark_is_seen() -> None:
    world = paper_world(50, 3)
    assert_allclose(world.poses[0], 0.0, atol=1e-12)
    assert set(world.log.sighting_truth.tolist()) == set(range(50))
    seen = world.landmarks[world.log.sighting_truth] - world.poses[world.log.sighting_step, :2]
    distance = np.hypot(*seen.T)
    assert distance.min() >= 0.06
    assert distance.max() <= 0.2
    assert np.std(world.log.sighting_z[:, 0] - distance) == pytest.approx(np.sqrt(0.002), rel=0.1)


def test_a_filter_of_exact_readings_finds_the_true_map() -> None:
    world = compass_world(LANDMARKS, 1, 1e6, steps=STEPS)
    assert map_error_m(drive(seif(6).filter(world.model), world)) < 0.05


def test_the_same_candidate_in_the_same_world_does_the_same() -> None:
    first, second = (outcome(seif(6), drive(seif(6).filter(0), small_world())) for _ in range(2))
    assert untimed(vars(first)) == untimed(vars(second))


def test_ekf_and_eif_are_one_filter() -> None:
    ekf, eif = compare([EKF, EIF], [small_world], lambda done, total: None)
    assert ekf.error_m == pytest.approx(eif.error_m, rel=1e-6)
    assert ekf.log_det == pytest.approx(eif.log_det, rel=1e-6)
    assert ekf.nees_relative == pytest.approx(eif.nees_relative, rel=1e-5)


def test_a_seif_says_how_often_it_exceeds_its_bound_and_every_candidate_has_a_name_of_its_own() -> None:
    done = outcome(seif(4), drive(seif(4).filter(0), small_world()))
    assert done.over_bound == 0.0
    assert len({each.label for each in LINEAR}) == len(LINEAR)
    assert all(each.settings.frames == "single" for each in LINEAR)


@one_thread
def linear_nees(candidates: Sequence[Candidate], runs: int, landmarks: int, steps: int) -> dict[str, list[Outcome]]:
    worlds = [
        (lambda seed=seed: compass_world(landmarks, seed, ONE_FRAME.start_information, steps=steps))
        for seed in range(runs)
    ]
    outcomes = compare(candidates, worlds, lambda done, total: None)
    return {each.label: [o for o in outcomes if o.filter == each.label] for each in candidates}


def test_in_the_linear_world_the_ekf_is_consistent() -> None:
    of = linear_nees([EKF], 25, LANDMARKS, STEPS)["EKF"]
    low, high = chi_square_band(sum(2 * each.seen for each in of))
    assert low < np.average([each.nees_global for each in of], weights=[each.seen for each in of]) < high


@pytest.mark.slow
def test_in_the_linear_world_eseif_is_consistent_and_a_very_sparse_seif_is_not() -> None:
    outcomes = linear_nees([eseif(6), eseif(10), seif(4)], 100, 50, 1000)
    low, high = chi_square_band(100 * 100)
    means = {label: np.mean([each.nees_global for each in of]) for label, of in outcomes.items()}
    assert low < means["ESEIF 6"] < high
    assert low < means["ESEIF 10"] < high
    assert means["SEIF 4"] > 1.5


def test_the_likelihood_from_a_markov_blanket_is_exact_while_the_blanket_holds_the_map() -> None:
    assert np.median(likelihood_errors(seif(LANDMARKS).settings, small_world())) < 1e-6
    assert np.median(likelihood_errors(seif(4).settings, small_world())) < 0.05


def test_standard_deviations_from_a_markov_blanket_are_at_most_the_exact_ones_and_hold_for_the_whole_map() -> None:
    whole = compared(LANDMARKS, [small_world()])
    assert np.abs(np.array(whole.ratios) - 1.0).max() < 1e-6
    assert whole.differ == 0
    sparse = compared(4, [paper_world(50, 4, steps=400)])
    assert max(sparse.sizes) < 50
    assert 0.5 < min(sparse.ratios) < 0.99
    assert max(sparse.ratios) < 1.0 + 1e-6


def test_the_compass_world_is_read_with_a_linear_model() -> None:
    world = compass_world(LANDMARKS, 4, 1e6, steps=STEPS)
    assert world.model == COMPASS_XY
    seen = world.landmarks[world.log.sighting_truth] - world.poses[world.log.sighting_step, :2]
    assert np.std(world.log.sighting_z - seen) == pytest.approx(np.sqrt(0.002), rel=0.1)


# What an experiment leaves.


def untimed(row: dict[str, object]) -> dict[str, object]:
    return {name: value for name, value in row.items() if "_us" not in name}


def table_of(path: Path) -> list[dict[str, object]]:
    with path.open(encoding="utf-8", newline="") as file:
        return [untimed(dict(row)) for row in csv.DictReader(file)]


def quick(name: str, out: Path, seed: int = 1) -> list[tuple[int, int]]:
    """Run an experiment quickly; what it said of its progress."""
    told: list[tuple[int, int]] = []
    run_experiment(find_experiment(name), out, seed, True, lambda done, total: told.append((done, total)))
    return told


@pytest.mark.parametrize("name", QUICKLY)
def test_an_experiment_leaves_a_figure_a_csv_and_a_summary(name: str, tmp_path: Path) -> None:
    told = quick(name, tmp_path)
    assert told == sorted(told)
    assert told[-1][0] == told[-1][1]
    image = matplotlib.image.imread(png_of(tmp_path, name))
    assert image.shape[1] >= 1200
    assert image.std() > 0.05
    assert table_of(csv_of(tmp_path, name))
    summary = summary_of(tmp_path).read_text(encoding="utf-8")
    assert "--quick" in summary
    assert f"`fleet-seif experiment {name} --seed 1 --quick`" in summary
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.png", f"{name}.csv", "summary.md"}


@pytest.mark.parametrize("name", AGAIN)
def test_the_same_seed_gives_the_same_csv_but_for_times(name: str, tmp_path: Path) -> None:
    tables = []
    for seed in (1, 1, 2):
        quick(name, tmp_path, seed)
        tables.append(table_of(csv_of(tmp_path, name)))
    assert tables[0] == tables[1]
    assert tables[0] != tables[2]


def test_the_command_says_the_numbers_and_where_the_figure_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = invoke("experiment", "correlation", "--quick")
    assert done.exit_code == 0, done.output
    assert "figure: correlation/correlation.png" in done.output
    assert "landmark error" in done.output
    assert (tmp_path / "correlation" / "summary.md").is_file()


def test_an_unknown_experiment_is_refused_with_the_names_there_are() -> None:
    said = refused(2, "experiment", "speed")
    assert "no experiment 'speed'" in said
    assert all(name in said for name in ("correlation", "cost", "error", "sparsity", "confidence", "fleet"))


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_run(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    said = refused(1, "experiment", "fleet", "--out", str(tmp_path / "file" / "out"))
    assert "give another --out" in said


def test_a_summary_sets_the_papers_number_beside_ours(tmp_path: Path) -> None:
    rows = [Row(quantity="error, m", paper="0.05", ours="0.06"), Row(quantity="a | b", ours="1")]
    write_summary(tmp_path / "s.md", "Title", "command", rows, quick=False)
    lines = (tmp_path / "s.md").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "# Title"
    assert "| error, m | 0.05 | 0.06 | `command` |" in lines
    assert "| a \\| b | - | 1 | `command` |" in lines


def test_a_csv_has_the_columns_of_its_first_row_and_nine_digits(tmp_path: Path) -> None:
    write_csv(tmp_path / "t.csv", [{"a": 1, "b": 1 / 3}, {"b": "x", "a": 2}])
    assert (tmp_path / "t.csv").read_text(encoding="utf-8") == "a,b\n1,0.333333333\n2,x\n"
