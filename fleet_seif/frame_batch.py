"""Closing a frame re-linearises it: a small batch over the frame's own readings, GraphSLAM in miniature.

1. Unknowns are the poses x_1 ... x_T and the landmarks the frame sighted; x_0 = (0, 0, 0) is given.
2. Gauss-Newton, damped where a step does not help. Poses are eliminated along the chain, so what is left is already
   the exact marginal of the last pose and the landmarks: (H, b) of the frame.
3. A sighting that contradicts the others is rejected and the frame solved again. Of two that contradict each other
   neither is believed. A landmark left without a sighting has rows of zeros: it is no landmark.
4. Same input, same bits on the same kind of machine: loops only, no library of linear algebra.

The algebra: between x_k and x_k+1 lies the residual e = x_k^-1 x_k+1 - u with covariance `cov`. Linearised,
dx_k+1 = F dx_k - s + noise of covariance U with s = G e, U = G cov G'. With the information A, g of everything before
(rows: pose k, then landmarks), A1 = F^-T A F^-1, g1 = F^-T g, W = A1_x: and K = (I + U A1_xx)^-1 U,

    A' = A1 - W' K W        g' = g1 - W' K g1_x - A'_:x s            on (x_k+1, landmarks)
    dx_k = B (dx_k+1, dy) + c + noise of covariance V
    B = F^-1 ([I 0] - K W)      c = F^-1 f,  f = s - K W_x s + K g1_x      V = F^-1 K F^-T
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from fleet_seif.dense import cholesky_into, inverse_2x2, solve_3x3, solve_lower_into, solve_upper_into
from fleet_seif.errors import NumericalError
from fleet_seif.geometry import between, wrap
from fleet_seif.jit import kernel
from fleet_seif.models import COMPASS_XY, RANGE_BEARING, heading_column, move, place, sight_numbers
from fleet_seif.records import Floats, Ints
from fleet_seif.robust import huber

Bools = NDArray[np.bool_]

GATE: Final = 30.0
"""Squared innovation (chi-square, 2 degrees of freedom), given all others, beyond which a sighting is rejected."""
ITERATIONS_MAX: Final = 100
"""Linearisations of one solution."""
STEP_MAX: Final = 1e-12
"""A solution is found where the next step would be shorter, in sigmas squared."""
HUBER: Final = 9.0
"""Squared normalised residual beyond which a sighting pulls no harder in a robust solution."""
ROUGH_ITERATIONS_MAX: Final = 30
ROUGH_STEP_MAX: Final = 1e-2
"""A robust solution only has to tell outliers from the rest."""
ROUNDS_MAX: Final = 20
"""Solutions after that, each with a sighting less or some again; a frame that needs more is returned as it is then."""
SLACK: Final = 1e-12
"""What the cost may grow by, relative: rounding."""
DAMPING_FIRST: Final = 1e-6
DAMPING_FACTOR: Final = 10.0
REDUNDANCY_MIN: Final = 1e-9
"""Below this share of det Z, the covariance of a residual says that nothing else measures what the sighting does."""

POINT: Final = 2
"""A model of this file: z is where the landmark lies (m ahead, m to the left). As RANGE_BEARING, without its
singularity and its branches."""

OK: Final = 0
NOT_POSITIVE: Final = 1
NOT_CONVERGED: Final = 2


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameReadings:
    """What a vehicle read within one frame of T steps.

    model: one of fleet_seif.models.
    odometry (T, 3): increment k leads from pose k to pose k + 1; odometry_cov (T, 3, 3).
    step (S,): the pose a sighting was made from, 0 ... T, in any order.
    landmark (S,): 0 ... L-1; cheapest where numbered in the order of their first sighting.
    z (S, 2), cov (S, 2, 2): what was measured, and its noise.
    """

    model: int
    odometry: Floats
    odometry_cov: Floats
    step: Ints
    landmark: Ints
    z: Floats
    cov: Floats


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameSolution:
    """The posterior of a frame, linearised at its own mean. n = 3 + 2 L: last pose, then landmarks by number.

    H (n, n), b = H mean (n,): zero in the rows of landmarks that are not `seen`; positive definite in the others.
    mean (n,): the solution; the first guess where not `seen`. poses (T, 3): x_1 ... x_T.
    seen (L,): landmarks that kept a sighting. rejected (S,): sightings left out, in the order given.
    chi_square: of all residuals in use. dof: its degrees of freedom; 0 where nothing was seen twice.
    worst: the largest squared innovation of a sighting in use, given the others; above the gate only where ROUNDS_MAX
    was reached.
    iterations: linearisations in all.
    """

    H: Floats
    b: Floats
    mean: Floats
    poses: Floats
    seen: Bools
    rejected: Bools
    chi_square: float
    dof: int
    worst: float
    iterations: int

    @property
    def chi_square_per_dof(self) -> float:
        """Near 1 where the noise is as declared; 0 where there is nothing to compare."""
        return self.chi_square / self.dof if self.dof else 0.0


class Chain(NamedTuple):
    """Readings as kernels take them. M (T, 3, 3), W (S, 2, 2): inverse noise; first (T+2,): sightings of pose k are
    first[k] ... first[k+1]."""

    u: Floats
    cov: Floats
    M: Floats
    first: Ints
    landmark: Ints
    z: Floats
    Z: Floats
    W: Floats


class Tape(NamedTuple):
    """What elimination leaves behind.

    A (n, n), g (n,): the front, lower half; at the end over (x_T, landmarks). L (n, n): its factor.
    B (T, 3, n), c (T, 3), V (T, 3, 3): how pose k follows from pose k+1 and the landmarks, k = 1 ... T-1.
    width (T,): columns of B[k] in use.
    """

    A: Floats
    g: Floats
    L: Floats
    B: Floats
    c: Floats
    V: Floats
    width: Ints


@kernel
def as_points(r: Chain) -> Chain:
    """Ranges and bearings as points, their noise to first order.

    Across, a point is known to the bearing's noise times the root of range^2 + its variance: a landmark measured on
    top of the vehicle is not known to the width of a hair.
    """
    z, Z, W = np.empty_like(r.z), np.empty_like(r.Z), np.empty_like(r.W)
    for i in range(len(z)):
        c, s = math.cos(r.z[i, 1]), math.sin(r.z[i, 1])
        d = math.sqrt(r.z[i, 0] * r.z[i, 0] + r.Z[i, 0, 0])
        z[i, 0], z[i, 1] = r.z[i, 0] * c, r.z[i, 0] * s
        a, b, q = r.Z[i, 0, 0], d * r.Z[i, 0, 1], d * d * r.Z[i, 1, 1]
        Z[i, 0, 0], Z[i, 1, 1] = c * c * a - 2.0 * c * s * b + s * s * q, s * s * a + 2.0 * c * s * b + c * c * q
        Z[i, 0, 1] = Z[i, 1, 0] = c * s * (a - q) + (c * c - s * s) * b
        W[i] = inverse_2x2(Z[i])
    return Chain(r.u, r.cov, r.M, r.first, r.landmark, z, Z, W)


@kernel
def reckoned(model: int, r: Chain, guess: Floats) -> tuple[Floats, Floats]:
    """Poses (T+1, 3) from odometry alone, landmarks (L, 2) where their first sighting puts them, else as guessed."""
    x, y, put = np.zeros((len(r.u) + 1, 3)), guess.copy(), np.zeros(len(guess), np.bool_)
    for k in range(len(x)):
        if k > 0:
            x[k] = move(model, x[k - 1], r.u[k - 1])[0]
        for i in range(r.first[k], r.first[k + 1]):
            j = r.landmark[i]
            if not put[j]:
                y[j], put[j] = place(model, x[k], r.z[i]), True
    return x, y


@kernel
def invert_noises_into(M: Floats, W: Floats, cov: Floats, Z: Floats) -> bool:
    """M = cov^-1, W = Z^-1, symmetric; False where one is not positive definite."""
    L = np.empty((3, 3))
    for k in range(len(cov)):
        if not cholesky_into(L, cov[k], 3):
            return False
        M[k] = solve_3x3(cov[k], np.eye(3))
        for i in range(3):
            for j in range(i):
                M[k, i, j] = M[k, j, i] = 0.5 * (M[k, i, j] + M[k, j, i])
    for s in range(len(Z)):
        if not cholesky_into(L, Z[s], 2):
            return False
        W[s] = inverse_2x2(Z[s])
    return True


@kernel
def squared_length(W: Floats, r: Floats) -> float:
    """r' W r; what W has beyond is left alone."""
    total = 0.0
    for i in range(len(r)):
        for j in range(len(r)):
            total += r[i] * W[i, j] * r[j]
    return total


@kernel
def motion_residual(model: int, x: Floats, x_next: Floats, u: Floats) -> tuple[Floats, float, float, float, float]:
    """e = x^-1 x_next - u (3,), headings not wrapped; and F = -J_e_next^-1 J_e_x, G = J_e_next^-1 as numbers.

    F^-1 is the identity but for f0, f1 above the 1 in its third column, G turns the first two axes by (c, s).
    """
    if model == COMPASS_XY:
        return x_next - x - u, 0.0, 0.0, 1.0, 0.0
    return between(x, x_next) - u, x_next[1] - x[1], x[0] - x_next[0], math.cos(x[2]), math.sin(x[2])


@kernel
def turned(c: float, s: float, M: Floats) -> Floats:
    """G M G' for symmetric M (3, 3)."""
    a, b, d = M[0, 0], M[0, 1], M[1, 1]
    out = np.empty((3, 3))
    out[0, 0], out[1, 1] = c * c * a - 2.0 * c * s * b + s * s * d, s * s * a + 2.0 * c * s * b + c * c * d
    out[0, 1] = out[1, 0] = c * s * (a - d) + (c * c - s * s) * b
    out[0, 2] = out[2, 0] = c * M[0, 2] - s * M[1, 2]
    out[1, 2] = out[2, 1] = s * M[0, 2] + c * M[1, 2]
    out[2, 2] = M[2, 2]
    return out


@kernel
def look(
    model: int, x: Floats, y: Floats, z: Floats
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float]:
    """A sighting from pose x, without arrays: r = z - h, bearings wrapped (2); rows of J_z_x and J_z_y, five each."""
    if model == POINT:
        c, s, dx, dy = math.cos(x[2]), math.sin(x[2]), y[0] - x[0], y[1] - x[1]
        ahead, left = c * dx + s * dy, -s * dx + c * dy
        return z[0] - ahead, z[1] - left, -c, -s, left, c, s, s, -c, -ahead, -s, c
    h0, h1, x00, x01, y00, y01, x10, x11, y10, y11 = sight_numbers(model, x, y[0], y[1])
    r1 = wrap(z[1] - h1) if model == RANGE_BEARING else z[1] - h1
    return z[0] - h0, r1, x00, x01, 0.0, y00, y01, x10, x11, heading_column(model), y10, y11


@kernel
def softened(r0: float, r1: float, W: Floats, bound: float) -> tuple[float, float]:
    """Huber's cost of a residual, and its weight, of r' W r."""
    return huber(r0 * r0 * W[0, 0] + 2.0 * r0 * r1 * W[0, 1] + r1 * r1 * W[1, 1], bound)


@kernel
def add_sighting_into(
    A: Floats, g: Floats, model: int, x: Floats, y: Floats, z: Floats, W: Floats, bound: float, at: int
) -> None:
    """A += w J' W J (lower half), g += w J' W r, w Huber's weight, on the pose's rows and the landmark's from `at`."""
    r0, r1, a0, a1, a2, a3, a4, b0, b1, b2, b3, b4 = look(model, x, y, z)
    _, weight = softened(r0, r1, W, bound)
    rows, J0, J1 = (0, 1, 2, at, at + 1), (a0, a1, a2, a3, a4), (b0, b1, b2, b3, b4)
    for i in range(5):
        w0 = weight * (J0[i] * W[0, 0] + J1[i] * W[1, 0])
        w1 = weight * (J0[i] * W[0, 1] + J1[i] * W[1, 1])
        g[rows[i]] += w0 * r0 + w1 * r1
        for j in range(i + 1):
            A[rows[i], rows[j]] += w0 * J0[j] + w1 * J1[j]


@kernel
def leave_start_into(A: Floats, g: Floats, n: int, e: Floats, c: float, s: float, M: Floats) -> None:
    """From the given pose 0 to pose 1: dx_1 = -G e + noise. What pose 0 saw stays with the landmarks."""
    G_M_G = turned(c, s, M)
    shift = (c * e[0] - s * e[1], s * e[0] + c * e[1], e[2])
    for a in range(3):
        g[a] = -(G_M_G[a, 0] * shift[0] + G_M_G[a, 1] * shift[1] + G_M_G[a, 2] * shift[2])
        for i in range(n):
            A[i, a] = G_M_G[i, a] if i < 3 else 0.0


@kernel
def leave_pose_into(
    tape: Tape, k: int, n: int, e: Floats, f0: float, f1: float, c: float, s: float, cov: Floats, M: Floats
) -> float:
    """Eliminate pose k in favour of pose k + 1: the equations above, in place on the first n rows.

    Returns c' V^-1 c: what pose k itself would gain by a step, in sigmas squared.
    """
    A, g, B, V = tape.A, tape.g, tape.B[k], tape.V[k]
    W, KW, q, f = np.empty((3, n)), np.empty((3, n)), np.empty(3), np.empty(3)
    shift = (c * e[0] - s * e[1], s * e[0] + c * e[1], e[2])
    for i in range(n):
        for a in range(3):
            W[a, i] = A[max(a, i), min(a, i)]
        W[2, i] += f0 * W[0, i] + f1 * W[1, i]
    for a in range(3):
        W[a, 2] += f0 * W[a, 0] + f1 * W[a, 1]
        q[a] = g[a]
    q[2] += f0 * g[0] + f1 * g[1]
    U, I_UW = turned(c, s, cov), np.empty((3, 3))
    for a in range(3):
        for i in range(3):
            I_UW[a, i] = U[a, 0] * W[0, i] + U[a, 1] * W[1, i] + U[a, 2] * W[2, i]
        I_UW[a, a] += 1.0
    K = solve_3x3(I_UW, U)
    for a in range(3):
        for i in range(a):
            K[a, i] = K[i, a] = 0.5 * (K[a, i] + K[i, a])
    for a in range(3):
        for i in range(n):
            KW[a, i] = K[a, 0] * W[0, i] + K[a, 1] * W[1, i] + K[a, 2] * W[2, i]
        f[a] = shift[a] + K[a, 0] * q[0] + K[a, 1] * q[1] + K[a, 2] * q[2]
        f[a] -= KW[a, 0] * shift[0] + KW[a, 1] * shift[1] + KW[a, 2] * shift[2]
        g[a] = q[a]
    for i in range(n):
        w0, w1, w2 = W[0, i], W[1, i], W[2, i]
        g[i] -= KW[0, i] * q[0] + KW[1, i] * q[1] + KW[2, i] * q[2]
        for a in range(min(i + 1, 3)):
            A[i, a] = W[a, i]
        for j in range(i + 1):
            A[i, j] -= w0 * KW[0, j] + w1 * KW[1, j] + w2 * KW[2, j]
    for i in range(n):
        for a in range(3):
            g[i] -= A[max(a, i), min(a, i)] * shift[a]
    for i in range(n):
        low = (1.0 if i == 2 else 0.0) - KW[2, i]
        B[0, i] = (1.0 if i == 0 else 0.0) - KW[0, i] + f0 * low
        B[1, i] = (1.0 if i == 1 else 0.0) - KW[1, i] + f1 * low
        B[2, i] = low
    tape.c[k, 0], tape.c[k, 1], tape.c[k, 2] = f[0] + f0 * f[2], f[1] + f1 * f[2], f[2]
    for a in range(3):
        V[a, 0], V[a, 1], V[a, 2] = K[a, 0] + f0 * K[a, 2], K[a, 1] + f1 * K[a, 2], K[a, 2]
    for a in range(3):
        V[0, a] += f0 * V[2, a]
        V[1, a] += f1 * V[2, a]
    tape.width[k] = n
    return squared_length(W, f) + squared_length(turned(c, s, M), f)


@kernel
def eliminate_into(
    tape: Tape, model: int, r: Chain, used: Bools, bound: float, x: Floats, y: Floats, damping: float
) -> float:
    """Linearise at poses x (T+1, 3) and landmarks y (L, 2), eliminate all poses but the last, factor what is left.

    damping: share by which the diagonal grows: of a pose when it is left, of the rest at the end.
    Returns dstate' H dstate, the squared length of the step in sigmas; -1 where H is not positive definite.
    """
    A, g, T = tape.A, tape.g, len(x) - 1
    A[:], g[:] = 0.0, 0.0
    n, length = 3, 0.0
    for k in range(T + 1):
        if k > 0:
            e, f0, f1, c, s = motion_residual(model, x[k - 1], x[k], r.u[k - 1])
            if k == 1:
                leave_start_into(A, g, n, e, c, s, r.M[0])
            else:
                length += leave_pose_into(tape, k - 1, n, e, f0, f1, c, s, r.cov[k - 1], r.M[k - 1])
        for i in range(r.first[k], r.first[k + 1]):
            j = r.landmark[i]
            n = max(n, 5 + 2 * j)
            if used[i]:
                add_sighting_into(A, g, model, x[k], y[j], r.z[i], r.W[i], bound, 3 + 2 * j)
        for a in range(3):
            A[a, a] *= 1.0 + damping
    for a in range(3, len(g)):
        A[a, a] = A[a, a] * (1.0 + damping) if A[a, a] != 0.0 else 1.0  # a landmark nobody saw stays where it is
    if not cholesky_into(tape.L, A, len(g)):
        return -1.0
    solve_lower_into(g, tape.L, len(g))
    for a in range(len(g)):
        length += g[a] * g[a]
    solve_upper_into(g, tape.L, len(g))
    return length


@kernel
def carried(x: Floats, dx: Floats, new_x: Floats, p0: float, p1: float, d0: float, d1: float) -> tuple[float, float]:
    """Point p + d as seen from pose x + dx to first order, put down at new_x instead."""
    v0, v1 = p0 - x[0], p1 - x[1]
    w0, w1 = v0 + d0 - dx[0] + dx[2] * v1, v1 + d1 - dx[1] - dx[2] * v0
    c, s = math.cos(dx[2]), math.sin(dx[2])
    return new_x[0] + c * w0 - s * w1, new_x[1] + s * w0 + c * w1


@kernel
def take_step_into(
    new_x: Floats, new_y: Floats, tape: Tape, model: int, r: Chain, used: Bools, x: Floats, y: Floats
) -> None:
    """The step from x, y: back along the chain from the front's, which elimination has left in g, then forward.

    What moves linearly is each pose as seen from the one before and each landmark as seen from the first pose that
    sighted it. A pose that turns swings round all that follows; in plain coordinates it would tear it off.
    """
    T, d, dx = len(x) - 1, tape.g.copy(), np.zeros_like(x)
    dx[T] = d[:3]
    for k in range(T - 1, 0, -1):
        for a in range(3):
            dx[k, a] = tape.c[k, a]
            for i in range(tape.width[k]):
                dx[k, a] += tape.B[k, a, i] * d[i]
        for a in range(3):
            d[a] = dx[k, a]
    new_x[:] = x + dx
    for j in range(len(y)):
        new_y[j, 0], new_y[j, 1] = y[j, 0] + d[3 + 2 * j], y[j, 1] + d[4 + 2 * j]
    if model == COMPASS_XY:
        return
    put = np.zeros(len(y), np.bool_)
    for k in range(T + 1):
        if k > 0:
            p, q = x[k], dx[k]
            new_x[k, 0], new_x[k, 1] = carried(x[k - 1], dx[k - 1], new_x[k - 1], p[0], p[1], q[0], q[1])
        for i in range(r.first[k], r.first[k + 1]):
            j = r.landmark[i]
            if used[i] and not put[j]:
                at = 3 + 2 * j
                new_y[j, 0], new_y[j, 1] = carried(x[k], dx[k], new_x[k], y[j, 0], y[j, 1], d[at], d[at + 1])
                put[j] = True


@kernel
def cost(model: int, r: Chain, used: Bools, bound: float, x: Floats, y: Floats) -> float:
    """The sum of all squared normalised residuals, those of sightings beyond `bound` softened."""
    total = 0.0
    for k in range(len(x)):
        if k > 0:
            e = motion_residual(model, x[k - 1], x[k], r.u[k - 1])[0]
            total += squared_length(r.M[k - 1], e)
        for i in range(r.first[k], r.first[k + 1]):
            if used[i]:
                seen = look(model, x[k], y[r.landmark[i]], r.z[i])
                total += softened(seen[0], seen[1], r.W[i], bound)[0]
    return total


@kernel
def optimise_into(
    x: Floats, y: Floats, tape: Tape, model: int, r: Chain, used: Bools, bound: float, step_max: float, most: int
) -> tuple[int, int, float]:
    """Gauss-Newton from x, y until it stands still, damped where a step raises the cost; `most` linearisations.

    bound: of Huber's cost; infinite for least squares. step_max: in sigmas squared.

    Leaves in x, y the solution, in the tape the linearisation there, undamped. Returns OK or what went wrong, the
    linearisations it took, and chi-square.
    """
    new_x, new_y = x.copy(), y.copy()
    now, damping = cost(model, r, used, bound, x, y), 0.0
    for iteration in range(1, most + 1):
        length = eliminate_into(tape, model, r, used, bound, x, y, damping)
        if not length >= 0.0:
            return NOT_POSITIVE, iteration, now
        if damping == 0.0 and length <= step_max:
            return OK, iteration, now
        take_step_into(new_x, new_y, tape, model, r, used, x, y)
        then = cost(model, r, used, bound, new_x, new_y)
        if then <= now + SLACK * (1.0 + now):
            x[:], y[:], now = new_x, new_y, then
            damping = damping / DAMPING_FACTOR if damping > DAMPING_FIRST else 0.0
        else:
            damping = max(DAMPING_FIRST, damping * DAMPING_FACTOR)
    found = eliminate_into(tape, model, r, used, bound, x, y, 0.0) >= 0.0
    return NOT_CONVERGED if found else NOT_POSITIVE, most + 1, now


@kernel
def inverse_of(L: Floats) -> Floats:
    """(L L')^-1 (n, n), symmetric."""
    n = len(L)
    S = np.eye(n)
    for i in range(n):
        solve_lower_into(S[i], L, n)
        solve_upper_into(S[i], L, n)
    return S


@kernel
def squared_innovation(
    S: Floats, model: int, x: Floats, y: Floats, z: Floats, Z: Floats, W: Floats, used: bool, bound: float, at: int
) -> float:
    """The squared innovation of a sighting, given all others: r its residual, P = J S J', w its weight in S.

        r' (Z - w P)^-1 Z (Z + (1 - w) P)^-1 r

    With w = 1 what chi-square loses when the sighting is left out, with w = 0 the test of one that is not in; exact in
    a linear world. 0 where nothing else measures what the sighting does.
    S (n, n): posterior covariance of the pose and the landmarks.
    """
    r0, r1, a0, a1, a2, a3, a4, b0, b1, b2, b3, b4 = look(model, x, y, z)
    weight = softened(r0, r1, W, bound)[1] if used else 0.0
    rows, J0, J1 = (0, 1, 2, at, at + 1), (a0, a1, a2, a3, a4), (b0, b1, b2, b3, b4)
    p00, p01, p11 = 0.0, 0.0, 0.0
    for i in range(5):
        s0, s1 = 0.0, 0.0
        for j in range(5):
            s0 += J0[j] * S[rows[j], rows[i]]
            s1 += J1[j] * S[rows[j], rows[i]]
        p00 += s0 * J0[i]
        p01 += s0 * J1[i]
        p11 += s1 * J1[i]
    a, b, d = Z[0, 0] + (1.0 - weight) * p00, Z[0, 1] + (1.0 - weight) * p01, Z[1, 1] + (1.0 - weight) * p11
    determinant = a * d - b * b
    v0, v1 = (d * r0 - b * r1) / determinant, (a * r1 - b * r0) / determinant
    v0, v1 = Z[0, 0] * v0 + Z[0, 1] * v1, Z[0, 1] * v0 + Z[1, 1] * v1
    a, b, d = Z[0, 0] - weight * p00, Z[0, 1] - weight * p01, Z[1, 1] - weight * p11
    determinant = a * d - b * b
    if not determinant > REDUNDANCY_MIN * (Z[0, 0] * Z[1, 1] - Z[0, 1] * Z[0, 1]):
        return 0.0
    return float((r0 * (d * v0 - b * v1) + r1 * (a * v1 - b * v0)) / determinant)


@kernel
def back_into(S: Floats, B: Floats, V: Floats, n: int) -> None:
    """From the covariance of pose k + 1 and the first landmarks, n rows, to that of pose k: B S, B S B' + V."""
    BS = np.zeros((3, n))
    for a in range(3):
        for i in range(n):
            for j in range(n):
                BS[a, j] += B[a, i] * S[i, j]
    for a in range(3):
        for c in range(3):
            S[a, c] = V[a, c]
            for i in range(n):
                S[a, c] += BS[a, i] * B[c, i]
        for i in range(3, n):
            S[a, i] = S[i, a] = BS[a, i]


@kernel
def squared_innovations(
    tape: Tape, model: int, r: Chain, used: Bools, seen: Bools, bound: float, x: Floats, y: Floats
) -> Floats:
    """`squared_innovation` of every sighting, (S,); infinite for one of a landmark that is not `seen`.

    Covariances run backwards: S_k: = B S_k+1:, S_kk = B S_k+1 B' + V.
    """
    value, S, T = np.zeros(len(r.z)), inverse_of(tape.L), len(x) - 1
    for k in range(T, -1, -1):
        if k == 0:
            S[:3], S[:, :3] = 0.0, 0.0
        elif k < T:
            back_into(S, tape.B[k], tape.V[k], tape.width[k])
        for i in range(r.first[k], r.first[k + 1]):
            j = r.landmark[i]
            if not seen[j]:
                value[i] = np.inf
                continue
            value[i] = squared_innovation(S, model, x[k], y[j], r.z[i], r.Z[i], r.W[i], used[i], bound, 3 + 2 * j)
    return value


@kernel
def marginal(tape: Tape, x: Floats, y: Floats, seen: Bools) -> tuple[Floats, Floats, Floats]:
    """H, b = H mean and mean of the last pose and the landmarks, the step included; rows of those not seen are zero."""
    n = len(tape.g)
    H, mean = tape.A.copy(), tape.g.copy()
    mean[:3] += x[len(x) - 1]
    for j in range(len(y)):
        mean[3 + 2 * j] += y[j, 0]
        mean[4 + 2 * j] += y[j, 1]
        if not seen[j]:
            H[3 + 2 * j, 3 + 2 * j] = H[4 + 2 * j, 4 + 2 * j] = 0.0
    for i in range(n):
        for j in range(i):
            H[j, i] = H[i, j]
    b = np.zeros(n)
    for i in range(n):
        for j in range(n):
            b[i] += H[i, j] * mean[j]
    return H, b, mean


def solve_frame(
    readings: FrameReadings, poses: Floats, landmarks: Floats, *, gate: float = GATE, bound: float = math.inf
) -> FrameSolution:
    """The posterior of a frame from its own readings, without the sightings that contradict the others.

    A sighting is tested by its innovation, given all others. Where all pass, that is all. Else a robust solution finds
    those to leave out; then the worst one beyond `gate` goes, round by round, and what passes after all comes back.

    Args:
        poses, landmarks: the first guess, (T, 3) and (L, 2), say of the live filter. A landmark without a sighting is
            left as it is.
        gate: squared innovation beyond which a sighting is rejected.
        bound: squared normalised residual beyond which one pulls no harder (Huber); H and chi-square have the weights.

    Raises:
        ValueError: shapes do not fit, or a number of a pose or landmark is out of range.
        NumericalError: a noise is not positive definite, a number not finite, or Gauss-Newton does not settle. The
            caller keeps the posterior it has.
    """
    chain, order = _checked(readings, poses, landmarks)
    state = _Estimate(readings.model, chain, poses, landmarks)
    code = state.solve(ROUGH_ITERATIONS_MAX, bound)
    if code != OK or state.worst() > gate:
        state = _robust(state, poses, landmarks, gate)
        for again in range(ROUNDS_MAX):
            code = state.solve(ITERATIONS_MAX, bound)
            if code != OK:
                _give_up(code, state.iterations)
            if again == ROUNDS_MAX - 1 or not state.reconsider(gate):
                break
    return _solution(state, order)


def _solution(state: "_Estimate", order: Ints) -> FrameSolution:
    H, b, mean = marginal(state.tape, state.x, state.y, state.seen())
    rejected = np.empty(len(order), np.bool_)
    rejected[order] = ~state.used
    return FrameSolution(
        H=H, b=b, mean=mean, poses=state.x[1:], seen=state.seen(), rejected=rejected, chi_square=state.cost,
        dof=2 * int(np.count_nonzero(state.used) - np.count_nonzero(state.seen())),
        worst=state.worst(), iterations=state.iterations,
    )  # fmt: skip


class _Estimate:
    """Where a solution stands: poses x (T+1, 3), landmarks y (L, 2), sightings used (S,)."""

    def __init__(self, model: int, chain: Chain, poses: Floats, landmarks: Floats) -> None:
        T, n = len(poses), 3 + 2 * len(landmarks)
        self.model, self.chain = model, chain
        self.x, self.y = np.vstack([np.zeros((1, 3)), poses]), np.array(landmarks, np.float64, order="C")
        self.tape = Tape(
            A=np.empty((n, n)), g=np.empty(n), L=np.zeros((n, n)),
            B=np.empty((T, 3, n)), c=np.empty((T, 3)), V=np.empty((T, 3, 3)), width=np.zeros(T, np.int64),
        )  # fmt: skip
        self.used = np.ones(len(chain.z), np.bool_)
        self.innovation = np.zeros(len(chain.z))  # squared, of each sighting given the others
        self.cost = 0.0
        self.iterations = 0
        self._returned = np.zeros(len(chain.z), np.bool_)

    def solve(self, most: int, bound: float, step_max: float = STEP_MAX) -> int:
        """Solve with what is in use, then test all sightings. Returns OK, or what went wrong."""
        fixed = self.tape, self.model, self.chain, self.used
        code, count, self.cost = optimise_into(self.x, self.y, *fixed, bound, step_max, most)
        self.iterations += count
        if code != NOT_POSITIVE:
            self.innovation = squared_innovations(*fixed, self.seen(), bound, self.x, self.y)
        return code

    def seen(self) -> Bools:
        """Landmarks with a sighting in use, (L,)."""
        return np.bincount(self.chain.landmark[self.used], minlength=len(self.y)) > 0

    def worst(self) -> float:
        """The largest squared innovation of a sighting in use."""
        return float(np.max(self.innovation[self.used], initial=0.0))

    def keep(self, those: Bools) -> None:
        """Use those sightings, but none that is the last of several: of two that disagree neither is believed."""
        given = np.bincount(self.chain.landmark, minlength=len(self.y))
        left = np.bincount(self.chain.landmark[those], minlength=len(self.y))
        self.used = those & ~((given > 1) & (left == 1))[self.chain.landmark]

    def reconsider(self, gate: float) -> bool:
        """Give up the worst sighting, or take back, once, what passes. False where there is nothing to change."""
        passes = ~self.used & ~self._returned & (self.innovation <= gate)
        if self.worst() > gate:
            self.keep(self.used & (self.innovation < self.worst()))
            return True
        self._returned |= passes
        self.keep(self.used | passes)
        return bool(np.any(passes))


def _robust(plain: _Estimate, poses: Floats, landmarks: Floats, gate: float) -> _Estimate:
    """A rough solution in which no sighting pulls hard, with those in use that pass the test there.

    Ranges and bearings count as points first, so that no outlier drags a landmark across a pose, where bearings turn
    over. A guess may be spoilt by the very outliers, so that the solution from odometry alone competes with it.
    """
    model, chain = plain.model, plain.chain
    sight, points = (POINT, as_points(chain)) if model == RANGE_BEARING else (model, chain)
    x, y = reckoned(model, chain, landmarks)
    starts = [_Estimate(sight, points, poses, landmarks), _Estimate(sight, points, x[1:], y)]
    codes = [start.solve(ROUGH_ITERATIONS_MAX, HUBER, ROUGH_STEP_MAX) for start in starts]
    best = min(
        (start for start, code in zip(starts, codes) if code != NOT_POSITIVE),
        key=lambda start: start.cost,
        default=None,
    )
    iterations = plain.iterations + sum(start.iterations for start in starts)
    if best is None:
        _give_up(NOT_POSITIVE, iterations)
    best.iterations = iterations
    best.keep(best.innovation <= gate)
    if model == RANGE_BEARING:
        best.model, best.chain = model, chain
        best.solve(ROUGH_ITERATIONS_MAX, HUBER, ROUGH_STEP_MAX)
        best.keep(best.innovation <= gate)
    return best


def _checked(readings: FrameReadings, poses: Floats, landmarks: Floats) -> tuple[Chain, Ints]:
    """Readings in the layout of kernels, sightings by pose; and which of those given each one is."""
    u, cov, z, Z = (
        np.array(a, np.float64, order="C") for a in (readings.odometry, readings.odometry_cov, readings.z, readings.cov)
    )
    step, landmark = np.asarray(readings.step, np.int64), np.asarray(readings.landmark, np.int64)
    T, S, L = len(u), len(z), len(landmarks)
    shapes = {
        "odometry": (u, (T, 3)), "odometry_cov": (cov, (T, 3, 3)), "z": (z, (S, 2)), "cov": (Z, (S, 2, 2)),
        "step": (step, (S,)), "landmark": (landmark, (S,)), "poses": (poses, (T, 3)), "landmarks": (landmarks, (L, 2)),
    }  # fmt: skip
    for name, (array, shape) in shapes.items():
        if array.shape != shape:
            raise ValueError(f"{name} of a frame has shape {array.shape}, expected {shape}")
    if not T:
        raise ValueError("a frame has at least one step, got none")
    if S and (step.min() < 0 or step.max() > T or landmark.min() < 0 or landmark.max() >= L):
        raise ValueError(
            f"sightings of a frame are of poses 0 ... {T} and landmarks 0 ... {L - 1}, got poses {step.min()} ..."
            f" {step.max()}, landmarks {landmark.min()} ... {landmark.max()}"
        )
    order = np.argsort(step, kind="stable")
    first = np.searchsorted(step[order], np.arange(T + 2)).astype(np.int64)
    M, W, z, Z = np.empty_like(cov), np.empty_like(Z), z[order], Z[order]
    if not invert_noises_into(M, W, cov, Z):
        raise NumericalError("frame not solved: the covariance of a motion or a sighting is not positive definite")
    return Chain(u, cov, M, first, landmark[order], z, Z, W), order


def _give_up(code: int, iterations: int) -> NoReturn:
    if code == NOT_POSITIVE:
        raise NumericalError(
            f"frame not solved: its information matrix is not positive definite or not finite in linearisation"
            f" {iterations}; is a landmark guessed at the place of a pose?"
        )
    raise NumericalError(
        f"frame not solved: no solution within {ITERATIONS_MAX} linearisations; the first"
        " guess is too far away or the readings contradict each other"
    )
