"""Where a vehicle is and what lies around it, as one dense Gaussian in the coordinates of the open frame.

1. It begins as the landmarks near the frame's start, as the vehicle's own map of closed frames knows them, with their
   joint covariance; the pose is (0, 0, 0) there, exactly. Then it is a textbook EKF over pose and landmarks.
2. It serves to tell which landmark a sighting belongs to, and nothing of it is published: the frame's filter takes the
   readings alone (DESIGN D4, D5).
3. Its size is bounded, whatever the size of the map.
4. Every function returns a new map: a step that is refused in the end has changed nothing.
"""

from dataclasses import dataclass

import numpy as np

from fleet_seif.dense import cholesky_into, inverse_2x2
from fleet_seif.errors import NumericalError
from fleet_seif.geometry import wrap
from fleet_seif.jit import kernel
from fleet_seif.models import COMPASS_XY, heading_column, innovation_numbers, move, place, sight_numbers
from fleet_seif.records import Floats, Ints


@dataclass(frozen=True, eq=False)
class LocalMap:
    """mean (3 + 2 k,): pose, then landmarks, m and rad. P (3 + 2 k, 3 + 2 k): its covariance. keys (k,): theirs."""

    mean: Floats
    P: Floats
    keys: Ints

    @property
    def landmarks(self) -> Floats:
        """Shape (k, 2), m."""
        return self.mean[3:].reshape(-1, 2)

    @property
    def pose(self) -> Floats:
        """Shape (3,)."""
        return self.mean[:3]


def nothing_known() -> LocalMap:
    """A frame's start, without a landmark."""
    return LocalMap(np.zeros(3), np.zeros((3, 3)), np.empty(0, np.int64))


@kernel
def _blocks(model: int, mean: Floats, which: Ints) -> tuple[Floats, Floats, Floats]:
    """Expected sightings h (c, 2) of these landmarks, and their Jacobians J_z_x (c, 2, 3), J_z_y (c, 2, 2)."""
    h, J_x, J_y = np.empty((len(which), 2)), np.zeros((len(which), 2, 3)), np.empty((len(which), 2, 2))
    for i in range(len(which)):
        a = 3 + 2 * which[i]
        h0, h1, x00, x01, y00, y01, x10, x11, y10, y11 = sight_numbers(model, mean[:3], mean[a], mean[a + 1])
        h[i, 0], h[i, 1] = h0, h1
        J_x[i, 0, 0], J_x[i, 0, 1], J_x[i, 1, 0], J_x[i, 1, 1] = x00, x01, x10, x11
        J_x[i, 1, 2] = heading_column(model)
        J_y[i, 0, 0], J_y[i, 0, 1], J_y[i, 1, 0], J_y[i, 1, 1] = y00, y01, y10, y11
    return h, J_x, J_y


@kernel
def _spread(P: Floats, which: Ints, J_x: Floats, J_y: Floats) -> Floats:
    """J P for sightings of these landmarks, shape (2 c, n)."""
    n, out = len(P), np.empty((2 * len(which), len(P)))
    for i in range(len(which)):
        a = 3 + 2 * which[i]
        for k in range(2):
            for j in range(n):
                out[2 * i + k, j] = (
                    P[0, j] * J_x[i, k, 0] + P[1, j] * J_x[i, k, 1] + P[2, j] * J_x[i, k, 2]
                    + P[a, j] * J_y[i, k, 0] + P[a + 1, j] * J_y[i, k, 1]
                )  # fmt: skip
    return out


@kernel
def _seen(spread: Floats, which: Ints, J_x: Floats, J_y: Floats) -> Floats:
    """(J P) J' for the same sightings, shape (2 c, 2 c)."""
    m, out = 2 * len(which), np.empty((2 * len(which), 2 * len(which)))
    for c in range(m):
        for i in range(len(which)):
            a = 3 + 2 * which[i]
            for k in range(2):
                out[c, 2 * i + k] = (
                    J_x[i, k, 0] * spread[c, 0] + J_x[i, k, 1] * spread[c, 1] + J_x[i, k, 2] * spread[c, 2]
                    + J_y[i, k, 0] * spread[c, a] + J_y[i, k, 1] * spread[c, a + 1]
                )  # fmt: skip
    return (out + out.T) / 2


@kernel
def _rows(which: Ints) -> Ints:
    """Rows of the pose and of these landmarks, shape (3 + 2 c,)."""
    rows = np.arange(3 + 2 * len(which))
    for i in range(len(which)):
        rows[3 + 2 * i], rows[4 + 2 * i] = 3 + 2 * which[i], 4 + 2 * which[i]
    return rows


@kernel
def _kept(mean: Floats, P: Floats, rows: Ints) -> tuple[Floats, Floats]:
    part = np.empty((len(rows), len(rows)))
    for i in range(len(rows)):
        for j in range(len(rows)):
            part[i, j] = P[rows[i], rows[j]]
    return mean[rows], part


@kernel
def expected(model: int, mean: Floats, P: Floats, which: Ints) -> tuple[Floats, Floats]:
    """Sightings of these landmarks: expected h (c, 2), their joint covariance J P J' (2 c, 2 c) without noise."""
    mean, P = _kept(mean, P, _rows(which))
    all_of_them = np.arange(len(which))
    h, J_x, J_y = _blocks(model, mean, all_of_them)
    return h, _seen(_spread(P, all_of_them, J_x, J_y), all_of_them, J_x, J_y)


@kernel
def in_reach(mean: Floats, P: Floats, reach: float, sigmas: float) -> Ints:
    """Landmarks that may be nearer than `reach`, given so many standard deviations of where they are from the pose."""
    count, found = 0, np.empty((len(mean) - 3) // 2, np.int64)
    for i in range(len(found)):
        a = 3 + 2 * i
        dx, dy = mean[a] - mean[0], mean[a + 1] - mean[1]
        variance = 0.0
        for k in range(2):
            variance += P[a + k, a + k] + P[k, k] - 2.0 * P[a + k, k]
        most = reach + sigmas * np.sqrt(max(variance, 0.0))
        if 0.0 < dx * dx + dy * dy <= most * most:
            found[count] = i
            count += 1
    return found[:count]


@kernel
def in_view(model: int, mean: Floats, reach_m: float, bearing: float) -> Ints:
    """Landmarks nearer than `reach_m`, and where headings count within `bearing` of straight ahead."""
    count, found = 0, np.empty((len(mean) - 3) // 2, np.int64)
    for i in range(len(found)):
        dx, dy = mean[3 + 2 * i] - mean[0], mean[4 + 2 * i] - mean[1]
        ahead = model == COMPASS_XY or abs(wrap(np.arctan2(dy, dx) - mean[2])) <= bearing
        if ahead and 0.0 < dx * dx + dy * dy <= reach_m * reach_m:
            found[count] = i
            count += 1
    return found[:count]


@kernel
def from_pose_std(P: Floats, i: int) -> float:
    """Largest standard deviation of where landmark i lies from the pose, the heading's share left out, m."""
    a = 3 + 2 * i
    xx = P[a, a] + P[0, 0] - 2.0 * P[a, 0]
    yy = P[a + 1, a + 1] + P[1, 1] - 2.0 * P[a + 1, 1]
    xy = P[a, a + 1] + P[0, 1] - P[a, 1] - P[a + 1, 0]
    return float(np.sqrt(max((xx + yy) / 2 + np.sqrt((xx - yy) ** 2 / 4 + xy * xy), 0.0)))


@kernel
def from_pose_stds(P: Floats, which: Ints) -> Floats:
    """The same of several landmarks, shape (c,)."""
    stds = np.empty(len(which))
    for k in range(len(which)):
        stds[k] = from_pose_std(P, which[k])
    return stds


@kernel
def squared_distances_from(model: int, x: Floats, mean: Floats, P: Floats, which: Ints, z: Floats, Z: Floats) -> Floats:
    """r' (Z + J_y P_yy J_y')^-1 r of sightings from a certain pose x (3,) with these landmarks, shape (s, c)."""
    out = np.empty((len(z), len(which)))
    for j in range(len(which)):
        a = 3 + 2 * which[j]
        h0, h1, _, _, y00, y01, _, _, y10, y11 = sight_numbers(model, x, mean[a], mean[a + 1])
        p, q, w = P[a, a], P[a, a + 1], P[a + 1, a + 1]
        c00 = y00 * y00 * p + 2.0 * y00 * y01 * q + y01 * y01 * w
        c01 = y00 * y10 * p + (y00 * y11 + y01 * y10) * q + y01 * y11 * w
        c11 = y10 * y10 * p + 2.0 * y10 * y11 * q + y11 * y11 * w
        for i in range(len(z)):
            r0, r1 = innovation_numbers(model, z[i, 0], z[i, 1], h0, h1)
            s00, s01, s11 = Z[i, 0, 0] + c00, Z[i, 0, 1] + c01, Z[i, 1, 1] + c11
            out[i, j] = (s11 * r0 * r0 - 2.0 * s01 * r0 * r1 + s00 * r1 * r1) / (s00 * s11 - s01 * s01)
    return out


@kernel
def _moved(model: int, mean: Floats, P: Floats, u: Floats, cov: Floats) -> tuple[Floats, Floats]:
    """x' = g(x, u)        P' = J_x P J_x' + J_u cov J_u', where J_x leaves landmarks as they are."""
    pose, J_x, J_u = move(model, mean[:3], u)
    mean, P = mean.copy(), P.copy()
    mean[:3] = pose
    for j in range(3, len(P)):
        a, b, c = P[0, j], P[1, j], P[2, j]
        for i in range(3):
            P[i, j] = P[j, i] = J_x[i, 0] * a + J_x[i, 1] * b + J_x[i, 2] * c
    old, new = P[:3, :3].copy(), np.zeros((3, 3))
    for i in range(3):
        for j in range(i + 1):
            for k in range(3):
                for m in range(3):
                    new[i, j] += J_x[i, k] * old[k, m] * J_x[j, m] + J_u[i, k] * cov[k, m] * J_u[j, m]
            P[i, j] = P[j, i] = new[i, j]
    return mean, P


def moved(model: int, local: LocalMap, u: Floats, cov: Floats) -> LocalMap:
    """After odometry u (3,) with covariance cov (3, 3)."""
    mean, P = _moved(model, local.mean, local.P, u, cov)
    return LocalMap(mean, P, local.keys)


@kernel
def _innovations(model: int, z: Floats, h: Floats) -> Floats:
    r = np.empty(2 * len(z))
    for i in range(len(z)):
        r[2 * i], r[2 * i + 1] = innovation_numbers(model, z[i, 0], z[i, 1], h[i, 0], h[i, 1])
    return r


@kernel
def _halved_into(gain: Floats, w: Floats, S: Floats) -> bool:
    """L^-1 J P in place of J P (m, n), L^-1 r in place of r (m,), S = L L'; False where S is not positive definite."""
    m = len(S)
    L = np.zeros((m, m))
    if not cholesky_into(L, S, m):
        return False
    for i in range(m):
        for k in range(i):
            w[i] -= L[i, k] * w[k]
            gain[i] -= L[i, k] * gain[k]
        w[i] /= L[i, i]
        gain[i] /= L[i, i]
    return True


@kernel
def _less(P: Floats, gain: Floats) -> Floats:
    """P - G'G, exactly symmetric; G (m, n) has an even number of rows. Loops: a library wakes threads for so little."""
    out = np.empty_like(P)
    for i in range(len(P)):
        for j in range(i + 1):
            out[i, j] = P[i, j]
        for k in range(0, len(gain), 2):
            a, b = gain[k, i], gain[k + 1, i]
            for j in range(i + 1):
                out[i, j] -= a * gain[k, j] + b * gain[k + 1, j]
    for i in range(len(P)):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


@kernel
def _sighted(
    model: int, mean: Floats, P: Floats, which: Ints, z: Floats, Z: Floats
) -> tuple[bool, Floats, Floats, float]:
    """Whether S is positive definite, then mean', P' and r' S^-1 r: see `sighted`."""
    h, J_x, J_y = _blocks(model, mean, which)
    gain = _spread(P, which, J_x, J_y)
    S, w = _seen(gain, which, J_x, J_y), _innovations(model, z, h)
    for i in range(len(which)):
        S[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += Z[i]
    if not _halved_into(gain, w, S):
        return False, mean, P, 0.0
    new, squared = mean.copy(), 0.0
    for k in range(len(w)):
        new += w[k] * gain[k]
        squared += w[k] * w[k]
    return True, new, _less(P, gain), squared


def sighted(model: int, local: LocalMap, which: Ints, z: Floats, Z: Floats) -> tuple[LocalMap, float]:
    """After sightings of these landmarks, all at once; and the squared normalised innovation r' S^-1 r.

    S = J P J' + Z        mean' = mean + P J' S^-1 r        P' = P - P J' S^-1 J P

    Raises NumericalError where S is not positive definite.

    Args:
        which (m,): positions in the map. z (m, 2), Z (m, 2, 2).
    """
    if not len(which):
        return local, 0.0
    sound, mean, P, squared = _sighted(model, local.mean, local.P, which, z, Z)
    if not sound:
        raise NumericalError("the covariance of sightings is not positive definite: reading refused")
    return LocalMap(mean, P, local.keys), squared


@kernel
def _with_new(model: int, mean: Floats, P: Floats, y: Floats, Z: Floats) -> tuple[Floats, Floats]:
    n = len(mean)
    whole, wider = np.concatenate((mean, y)), np.empty((n + 2, n + 2))
    _, J_x, J_y = _blocks(model, whole, np.full(1, (n - 3) // 2))
    G_z = inverse_2x2(J_y[0])
    wider[:n, :n] = P
    for i in range(2):
        g = -(G_z[i, 0] * J_x[0, 0] + G_z[i, 1] * J_x[0, 1])
        wider[n + i, :n] = g[0] * P[0] + g[1] * P[1] + g[2] * P[2]
        wider[:n, n + i] = wider[n + i, :n]
        for j in range(i + 1):
            f = -(G_z[j, 0] * J_x[0, 0] + G_z[j, 1] * J_x[0, 1])
            total = 0.0
            for k in range(3):
                total += wider[n + i, k] * f[k]
            for k in range(2):
                for m in range(2):
                    total += G_z[i, k] * Z[k, m] * G_z[j, m]
            wider[n + i, n + j] = wider[n + j, n + i] = total
    return whole, wider


def with_new(model: int, local: LocalMap, key: int, z: Floats, Z: Floats) -> LocalMap:
    """With one more landmark, where a sighting puts it: y = f(x, z), P_yy = G_x P_xx G_x' + G_z Z G_z'."""
    mean, P = _with_new(model, local.mean, local.P, place(model, local.pose, z), Z)
    return LocalMap(mean, P, np.append(local.keys, key))


def kept(local: LocalMap, which: Ints) -> LocalMap:
    """Only these landmarks."""
    return LocalMap(*_kept(local.mean, local.P, _rows(which)), local.keys[which])


@kernel
def _seen_from(R_T: Floats, turn: Floats, P: Floats) -> Floats:
    """J P J' with J = [-R'  turn  R'] for each landmark, P (3 + 2 k, 3 + 2 k) pose first, turn (2 k,)."""
    n = len(P) - 3
    half = np.empty((n, n + 3))
    for i in range(n):
        a, b = R_T[i % 2, 0], R_T[i % 2, 1]
        first = 3 + i - i % 2
        for j in range(n + 3):
            half[i, j] = a * (P[first, j] - P[0, j]) + b * (P[first + 1, j] - P[1, j]) + turn[i] * P[2, j]
    out = np.empty((n, n))
    for j in range(n):
        a, b = R_T[j % 2, 0], R_T[j % 2, 1]
        first = 3 + j - j % 2
        for i in range(n):
            out[i, j] = a * (half[i, first] - half[i, 0]) + b * (half[i, first + 1] - half[i, 1]) + turn[j] * half[i, 2]
    return out


def seen_from(start: Floats, landmarks: Floats, P: Floats, keys: Ints) -> LocalMap:
    """Landmarks (k, 2) in the world, as seen from the pose `start` (3,) that becomes the origin.

    y' = R'(y - t):   J_y'_t = -R'   J_y'_theta = (y'_y, -y'_x)   J_y'_y = R'

    Args:
        P: joint covariance of `start` and the landmarks, shape (3 + 2 k, 3 + 2 k).
    """
    c, s = np.cos(start[2]), np.sin(start[2])
    R_T = np.array([[c, s], [-s, c]])
    y = (landmarks - start[:2]) @ R_T.T
    k = len(y)
    turn = np.column_stack([y[:, 1], -y[:, 0]]).ravel()
    whole = np.zeros((3 + 2 * k, 3 + 2 * k))
    whole[3:, 3:] = _seen_from(R_T, turn, P)
    return LocalMap(np.concatenate([np.zeros(3), y.ravel()]), (whole + whole.T) / 2, keys)


def begun_at(local: LocalMap) -> LocalMap:
    """The map as seen from its pose, which becomes the origin: for landmarks that the next frame goes on with."""
    pose, landmarks = local.pose, local.landmarks
    return seen_from(np.array([*pose[:2], wrap(pose[2])]), landmarks, local.P, local.keys)
