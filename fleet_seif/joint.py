"""The joint map: frame totals of all vehicles, assembled into one sparse system and solved.

Every frame contributes (H_f, b_f) over z_f = (T_f^-1 T_f+1, T_f^-1 y_j ...), in its own coordinates. With J the
Jacobian of z_f in the joint state x,

    H = sum_f J_f' H_f J_f  (+ priors of start poses)        g = sum_f J_f' (b_f - H_f z_f)

solved by Gauss-Newton. Landmarks of one class share columns of J: that is the paper's merging by addition (section
4.2). Where every vehicle has one frame and a given start pose, z is linear in x and one step solves it. MATHS.md has
the derivation.

Rows of x: landmarks (two each) in canonical order, then the poses (three each): per life its frame starts that are not
given, then its newest pose.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar, cast

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
import threadpoolctl
from numpy.typing import NDArray

from fleet_seif.errors import NumericalError
from fleet_seif.geometry import act_all, between, between_jacobians, compose
from fleet_seif.information import POSE, FrameDelta, FrameInformation, to_information
from fleet_seif.messages import LandmarkName
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints

ITERATIONS_MAX: Final = 30
STEP_TOLERANCE: Final = 1e-10
COLUMNS_AT_ONCE: Final = 512
DENSE_ROWS_MAX: Final = 5000

F = TypeVar("F", bound=Callable[..., object])
_libraries = threadpoolctl.ThreadpoolController()


def one_thread(function: F) -> F:
    """Run a function with single-threaded BLAS: the same bits on any number of cores, no threads waiting for others."""
    return cast(F, _libraries.wrap(limits=1, user_api="blas")(function))


@dataclass(frozen=True, eq=False, kw_only=True)
class Life:
    """What one life of a vehicle has contributed: cumulative deltas of frames 0, 1, ...; signatures by number."""

    vehicle: str
    life: int
    start_pose: Floats
    start_pose_cov: Floats
    frames: tuple[FrameDelta, ...]
    signatures: tuple[int, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class JointSolution:
    """The solved joint system.

    H (n, n) symmetric CSR and b (n,) with H mean = b, linearised at mean (n,). classes: names of each landmark;
    poses: (vehicle, life, k) of each pose in row order, k the frame it starts, -1 the newest pose of that life.
    """

    H: scipy.sparse.csr_array
    b: Floats
    mean: Floats
    classes: tuple[tuple[LandmarkName, ...], ...]
    signatures: tuple[int, ...]
    poses: tuple[tuple[str, int, int], ...]

    @property
    def landmark_mean(self) -> Floats:
        """Landmarks in the world, m, shape (n, 2)."""
        return self.mean[: 2 * len(self.classes)].reshape(-1, 2)

    @property
    def pose_mean(self) -> Floats:
        """Poses in the world (x m, y m, theta rad), shape (p, 3), in the order of `poses`."""
        return self.mean[2 * len(self.classes) :].reshape(-1, 3)

    def variables(self) -> list[str]:
        """A name for each row: landmark/<i>/x, pose/<vehicle>/theta, frame/<vehicle>/<life>/<f>/y."""
        rows = [f"landmark/{i}/{axis}" for i in range(len(self.classes)) for axis in "xy"]
        for vehicle, life, k in self.poses:
            stem = f"pose/{vehicle}" if k < 0 else f"frame/{vehicle}/{life}/{k}"
            rows += [f"{stem}/{axis}" for axis in ("x", "y", "theta")]
        return rows


Pair = tuple[LandmarkName, LandmarkName]


def landmark_names(life: Life) -> list[LandmarkName]:
    """The landmarks of a life, ascending; one whose rows are all zero in every frame is none."""
    present = [delta.variables[delta.variables != POSE] - 1 for delta in life.frames]
    numbers = np.unique(np.concatenate(present)).tolist() if present else []
    return [LandmarkName(life.vehicle, life.life, number) for number in numbers]


def landmark_classes(
    lives: Sequence[Life], forced: Sequence[Pair] = (), forbidden: Sequence[Pair] = ()
) -> tuple[tuple[LandmarkName, ...], ...]:
    """Which landmarks are the same: those that carry one signature. In canonical order of their first names.

    Landmarks whose rows are all zero in every frame are none and do not appear.

    Args:
        forced: pairs that are one landmark whatever they carry, joined first and in this order.
        forbidden: pairs that are two: what would join them, a forced pair too, does nothing.
    """
    groups: dict[object, list[LandmarkName]] = {}
    names: list[LandmarkName] = []
    for life in lives:
        for name in landmark_names(life):
            names.append(name)
            signature = life.signatures[name.number]
            groups.setdefault(name if signature == UNKNOWN_SIGNATURE else signature, []).append(name)
    if forced or forbidden:
        same = [(group[0], other) for group in map(sorted, groups.values()) for other in group[1:]]
        return _joined(names, [*forced, *sorted(same)], forbidden)
    return tuple(sorted(tuple(sorted(group)) for group in groups.values()))


def _joined(
    names: Sequence[LandmarkName], pairs: Sequence[Pair], forbidden: Sequence[Pair]
) -> tuple[tuple[LandmarkName, ...], ...]:
    """Classes of names: pairs are joined in order, but for those that would put a forbidden pair into one class."""
    classes = {name: {name} for name in names}
    apart: dict[LandmarkName, set[LandmarkName]] = {}
    for a, b in forbidden:
        apart.setdefault(a, set()).add(b)
        apart.setdefault(b, set()).add(a)
    for a, b in pairs:
        if a not in classes or b not in classes or classes[a] is classes[b]:
            continue
        one, other = classes[a], classes[b]
        if any(not apart[name].isdisjoint(other) for name in one & apart.keys()):
            continue
        one |= other
        for name in other:
            classes[name] = one
    return tuple(sorted({tuple(sorted(group)) for group in classes.values()}))


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame with where its variables live: joint rows, -1 for a pose that is given."""

    info: FrameInformation
    given_start: Floats
    start_row: int
    end_row: int
    landmark_rows: Ints


def _rows_of_poses(lives: Sequence[Life], first: int) -> tuple[list[tuple[str, int, int]], dict[tuple[int, int], int]]:
    poses: list[tuple[str, int, int]] = []
    rows: dict[tuple[int, int], int] = {}
    for i, life in enumerate(lives):
        count = len(life.frames)
        for k in range(count + 1):
            if k == 0 and not np.any(life.start_pose_cov):
                rows[i, k] = -1
                continue
            rows[i, k] = first + 3 * len(poses)
            poses.append((life.vehicle, life.life, k if k < count else -1))
    return poses, rows


class _Factor:
    """A sparse factor of a symmetric positive definite matrix: factored once, solved with many."""

    def __init__(self, H: scipy.sparse.csr_array) -> None:
        options = {"SymmetricMode": True, "Equil": False}
        try:
            self._lu = scipy.sparse.linalg.splu(
                scipy.sparse.csc_matrix(H), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
            )
        except RuntimeError as error:
            raise NumericalError(f"information matrix of {H.shape[0]} rows is singular: {error}") from None
        if not np.array_equal(self._lu.perm_r, self._lu.perm_c) or not np.all(self._lu.U.diagonal() > 0):
            raise NumericalError(
                f"information matrix of {H.shape[0]} rows is not positive definite: a delta is missing or wrong"
            )

    def solve(self, b: Floats) -> Floats:
        return np.asarray(self._lu.solve(np.asarray(b, float)))


def _start_state(frames: Sequence[tuple[int, _Frame]], size: int) -> Floats:
    """First estimate: each frame's own mean, carried through the frame poses; the first to see a landmark wins."""
    x, seen = np.zeros(size), np.zeros(size, bool)
    pose = np.zeros(3)
    life_now = -1
    for i, frame in frames:
        if i != life_now:
            life_now, pose = i, frame.given_start
            if frame.start_row >= 0:
                x[frame.start_row : frame.start_row + 3] = pose
        mean = _Factor(frame.info.H).solve(frame.info.b)
        points = act_all(pose, mean[3:].reshape(-1, 2))
        for row, point in zip(frame.landmark_rows, points, strict=True):
            if not seen[row]:
                x[row : row + 2], seen[row] = point, True
        pose = compose(pose, mean[:3])
        x[frame.end_row : frame.end_row + 3] = pose
    return x


def _expected(frame: _Frame, x: Floats) -> tuple[Floats, scipy.sparse.csr_array]:
    """z_f and its Jacobian in the joint state, at x."""
    given = frame.start_row < 0
    start = frame.given_start if given else x[frame.start_row : frame.start_row + 3]
    end = x[frame.end_row : frame.end_row + 3]
    c, s = math.cos(start[2]), math.sin(start[2])
    count = len(frame.landmark_rows)
    y = x[frame.landmark_rows[:, None] + np.arange(2)]
    d = y - start[:2]
    z = np.empty(3 + 2 * count)
    z[:3] = between(start, end)
    z[3::2] = c * d[:, 0] + s * d[:, 1]
    z[4::2] = -s * d[:, 0] + c * d[:, 1]
    J_start, J_end = between_jacobians(start, end)
    rotation = np.array([[c, s], [-s, c]])
    i = [np.repeat(np.arange(3), 3), 3 + np.repeat(np.arange(2 * count), 2)]
    j = [
        frame.end_row + np.tile(np.arange(3), 3),
        (frame.landmark_rows[:, None, None] + np.array([[0, 1]] * 2)).ravel(),
    ]
    v = [J_end.ravel(), np.tile(rotation.ravel(), count)]
    if not given:
        J_points = np.empty((2 * count, 3))
        J_points[0::2] = np.column_stack([np.full(count, -c), np.full(count, -s), z[4::2]])
        J_points[1::2] = np.column_stack([np.full(count, s), np.full(count, -c), -z[3::2]])
        i += [np.repeat(np.arange(3), 3), 3 + np.repeat(np.arange(2 * count), 3)]
        j += [frame.start_row + np.tile(np.arange(3), 3), frame.start_row + np.tile(np.arange(3), 2 * count)]
        v += [J_start.ravel(), J_points.ravel()]
    J = scipy.sparse.coo_array(
        (np.concatenate(v), (np.concatenate(i), np.concatenate(j))), shape=(len(z), len(x))
    ).tocsr()
    return z, J


def assemble(
    frames: Sequence[tuple[int, _Frame]], priors: Sequence[tuple[int, Floats, Floats]], x: Floats
) -> tuple[scipy.sparse.csr_array, Floats]:
    """H and gradient g of the joint system linearised at x. priors: (row, mean, information) of start poses."""
    pieces = [_expected(frame, x) for _, frame in frames]
    J = scipy.sparse.vstack([J for _, J in pieces], format="csr")
    H_f = scipy.sparse.block_diag([frame.info.H for _, frame in frames], format="csr")
    z = np.concatenate([z for z, _ in pieces])
    b = np.concatenate([frame.info.b for _, frame in frames])
    J_t = J.T.tocsr()
    H = J_t @ (H_f @ J)
    g = J_t @ (b - H_f @ z)
    if priors:
        n = len(x)
        H = H.tolil()
        for row, mean, information in priors:
            at = slice(row, row + 3)
            H[at, at] = H[at, at].toarray() + information
            g[at] += information @ (mean - x[at])
        H = H.tocsr().reshape(n, n)
    H = (H + H.T) * 0.5
    return scipy.sparse.csr_array(H), g


@one_thread
def solve(lives: Sequence[Life], classes: tuple[tuple[LandmarkName, ...], ...]) -> JointSolution:
    """The joint map of these lives, in canonical order (by vehicle, then life).

    Raises NumericalError where the system is not positive definite or Gauss-Newton does not converge.
    """
    row_of = {name: 2 * c for c, names in enumerate(classes) for name in names}
    poses, rows = _rows_of_poses(lives, 2 * len(classes))
    size = 2 * len(classes) + 3 * len(poses)
    frames = []
    for i, life in enumerate(lives):
        for f, delta in enumerate(life.frames):
            info = to_information(delta)
            if not len(info.variables) or info.variables[0] != POSE:
                raise NumericalError(f"frame {f} of {life.vehicle} holds no information about its pose")
            numbers = (info.variables[1:] - 1).tolist()
            landmark_rows = np.array([row_of[LandmarkName(life.vehicle, life.life, n)] for n in numbers], np.int64)
            frame = _Frame(info, np.asarray(life.start_pose, float), rows[i, f], rows[i, f + 1], landmark_rows)
            frames.append((i, frame))
    if not frames:
        raise NumericalError("nothing to solve: no vehicle has contributed anything yet")
    priors: list[tuple[int, Floats, Floats]] = [
        (rows[i, 0], np.asarray(life.start_pose, float), np.linalg.inv(np.asarray(life.start_pose_cov, np.float64)))
        for i, life in enumerate(lives)
        if rows[i, 0] >= 0
    ]
    x = _start_state(frames, size)
    linear = not priors and all(len(life.frames) == 1 for life in lives)
    for _ in range(ITERATIONS_MAX):
        H, g = assemble(frames, priors, x)
        step = _Factor(H).solve(g)
        x = x + step
        if linear or float(step @ (H @ step)) < STEP_TOLERANCE * size:
            break
    else:
        raise NumericalError(f"the joint map did not converge in {ITERATIONS_MAX} iterations")
    if not linear:
        H, _ = assemble(frames, priors, x)
    signatures = {LandmarkName(life.vehicle, life.life, n): s for life in lives for n, s in enumerate(life.signatures)}
    return JointSolution(
        H=H,
        b=H @ x,
        mean=x,
        classes=classes,
        signatures=tuple(signatures[names[0]] for names in classes),
        poses=tuple(poses),
    )


@one_thread
def marginal_covariances(solution: JointSolution) -> tuple[Floats, Floats]:
    """Exact marginals P_ii of every landmark (n, 2, 2), m^2, and pose (p, 3, 3).

    Up to DENSE_ROWS_MAX rows by a dense Cholesky inverse, above by blocks of columns of the sparse one.
    """
    n, p = len(solution.classes), len(solution.poses)
    landmarks, poses = np.empty((n, 2, 2)), np.empty((p, 3, 3))
    for low, P in _inverse_columns(solution.H):
        for column in range(low, low + P.shape[1]):
            if column < 2 * n:
                at = column - column % 2
                landmarks[column // 2, :, column % 2] = P[at : at + 2, column - low]
            else:
                k, axis = divmod(column - 2 * n, 3)
                at = 2 * n + 3 * k
                poses[k, :, axis] = P[at : at + 3, column - low]
    return (landmarks + landmarks.transpose(0, 2, 1)) / 2, (poses + poses.transpose(0, 2, 1)) / 2


def _inverse_columns(H: scipy.sparse.csr_array) -> Iterator[tuple[int, Floats]]:
    """Columns of H^-1: the number of the first, and the columns."""
    size = H.shape[0]
    if size <= DENSE_ROWS_MAX:
        factor, fault = scipy.linalg.lapack.dpotrf(H.toarray(), lower=1)
        lower, fault = scipy.linalg.lapack.dpotri(factor, lower=1) if fault == 0 else (factor, fault)
        if fault:
            raise NumericalError(f"information matrix of {size} rows is not positive definite: no covariances")
        yield 0, np.tril(lower) + np.tril(lower, -1).T
        return
    sparse_factor = _Factor(H)
    for low in range(0, size, COLUMNS_AT_ONCE):
        columns = np.zeros((size, min(COLUMNS_AT_ONCE, size - low)))
        columns[low + np.arange(columns.shape[1]), np.arange(columns.shape[1])] = 1.0
        yield low, sparse_factor.solve(columns)


def landmark_chi_square(solution: JointSolution, error: Floats, chosen: NDArray[np.bool_] | None = None) -> float:
    """d' P^-1 d with the joint covariance P of the chosen landmarks (all by default).

    Args:
        error: d, shape (k, 2), m, one row for each chosen landmark.
        chosen: which landmarks, shape (n,).
    """
    every = np.ones(len(solution.classes), bool)
    return marginal_chi_square(solution.H, np.flatnonzero(np.repeat(every if chosen is None else chosen, 2)), error)


def marginal_chi_square(H: scipy.sparse.csr_array, rows: Ints, error: Floats) -> float:
    """d' P^-1 d with the joint covariance P of the chosen rows of a system with information H.

    P^-1 is the Schur complement of all other variables: H_cc - H_co H_oo^-1 H_oc.

    Args:
        rows: which rows, ascending, shape (k,).
        error: d, k values in any shape.

    Raises:
        NumericalError: H is not positive definite.
    """
    other = np.setdiff1d(np.arange(H.shape[0]), rows)
    d = error.ravel()
    value = float(d @ (H[rows][:, rows] @ d))
    if len(other):
        pulled = H[other][:, rows] @ d
        value -= float(pulled @ _Factor(H[other][:, other]).solve(pulled))
    return value
