"""The batch over one frame, against dense least squares over all its poses and against the truth."""

import dataclasses
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fleet_seif import frame_batch
from fleet_seif.config import FilterSettings
from fleet_seif.errors import NumericalError
from fleet_seif.frame_batch import (
    POINT,
    FrameReadings,
    FrameSolution,
    look,
    motion_residual,
    solve_frame,
    turned,
)
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats, Ints, Reading, Sightings
from fleet_seif.seif import Seif
from scenarios.recording import Log
from scenarios.world import NoiseSettings, WorldSettings, simulate
from tests import reference
from tests.drives import Drive, drive, landmark_of, square
from tests.strategies import points, poses, settled

MODELS = pytest.mark.parametrize("model", [RANGE_BEARING, COMPASS_XY])
MILD = NoiseSettings(forward_std_m=0.005, turn_std_rad=0.03, range_std_m=0.01, bearing_std_rad=0.02)
PAPER = NoiseSettings()
NO_GATE = 1e300


def frame_of(log: Drive, model: int = RANGE_BEARING) -> FrameReadings:
    """A whole drive as one frame; landmarks keep their numbers in the world."""
    seen = [log.start, *(each.sightings for each in log.readings)]
    signature = np.concatenate([each.signature for each in seen])
    return FrameReadings(
        model=model,
        odometry=np.array([each.odometry for each in log.readings]),
        odometry_cov=np.array([each.odometry_cov for each in log.readings]),
        step=np.repeat(np.arange(len(seen)), [len(each.z) for each in seen]),
        landmark=np.array([landmark_of(s) for s in signature.tolist()], np.int64),
        z=np.concatenate([each.z for each in seen]),
        cov=np.concatenate([each.cov for each in seen]),
    )


def without(frame: FrameReadings, gone: Ints) -> FrameReadings:
    return dataclasses.replace(
        frame, **{name: np.delete(getattr(frame, name), gone, axis=0) for name in ("step", "landmark", "z", "cov")}
    )


def reckoned(frame: FrameReadings, landmarks: int) -> tuple[Floats, Floats]:
    """The plainest guess: poses from odometry alone, landmarks where their first sighting puts them."""
    x = [np.zeros(3)]
    for u in frame.odometry:
        x.append(reference.moved(frame.model, x[-1], u))
    y = np.full((landmarks, 2), 0.5)
    for i in range(len(frame.z) - 1, -1, -1):
        y[frame.landmark[i]] = reference.placed(frame.model, x[frame.step[i]], frame.z[i])
    return np.array(x[1:]), y


def solved(frame: FrameReadings, landmarks: int, gate: float = frame_batch.GATE) -> FrameSolution:
    return solve_frame(frame, *reckoned(frame, landmarks), gate=gate)


def whitened(frame: FrameReadings, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Every residual of a frame over its noise, and the Jacobian with respect to x_1 ... x_T, landmarks."""
    T, n = len(x), 3 * len(x) + 2 * len(y)
    state = np.concatenate([x.ravel(), y.ravel()])
    rows: list[Floats] = []
    r: list[Floats] = []

    def pose(v: Floats, k: int) -> Floats:
        return v[3 * k - 3 : 3 * k] if k else np.zeros(3)

    def add(value: Floats, blocks: list[tuple[int, Floats]], cov: Floats) -> None:
        row = np.zeros((len(value), n))
        for at, block in blocks:
            if at >= 0:
                row[:, at : at + block.shape[1]] = block
        W = reference.whitener(cov)
        r.append(W @ value)
        rows.append(W @ row)

    for k in range(T):
        a, b, u = pose(state, k), pose(state, k + 1), frame.odometry[k]
        if frame.model == COMPASS_XY:
            add(b - a - u, [(3 * k - 3, -np.eye(3)), (3 * k, np.eye(3))], frame.odometry_cov[k])
        else:
            R = reference.rotation(a[2])
            J_b = np.eye(3)
            J_b[:2, :2] = R.T
            J_a = -J_b
            J_a[:2, 2] = -(R @ np.array([[0.0, -1.0], [1.0, 0.0]])).T @ (a[:2] - b[:2])
            add(reference.relative_pose(a, b) - u, [(3 * k - 3, J_a), (3 * k, J_b)], frame.odometry_cov[k])
    for k, j, z, Z in zip(frame.step.tolist(), frame.landmark.tolist(), frame.z, frame.cov, strict=True):
        J = reference.sighting_jacobian(frame.model, pose(state, k), y[j])
        value = reference.difference(frame.model, z, reference.expected(frame.model, pose(state, k), y[j]))
        add(value, [(3 * k - 3, -J[:, :3]), (3 * T + 2 * j, -J[:, 3:])], Z)
    return np.concatenate(r), np.vstack(rows)


def dense_solution(frame: FrameReadings, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Gauss-Newton over everything: poses, landmarks, H of all."""
    for _ in range(100):
        r, J = whitened(frame, x, y)
        step = -np.linalg.lstsq(J, r)[0]
        x, y = x + step[: x.size].reshape(x.shape), y + step[x.size :].reshape(y.shape)
        if np.linalg.norm(J @ step) < 1e-10:
            return x, y, J.T @ J
    raise AssertionError("the reference did not converge: a case for another test")


def marginal_of_last(H: Floats, T: int) -> Floats:
    """Schur complement: all poses but the last are gone."""
    gone, stay = slice(0, 3 * T - 3), slice(3 * T - 3, None)
    return np.asarray(H[stay, stay] - H[stay, gone] @ np.linalg.solve(H[gone, gone], H[gone, stay]))


def close(a: Floats, b: Floats, tolerance: float) -> None:
    """Equal relative to the largest entry."""
    np.testing.assert_allclose(a, b, rtol=0.0, atol=tolerance * max(1.0, float(np.max(np.abs(b)))))


def sigmas(solution: FrameSolution) -> Floats:
    """Standard deviations of the mean, infinite where there is no landmark."""
    rows = np.concatenate([[True] * 3, np.repeat(solution.seen, 2)])
    std = np.full(len(rows), np.inf)
    std[rows] = np.sqrt(np.diag(np.linalg.inv(solution.H[np.ix_(rows, rows)])))
    return std


# --- against dense least squares


@MODELS
@pytest.mark.parametrize("steps", [1, 2, 30])
def test_it_is_least_squares_over_all_poses_with_all_but_the_last_marginalised(model: int, steps: int) -> None:
    frame = frame_of(drive(square(14, 3.0, 1), steps=steps, seed=2, model=model), model)
    number = {j: i for i, j in enumerate(np.unique(frame.landmark).tolist())}
    frame = dataclasses.replace(frame, landmark=np.array([number[j] for j in frame.landmark.tolist()]))
    solution = solved(frame, len(number), NO_GATE)
    x, y, H = dense_solution(frame, *reckoned(frame, len(number)))
    np.testing.assert_allclose(solution.poses, x, atol=1e-8)
    np.testing.assert_allclose(solution.mean, np.concatenate([x[-1], y.ravel()]), atol=1e-8)
    close(solution.H, marginal_of_last(H, steps), 1e-8)
    r, _ = whitened(frame, x, y)
    assert solution.chi_square == pytest.approx(r @ r, abs=1e-8)
    assert solution.dof == len(r) - 3 * steps - 2 * len(number)
    assert np.all(solution.seen)
    assert not np.any(solution.rejected)


@MODELS
def test_the_gradient_is_zero_at_the_solution(model: int) -> None:
    frame = frame_of(drive(square(12, 3.0, 3), steps=40, seed=4, model=model), model)
    solution = solved(frame, 12)
    r, J = whitened(frame, solution.poses, solution.mean[3:].reshape(-1, 2))
    columns = np.concatenate([np.full(120, True), np.repeat(solution.seen, 2)])
    step = np.linalg.lstsq(J[:, columns], r)[0]
    assert np.linalg.norm(J[:, columns] @ step) < 1e-5  # in sigmas, over all unknowns together


@given(poses(), poses(), poses())
@settled
def test_motion_jacobians_are_those_of_the_residual(x: Floats, x_next: Floats, u: Floats) -> None:
    for model in (RANGE_BEARING, COMPASS_XY):

        def residual(a: Floats, b: Floats, model: int = model) -> Floats:
            return motion_residual(model, a, b, u)[0]

        e, f0, f1, c, s = motion_residual(model, x, x_next, u)
        G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        F_inv = np.array([[1.0, 0.0, f0], [0.0, 1.0, f1], [0.0, 0.0, 1.0]])
        np.testing.assert_allclose(reference.moved(model, x, u + e), x_next, atol=1e-9)
        J_e_x = reference.numeric_jacobian(lambda a: residual(a, x_next), x)
        J_e_next = reference.numeric_jacobian(lambda b: residual(x, b), x_next)
        np.testing.assert_allclose(np.linalg.inv(G), J_e_next, atol=1e-7)
        np.testing.assert_allclose(-np.linalg.inv(G) @ np.linalg.inv(F_inv), J_e_x, atol=1e-6)
        noise = np.diag([1.0, 2.0, 3.0]) + 0.5
        np.testing.assert_allclose(turned(c, s, noise), G @ noise @ G.T, atol=1e-12)


@given(st.sampled_from([RANGE_BEARING, COMPASS_XY, POINT]), poses(), points(), points())
@settled
def test_sighting_jacobians_are_those_of_the_residual(model: int, x: Floats, y: Floats, z: Floats) -> None:
    assume(np.hypot(*(y - x[:2])) > 0.1)
    expected = reference.expected(model, x, y) if model != POINT else reference.seen_from(x, y)
    r0, r1, *rows = look(model, x, y, expected + np.array([0.1, -0.2]))
    np.testing.assert_allclose([r0, r1], [0.1, -0.2], atol=1e-9)
    J = -reference.numeric_jacobian(lambda v: np.array(look(model, v[:3], v[3:], expected)[:2]), np.append(x, y))
    np.testing.assert_allclose(np.array(rows).reshape(2, 5), J, rtol=1e-6, atol=1e-6)


def test_in_a_linear_world_it_is_the_information_filter() -> None:
    """The filter starts with variance 1 / start_information where the frame starts exactly: a shift of everything."""
    start_information = 1e9
    log = drive(square(10, 3.0, 8), steps=60, seed=9, model=COMPASS_XY)
    frame = frame_of(log, COMPASS_XY)
    seif = Seif(FilterSettings(kind="eif", mean="exact", gate=NO_GATE, start_information=start_information), COMPASS_XY)
    seif.start(log.start)
    for each in log.readings:
        seif.step(each)
    order = [landmark_of(s) for s in seif.signatures]
    number = {j: i for i, j in enumerate(order)}
    frame = dataclasses.replace(frame, landmark=np.array([number[j] for j in frame.landmark.tolist()]))
    solution = solved(frame, len(order), NO_GATE)
    np.testing.assert_allclose(solution.mean, seif.mean(), atol=1e-9)
    H, _ = seif.information()
    shift = np.vstack([np.eye(3), np.tile(np.eye(2, 3), (len(order), 1))])
    P = np.linalg.inv(H.toarray())
    np.testing.assert_allclose(np.linalg.inv(solution.H) + shift @ shift.T / start_information, P, rtol=0.0, atol=1e-9)


def test_without_sightings_it_is_the_motion_alone() -> None:
    log = drive(square(1, 100.0, 1), steps=5, seed=1)
    frame = without(frame_of(log), np.arange(0))
    assert not len(frame.z)
    solution = solved(frame, 0)
    x, P = np.zeros(3), np.zeros((3, 3))
    for u, cov in zip(frame.odometry, frame.odometry_cov, strict=True):
        F, G = reference.motion_jacobians(RANGE_BEARING, x, u)
        x, P = reference.moved(RANGE_BEARING, x, u), F @ P @ F.T + G @ cov @ G.T
    np.testing.assert_allclose(solution.mean, x, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(solution.H), P, rtol=0.0, atol=1e-12)
    assert (solution.dof, solution.chi_square_per_dof) == (0, 0.0)


# --- outliers


def misread(frame: FrameReadings, at: int, as_landmark: int) -> FrameReadings:
    landmark = frame.landmark.copy()
    landmark[at] = as_landmark
    return dataclasses.replace(frame, landmark=landmark)


def assert_near(a: FrameSolution, b: FrameSolution) -> None:
    """In units of sigma, where b has landmarks."""
    assert np.max(np.abs(a.mean - b.mean) / sigmas(b)) < 1e-4


@MODELS
@pytest.mark.parametrize("at", [0, 40, 90])
def test_a_misread_barcode_is_rejected_and_leaves_no_trace(model: int, at: int) -> None:
    frame = frame_of(drive(square(12, 3.0, 10), steps=30, seed=11, model=model), model)
    often = int(np.bincount(frame.landmark).argmax())
    assume_other = (often + 1) % 12 if frame.landmark[at] == often else often
    wrong = misread(frame, at, assume_other)
    solution = solved(wrong, 12)
    assert np.flatnonzero(solution.rejected).tolist() == [at]
    clean = solved(without(frame, np.array([at])), 12)
    assert_near(solution, clean)
    close(solution.H, clean.H, 1e-6)
    assert solution.chi_square == pytest.approx(clean.chi_square, rel=1e-6)
    assert solution.worst < frame_batch.GATE


def test_a_first_sighting_misread_does_not_matter_whatever_guess_it_led_to() -> None:
    """The filter believes the first sighting of a landmark; the batch does not have to."""
    log = drive(square(12, 3.0, 10), steps=30, seed=11)
    frame = frame_of(log)
    first = int(np.flatnonzero(frame.landmark == frame.landmark[-1])[0])
    victim = int(np.flatnonzero((frame.step == frame.step[first]) & (frame.landmark != frame.landmark[first]))[0])
    wrong = misread(without(frame, np.array([first])), victim - (victim > first), int(frame.landmark[first]))
    solution = solved(wrong, 12)
    assert np.flatnonzero(solution.rejected).tolist() == [victim - (victim > first)]


def test_several_misread_barcodes_are_rejected() -> None:
    frame = frame_of(drive(square(12, 3.0, 12), steps=60, seed=13))
    wrong = frame
    bad = [17, 60, 101, 150, 200]
    for at in bad:
        wrong = misread(wrong, at, int(frame.landmark[at] + 5) % 12)
    solution = solved(wrong, 12)
    assert np.flatnonzero(solution.rejected).tolist() == bad
    assert_near(solution, solved(without(frame, np.array(bad)), 12))


def test_of_two_sightings_that_contradict_each_other_neither_is_believed() -> None:
    frame = frame_of(drive(square(12, 3.0, 10), steps=30, seed=11))
    both = np.array([20, 80])
    wrong = misread(misread(frame, 20, 12), 80, 12)
    assert frame.landmark[20] != frame.landmark[80]
    solution = solved(wrong, 13)
    assert np.flatnonzero(solution.rejected).tolist() == both.tolist()
    assert not solution.seen[12]
    assert not np.any(solution.H[-2:])
    assert not np.any(solution.H[:, -2:])
    assert not np.any(solution.b[-2:])
    assert_near(solution, solved(without(frame, both), 13))
    rows = np.flatnonzero(np.concatenate([[True] * 3, np.repeat(solution.seen, 2)]))
    np.linalg.cholesky(solution.H[np.ix_(rows, rows)])


def test_a_landmark_sighted_once_is_a_landmark() -> None:
    frame = frame_of(drive(square(12, 3.0, 10), steps=30, seed=11))
    solution = solved(misread(frame, 70, 12), 13)
    assert not np.any(solution.rejected)
    assert solution.seen[12]
    pose = solution.poses[frame.step[70] - 1]
    placed = reference.placed(RANGE_BEARING, pose, frame.z[70])
    np.testing.assert_allclose(solution.mean[-2:], placed, atol=1e-7)
    before = solved(without(frame, np.array([70])), 12)
    assert solution.chi_square == pytest.approx(before.chi_square)
    assert solution.dof == before.dof


def test_in_a_linear_world_the_squared_innovation_is_what_chi_square_loses() -> None:
    frame = frame_of(drive(square(8, 3.0, 14), steps=15, seed=15, model=COMPASS_XY), COMPASS_XY)
    whole = solved(frame, 8, NO_GATE)
    loss = [
        whole.chi_square - solved(without(frame, np.array([i])), 8, NO_GATE).chi_square for i in range(len(frame.z))
    ]
    assert whole.worst == pytest.approx(max(loss), rel=1e-7)


def test_what_was_wrongly_rejected_comes_back() -> None:
    """With a gate that the rough solution fails in, but the exact one passes, nothing is lost."""
    frame = frame_of(drive(square(12, 3.0, 10), steps=30, seed=11))
    wrong = misread(frame, 40, int(frame.landmark[40] + 3) % 12)
    gate = 1.001 * solved(without(wrong, np.array([40])), 12, NO_GATE).worst
    assert np.flatnonzero(solved(wrong, 12, gate).rejected).tolist() == [40]


def test_sightings_may_come_in_any_order() -> None:
    frame = misread(frame_of(drive(square(12, 3.0, 10), steps=30, seed=11)), 40, 3)
    order = np.random.default_rng(1).permutation(len(frame.z))
    mixed = dataclasses.replace(
        frame, step=frame.step[order], landmark=frame.landmark[order], z=frame.z[order], cov=frame.cov[order]
    )
    a, b = solved(frame, 12), solved(mixed, 12)
    assert np.array_equal(a.rejected[order], b.rejected)
    assert_near(a, b)


# --- guesses and failures


def test_the_same_input_gives_the_same_bits() -> None:
    frame = misread(frame_of(drive(square(12, 3.0, 10), steps=30, seed=11)), 40, 3)
    guess = reckoned(frame, 12)
    before = [array.copy() for array in guess]
    assert reference.same(solve_frame(frame, *guess), solve_frame(frame, *guess))
    assert all(np.array_equal(a, b) for a, b in zip(guess, before, strict=True))


def test_h_is_symmetric_to_the_bit_and_b_is_h_times_the_mean() -> None:
    solution = solved(frame_of(drive(square(12, 3.0, 10), steps=30, seed=11)), 12)
    assert np.array_equal(solution.H, solution.H.T)
    close(solution.b, solution.H @ solution.mean, 1e-13)


@pytest.mark.parametrize("seed", range(5))
def test_a_guess_far_away_leads_to_the_same_solution(seed: int) -> None:
    frame = frame_of(drive(square(12, 3.0, 10), steps=30, seed=11))
    x, y = reckoned(frame, 12)
    good = solve_frame(frame, x, y)
    rng = np.random.default_rng(seed)
    bad = solve_frame(frame, x + rng.standard_normal(x.shape), y + rng.standard_normal(y.shape))
    assert_near(bad, good)


def test_a_landmark_guessed_on_top_of_a_pose_is_no_obstacle() -> None:
    frame = frame_of(drive(square(12, 3.0, 10), steps=30, seed=11))
    x, y = reckoned(frame, 12)
    y[frame.landmark[0]] = 0.0
    with np.errstate(all="ignore"):
        assert_near(solve_frame(frame, x, y), solved(frame, 12))


def small() -> tuple[FrameReadings, Floats, Floats]:
    frame = frame_of(drive(square(4, 2.0, 10), steps=3, seed=11, range_m=9.0))
    return frame, *reckoned(frame, 4)


@pytest.mark.parametrize("name", ["odometry_cov", "cov"])
def test_a_noise_that_is_not_positive_definite_is_refused(name: str) -> None:
    frame, x, y = small()
    cov = getattr(frame, name).copy()
    cov[1, 0, 0] = -1e-6
    with pytest.raises(NumericalError, match="not positive definite"):
        solve_frame(dataclasses.replace(frame, **{name: cov}), x, y)


@pytest.mark.parametrize("name", ["odometry", "z"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_reading_that_is_not_finite_is_refused(name: str, value: float) -> None:
    frame, x, y = small()
    array = getattr(frame, name).copy()
    array[1, 0] = value
    with pytest.raises((NumericalError, ValueError)):
        solve_frame(dataclasses.replace(frame, **{name: array}), x, y)


def test_a_frame_that_does_not_settle_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, x, y = small()
    monkeypatch.setattr(frame_batch, "ITERATIONS_MAX", 1)
    monkeypatch.setattr(frame_batch, "ROUGH_ITERATIONS_MAX", 1)
    with pytest.raises(NumericalError, match="no solution within 1 linearisations"):
        solve_frame(frame, x, y)


def test_arguments_that_do_not_fit_are_refused() -> None:
    frame, x, y = small()
    with pytest.raises(ValueError, match=r"poses of a frame has shape \(2, 3\)"):
        solve_frame(frame, x[1:], y)
    with pytest.raises(ValueError, match=r"landmarks 0 \.\.\. 2"):
        solve_frame(frame, x, y[:3])
    with pytest.raises(ValueError, match=r"poses 0 \.\.\. 3"):
        solve_frame(dataclasses.replace(frame, step=frame.step + 1), x, y)
    still = dataclasses.replace(frame, odometry=x[:0], odometry_cov=np.empty((0, 3, 3)))
    with pytest.raises(ValueError, match="at least one step"):
        solve_frame(still, x[:0], y)


# --- against the truth


@dataclass(frozen=True, eq=False)
class Piece:
    """A frame cut out of a simulated run, and the truth in its coordinates."""

    frame: FrameReadings
    last: Floats
    landmarks: Floats


def pieces(noise: NoiseSettings, length: int) -> Iterator[Piece]:
    """Frames of so many steps without end: worlds of 50 landmarks, three vehicles, 500 steps each."""
    for seed in itertools.count(1):
        recording = simulate(WorldSettings(), noise, ("v1", "v2", "v3"), seed)
        for log in recording.logs.values():
            for begin in range(0, log.steps - length + 1, length):
                yield piece(log, recording.landmarks, begin, begin + length)


def piece(log: Log, landmarks: Floats, begin: int, end: int) -> Piece:
    """Sightings from pose `begin` belong to the frame before."""
    mine = (log.sighting_step > begin) & (log.sighting_step <= end)
    names, first, number = np.unique(log.sighting_signature[mine], return_index=True, return_inverse=True)
    order = np.argsort(first)
    start = log.truth_pose[begin]
    return Piece(
        FrameReadings(
            model=RANGE_BEARING,
            odometry=log.odometry[begin:end],
            odometry_cov=log.odometry_cov[begin:end],
            step=log.sighting_step[mine] - begin,
            landmark=np.argsort(order)[number],
            z=log.sighting_z[mine],
            cov=log.sighting_cov[mine],
        ),
        reference.relative_pose(start, log.truth_pose[end]),
        np.array([reference.seen_from(start, landmarks[i]) for i in names[order].tolist()]).reshape(-1, 2),
    )


def filtered(frame: FrameReadings, landmarks: int) -> tuple[Floats, Floats, Seif]:
    """What the vehicle's own filter believes: its pose after each step, landmarks at the end by number."""
    seif = Seif(FilterSettings(active_max=10))
    seif.start(Sightings.none())
    x = []
    for k, (u, cov) in enumerate(zip(frame.odometry, frame.odometry_cov, strict=True), 1):
        mine = frame.step == k
        seen = Sightings(z=frame.z[mine], cov=frame.cov[mine], signature=frame.landmark[mine])
        seif.step(Reading(time_s=float(k), odometry=u, odometry_cov=cov, sightings=seen))
        x.append(seif.pose)
    y = np.zeros((landmarks, 2))
    y[seif.signatures] = seif.landmarks
    return np.array(x), y, seif


def nees(H: Floats, error: Floats) -> float:
    """error' P^-1 error of landmarks, P their block of H^-1."""
    return float(error @ np.linalg.solve(np.linalg.inv(H)[3:, 3:], error))


def consistency(noise: NoiseSettings, length: int, count: int) -> tuple[float, float, float]:
    """NEES per degree of freedom of landmarks in so many frames: the batch's, the filter's; mean chi-square per dof."""
    batch = live = chi_square = 0.0
    dof = 0
    for each in itertools.islice(pieces(noise, length), count):
        x, y, seif = filtered(each.frame, len(each.landmarks))
        solution = solve_frame(each.frame, x, y)
        assert np.all(solution.seen)
        batch += nees(solution.H, solution.mean[3:] - each.landmarks.ravel())
        live += nees(seif.information()[0].toarray(), (seif.landmarks - each.landmarks[seif.signatures]).ravel())
        dof += each.landmarks.size
        chi_square += solution.chi_square_per_dof / count
    return batch / dof, live / dof, chi_square


@pytest.mark.slow
def test_landmarks_in_a_frame_are_as_uncertain_as_it_says_with_mild_noise() -> None:
    ours, live, chi_square = consistency(MILD, 25, 200)
    print(f"mild noise, frames of 25 steps: NEES per dof {ours:.3f}, of the filter {live:.3f}")
    assert 0.9 < ours < 1.1
    assert 0.95 < chi_square < 1.05


@pytest.mark.slow
def test_landmarks_in_a_frame_are_as_uncertain_as_it_says_with_the_papers_noise() -> None:
    for length in (10, 25, 50, 100):
        ours, live, _ = consistency(PAPER, length, 60)
        print(f"paper's noise, frames of {length} steps: NEES per dof {ours:.3f}, of the filter {live:.3f}")
        assert ours < 1.35
        assert ours < live


@pytest.mark.slow
def test_simulated_frames_are_solved_from_odometry_alone_and_lose_nothing() -> None:
    for length in (10, 100):
        for each in itertools.islice(pieces(PAPER, length), 20):
            x, y, _ = filtered(each.frame, len(each.landmarks))
            solution = solve_frame(each.frame, x, y)
            assert not np.any(solution.rejected)
            assert_near(solved(each.frame, len(each.landmarks)), solution)


@pytest.mark.slow
@pytest.mark.alone
def test_a_frame_is_closed_in_milliseconds() -> None:
    for length, limit_ms in ((25, 10.0), (50, 20.0), (200, 80.0)):
        took = []
        for each in itertools.islice(pieces(MILD, length), 10):
            x, y, _ = filtered(each.frame, len(each.landmarks))
            begin = time.perf_counter()
            solve_frame(each.frame, x, y)
            took.append(1e3 * (time.perf_counter() - begin))
        print(f"closing a frame of {length} steps: median {np.median(took):.2f} ms")
        assert np.median(took) < limit_ms
