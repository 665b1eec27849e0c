"""The SEIF's updates on a dense local block: the pose and every landmark a step can touch.

All change only rows and columns of the pose, the active landmarks and the sighted ones, so that they are exact on that
block whatever the size of the map. Order in a block: pose (3 rows), then landmarks (2 rows each).
Equation numbers are those of Thrun et al., IJRR 2004; the algebra is in MATHS.md. Loops are written out: at these
sizes a call into a library or a new array costs more than the arithmetic.
"""

import math
from typing import Final

import numpy as np

from fleet_seif.dense import cholesky_into, solve_3x3, solve_lower_into, solve_upper_into
from fleet_seif.geometry import wrap
from fleet_seif.jit import kernel
from fleet_seif.models import RANGE_BEARING, heading_column, move, pose_rows_seen, sight_numbers
from fleet_seif.records import Floats, Ints

NORMALISED: Final = 0
RAW: Final = 1
KL: Final = 2


@kernel
def add_outer_into(H: Floats, W: Floats, K: Floats, sign: float) -> None:
    """H += sign W' K W, kept exactly symmetric; H (n, n), W (3, n), K (3, 3) symmetric."""
    n = H.shape[0]
    touched, count = np.empty(n, np.int64), 0
    for i in range(n):
        if W[0, i] != 0.0 or W[1, i] != 0.0 or W[2, i] != 0.0:
            touched[count] = i
            count += 1
    for a in range(count):
        i = touched[a]
        k0 = sign * (W[0, i] * K[0, 0] + W[1, i] * K[1, 0] + W[2, i] * K[2, 0])
        k1 = sign * (W[0, i] * K[0, 1] + W[1, i] * K[1, 1] + W[2, i] * K[2, 1])
        k2 = sign * (W[0, i] * K[0, 2] + W[1, i] * K[1, 2] + W[2, i] * K[2, 2])
        for c in range(a, count):
            j = touched[c]
            H[i, j] += k0 * W[0, j] + k1 * W[1, j] + k2 * W[2, j]
            H[j, i] = H[i, j]


@kernel
def motion_update_into(H: Floats, b: Floats, mu: Floats, model: int, u: Floats, cov: Floats) -> None:
    """Lemma 3: the pose moves by increment u with covariance cov; H, b and mu of the block are updated.

        H1 = F^-T H F^-1,   K = (I + U H1_xx)^-1 U,   H' = H1 - H1_:x K H1_x:
        b' = H' mu' + r1 - H1_:x K r1_x    with the residual r = b - H mu, r1 = F^-T r

    F is the Jacobian of the motion on the pose and the identity elsewhere, U = J_u cov J_u'. U is never inverted. The
    residual term keeps b right where the mean has not converged. Only what changes is formed: for a landmark's row
    b' = b - H_:x mu_x + H1_:x mu_x' - H1_:x K (H1_x: mu' + r1_x).
    """
    n = len(b)
    new_x, J_new_x, J_new_u = move(model, mu[:3].copy(), u)
    f0, f1 = -J_new_x[0, 2], -J_new_x[1, 2]
    U, JU = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            JU[i, j] = J_new_u[i, 0] * cov[0, j] + J_new_u[i, 1] * cov[1, j] + J_new_u[i, 2] * cov[2, j]
    for i in range(3):
        for j in range(3):
            U[i, j] = JU[i, 0] * J_new_u[j, 0] + JU[i, 1] * J_new_u[j, 1] + JU[i, 2] * J_new_u[j, 2]
    r = np.empty(3)
    for a in range(3):
        r[a] = b[a]
        for c in range(n):
            r[a] -= H[a, c] * mu[c]
    r[2] += f0 * r[0] + f1 * r[1]
    W = np.empty((3, n))
    for c in range(n):
        W[0, c], W[1, c], W[2, c] = H[0, c], H[1, c], H[2, c] + f0 * H[0, c] + f1 * H[1, c]
        if c >= 3:
            b[c] -= H[0, c] * mu[0] + H[1, c] * mu[1] + H[2, c] * mu[2]
    for a in range(3):
        W[a, 2] += f0 * W[a, 0] + f1 * W[a, 1]
    W[1, 0], W[2, 0], W[2, 1] = W[0, 1], W[0, 2], W[1, 2]
    A = np.eye(3)
    for i in range(3):
        for j in range(3):
            A[i, j] += U[i, 0] * W[0, j] + U[i, 1] * W[1, j] + U[i, 2] * W[2, j]
    K = solve_3x3(A, U)
    for i in range(3):
        for j in range(i):
            K[i, j] = K[j, i] = 0.5 * (K[i, j] + K[j, i])
    for a in range(3):
        mu[a] = new_x[a]
        for c in range(n):
            H[a, c] = H[c, a] = W[a, c]
    t, v = np.zeros(3), np.zeros(3)
    for a in range(3):
        for c in range(n):
            t[a] += W[a, c] * mu[c]
    for a in range(3):
        v[a] = K[a, 0] * (t[0] + r[0]) + K[a, 1] * (t[1] + r[1]) + K[a, 2] * (t[2] + r[2])
    add_outer_into(H, W, K, -1.0)
    for c in range(3, n):
        b[c] += W[0, c] * (mu[0] - v[0]) + W[1, c] * (mu[1] - v[1]) + W[2, c] * (mu[2] - v[2])
    for c in range(3):
        b[c] = t[c] + r[c] - W[0, c] * v[0] - W[1, c] * v[1] - W[2, c] * v[2]


@kernel
def measurement_update_into(H: Floats, b: Floats, mu: Floats, model: int, z: Floats, Z: Floats, at: int) -> None:
    """Eq. (17), (18): one sighting of the landmark whose rows start at `at`.

    H += J' Z^-1 J,   b += J' Z^-1 (z - h(mu) + J mu)
    """
    h0, h1, x00, x01, y00, y01, x10, x11, y10, y11 = sight_numbers(model, mu, mu[at], mu[at + 1])
    heading = heading_column(model)
    r0, r1 = z[0] - h0, z[1] - h1
    if model == RANGE_BEARING:
        r1 = wrap(r1)
    r0 += x00 * mu[0] + x01 * mu[1] + y00 * mu[at] + y01 * mu[at + 1]
    r1 += x10 * mu[0] + x11 * mu[1] + heading * mu[2] + y10 * mu[at] + y11 * mu[at + 1]
    determinant = Z[0, 0] * Z[1, 1] - Z[0, 1] * Z[1, 0]
    i00, i01, i10, i11 = Z[1, 1] / determinant, -Z[0, 1] / determinant, -Z[1, 0] / determinant, Z[0, 0] / determinant
    rows = (0, 1, 2, at, at + 1)
    J0 = (x00, x01, 0.0, y00, y01)
    J1 = (x10, x11, heading, y10, y11)
    for i in range(5):
        w0, w1 = J0[i] * i00 + J1[i] * i10, J0[i] * i01 + J1[i] * i11
        row = rows[i]
        b[row] += w0 * r0 + w1 * r1
        for j in range(i, 5):
            H[rows[j], row] += w0 * J0[j] + w1 * J1[j]
            H[row, rows[j]] = H[rows[j], row]


@kernel
def squared_innovation(L: Floats, known: int, mu: Floats, model: int, z: Floats, Z: Floats, at: int) -> float:
    """r' S^-1 r with S = J H^-1 J' + Z of one sighting; L is the lower factor of H's leading `known` rows.

    H^-1 is that of the block, given the rest of the map, so S is at most the full innovation covariance.
    """
    h0, h1, x00, x01, y00, y01, x10, x11, y10, y11 = sight_numbers(model, mu, mu[at], mu[at + 1])
    r0, r1 = z[0] - h0, z[1] - h1
    if model == RANGE_BEARING:
        r1 = wrap(r1)
    v, w = np.zeros(known), np.zeros(known)
    v[0], v[1], v[at], v[at + 1] = x00, x01, y00, y01
    w[0], w[1], w[2], w[at], w[at + 1] = x10, x11, heading_column(model), y10, y11
    s00, s10, s11 = Z[0, 0], Z[1, 0], Z[1, 1]
    for i in range(known):
        p, q = v[i], w[i]
        for k in range(i):
            p -= L[i, k] * v[k]
            q -= L[i, k] * w[k]
        v[i], w[i] = p / L[i, i], q / L[i, i]
        s00 += v[i] * v[i]
        s10 += w[i] * v[i]
        s11 += w[i] * w[i]
    return float((r0 * r0 * s11 - 2.0 * r0 * r1 * s10 + r1 * r1 * s00) / (s00 * s11 - s10 * s10))


@kernel
def link_strengths(H: Floats, measure: int) -> Floats:
    """How strongly the pose is linked to each landmark of the block, (m,); 0 where it is not.

    NORMALISED: sum over the entries of H_xa^2 / (H_xx H_aa), squared partial correlations.
    RAW: sum of H_xa^2, of mixed units, as published.
    KL: what dropping the link costs, the information that pose and landmark share given all others,
        -1/2 log det(I - H_aa^-1 H_ax H_xx^-1 H_xa), in nats.
    """
    m = (H.shape[0] - 3) // 2
    strength = np.zeros(m)
    for i in range(m):
        at = 3 + 2 * i
        for r in range(3):
            for c in range(at, at + 2):
                if H[r, c] != 0.0:
                    scale = 1.0 if measure == RAW else H[r, r] * H[c, c]
                    strength[i] += H[r, c] * H[r, c] / scale
    if measure == KL:
        H_xx = H[:3, :3].copy()
        for i in range(m):
            if strength[i] > 0.0:
                at = 3 + 2 * i
                H_xa = H[:3, at : at + 2].copy()
                X = solve_3x3(H_xx, H_xa)
                a, b, c, d = H[at, at], H[at, at + 1], H[at + 1, at], H[at + 1, at + 1]
                whole = a * d - b * c
                for k in range(3):
                    a -= H_xa[k, 0] * X[k, 0]
                    b -= H_xa[k, 0] * X[k, 1]
                    c -= H_xa[k, 1] * X[k, 0]
                    d -= H_xa[k, 1] * X[k, 1]
                strength[i] = max(-0.5 * math.log(max((a * d - b * c) / whole, 1e-300)), 1e-300)
    return strength


@kernel
def weakest_links(strength: Floats, active_max: int) -> Ints:
    """Landmarks of the block (0, 1, ...) to deactivate so that at most active_max stay linked to the pose.

    The weakest first, the lower number of two equal ones. strength (m,): see link_strengths.
    """
    left = strength.copy()
    linked = 0
    for i in range(len(left)):
        linked += left[i] > 0.0
    drop = np.empty(max(linked - active_max, 0), np.int64)
    for k in range(len(drop)):
        best = -1
        for i in range(len(left)):
            if left[i] > 0.0 and (best == -1 or left[i] < left[best]):
                best = i
        drop[k] = best
        left[best] = 0.0
    return drop


@kernel
def sparsify_into(H: Floats, b: Floats, mu: Floats, drop: Ints, soften: float) -> bool:
    """Eq. (42), (43): remove the links between the pose and the landmarks `drop` of the block.

        H~ = H - H_:x H_xx^-1 H_x: + U_:x U_xx^-1 U_x:,    U_x: = H_x: - H_x0 H_00^-1 H_0:  over the pose and the
        landmarks that stay active, 0 the dropped ones;    b' = b + (H' - H) mu

    soften: rho of eq. (56), H' = (1 - rho) H + rho H~; 1 removes the links, less weakens them.
    Returns False, leaving the block unusable, where H is not positive definite.
    """
    n, k = H.shape[0], 2 * len(drop)
    rows = np.empty(k, np.int64)
    for i in range(len(drop)):
        rows[2 * i], rows[2 * i + 1] = 3 + 2 * drop[i], 4 + 2 * drop[i]
    H_00, L = np.empty((k, k)), np.empty((k, k))
    for i in range(k):
        for j in range(k):
            H_00[i, j] = H[rows[i], rows[j]]
    if not cholesky_into(L, H_00, k):
        return False
    T = np.empty((3, k))
    for a in range(3):
        for i in range(k):
            T[a, i] = H[a, rows[i]]
        solve_lower_into(T[a], L, k)
        solve_upper_into(T[a], L, k)
    W, U = np.empty((3, n)), np.zeros((3, n))
    for c in range(n):
        for a in range(3):
            W[a, c] = H[a, c]
        if W[0, c] != 0.0 or W[1, c] != 0.0 or W[2, c] != 0.0:
            for a in range(3):
                U[a, c] = W[a, c]
                for i in range(k):
                    U[a, c] -= T[a, i] * H[rows[i], c]
    for a in range(3):
        for i in range(k):
            U[a, rows[i]] = 0.0
        for j in range(a):
            U[a, j] = U[j, a]
    W_inv, U_inv = solve_3x3(W[:, :3].copy(), np.eye(3)), solve_3x3(U[:, :3].copy(), np.eye(3))
    v, w, r = np.zeros(3), np.zeros(3), np.zeros(3)
    for c in range(n):
        for a in range(3):
            v[a] += W[a, c] * mu[c]
            w[a] += U[a, c] * mu[c]
    for a in range(3):
        r[a] = soften * (w[a] - v[a])  # what the rows of the pose change by
    v = soften * (W_inv @ v)
    w = soften * (U_inv @ w)
    add_outer_into(H, W, W_inv, -soften)
    add_outer_into(H, U, U_inv, soften)
    keep = 1.0 - soften
    for c in range(n):
        for a in range(3):
            H[a, c] = H[c, a] = U[a, c] if soften == 1.0 else keep * W[a, c] + soften * U[a, c]
    for c in range(3, n):
        for a in range(3):
            b[c] += U[a, c] * w[a] - W[a, c] * v[a]
    for a in range(3):
        b[a] += r[a]
    return True


@kernel
def forget_pose_into(H: Floats, b: Floats, model: int) -> bool:
    """Marginalise the pose out and leave none: eq. (11) of Walter, Eustice & Leonard, IJRR 26(4), 2007.

        H' = H - H_:x H_xx^-1 H_x:      b' = b - H_:x H_xx^-1 b_x      on the landmarks; zero on the pose

    Rows of the pose that sightings do not see (the heading of a vehicle with a compass) stay: nothing could bring them
    back. Returns False, with nothing changed, where they are linked to anything else.
    """
    n, seen = len(b), pose_rows_seen(model)
    if seen == 2:
        for c in range(n):
            if c != 2 and H[2, c] != 0.0:
                return False
    W, A, B = np.zeros((3, n)), np.eye(3), np.zeros((3, 1))
    for a in range(seen):
        B[a, 0] = b[a]
        for c in range(n):
            W[a, c] = H[a, c]
        for c in range(seen):
            A[a, c] = H[a, c]
    A_inv, x = solve_3x3(A, np.eye(3)), solve_3x3(A, B)
    for i in range(3):
        for j in range(i):
            A_inv[i, j] = A_inv[j, i] = 0.5 * (A_inv[i, j] + A_inv[j, i])
    add_outer_into(H, W, A_inv, -1.0)
    for c in range(3, n):
        b[c] -= W[0, c] * x[0, 0] + W[1, c] * x[1, 0] + W[2, c] * x[2, 0]
    for a in range(seen):
        b[a] = 0.0
        for c in range(n):
            H[a, c] = H[c, a] = 0.0
    return True
