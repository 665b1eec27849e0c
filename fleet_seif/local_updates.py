"""The SEIF's updates on a dense local block: the pose and every landmark a step can touch.

All three change only rows and columns of the pose, the active landmarks and the sighted ones, so that they are exact
on that block whatever the size of the map. Order in a block: pose (3 rows), then landmarks (2 rows each).
Equation numbers are those of Thrun et al., IJRR 2004; the algebra is in MATHS.md.
"""

import numpy as np

from fleet_seif.dense import cholesky_into, inverse_2x2, solve_3x3, solve_lower_into, solve_upper_into
from fleet_seif.jit import kernel
from fleet_seif.models import innovation, move, sight
from fleet_seif.records import Floats, Ints


@kernel
def add_outer_into(H: Floats, W: Floats, K: Floats, sign: float) -> None:
    """H += sign W' K W, kept exactly symmetric; H (n, n), W (3, n), K (3, 3) symmetric."""
    n = H.shape[0]
    for i in range(n):
        k0 = sign * (W[0, i] * K[0, 0] + W[1, i] * K[1, 0] + W[2, i] * K[2, 0])
        k1 = sign * (W[0, i] * K[0, 1] + W[1, i] * K[1, 1] + W[2, i] * K[2, 1])
        k2 = sign * (W[0, i] * K[0, 2] + W[1, i] * K[1, 2] + W[2, i] * K[2, 2])
        if k0 == 0.0 and k1 == 0.0 and k2 == 0.0:
            continue
        for j in range(i, n):
            H[i, j] += k0 * W[0, j] + k1 * W[1, j] + k2 * W[2, j]
            H[j, i] = H[i, j]


@kernel
def motion_update_into(H: Floats, b: Floats, mu: Floats, model: int, u: Floats, cov: Floats) -> None:
    """Lemma 3: the pose moves by increment u with covariance cov; H, b and mu of the block are updated.

        H1 = F^-T H F^-1,   K = (I + U H1_xx)^-1 U,   H' = H1 - H1_:x K H1_x:
        b' = H' mu' + r1 - H1_:x K r1_x    with the residual r = b - H mu, r1 = F^-T r

    F is the Jacobian of the motion on the pose and the identity elsewhere, U = J_u cov J_u'. U is never inverted. The
    residual term keeps b right where the mean has not converged.
    """
    r = b - H @ mu
    new_x, J_new_x, J_new_u = move(model, mu[:3].copy(), u)
    U = J_new_u @ cov @ J_new_u.T
    F_inv = np.eye(3)
    F_inv[0, 2], F_inv[1, 2] = -J_new_x[0, 2], -J_new_x[1, 2]
    W = F_inv.T @ np.ascontiguousarray(H[:3])
    W[:, :3] = np.ascontiguousarray(W[:, :3]) @ F_inv
    for i in range(3):
        for j in range(i):
            W[i, j] = W[j, i]
    H[:3] = W
    H[:, :3] = W.T
    r[:3] = F_inv.T @ r[:3]
    K = solve_3x3(np.eye(3) + U @ np.ascontiguousarray(W[:, :3]), U)
    for i in range(3):
        for j in range(i):
            K[i, j] = K[j, i] = 0.5 * (K[i, j] + K[j, i])
    add_outer_into(H, W, K, -1.0)
    mu[:3] = new_x
    b[:] = H @ mu + r - W.T @ (K @ r[:3])


@kernel
def measurement_update_into(H: Floats, b: Floats, mu: Floats, model: int, z: Floats, Z: Floats, at: int) -> None:
    """Eq. (17), (18): one sighting of the landmark whose rows start at `at`.

    H += J' Z^-1 J,   b += J' Z^-1 (z - h(mu) + J mu)
    """
    h, J_z_x, J_z_y = sight(model, mu[:3], mu[at : at + 2])
    r = innovation(model, z, h)
    J = np.empty((2, 5))
    J[:, :3], J[:, 3:] = J_z_x, J_z_y
    rows = np.array([0, 1, 2, at, at + 1])
    for k in range(2):
        for c in range(5):
            r[k] += J[k, c] * mu[rows[c]]
    Z_inv = inverse_2x2(Z)
    weighted = np.empty((5, 2))
    for i in range(5):
        for k in range(2):
            weighted[i, k] = J[0, i] * Z_inv[0, k] + J[1, i] * Z_inv[1, k]
    for i in range(5):
        b[rows[i]] += weighted[i, 0] * r[0] + weighted[i, 1] * r[1]
        for j in range(i, 5):
            H[rows[i], rows[j]] += weighted[i, 0] * J[0, j] + weighted[i, 1] * J[1, j]
            H[rows[j], rows[i]] = H[rows[i], rows[j]]


@kernel
def squared_innovation(L: Floats, known: int, mu: Floats, model: int, z: Floats, Z: Floats, at: int) -> float:
    """r' S^-1 r with S = J H^-1 J' + Z of one sighting; L is the lower factor of H's leading `known` rows.

    H^-1 is that of the block, given the rest of the map, so S is at most the full innovation covariance.
    """
    h, J_z_x, J_z_y = sight(model, mu[:3], mu[at : at + 2])
    r = innovation(model, z, h)
    V = np.zeros((2, known))
    S = Z.copy()
    for k in range(2):
        V[k, :3] = J_z_x[k]
        V[k, at], V[k, at + 1] = J_z_y[k, 0], J_z_y[k, 1]
        solve_lower_into(V[k], L, known)
    for i in range(known):
        S[0, 0] += V[0, i] * V[0, i]
        S[1, 0] += V[1, i] * V[0, i]
        S[1, 1] += V[1, i] * V[1, i]
    S[0, 1] = S[1, 0]
    S_inv = inverse_2x2(S)
    return float(r[0] * r[0] * S_inv[0, 0] + 2.0 * r[0] * r[1] * S_inv[0, 1] + r[1] * r[1] * S_inv[1, 1])


@kernel
def weakest_links(H: Floats, active_max: int) -> Ints:
    """Landmarks of the block (0, 1, ...) to deactivate so that at most active_max stay linked to the pose.

    The strength of a link is normalised: the sum over its entries of H_xa^2 / (H_xx H_aa).
    """
    m = (H.shape[0] - 3) // 2
    strength = np.zeros(m)
    linked = 0
    for i in range(m):
        at = 3 + 2 * i
        for r in range(3):
            for c in range(at, at + 2):
                if H[r, c] != 0.0:
                    strength[i] += H[r, c] * H[r, c] / (H[r, r] * H[c, c])
        linked += strength[i] > 0.0
    drop = np.empty(max(linked - active_max, 0), np.int64)
    for k in range(len(drop)):
        best = -1
        for i in range(m):
            if strength[i] > 0.0 and (best == -1 or strength[i] < strength[best]):
                best = i
        drop[k] = best
        strength[best] = 0.0
    return drop


@kernel
def sparsify_into(H: Floats, b: Floats, mu: Floats, drop: Ints) -> bool:
    """Eq. (42), (43): remove the links between the pose and the landmarks `drop` of the block.

        H' = H - H_:x H_xx^-1 H_x: + U_:x U_xx^-1 U_x:,    U_x: = H_x: - H_x0 H_00^-1 H_0:  over the pose and the
        landmarks that stay active, 0 the dropped ones;    b' = b + (H' - H) mu

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
    W = H[:3].copy()
    U = np.zeros((3, n))
    for c in range(n):
        if W[0, c] != 0.0 or W[1, c] != 0.0 or W[2, c] != 0.0:
            for a in range(3):
                U[a, c] = W[a, c]
                for i in range(k):
                    U[a, c] -= T[a, i] * H[rows[i], c]
    for i in range(k):
        U[:, rows[i]] = 0.0
    for i in range(3):
        for j in range(i):
            U[i, j] = U[j, i]
    before = H @ mu
    identity = np.eye(3)
    add_outer_into(H, W, solve_3x3(np.ascontiguousarray(W[:, :3]), identity), -1.0)
    add_outer_into(H, U, solve_3x3(np.ascontiguousarray(U[:, :3]), identity), 1.0)
    H[:3] = U
    H[:, :3] = U.T
    b += H @ mu - before
    return True
