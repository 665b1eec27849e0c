"""What frames say about the joint state at X: cost, gradient, and their part of the joint information matrix.

With z_f = (T_f^-1 T_f+1, T_f^-1 y_j ...), the frame's own mean m_f, r = z_f - m_f (its heading without whole turns,
which stay the same while the cost is brought down: it is smooth):

    chi_f = r' H_f r        cost = sum_f rho(chi_f) + priors        g = sum_f w_f J_f' (-H_f r) + priors
    H = sum_f w_f J_f' H_f J_f + priors

-H_f r is b_f - H_f z_f on that branch. rho is Huber's: chi up to the frame's limit c, beyond 2 sqrt(c chi) - c, with
the weight w = sqrt(c / chi); g is minus half its gradient.

Moving start, end and landmarks together by one rigid motion leaves z_f as it is. So the columns of J_f for T_f are
minus the sum of the others', times what they do when the world turns round T_f: with d = y - t_f,

    J_start = -sum_k J_k G_k        G = [1 0 -d_y; 0 1 d_x]  (landmark; a pose has the row 0 0 1 as well)

and J_k is R' on x and y. Blocks of H_f are rotated into the world, B = R H_ij R', and T_f gets -G'B and G'BG.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse

from fleet_seif.errors import NumericalError
from fleet_seif.jit import kernel, long_kernel
from fleet_seif.joint_frames import Frames, row_of
from fleet_seif.records import Floats, Ints
from fleet_seif.robust import huber


class Evaluation(NamedTuple):
    """What frames say at X (v, 3): the cost, minus half its gradient g (v, 3); by frame its chi-square and weight, by
    row of a frame its view z."""

    X: Floats
    cost: float
    g: Floats
    z: Floats
    chi_square: Floats
    weight: Floats


@kernel
def _pose_of(frames: Frames, f: int, X: Floats) -> tuple[float, float, float]:
    """T_f."""
    if frames.start[f] < 0:
        return frames.given[f, 0], frames.given[f, 1], frames.given[f, 2]
    return X[frames.start[f], 0], X[frames.start[f], 1], X[frames.start[f], 2]


@kernel
def view_into(z: Floats, frames: Frames, f: int, X: Floats) -> None:
    """z_f, written to the rows of frame f."""
    tx, ty, angle = _pose_of(frames, f, X)
    c, s = math.cos(angle), math.sin(angle)
    row = frames.first_row[f]
    for v in range(frames.first_variable[f], frames.end_variable[f]):
        x = X[frames.variable[v]]
        dx, dy = x[0] - tx, x[1] - ty
        z[row], z[row + 1] = c * dx + s * dy, -s * dx + c * dy
        row += 2
        if v == frames.first_variable[f]:
            z[row] = x[2] - angle
            row += 1


@kernel
def _times_into(q: Floats, frames: Frames, f: int, r: Floats) -> None:
    """q = H_f r."""
    q[:] = 0.0
    for k in range(frames.first_block[f], frames.end_block[f]):
        p, o, at = frames.rows[k], frames.cols[k], frames.starts[k]
        i, j = row_of(p), row_of(o)
        for a in range(3 if p == 0 else 2):
            for b in range(a if p == o else 0, 3 if o == 0 else 2):
                h = frames.values[at]
                at += 1
                q[i + a] += h * r[j + b]
                if i + a != j + b:
                    q[j + b] += h * r[i + a]


@kernel
def _pull_into(g: Floats, frames: Frames, f: int, X: Floats, q: Floats) -> None:
    """g -= J_f' q, g (v, 3) by joint variable."""
    tx, ty, angle = _pose_of(frames, f, X)
    c, s = math.cos(angle), math.sin(angle)
    first, start = frames.first_variable[f], frames.start[f]
    row = 0
    for v in range(first, frames.end_variable[f]):
        i = frames.variable[v]
        u, w = c * q[row] - s * q[row + 1], s * q[row] + c * q[row + 1]
        turn = (X[i, 0] - tx) * w - (X[i, 1] - ty) * u
        g[i, 0] -= u
        g[i, 1] -= w
        row += 2
        if v == first:
            g[i, 2] -= q[row]
            turn += q[row]
            row += 1
        if start >= 0:
            g[start, 0] += u
            g[start, 1] += w
            g[start, 2] += turn


@kernel
def turns_into(turns: Floats, frames: Frames, chosen: Ints, X: Floats) -> None:
    """Whole turns to take off what headings of frames (column 0) and of priors (column 1) differ from theirs, rad."""
    for f in chosen:
        t, first, row = frames.start[f], frames.first_variable[f], frames.first_row[f]
        angle = frames.given[f, 2] if t < 0 else X[t, 2]
        if frames.end_variable[f] > first:
            ahead = X[frames.variable[first], 2] - angle - frames.mean[row + 2]
            turns[f, 0] = 2.0 * math.pi * math.floor(ahead / (2.0 * math.pi) + 0.5)
        turns[f, 1] = 2.0 * math.pi * math.floor((angle - frames.given[f, 2]) / (2.0 * math.pi) + 0.5)


@long_kernel
def evaluate_into(
    g: Floats, z: Floats, chi_square: Floats, weight: Floats, frames: Frames, chosen: Ints, X: Floats, turns: Floats
) -> float:
    """Cost, gradient, and each chosen frame's view, chi-square and weight at X. Returns the cost.

    g (v, 3): zero at first. z (n,): rows of all frames. chi_square, weight (f,). turns (f, 2): see turns_into.
    """
    most = 0
    for f in chosen:
        most = max(most, frames.end_row[f] - frames.first_row[f])
    r, q, cost = np.empty(most), np.empty(most), 0.0
    for f in chosen:
        begin, end = frames.first_row[f], frames.end_row[f]
        n = end - begin
        view_into(z, frames, f, X)
        for i in range(n):
            r[i] = z[begin + i] - frames.mean[begin + i]
        if n > 0:
            r[2] -= turns[f, 0]
        _times_into(q[:n], frames, f, r)
        chi = 0.0
        for i in range(n):
            chi += r[i] * q[i]
        limit = frames.limit[f]
        chi_square[f] = chi
        chi, weight[f] = huber(chi, limit)
        cost += chi
        for i in range(n):
            q[i] *= weight[f]
        _pull_into(g, frames, f, X, q)
        if frames.start[f] >= 0:
            cost += _prior_into(g, frames, f, X, turns[f, 1])
    return cost


@kernel
def _prior_into(g: Floats, frames: Frames, f: int, X: Floats, turn: float) -> float:
    """Cost of the prior of T_f, and its part of g."""
    t, cost = frames.start[f], 0.0
    for a in range(3):
        q = 0.0
        for b in range(3):
            q += frames.prior[f, a, b] * (X[t, b] - frames.given[f, b] - (turn if b == 2 else 0.0))
        g[t, a] -= q
        cost += q * (X[t, a] - frames.given[f, a] - (turn if a == 2 else 0.0))
    return cost


@long_kernel
def moved_frames(
    frames: Frames, chosen: Ints, X: Floats, z: Floats, weight: Floats,
    heading_then: Floats, z_then: Floats, weight_then: Floats, tolerance: float,
) -> Ints:  # fmt: skip
    """Those of the chosen frames whose J or weight differs by more than `tolerance` from what it was, relative.

    J depends on the heading of T_f and on z_f; where T_f is given, on nothing. What it was is NaN for a new frame.
    """
    moved, count = np.empty(len(chosen), np.int64), 0
    for f in chosen:
        same = abs(weight[f] - weight_then[f]) <= tolerance * weight_then[f]
        if frames.start[f] >= 0:
            same = same and abs(X[frames.start[f], 2] - heading_then[f]) <= tolerance
            for i in range(frames.first_row[f], frames.end_row[f]):
                scale = 1.0 if i - frames.first_row[f] == 2 else frames.scale[f]
                same = same and abs(z[i] - z_then[i]) <= tolerance * scale
        if not same:
            moved[count] = f
            count += 1
    return moved[:count].copy()


@kernel
def remember_into(
    heading_then: Floats, z_then: Floats, weight_then: Floats,
    frames: Frames, chosen: Ints, X: Floats, z: Floats, weight: Floats,
) -> None:  # fmt: skip
    """Note where frames are linearised."""
    for f in chosen:
        heading_then[f] = X[frames.start[f], 2] if frames.start[f] >= 0 else 0.0
        weight_then[f] = weight[f]
        for i in range(frames.first_row[f], frames.end_row[f]):
            z_then[i] = z[i]


@kernel
def place_into(X: Floats, known: Ints, frames: Frames, chosen: Ints) -> None:
    """First estimates, frame by frame: the frame's own mean seen from T_f. known (v,): 1 where X has one already."""
    for f in chosen:
        start, row = frames.start[f], frames.first_row[f]
        if start >= 0 and known[start] == 0:
            known[start] = 1
            for a in range(3):
                X[start, a] = frames.given[f, a]
        tx, ty, angle = _pose_of(frames, f, X)
        c, s = math.cos(angle), math.sin(angle)
        for v in range(frames.first_variable[f], frames.end_variable[f]):
            i, m_x, m_y = frames.variable[v], frames.mean[row], frames.mean[row + 1]
            if known[i] == 0:
                X[i, 0], X[i, 1], known[i] = tx + c * m_x - s * m_y, ty + s * m_x + c * m_y, 1
                X[i, 2] = angle + frames.mean[row + 2] if v == frames.first_variable[f] else 0.0
            row += 3 if v == frames.first_variable[f] else 2


@kernel
def _world_block_into(B: Floats, frames: Frames, k: int, c: float, s: float, weight: float) -> None:
    """B (3, 3) = w R H_ij R' of block k."""
    p, o, at = frames.rows[k], frames.cols[k], frames.starts[k]
    rows, cols = 3 if p == 0 else 2, 3 if o == 0 else 2
    for a in range(rows):
        for b in range(a if p == o else 0, cols):
            B[a, b] = weight * frames.values[at]
            if p == o:
                B[b, a] = B[a, b]
            at += 1
    for b in range(cols):
        u, w = B[0, b], B[1, b]
        B[0, b], B[1, b] = c * u - s * w, s * u + c * w
    for a in range(rows):
        u, w = B[a, 0], B[a, 1]
        B[a, 0], B[a, 1] = c * u - s * w, s * u + c * w


@kernel
def _put_block(F: Floats, i: int, j: int, B: Floats, rows: int, cols: int, diagonal: bool) -> None:
    """Add a block and its transpose to F at (i, j). At i = j: the block alone where it is diagonal, else both."""
    for a in range(rows):
        for b in range(a if diagonal else 0, cols):
            x = 2.0 * B[a, b] if i == j and a == b and not diagonal else B[a, b]
            F[min(i + a, j + b), max(i + a, j + b)] += x


@kernel
def _put_turned(
    F: Floats, t: int, j: int, T: Floats, B: Floats, transposed: bool, rows: int, cols: int,
    d_i: tuple[float, float], d_j: tuple[float, float],
) -> None:  # fmt: skip
    """Add -G_i'B to F at (t, j), and G_i'B G_j to T. B or its transpose, (rows, cols); d_i, d_j: points less t_f."""
    for b in range(cols):
        B_0, B_1 = (B[b, 0], B[b, 1]) if transposed else (B[0, b], B[1, b])
        turn = d_i[0] * B_1 - d_i[1] * B_0
        if rows == 3:
            turn += B[b, 2] if transposed else B[2, b]
        lever = 1.0
        if b < 2:
            lever = d_j[0] if b == 1 else -d_j[1]
            T[0, b] += B_0
            T[1, b] += B_1
            T[2, b] += turn
        T[0, 2] += lever * B_0
        T[1, 2] += lever * B_1
        T[2, 2] += lever * turn
        F[min(t, j + b), max(t, j + b)] -= B_0
        F[min(t + 1, j + b), max(t + 1, j + b)] -= B_1
        F[min(t + 2, j + b), max(t + 2, j + b)] -= turn


@kernel
def add_pieces_into(F: Floats, frames: Frames, pieces: Ints, at: Evaluation, place: Ints) -> None:
    """Add pieces of frames, w J' H_f J, to F (n, n): its upper triangle.

    pieces (p, 3): frame, first and last block + 1, counted within the frame. place (v,): where in F a joint variable
    begins. The first piece of a frame brings the prior of T_f.
    """
    B, T = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(pieces)):
        f = pieces[n, 0]
        first, start = frames.first_variable[f], frames.start[f]
        tx, ty, angle = _pose_of(frames, f, at.X)
        c, s = math.cos(angle), math.sin(angle)
        for a in range(3):
            for b in range(3):
                T[a, b] = frames.prior[f, a, b] if pieces[n, 1] == 0 else 0.0
        for k in range(frames.first_block[f] + pieces[n, 1], frames.first_block[f] + pieces[n, 2]):
            p, o = frames.rows[k], frames.cols[k]
            v, w = frames.variable[first + p], frames.variable[first + o]
            rows, cols = 3 if p == 0 else 2, 3 if o == 0 else 2
            _world_block_into(B, frames, k, c, s, at.weight[f])
            _put_block(F, place[v], place[w], B, rows, cols, p == o)
            if start < 0:
                continue
            t, d_v, d_w = place[start], (at.X[v, 0] - tx, at.X[v, 1] - ty), (at.X[w, 0] - tx, at.X[w, 1] - ty)
            _put_turned(F, t, place[w], T, B, False, rows, cols, d_v, d_w)
            if p != o:
                _put_turned(F, t, place[v], T, B, True, cols, rows, d_w, d_v)
        if start >= 0:
            _put_block(F, place[start], place[start], T, 3, 3, True)


def held_step(frames: Frames, pieces: Ints, at: Evaluation, variables: Ints, size: Ints) -> Floats:
    """The Gauss-Newton step of these joint variables, all others held: H_vv d = g_v. Shape (k, 3), 0 where no row is.

    Args:
        pieces (p, 3): all that touch one of the variables. at: with the gradient of their frames. variables (k,).
        size: rows of each joint variable.

    Raises NumericalError where H_vv is not positive definite.
    """
    sizes = size[variables]
    n = int(sizes.sum())
    place = np.full(len(size), n)  # what is held goes to three rows at the end, which nobody reads
    place[variables] = np.cumsum(sizes) - sizes
    F = np.zeros((n + 3, n + 3))
    add_pieces_into(F, frames, pieces, at, place)
    step = np.zeros((len(variables), 3))
    there = np.arange(3) < sizes[:, None]
    try:
        step[there] = scipy.linalg.cho_solve(scipy.linalg.cho_factor(F[:n, :n]), at.g[variables][there])
    except scipy.linalg.LinAlgError:
        raise NumericalError("what a frame is about is not positive definite") from None
    return step


@kernel
def _upper_into(i: Ints, j: Ints, value: Floats, U: Floats, rows: Ints) -> None:
    """Entries of a symmetric matrix whose upper triangle is U, at these rows and columns."""
    at = 0
    for a in range(len(U)):
        for b in range(len(U)):
            i[at], j[at], value[at] = rows[a], rows[b], U[min(a, b), max(a, b)]
            at += 1


def assembled(
    frames: Frames, pieces: Ints, members: list[Ints], at: Evaluation, rows: Ints, size: Ints, n: int
) -> scipy.sparse.csr_array:
    """The joint information matrix (n, n), symmetric CSR, linearised at `at`.

    Args:
        pieces: of all frames, see add_pieces_into. members: the joint variables of each piece, each once.
        rows, size: first row and number of rows of each joint variable.
    """
    place = np.zeros(len(rows), np.int64)
    i: list[Ints] = []
    j: list[Ints] = []
    values: list[Floats] = []
    for piece, variables in zip(pieces, members, strict=True):
        sizes = size[variables]
        ends = np.cumsum(sizes)
        place[variables] = ends - sizes
        own = np.repeat(rows[variables] - place[variables], sizes) + np.arange(sizes.sum())
        U = np.zeros((len(own), len(own)))
        add_pieces_into(U, frames, piece[None], at, place)
        triplet = np.empty(U.size, np.int64), np.empty(U.size, np.int64), np.empty(U.size)
        _upper_into(*triplet, U, own)
        i.append(triplet[0])
        j.append(triplet[1])
        values.append(triplet[2])
    entries = (np.concatenate(values), (np.concatenate(i), np.concatenate(j)))
    H = scipy.sparse.coo_array(entries, shape=(n, n)).tocsr()
    return scipy.sparse.csr_array((H + H.T) * 0.5)  # rounding depends on the order of addition
