"""Slow, dense textbook versions of what the library does, written from the papers in plain numpy.

Nothing here calls a kernel. Where accuracy is what a test is about, the algebra runs in long double, so that a
difference is the library's and not the reference's. Equation numbers are those of Thrun et al., IJRR 2004.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fleet_seif.information import FrameDelta
from fleet_seif.models import COMPASS_XY
from fleet_seif.records import Floats, Reading, Sightings

Long = NDArray[Any]
H_STEP, B_STEP = 2.0**-28, 2.0**-24


def solve(A: Long, B: Long) -> Long:
    """X with A X = B in long double, by Gaussian elimination with partial pivoting."""
    n = len(A)
    M = np.hstack([np.asarray(A, np.longdouble), np.asarray(B, np.longdouble).reshape(n, -1)])
    for i in range(n):
        pivot = i + int(np.argmax(np.abs(M[i:, i])))
        M[[i, pivot]] = M[[pivot, i]]
        M[i] /= M[i, i]
        factors = M[:, i].copy()
        factors[i] = 0.0
        M -= factors[:, None] * M[i]
    return cast(Long, M[:, n:].reshape(np.shape(B)))


def invert(A: Long) -> Long:
    X = solve(A, np.eye(len(A)))
    return cast(Long, (X + X.T) / 2)


def rotation(theta: float) -> Floats:
    return np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])


def matrix(T: Floats) -> Floats:
    """A pose as a homogeneous matrix, shape (3, 3)."""
    M = np.eye(3)
    M[:2, :2], M[:2, 2] = rotation(T[2]), T[:2]
    return M


def numeric_jacobian(f: Callable[[Floats], Floats], x: Floats, h: float = 1e-6) -> Floats:
    """df/dx by central differences: error of about h^2 times the third derivative, plus 1e-16 |f| / h."""
    columns = []
    for i in range(len(x)):
        step = np.zeros(len(x))
        step[i] = h
        columns.append((f(x + step) - f(x - step)) / (2.0 * h))
    return np.array(columns).T


def moved(model: int, x: Floats, u: Floats) -> Floats:
    """Pose after an increment."""
    if model == COMPASS_XY:
        return np.asarray(x + u)
    M = matrix(x) @ matrix(u)
    return np.array([M[0, 2], M[1, 2], x[2] + u[2]])


def motion_jacobians(model: int, x: Floats, u: Floats) -> tuple[Floats, Floats]:
    """F = dx'/dx and G = dx'/du."""
    F, G = np.eye(3), np.eye(3)
    if model != COMPASS_XY:
        quarter = rotation(x[2] + math.pi / 2)
        F[:2, 2] = quarter @ u[:2]
        G[:2, :2] = rotation(x[2])
    return F, G


def expected(model: int, x: Floats, y: Floats) -> Floats:
    """What pose x would see of landmark y."""
    d = y - x[:2]
    if model == COMPASS_XY:
        return np.asarray(d)
    return np.array([math.hypot(d[0], d[1]), math.remainder(math.atan2(d[1], d[0]) - x[2], math.tau)])


def sighting_jacobian(model: int, x: Floats, y: Floats) -> Floats:
    """dh/d(x, y), shape (2, 5): the direction to the landmark and its perpendicular, over the distance."""
    if model == COMPASS_XY:
        return np.hstack([-np.eye(2), np.zeros((2, 1)), np.eye(2)])
    d = y - x[:2]
    distance = math.hypot(d[0], d[1])
    along = d / distance
    across = np.array([-along[1], along[0]]) / distance
    J_y = np.array([along, across])
    return np.hstack([-J_y, np.array([[0.0], [-1.0]]), J_y])


def placed(model: int, x: Floats, z: Floats) -> Floats:
    """Where a sighting puts a landmark."""
    return np.asarray(x[:2] + (z if model == COMPASS_XY else rotation(x[2] + z[1]) @ np.array([z[0], 0.0])))


def difference(model: int, z: Floats, h: Floats) -> Floats:
    r = z - h
    if model != COMPASS_XY:
        r[1] = math.remainder(r[1], math.tau)
    return np.asarray(r)


def motion_update(H: Long, b: Long, mu: Floats, model: int, u: Floats, cov: Floats) -> tuple[Long, Long, Floats]:
    """Prediction in moments: the true mean H^-1 b and covariance H^-1, propagated with the Jacobians at mu."""
    n = len(b)
    F, G = np.eye(n), np.zeros((n, 3))
    F[:3, :3], G[:3] = motion_jacobians(model, mu[:3], u)
    P = invert(H)
    m = P @ b
    new_mu = mu.copy()
    new_mu[:3] = moved(model, mu[:3], u)
    P = F @ P @ F.T + G @ cov @ G.T
    m = new_mu + F @ (m - mu)
    new_H = invert(P)
    return new_H, new_H @ m, new_mu


def measurement_update(
    H: Long, b: Long, mu: Floats, model: int, z: Floats, Z: Floats, at: Sequence[int]
) -> tuple[Long, Long]:
    """Eq. (17), (18) for all sightings of a step at once: stacked Jacobian J, block-diagonal noise."""
    n, k = len(b), len(z)
    J, r, W = np.zeros((2 * k, n)), np.zeros(2 * k), np.zeros((2 * k, 2 * k))
    for i in range(k):
        y = mu[at[i] : at[i] + 2]
        rows = slice(2 * i, 2 * i + 2)
        J[rows, [0, 1, 2, at[i], at[i] + 1]] = 0.0
        J[np.ix_(range(2 * i, 2 * i + 2), [0, 1, 2, at[i], at[i] + 1])] = sighting_jacobian(model, mu[:3], y)
        r[rows] = difference(model, z[i], expected(model, mu[:3], y))
        W[rows, rows] = np.linalg.inv(Z[i])
    return H + J.T @ W @ J, b + J.T @ W @ (r + J @ mu)


class DenseEif:
    """The extended information filter over the pose and all landmarks: nothing sparse, an exact mean each step."""

    def __init__(self, model: int, start_information: float) -> None:
        self.model = model
        self.H: Long = start_information * np.eye(3, dtype=np.longdouble)
        self.b: Long = np.zeros(3, np.longdouble)
        self.mu = np.zeros(3)
        self._at: dict[int, int] = {}

    def see(self, seen: Sightings) -> None:
        for z, signature in zip(seen.z, seen.signature.tolist(), strict=True):
            if signature not in self._at:
                n = len(self.b)
                self._at[signature] = n
                self.H = np.pad(self.H, (0, 2))
                self.b = np.pad(self.b, (0, 2))
                self.mu = np.concatenate([self.mu, placed(self.model, self.mu[:3], z)])
        at = [self._at[signature] for signature in seen.signature.tolist()]
        self.H, self.b = measurement_update(self.H, self.b, self.mu, self.model, seen.z, seen.cov, at)
        self.mu = solve(self.H, self.b).astype(float)

    def step(self, reading: Reading) -> None:
        self.H, self.b, self.mu = motion_update(
            self.H, self.b, self.mu, self.model, reading.odometry, reading.odometry_cov
        )
        self.see(reading.sightings)


def sparsified(H: Floats, b: Floats, mu: Floats, stay: Sequence[int], drop: Sequence[int]) -> tuple[Floats, Floats]:
    """Eq. (42), (43) with projection matrices; stay and drop: rows of the landmarks that stay active or are dropped."""

    def F(rows: Sequence[int]) -> Floats:
        return np.eye(len(H))[:, list(rows)]

    def term(A: Floats, rows: Sequence[int]) -> Floats:
        return np.asarray(A @ F(rows) @ np.linalg.inv(F(rows).T @ A @ F(rows)) @ F(rows).T @ A)

    x = [0, 1, 2]
    S = F([*x, *stay, *drop])
    H0 = S @ S.T @ H @ S @ S.T
    H_new = H - term(H0, drop) + term(H0, [*x, *drop]) - term(H, x)
    return H_new, b + (H_new - H) @ mu


def batch(
    model: int, runs: Sequence[tuple[Floats, float, Sightings, Sequence[Reading]]]
) -> tuple[list[Floats], dict[int, Floats], Floats]:
    """Least squares over all readings of a linear world at once: every pose and landmark is an unknown.

    runs: start pose (3,), its information, what is seen there, readings. Returns each run's last pose, the landmark of
    each signature, and the standard deviations of those landmarks (m, 2) in the order of the table.
    """
    assert model == COMPASS_XY
    signatures = sorted({s for _, _, seen, readings in runs for s in _signatures(seen, readings)})
    poses = [3 * (len(readings) + 1) for _, _, _, readings in runs]
    column = {s: sum(poses) + 2 * i for i, s in enumerate(signatures)}
    n = sum(poses) + 2 * len(signatures)
    J: list[Floats] = []
    r: list[Floats] = []

    def add(blocks: Sequence[tuple[int, Floats]], value: Floats, root: Floats) -> None:
        """One reading: sum of blocks @ state = value, with inverse square root of its covariance."""
        row = np.zeros((len(value), n))
        for at, block in blocks:
            row[:, at : at + block.shape[1]] = block
        J.append(root @ row)
        r.append(root @ value)

    def see(pose: int, seen: Sightings) -> None:
        for z, Z, s in zip(seen.z, seen.cov, seen.signature.tolist(), strict=True):
            add([(pose, -np.eye(2, 3)), (column[s], np.eye(2))], z, whitener(Z))

    for i, (start, information, seen, readings) in enumerate(runs):
        pose = sum(poses[:i])
        add([(pose, np.eye(3))], start, math.sqrt(information) * np.eye(3))
        see(pose, seen)
        for reading in readings:
            add([(pose, -np.eye(3)), (pose + 3, np.eye(3))], reading.odometry, whitener(reading.odometry_cov))
            pose += 3
            see(pose, reading.sightings)
    Q, R = np.linalg.qr(np.vstack(J))
    x = np.linalg.solve(R, Q.T @ np.concatenate(r))
    ends = [x[end - 3 : end] for end in np.cumsum(poses)]
    std = np.linalg.norm(np.linalg.inv(R), axis=1)[sum(poses) :].reshape(-1, 2)
    return ends, {s: x[at : at + 2] for s, at in column.items()}, std


def _signatures(seen: Sightings, readings: Sequence[Reading]) -> list[int]:
    return [s for each in [seen, *(r.sightings for r in readings)] for s in each.signature.tolist()]


def whitener(cov: Floats) -> Floats:
    """W with W' W = cov^-1."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))


Blocks = dict[tuple[int, int], NDArray[np.object_]]


def size_of(variable: int) -> int:
    return 3 if variable == 0 else 2


def blocks_of(delta: FrameDelta) -> tuple[Blocks, dict[int, NDArray[np.object_]]]:
    """A delta as plain tables of full blocks (upper triangle of variables) and vectors, of Python integers."""
    H: Blocks = {}
    b: dict[int, NDArray[np.object_]] = {}
    values = iter(delta.H.tolist())
    variables = delta.variables.tolist()
    for i, j in zip(delta.rows.tolist(), delta.cols.tolist(), strict=True):
        v, w = variables[i], variables[j]
        block = np.zeros((size_of(v), size_of(w)), object)
        for r in range(size_of(v)):
            for c in range(r if v == w else 0, size_of(w)):
                block[r, c] = next(values)
                if v == w:
                    block[c, r] = block[r, c]
        H[v, w] = block
    assert next(values, None) is None
    values = iter(delta.b.tolist())
    for v in variables:
        b[v] = np.array([next(values) for _ in range(size_of(v))], object)
    assert next(values, None) is None
    return H, b


def summed(deltas: Sequence[FrameDelta]) -> tuple[Blocks, dict[int, NDArray[np.object_]]]:
    """The sum of deltas as tables, without blocks and vectors that are zero."""
    H: Blocks = {}
    b: dict[int, NDArray[np.object_]] = {}
    for delta in deltas:
        more_H, more_b = blocks_of(delta)
        for place, block in more_H.items():
            H[place] = H.get(place, np.zeros_like(block)) + block
        for v, vector in more_b.items():
            b[v] = b.get(v, np.zeros_like(vector)) + vector
    return {k: x for k, x in H.items() if np.any(x != 0)}, {k: x for k, x in b.items() if np.any(x != 0)}


def dense(H: Blocks, b: dict[int, NDArray[np.object_]], variables: Sequence[int]) -> tuple[Floats, Floats]:
    """Tables as a dense symmetric matrix and a vector, in SI units."""
    at = dict(zip(variables, np.cumsum([0, *(size_of(v) for v in variables)]).tolist(), strict=False))
    n = sum(size_of(v) for v in variables)
    full_H, full_b = np.zeros((n, n)), np.zeros(n)
    for (v, w), block in H.items():
        rows, cols = slice(at[v], at[v] + size_of(v)), slice(at[w], at[w] + size_of(w))
        full_H[rows, cols] = block.astype(float) * H_STEP
        full_H[cols, rows] = block.T.astype(float) * H_STEP
    for v, vector in b.items():
        full_b[at[v] : at[v] + size_of(v)] = vector.astype(float) * B_STEP
    return full_H, full_b


def quantised(H: Floats, b: Floats, variables: Sequence[int]) -> FrameDelta:
    """A dense frame as a cumulative delta with every block written down; H and b must be whole multiples of the quanta
    or lose what is below them."""
    at = np.cumsum([0, *(size_of(v) for v in variables)]).tolist()
    rows, cols, values = [], [], []
    for i, v in enumerate(variables):
        for j in range(i, len(variables)):
            rows.append(i)
            cols.append(j)
            for r in range(size_of(v)):
                for c in range(r if i == j else 0, size_of(variables[j])):
                    values.append(round(float(H[at[i] + r, at[j] + c]) / H_STEP))
    return FrameDelta(
        variables=np.array(variables, np.int64),
        rows=np.array(rows, np.int64),
        cols=np.array(cols, np.int64),
        H=np.array(values, np.int64),
        b=np.array([round(float(x) / B_STEP) for x in b], np.int64),
    )


def relative_pose(T_wa: Floats, T_wb: Floats) -> Floats:
    """T_wa^-1 T_wb, headings subtracted."""
    return np.append(rotation(T_wa[2]).T @ (T_wb[:2] - T_wa[:2]), T_wb[2] - T_wa[2])


def seen_from(T_wf: Floats, y: Floats) -> Floats:
    return np.asarray(rotation(T_wf[2]).T @ (y - T_wf[:2]))


def joint_solution(
    frames: Sequence[tuple[Floats, Floats, Callable[[Long], Long]]],
    priors: Sequence[tuple[int, Floats, Floats]],
    x: Floats,
) -> tuple[Floats, Floats]:
    """Gauss-Newton from x until it stands still: the mean, and H linearised there.

    frames: H, b and z(x) of each, z written so that complex numbers pass through it. priors: row, mean, covariance.
    """
    n = len(x)
    for _ in range(100):
        H, g = np.zeros((n, n)), np.zeros(n)
        for H_f, b_f, z in frames:
            J = np.array([z(x + 1e-30j * row).imag / 1e-30 for row in np.eye(n)]).T
            H += J.T @ H_f @ J
            g += J.T @ (b_f - H_f @ z(x.astype(complex)).real)
        for row, mean, cov in priors:
            at = slice(row, row + 3)
            H[at, at] += np.linalg.inv(cov)
            g[at] += np.linalg.solve(cov, mean - x[at])
        step = np.linalg.solve(H, g)
        x = x + step
        if step @ H @ step < 1e-20:
            return x, H
    raise AssertionError("the reference did not converge: a case for another test")


def frame_view(start: Long, end: Long, points: Long) -> Long:
    """z_f: the end pose and points (m, 2) as seen from the start pose; complex numbers pass through."""
    c, s = np.cos(start[2]), np.sin(start[2])
    back = np.array([[c, s], [-s, c]])
    local = (np.vstack([end[None, :2], points]) - start[:2]) @ back.T
    return np.concatenate([local[0], [end[2] - start[2]], local[1:].ravel()])


def same(a: Any, b: Any) -> bool:
    """Equal in every field and type, arrays to the bit."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if type(a) is not type(b):
        return False
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)
