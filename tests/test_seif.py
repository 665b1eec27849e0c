"""The filter as a whole: against a dense filter, against batch least squares, and what it publishes."""

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fleet_seif import joint
from fleet_seif import seif as seif_module
from fleet_seif import seif_step as kernels
from fleet_seif.config import FilterSettings
from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.information import (
    B_QUANTUM,
    H_QUANTUM,
    FrameTotal,
    delta_digest,
    to_information,
)
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats, Reading, Sightings
from fleet_seif.seif import Seif
from fleet_seif.seif_arrays import LINKS_EACH, used
from tests import reference
from tests.drives import Drive, drive, landmark_of, reading, sighting, square, sum_deltas

DENSE = FilterSettings(active_max=1000, gate=1e300)
SPARSE = FilterSettings(active_max=6)


def run(settings: FilterSettings, log: Drive, model: int = RANGE_BEARING) -> tuple[Seif, FrameTotal]:
    """The filter after a drive, and the sum of what it published."""
    seif, total = Seif(settings, model), FrameTotal()
    total.add(seif.start(log.start).delta)
    for each in log.readings:
        total.add(seif.step(each).delta)
    return seif, total


def dense_information(seif: Seif) -> tuple[Floats, Floats]:
    H, b = seif.information()
    return H.toarray(), b


def mean_of(seif: Seif) -> Floats:
    return np.concatenate([seif.pose, seif.landmarks.ravel()])


def state_of(seif: Seif) -> list[bytes]:
    """Every bit that a filter carries from step to step."""
    arrays = [array.tobytes() for array in used(seif._s).values()]
    assert not np.any(seif._s.local[: len(seif.signatures) + 8])
    return [*arrays, repr(seif.signatures).encode(), repr(seif._names._number).encode()]


# Against a dense filter.


@pytest.mark.parametrize("model", [RANGE_BEARING, COMPASS_XY])
def test_without_sparsification_it_is_the_dense_information_filter(model: int) -> None:
    """H and b relative to the square root of the reference's diagonal, the mean in units of its sigma."""
    log = drive(square(12, 4.0, 1), steps=1000, seed=2, model=model)
    seif, dense = Seif(DENSE, model), reference.DenseEif(model, DENSE.start_information)
    seif.start(log.start)
    dense.see(log.start)
    for k, each in enumerate(log.readings, 1):
        seif.step(each)
        dense.step(each)
        if k % 100 == 0:
            H, b = dense_information(seif)
            scale = np.sqrt(np.diag(dense.H)).astype(float)
            sigma = np.sqrt(np.diag(np.linalg.inv(dense.H.astype(float))))
            assert np.max(np.abs(H - dense.H) / np.outer(scale, scale)) < 1e-9
            assert np.max(np.abs(b - dense.b) / scale) < 1e-9 * np.max(np.abs(dense.b) / scale)
            assert np.max(np.abs(mean_of(seif) - dense.mu) / sigma) < 1e-9
    assert len(seif.landmarks) == 12


# The linear world, where a filter has to be exact.


def test_in_the_linear_world_its_mean_is_batch_least_squares() -> None:
    log = drive(square(8, 4.0, 4), steps=150, seed=5, model=COMPASS_XY)
    seif, _ = run(DENSE, log, COMPASS_XY)
    ends, landmarks, _ = reference.batch(COMPASS_XY, [(np.zeros(3), DENSE.start_information, log.start, log.readings)])
    np.testing.assert_allclose(seif.pose, ends[0], rtol=1e-9, atol=1e-9)
    for number, signature in enumerate(seif.signatures):
        np.testing.assert_allclose(seif.landmarks[number], landmarks[signature], rtol=1e-9, atol=1e-9)


@cache
def linear_trio() -> tuple[tuple[Drive, Seif, FrameTotal], ...]:
    starts = ((0.0, -1.0, 0.0), (1.5, 0.5, 0.0), (-1.0, 1.0, 0.0))
    runs = []
    for i, start in enumerate(starts):
        log = drive(square(10, 4.0, 6), steps=50, seed=20 + i, model=COMPASS_XY, start_pose=start)
        runs.append((log, *run(DENSE, log, COMPASS_XY)))
    return tuple(runs)


@cache
def linear_batch() -> tuple[list[Floats], dict[int, Floats], Floats]:
    return reference.batch(
        COMPASS_XY,
        [(log.start_pose, DENSE.start_information, log.start, log.readings) for log, _, _ in linear_trio()],
    )


def test_in_the_linear_world_the_sum_of_three_filters_is_the_batch_over_all_readings() -> None:
    """The filters' own H and b, summed densely over landmarks of one signature, poses apart."""
    ends, landmarks, _ = linear_batch()
    signatures = list(landmarks)
    n = 2 * len(signatures) + 9
    H, b = np.zeros((n, n)), np.zeros(n)
    for i, (log, seif, _) in enumerate(linear_trio()):
        own_H, own_b = dense_information(seif)
        rows = [2 * len(signatures) + 3 * i + r for r in range(3)]
        rows += [2 * signatures.index(s) + r for s in seif.signatures for r in range(2)]
        shift = np.concatenate([log.start_pose, np.tile(log.start_pose[:2], len(seif.signatures))])
        H[np.ix_(rows, rows)] += own_H
        b[rows] += own_b + own_H @ shift
    x = reference.solve(H, b).astype(float)
    for k, signature in enumerate(signatures):
        np.testing.assert_allclose(x[2 * k : 2 * k + 2], landmarks[signature], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(x[-9:].reshape(3, 3), ends, rtol=1e-9, atol=1e-9)


def test_in_the_linear_world_the_joint_map_of_three_vehicles_is_the_batch_over_all_readings() -> None:
    """After quantisation, within 1e-4 sigma."""
    ends, landmarks, std = linear_batch()
    lives = [
        joint.Life(
            vehicle=f"v{i}", life=0, start_pose=log.start_pose, start_pose_cov=np.zeros((3, 3)),
            frames=(total.delta(),), signatures=tuple(seif.signatures),
        )
        for i, (log, seif, total) in enumerate(linear_trio())
    ]  # fmt: skip
    solution = joint.solve(lives, joint.landmark_classes(lives))
    assert sorted(solution.signatures) == sorted(landmarks)
    expected = np.array([landmarks[s] for s in solution.signatures])
    sigma = np.array([std[list(landmarks).index(s)] for s in solution.signatures])
    assert np.max(np.abs(solution.landmark_mean - expected) / sigma) < 1e-4
    _, pose_cov = joint.marginal_covariances(solution)
    pose_sigma = np.sqrt(np.diagonal(pose_cov, axis1=1, axis2=2))
    assert np.max(np.abs(solution.pose_mean - np.array(ends)) / pose_sigma) < 1e-4


# What holds at every step, with sparsification.


def test_at_every_step_it_is_sparse_positive_definite_and_equals_the_sum_of_its_deltas() -> None:
    log = drive(square(25, 5.0, 7), steps=400, seed=8)
    seif, total = Seif(SPARSE), FrameTotal()
    total.add(seif.start(log.start).delta)
    for each in log.readings:
        total.add(seif.step(each).delta)
        H, b = dense_information(seif)
        assert np.array_equal(H, H.T)
        assert np.linalg.eigvalsh(H)[0] > 0.0
        assert len(seif.active) <= SPARSE.active_max
        linked = np.flatnonzero(np.any(H[:3, 3:].reshape(3, -1, 2) != 0.0, axis=(0, 2)))
        assert seif.active.tolist() == linked.tolist()
        check_total(total, H, b)


def check_total(total: FrameTotal, H: Floats, b: Floats) -> None:
    """The published sum: within rounding and loading of the filter's, positive definite, of the same mean."""
    info = to_information(total.delta())
    n = len(b)
    assert info.variables.tolist() == list(range(1 + (n - 3) // 2))
    published = info.H.toarray()
    load = 0.5 * H_QUANTUM * n
    excess = published - H
    diagonal = np.diag(excess).copy()
    np.fill_diagonal(excess, 0.0)
    assert np.max(np.abs(excess)) <= 0.5 * H_QUANTUM
    assert np.all(np.count_nonzero(published, axis=1) * 0.5 * H_QUANTUM <= diagonal + 0.5 * H_QUANTUM)
    assert np.all(diagonal <= load + 0.5 * H_QUANTUM)
    mean = np.linalg.solve(H, b)
    assert np.max(np.abs(info.b - b)) <= 0.5 * B_QUANTUM + 1.5 * load * np.max(np.abs(mean))
    assert np.linalg.eigvalsh(published)[0] > 0.0
    sigma = np.sqrt(np.diag(np.linalg.inv(H)))
    assert np.max(np.abs(np.linalg.solve(published, info.b) - mean) / sigma) < 1e-3


@pytest.mark.parametrize("landmarks", [20, 200])
def test_a_delta_names_the_pose_and_what_was_active_or_sighted_at_any_map_size(landmarks: int) -> None:
    log = drive(square(landmarks, 4.0, 9), steps=150, seed=10)
    seif = Seif(SPARSE)
    seif.start(log.start)
    for each in log.readings:
        before = set(seif.active.tolist())
        result = seif.step(each)
        seen = {seif.signatures.index(s) for s in each.sightings.signature.tolist()}
        assert set(result.delta.variables.tolist()) <= {0} | {n + 1 for n in before | seen}
    assert len(seif.landmarks) > landmarks // 2


def test_what_it_says_it_has_published_is_the_sum_of_its_deltas() -> None:
    log = drive(square(25, 5.0, 7), steps=100, seed=8)
    seif, total = Seif(SPARSE), FrameTotal()
    total.add(seif.start(log.start).delta)
    for each in log.readings:
        total.add(seif.step(each).delta)
        assert delta_digest(sum_deltas([seif.published()])) == delta_digest(total.delta())


def test_it_stays_close_to_the_truth_with_sparsification() -> None:
    log = drive(square(25, 5.0, 7), steps=400, seed=8)
    seif, _ = run(SPARSE, log)
    truth = np.array([reference.seen_from(log.start_pose, y) for y in square(25, 5.0, 7)])
    expected = np.array([truth[landmark_of(s)] for s in seif.signatures])
    assert np.sqrt(np.mean(np.sum((seif.landmarks - expected) ** 2, axis=1))) < 0.05


def test_landmarks_are_numbered_in_the_order_of_their_first_sighting() -> None:
    log = drive(square(25, 5.0, 7), steps=50, seed=8)
    seif = Seif(SPARSE)
    results = [seif.start(log.start), *(seif.step(each) for each in log.readings)]
    first_seen: dict[int, None] = {}
    for seen in [log.start, *(each.sightings for each in log.readings)]:
        first_seen |= dict.fromkeys(seen.signature.tolist())
    assert seif.signatures == list(first_seen)
    assert [s for result in results for s in result.new] == list(first_seen)
    assert [r.first_new for r in results] == [sum(len(q.new) for q in results[:k]) for k in range(len(results))]


def test_two_first_sightings_of_one_landmark_in_one_step_make_one_landmark() -> None:
    twice = Sightings(
        z=np.array([[1.0, 0.1], [1.02, 0.12]]),
        cov=np.tile(np.diag([1e-4, 4e-4]), (2, 1, 1)),
        signature=np.array([5, 5]),
    )
    seif, dense = Seif(DENSE), reference.DenseEif(RANGE_BEARING, DENSE.start_information)
    seif.start(twice)
    dense.see(twice)
    assert seif.signatures == [5]
    H, _ = dense_information(seif)
    np.testing.assert_allclose(H, dense.H.astype(float), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(mean_of(seif), dense.mu, atol=1e-12)


# The mean that is recovered.


def test_after_a_step_the_mean_solves_the_rows_of_the_pose_and_of_what_was_active_or_sighted() -> None:
    log = drive(square(25, 5.0, 7), steps=100, seed=8)
    seif = Seif(FilterSettings(active_max=4, relax_others=0))
    seif.start(log.start)
    for each in log.readings:
        before = set(seif.active.tolist())
        seif.step(each)
        touched = before | {seif.signatures.index(s) for s in each.sightings.signature.tolist()}
        rows = [0, 1, 2, *(3 + 2 * n + axis for n in touched for axis in (0, 1))]
        H, b = dense_information(seif)
        assert np.max(np.abs(H @ mean_of(seif) - b)[rows]) < 1e-9 * np.max(np.abs(b))


def relax_all(seif: Seif) -> None:
    for y in range(len(seif.landmarks)):
        kernels.relax(seif._s, y)


def test_relaxing_the_others_again_and_again_solves_for_all_landmarks_given_the_pose() -> None:
    seif, _ = run(SPARSE, drive(square(25, 5.0, 7), steps=100, seed=8))
    H, b = dense_information(seif)
    pose = seif.pose
    exact = np.linalg.solve(H[3:, 3:], b[3:] - H[3:, :3] @ pose)
    for _ in range(20):
        off = seif.landmarks.ravel() - exact
        relax_all(seif)
        closer = seif.landmarks.ravel() - exact
        assert closer @ H[3:, 3:] @ closer <= off @ H[3:, 3:] @ off + 1e-12
    for _ in range(3000):
        relax_all(seif)
    np.testing.assert_allclose(seif.landmarks.ravel(), exact, rtol=0.0, atol=1e-9)
    assert np.array_equal(seif.pose, pose)


# Readings that are refused.


def bent(part: str, value: Any) -> Callable[[Reading], Reading]:
    """A reading with one field replaced."""

    def bend(good: Reading) -> Reading:
        if part in ("z", "cov", "signature"):
            return dataclasses.replace(good, sightings=dataclasses.replace(good.sightings, **{part: value}))
        return dataclasses.replace(good, **{part: value})

    return bend


GOOD_Z = np.array([[1.0, 0.2], [0.8, -0.5]])
BAD = {
    "odometry not a number": bent("odometry", np.array([0.1, np.nan, 0.0])),
    "odometry infinite": bent("odometry", np.array([np.inf, 0.0, 0.0])),
    "odometry covariance not a number": bent("odometry_cov", np.full((3, 3), np.nan)),
    "odometry covariance singular": bent("odometry_cov", np.diag([1e-4, 0.0, 1e-4])),
    "odometry covariance indefinite": bent("odometry_cov", np.eye(3) - 0.6),
    "range not a number": bent("z", np.array([[1.0, 0.2], [np.nan, 0.0]])),
    "bearing infinite": bent("z", np.array([[1.0, np.inf], [0.8, -0.5]])),
    "sighting covariance not a number": bent("cov", np.array([np.eye(2), np.full((2, 2), np.nan)])),
    "sighting covariance singular": bent("cov", np.array([np.eye(2), np.ones((2, 2))])),
    "sighting covariance negative": bent("cov", np.array([-np.eye(2), np.eye(2)])),
    "signature missing": bent("signature", np.array([4, -1])),
    "signature negative": bent("signature", np.array([-7, 5])),
}


@pytest.mark.parametrize("bend", BAD.values(), ids=BAD.keys())
def test_a_refused_reading_leaves_every_bit_of_the_filter_as_it_was(bend: Callable[[Reading], Reading]) -> None:
    """One sighting is of a known landmark, the other of a new one, so that both paths have something to undo."""
    log = drive(square(12, 4.0, 1), steps=20, seed=2)
    seif, _ = run(SPARSE, log)
    good = reading(
        9.0, Sightings(z=GOOD_Z, cov=np.tile(np.eye(2), (2, 1, 1)), signature=np.array([seif.signatures[0], 5]))
    )
    before = state_of(seif)
    with pytest.raises(ReadingRefused):
        seif.step(bend(good))
    assert state_of(seif) == before
    seif.step(good)
    assert state_of(seif) != before


def test_a_number_beyond_the_quanta_is_refused_and_leaves_the_filter_as_it_was() -> None:
    seif, _ = run(SPARSE, drive(square(12, 4.0, 1), steps=20, seed=2))
    before = state_of(seif)
    with pytest.raises(ReadingRefused, match="quanta"):
        seif.step(reading(9.0, sighting((1.0, 0.0), 5, std=(1e-6, 1e-6))))
    assert state_of(seif) == before


def test_a_landmark_at_the_place_of_the_pose_is_refused_and_leaves_the_filter_as_it_was() -> None:
    seif, _ = run(SPARSE, drive(square(12, 4.0, 1), steps=20, seed=2))
    before = state_of(seif)
    with pytest.raises((NumericalError, ReadingRefused)):
        seif.step(reading(9.0, sighting((0.0, 0.0), 5)))
    assert state_of(seif) == before


# The gate.


def test_an_outlier_is_refused_and_counted_and_changes_what_motion_alone_would() -> None:
    gated, blind = (run(SPARSE, drive(square(12, 4.0, 1), steps=20, seed=2))[0] for _ in range(2))
    result = gated.step(reading(9.0, sighting((1.4, 3.0), gated.signatures[0])))
    motion = blind.step(reading(9.0, Sightings.none()))
    assert result.refused == 1
    assert (result.sightings, result.innovation) == (0, 0.0)
    H, b = dense_information(gated)
    expected_H, expected_b = dense_information(blind)
    np.testing.assert_allclose(H, expected_H, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(b, expected_b, rtol=1e-9, atol=1e-6)
    assert motion.refused == 0


def patience_filter(patience: int) -> Seif:
    seif = Seif(FilterSettings(gate_patience=patience))
    seif.start(sighting((1.0, 0.0), 5))
    return seif


def see(seif: Seif, time_s: float, z: tuple[float, float]) -> int:
    return seif.step(reading(time_s, sighting(z, 5), u=(0.0, 0.0, 0.0))).refused


@pytest.mark.parametrize("patience", [1, 3])
def test_after_as_many_refusals_in_a_row_as_its_patience_a_sighting_is_believed(patience: int) -> None:
    seif = patience_filter(patience)
    before = seif.landmarks[0]
    assert [see(seif, t, (2.0, 0.5)) for t in range(patience + 1)] == [1] * patience + [0]
    assert np.hypot(*(seif.landmarks[0] - before)) > 0.05


def test_a_sighting_that_fits_starts_the_count_of_refusals_again() -> None:
    seif = patience_filter(3)
    refused = [see(seif, t, z) for t, z in enumerate([(2.0, 0.5), (2.0, 0.5), (1.0, 0.0), (2.0, 0.5), (2.0, 0.5)])]
    assert refused == [1, 1, 0, 1, 1]


def test_innovations_have_two_degrees_of_freedom_each() -> None:
    """The mean over a run of a filter without sparsification; its sum is chi-square distributed."""
    log = drive(square(12, 4.0, 1), steps=300, seed=12, model=COMPASS_XY)
    seif = Seif(DENSE, COMPASS_XY)
    seif.start(log.start)
    results = [seif.step(each) for each in log.readings]
    dof = 2 * sum(r.sightings for r in results)
    assert abs(sum(r.innovation for r in results) - dof) < 5.0 * np.sqrt(2.0 * dof)


# Growth.


def crowd() -> Drive:
    """A start that sees 90 landmarks at once, then a drive among 150: past every capacity a filter starts with."""
    landmarks = square(150, 4.0, 13)
    log = drive(landmarks, steps=80, seed=14, most=12)
    return dataclasses.replace(log, start=drive(landmarks, steps=0, seed=15, range_m=9.0, most=90).start)


def test_growing_past_the_links_that_are_reserved_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    log = crowd()
    with monkeypatch.context() as patch:
        patch.setattr(seif_module, "LINKS_EACH", 1)
        tight = SPARSE.model_copy(update={"landmarks_max": 400})
        before = len(Seif(tight)._s.H_link)
        grown, grown_total = run(tight, log)
    assert len(grown._s.H_link) > before
    roomy, roomy_total = run(SPARSE, log)
    assert len(roomy._s.H_link) == LINKS_EACH * SPARSE.landmarks_max
    assert delta_digest(grown_total.delta()) == delta_digest(roomy_total.delta())
    assert mean_of(grown).tobytes() == mean_of(roomy).tobytes()


# Kernels as ordinary Python.


def published_by_small_runs() -> dict[str, Floats]:
    """Means and published sums of every kind of filter and every option that takes another way through the kernels."""
    log = drive(square(10, 4.0, 16), steps=60, seed=17)
    found: dict[str, Floats] = {}
    for options in (
        {}, {"kind": "eif"}, {"kind": "eseif"}, {"strength": "raw"}, {"strength": "kl", "soften": 0.5},
        {"neighbours_max": 6},
    ):  # fmt: skip
        seif, total = run(FilterSettings.model_validate({"active_max": 4, **options}), log)
        delta = total.delta()
        values = {**vars(delta), "mean": mean_of(seif), "blanket": seif.blanket_covariance([0, 7])}
        found |= {f"{name} {options}": np.asarray(value) for name, value in values.items()}
    return found


WITHOUT_JIT = """
import sys
import numba, numpy as np
from tests.test_seif import published_by_small_runs
assert numba.config.DISABLE_JIT
np.savez(sys.argv[1], **published_by_small_runs())
"""


def test_kernels_run_as_ordinary_python_too_with_the_same_result(tmp_path: Path) -> None:
    out = tmp_path / "plain.npz"
    subprocess.run(
        [sys.executable, "-c", WITHOUT_JIT, str(out)],
        check=True, timeout=100, cwd=Path(__file__).parents[1], env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )  # fmt: skip
    with np.load(out) as plain:
        for name, compiled in published_by_small_runs().items():
            if name.split()[0] in ("variables", "rows", "cols"):
                assert np.array_equal(plain[name], compiled)
            else:
                scale = float(np.max(np.abs(compiled)))
                np.testing.assert_allclose(plain[name], compiled, rtol=1e-12, atol=1e-12 * scale)


def test_two_kilometres_from_the_start_the_quanta_move_the_mean_by_less_than_a_thousandth_of_sigma() -> None:
    """The load on the diagonal pulls towards zero unless b is loaded too: far from the origin it would show."""
    seif, total = Seif(FilterSettings(active_max=4)), FrameTotal()
    rng = np.random.default_rng(4)
    places = np.column_stack([np.arange(0.0, 2000.0, 10.0), rng.uniform(-8.0, 8.0, 200)])
    pose = np.zeros(3)
    total.add(seif.start(seen_from(places, pose)).delta)
    for k in range(1, 401):
        pose = pose + np.array([5.0, 0.0, 0.0])
        motion = np.array([5.0, 0.0, 0.0]) + rng.normal(size=3) * [0.05, 1e-3, 1e-3]
        cov = np.diag([0.05, 1e-3, 1e-3]) ** 2
        reading = Reading(time_s=float(k), odometry=motion, odometry_cov=cov, sightings=seen_from(places, pose))
        total.add(seif.step(reading).delta)
    H, b = seif.information()
    exact = np.linalg.solve(H.toarray(), b)
    info = to_information(total.delta())
    published = np.linalg.solve(info.H.toarray(), info.b)
    sigma = np.sqrt(np.diag(np.linalg.inv(H.toarray())))
    assert exact[3::2].max() > 1900.0
    assert np.max(np.abs(published - exact) / sigma) < 1e-3


def seen_from(places: Floats, pose: Floats) -> Sightings:
    """Exact sightings of the places within 25 m."""
    d = places - pose[:2]
    near = np.flatnonzero((np.hypot(*d.T) < 25.0) & (np.hypot(*d.T) > 1.0))
    z = np.column_stack([np.hypot(*d[near].T), np.arctan2(d[near, 1], d[near, 0]) - pose[2]])
    return Sightings(z=z, cov=np.tile(np.diag([0.04, 1e-4]), (len(near), 1, 1)), signature=near)
