"""The batch reference: against a dense least-squares solver of scipy, and against what its errors should be."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.errors import RunError
from fleet_seif.geometry import between
from fleet_seif.joint import marginal_chi_square
from fleet_seif.records import Floats
from scenarios import batch
from scenarios.batch import BatchSolution, Guess, solve_batch
from scenarios.detection import DetectionSettings, detected, without_signatures
from scenarios.evaluate import batch_map
from scenarios.recording import Log, Recording
from scenarios.world import NoiseSettings, WorldSettings, simulate
from tests.frames_against_batch import compare

MILD = NoiseSettings(forward_std_m=0.005, turn_std_rad=0.03, range_std_m=0.01, bearing_std_rad=0.02)
SEEDS = range(1, 11)


def world(seed: int, steps: int = 60, landmarks: int = 12) -> Recording:
    """Two vehicles with mild noise."""
    settings = WorldSettings(landmarks=landmarks, steps=steps, routes="coverage")
    return simulate(settings, MILD, ["v1", "v2"], seed)


def with_logs(recording: Recording, change: Callable[[Log], Log]) -> Recording:
    return replace(recording, logs={name: change(log) for name, log in recording.logs.items()})


def skewed(log: Log) -> Log:
    """Covariances that are far from round, different at every reading; the start of v2 is not given but a prior."""
    rng = np.random.default_rng(len(log.sighting_z))

    def skew(cov: Floats) -> Floats:
        """The same size, scaled and correlated."""
        scale = np.eye(cov.shape[1]) * rng.uniform(0.7, 1.5, (len(cov), 1, 1))
        L = np.linalg.cholesky(cov) @ (np.tril(rng.uniform(-0.6, 0.6, cov.shape), -1) + scale)
        return np.asarray(L @ L.transpose(0, 2, 1))

    start = np.array([[0.02, 0.01, 0.0], [0.0, 0.03, 0.01], [0.0, 0.0, 0.05]])
    return replace(
        log,
        odometry_cov=skew(log.odometry_cov + np.diag([0.0, 1e-6, 0.0])),
        sighting_cov=skew(log.sighting_cov),
        start_pose=log.start_pose + ([0.01, -0.02, 0.03] if log.vehicle == "v2" else 0.0),
        start_pose_cov=start @ start.T if log.vehicle == "v2" else np.zeros((3, 3)),
    )


class Dense:
    """The same problem for scipy: plain coordinates, residuals whitened by a Cholesky factor of their covariance.

    x holds the landmarks by signature, then per vehicle its poses, without a start pose that is given.
    """

    def __init__(self, recording: Recording) -> None:
        self.logs = list(recording.logs.values())
        self.signatures = np.unique(np.concatenate([log.sighting_signature for log in self.logs])).tolist()

    def pack(self, landmarks: Floats, poses: dict[str, Floats]) -> Floats:
        free = [poses[log.vehicle][0 if log.start_pose_cov.any() else 1 :].ravel() for log in self.logs]
        return np.concatenate([landmarks.ravel(), *free])

    def unpack(self, x: Floats) -> tuple[Floats, dict[str, Floats]]:
        at = 2 * len(self.signatures)
        poses = {}
        for log in self.logs:
            known = np.empty((0, 3)) if log.start_pose_cov.any() else log.start_pose[None]
            count = log.steps + 1 - len(known)
            poses[log.vehicle] = np.concatenate([known, x[at : at + 3 * count].reshape(-1, 3)])
            at += 3 * count
        return x[: 2 * len(self.signatures)].reshape(-1, 2), poses

    def residuals(self, x: Floats) -> Floats:
        landmarks, poses = self.unpack(x)
        found = []
        for log in self.logs:
            path = poses[log.vehicle]
            if log.start_pose_cov.any():
                found.append(whitened(path[0] - log.start_pose, log.start_pose_cov))
            for k in range(log.steps):
                found.append(whitened(between(path[k], path[k + 1]) - log.odometry[k], log.odometry_cov[k]))
            for i, signature in enumerate(log.sighting_signature.tolist()):
                pose, y = path[log.sighting_step[i]], landmarks[self.signatures.index(signature)]
                d = y - pose[:2]
                r = log.sighting_z[i] - [math.hypot(d[0], d[1]), math.atan2(d[1], d[0]) - pose[2]]
                found.append(whitened(np.array([r[0], math.remainder(r[1], math.tau)]), log.sighting_cov[i]))
        return np.concatenate(found)


def whitened(r: Floats, cov: Floats) -> Floats:
    r = np.array([*r[:2], math.remainder(r[2], math.tau)]) if len(r) == 3 else r
    return np.asarray(np.linalg.solve(np.linalg.cholesky(cov), r))


def landmark_covariance(solution: BatchSolution) -> Floats:
    """The joint covariance of all landmarks by a dense inverse, m^2, shape (2n, 2n)."""
    n = solution.landmark_mean.size
    return np.asarray(np.linalg.inv(solution.H.toarray())[:n, :n])


def landmark_errors(solution: BatchSolution, recording: Recording) -> Floats:
    return np.asarray(solution.landmark_mean - recording.landmarks[solution.signatures]).ravel()


def test_without_gtsam_it_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(batch, "import_module", missing)
    with pytest.raises(RunError, match=r"pip install 'fleet-seif\[bench\]'"):
        solve_batch(world(1, steps=5))


def test_it_is_the_minimum_that_a_dense_solver_finds() -> None:
    pytest.importorskip("gtsam")
    recording = with_logs(world(3, steps=9, landmarks=8), skewed)
    found = solve_batch(recording)
    dense = Dense(recording)
    truth = dense.pack(
        recording.landmarks[dense.signatures], {log.vehicle: log.truth_pose for log in recording.logs.values()}
    )
    best = scipy.optimize.least_squares(dense.residuals, truth, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    J = np.asarray(best.jac)
    landmarks, poses = dense.unpack(best.x)
    assert found.signatures.tolist() == dense.signatures
    np.testing.assert_allclose(found.landmark_mean, landmarks, atol=1e-6)
    for name, path in found.poses.items():
        np.testing.assert_allclose(path[:, :2], poses[name][:, :2], atol=1e-6)
        turns = path[:, 2] - poses[name][:, 2]
        np.testing.assert_allclose(turns - math.tau * np.round(turns / math.tau), 0.0, atol=1e-6)
    assert found.chi_square == pytest.approx(2.0 * best.cost, rel=1e-7)
    assert found.degrees_of_freedom == len(best.fun) - len(best.x)
    n = landmarks.size
    P = np.linalg.inv(J.T @ J)[:n, :n]
    np.testing.assert_allclose(landmark_covariance(found), P, rtol=1e-4, atol=1e-6 * np.max(np.diag(P)))


def test_chi_square_of_some_landmarks_is_that_of_their_joint_covariance() -> None:
    pytest.importorskip("gtsam")
    recording = world(2)
    found = solve_batch(recording)
    error = landmark_errors(found, recording)
    P = landmark_covariance(found)
    for rows in (np.arange(len(error)), np.array([2, 3, 8, 9])):
        expected = error[rows] @ np.linalg.solve(P[np.ix_(rows, rows)], error[rows])
        assert marginal_chi_square(found.H, rows, error[rows]) == pytest.approx(expected, rel=1e-6)


def test_its_errors_are_what_it_says_they_are() -> None:
    pytest.importorskip("gtsam")
    total, dof = 0.0, 0
    for seed in SEEDS:
        recording = world(seed)
        found = solve_batch(recording)
        error = landmark_errors(found, recording)
        total += marginal_chi_square(found.H, np.arange(len(error)), error)
        dof += len(error)
        assert found.chi_square / found.degrees_of_freedom == pytest.approx(1.0, abs=0.25)
    assert scipy.stats.chi2.ppf(0.005, dof) < total < scipy.stats.chi2.ppf(0.995, dof)


def test_robust_weights_put_up_with_misread_signatures() -> None:
    pytest.importorskip("gtsam")
    clean = world(4)

    def misread(log: Log) -> Log:
        signature = log.sighting_signature.copy()
        signature[20::25] = signature[10::25][: len(signature[20::25])]
        return replace(log, sighting_signature=signature)

    read = with_logs(clean, misread)
    assert any((log.sighting_signature != log.sighting_truth).sum() >= 3 for log in read.logs.values())
    start = Guess(
        poses={name: log.truth_pose for name, log in clean.logs.items()}, landmarks=dict(enumerate(clean.landmarks))
    )
    right = np.abs(landmark_errors(solve_batch(clean), clean)).max()
    robust = np.abs(landmark_errors(solve_batch(read, robust=True, start=start), read)).max()
    plain = np.abs(landmark_errors(solve_batch(read, start=start), read)).max()
    assert robust < 3 * right
    assert plain > 3 * robust


def test_the_minimum_does_not_depend_on_where_it_begins() -> None:
    pytest.importorskip("gtsam")
    recording = world(5)
    found = solve_batch(recording)
    landmarks = dict(enumerate(recording.landmarks))
    poses = {name: log.truth_pose for name, log in recording.logs.items()}
    again = solve_batch(recording, start=Guess(poses=poses, landmarks=landmarks))
    np.testing.assert_allclose(again.landmark_mean, found.landmark_mean, atol=1e-6)
    assert again.chi_square == pytest.approx(found.chi_square, rel=1e-7)


def test_it_tells_how_far_it_is() -> None:
    pytest.importorskip("gtsam")
    told: list[tuple[str, int, int]] = []
    found = solve_batch(world(1), progress=lambda *each: told.append(each))
    assert [each for each in told if each[0] == batch.FILTERING][-1] == (batch.FILTERING, 100, 100)
    assert [each for each in told if each[0] == batch.ITERATING][-1][1] == found.iterations
    assert all(batch.STAGES[stage] == total >= done >= 0 for stage, done, total in told)


def test_a_start_that_lacks_something_is_refused() -> None:
    pytest.importorskip("gtsam")
    recording = world(5, steps=10)
    poses = {name: log.truth_pose for name, log in recording.logs.items()}
    with pytest.raises(RunError, match=r"lacks \d+ landmarks, first signature \d+"):
        solve_batch(recording, start=Guess(poses=poses, landmarks={}))
    with pytest.raises(RunError, match="11 finite poses of v2"):
        solve_batch(recording, start=Guess(poses={**poses, "v2": poses["v2"][:5]}, landmarks={}))


def test_sightings_without_a_signature_are_left_out() -> None:
    pytest.importorskip("gtsam")

    def anonymous(log: Log) -> Log:
        unknown = np.arange(len(log.sighting_signature)) % 3 == 0
        return replace(log, sighting_signature=np.where(unknown, -1, log.sighting_signature))

    def thinned(log: Log) -> Log:
        kept = np.arange(len(log.sighting_signature)) % 3 != 0
        return log.chosen(np.flatnonzero(kept))

    recording = world(6)
    found, expected = (solve_batch(with_logs(recording, change)) for change in (anonymous, thinned))
    assert expected.left_out == 0
    assert found.left_out == sum((len(log.sighting_signature) + 2) // 3 for log in recording.logs.values())
    np.testing.assert_array_equal(found.landmark_mean, expected.landmark_mean)
    nothing = with_logs(recording, lambda log: log.chosen(np.empty(0, np.int64)))
    with pytest.raises(RunError, match="no sighting in these readings has a signature"):
        solve_batch(nothing)


def test_where_no_sighting_has_a_signature_the_batch_is_told_the_truth() -> None:
    pytest.importorskip("gtsam")
    known = world(6)
    settings = DetectionSettings(signatures="none", clutter_share=0.2)
    cluttered = detected(known, WorldSettings(landmarks=12), MILD, settings, 1)
    hidden = without_signatures(cluttered, tuple(known.logs), 1)
    found, expected = solve_batch(hidden), solve_batch(known)
    assert found.signatures.tolist() == expected.signatures.tolist()
    np.testing.assert_allclose(found.landmark_mean, expected.landmark_mean, atol=1e-6)
    assert found.left_out == sum(np.count_nonzero(log.sighting_truth < 0) for log in hidden.logs.values()) > 0
    np.testing.assert_array_equal(batch_map(found, hidden).truth, batch_map(expected, known).truth)


@given(st.lists(st.tuples(st.integers(1, 90), st.floats(0.0, 0.3)), min_size=1, max_size=4))
def test_strides_cover_every_pose_once_and_none_is_long(runs: list[tuple[int, float]]) -> None:
    one = world(1, steps=5).logs["v1"]
    logs = [
        replace(one, odometry=np.zeros((steps, 3)), odometry_cov=np.tile(std**2 * np.eye(3), (steps, 1, 1)))
        for steps, std in runs
    ]
    spans = list(batch._strides(logs))
    for i, (steps, std) in enumerate(runs):
        assert [k for span in spans for k in range(*span[i])] == list(range(steps + 1))
        longest = max(high - low for low, high in (span[i] for span in spans))
        assert longest <= batch.STRIDE_MAX
        assert longest <= 1 + (steps + 1) / steps * (batch.STRIDE_HEADING_STD_RAD / max(std, 1e-9)) ** 2


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "most"), [("three_air_vehicles_mild", 1.1), ("three_air_vehicles", 1.8)])
def test_a_fused_map_of_frames_is_as_accurate_as_the_batch(scenario: str, most: float) -> None:
    """Two seeds; twenty by hand: python -m tests.frames_against_batch."""
    pytest.importorskip("gtsam")
    found = [compare(scenario, seed, ()) for seed in (1, 2)]
    assert all(each.ratio is not None and each.ratio < most for each in found)
    assert all(each.ours.nees_per_dof is not None and each.ours.nees_per_dof < 2.0 for each in found)
