"""One step of the sparse extended information filter, as one kernel over the filter's arrays.

A step gathers the dense block of the pose, the active and the sighted landmarks, works on that (local_updates),
recovers its mean given the rest of the map, and scatters what changed. Nothing here looks at the whole map, so a step
costs the same at any map size. On failure the arrays are as they were.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from fleet_seif.dense import cholesky_into, inverse_2x2, solve_lower_into, solve_upper_into
from fleet_seif.information import B_QUANTUM, H_QUANTUM, QUANTA_MAX
from fleet_seif.jit import kernel
from fleet_seif.local_updates import (
    measurement_update_into,
    motion_update_into,
    sparsify_into,
    squared_innovation,
    weakest_links,
)
from fleet_seif.models import RANGE_BEARING, place
from fleet_seif.records import Floats, Ints

LANDMARKS: Final = 0
LINKS: Final = 1
ACTIVE: Final = 2
CURSOR: Final = 3
DEGREE_MAX: Final = 4

ASYMMETRY_MAX: Final = 1e-9

OK: Final = 0
NOT_FINITE: Final = 1
BAD_ODOMETRY_COV: Final = 2
BAD_SIGHTING_COV: Final = 3
NOT_POSITIVE_DEFINITE: Final = 4
TOO_LARGE: Final = 5
BAD_RANGE: Final = 6
ABSURD: Final = 7


class SeifArrays(NamedTuple):
    """The filter's state. N, K, E, A are capacities for landmarks, neighbours, links and active landmarks.

    counts: how much of each is used, indexed by LANDMARKS ... DEGREE_MAX.
    mu_x (3,), b_x (3,), H_xx (3, 3); active (A,) ascending; H_xa (A, 3, 2).
    mu_y (N, 2), b_y (N, 2), H_yy (N, 2, 2); degree (N,); neighbour (N, K); link (N, K) into H_link.
    H_link (E, 2, 2): rows of the lower landmark, columns of the higher.
    q_*: the same quantities as last published, in quanta. refusals (N,): in a row. local (N,): scratch, -1.
    """

    counts: Ints
    mu_x: Floats
    b_x: Floats
    H_xx: Floats
    active: Ints
    H_xa: Floats
    mu_y: Floats
    b_y: Floats
    H_yy: Floats
    degree: Ints
    neighbour: Ints
    link: Ints
    H_link: Floats
    q_b_x: Ints
    q_xx: Ints
    q_xa: Ints
    q_b_y: Ints
    q_yy: Ints
    q_link: Ints
    refusals: Ints
    local: Ints


@kernel
def block_ids(active: Ints, sighted: Ints) -> Ints:
    """The landmarks of a step's block: active or sighted, ascending, each once."""
    ids = np.empty(len(active) + len(sighted), np.int64)
    ids[: len(active)] = active
    n = len(active)
    for new in sighted:
        at = n
        while at > 0 and ids[at - 1] > new:
            at -= 1
        if at > 0 and ids[at - 1] == new:
            continue
        for i in range(n, at, -1):
            ids[i] = ids[i - 1]
        ids[at] = new
        n += 1
    return ids[:n]


@kernel
def gather(s: SeifArrays, ids: Ints) -> tuple[Floats, Floats, Floats, Ints, Floats]:
    """The dense block of the pose and landmarks `ids`: H, b, mu; which link joins i < j (-1 none); H_out mu_out."""
    m = len(ids)
    n, known = 3 + 2 * m, s.counts[LANDMARKS]
    H, b, mu, pull = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros(n)
    links = np.full((m, m), -1, np.int64)
    H[:3, :3], b[:3], mu[:3] = s.H_xx, s.b_x, s.mu_x
    for i in range(m):
        if ids[i] < known:
            s.local[ids[i]] = i
    for a in range(s.counts[ACTIVE]):
        at = 3 + 2 * s.local[s.active[a]]
        for r in range(3):
            for c in range(2):
                H[r, at + c] = H[at + c, r] = s.H_xa[a, r, c]
    for i in range(m):
        y, at = ids[i], 3 + 2 * i
        if y >= known:
            continue
        for r in range(2):
            b[at + r], mu[at + r] = s.b_y[y, r], s.mu_y[y, r]
            for c in range(2):
                H[at + r, at + c] = s.H_yy[y, r, c]
        for k in range(s.degree[y]):
            other, e = s.neighbour[y, k], s.link[y, k]
            j = s.local[other]
            if j > i:
                links[i, j] = e
                for r in range(2):
                    for c in range(2):
                        H[at + r, 3 + 2 * j + c] = H[3 + 2 * j + c, at + r] = s.H_link[e, r, c]
            elif j == -1:
                for r in range(2):
                    for c in range(2):
                        h = s.H_link[e, r, c] if y < other else s.H_link[e, c, r]
                        pull[at + r] += h * s.mu_y[other, c]
    for i in range(m):
        if ids[i] < known:
            s.local[ids[i]] = -1
    return H, b, mu, links, pull


@kernel
def recover_mean_into(mu: Floats, H: Floats, b: Floats, pull: Floats) -> bool:
    """Eq. (49), (50) on a block: solve H mu = b - H_out mu_out for all of it at once. False if H is not PD."""
    n = len(mu)
    L = np.empty((n, n))
    if not cholesky_into(L, H, n):
        return False
    mu[:] = b - pull
    solve_lower_into(mu, L, n)
    solve_upper_into(mu, L, n)
    return True


@kernel
def relax_others(s: SeifArrays, count: int) -> None:
    """Eq. (49), (50) one landmark at a time, for the next `count` in turn: mu_j = H_jj^-1 (b_j - H_j. mu)."""
    n = s.counts[LANDMARKS]
    for _ in range(min(count, n)):
        y = s.counts[CURSOR] % n
        s.counts[CURSOR] = (y + 1) % n
        r = s.b_y[y].copy()
        for k in range(s.degree[y]):
            other, e = s.neighbour[y, k], s.link[y, k]
            for i in range(2):
                for c in range(2):
                    h = s.H_link[e, i, c] if y < other else s.H_link[e, c, i]
                    r[i] -= h * s.mu_y[other, c]
        for a in range(s.counts[ACTIVE]):
            if s.active[a] == y:
                for i in range(2):
                    for c in range(3):
                        r[i] -= s.H_xa[a, c, i] * s.mu_x[c]
        H_inv = inverse_2x2(s.H_yy[y])
        for i in range(2):
            s.mu_y[y, i] = H_inv[i, 0] * r[0] + H_inv[i, 1] * r[1]


@kernel
def touches(H: Floats, r: int, rows: int, c: int) -> bool:
    """Whether the block of H at (r, c), `rows` rows and 2 columns, has an entry that is not zero."""
    for i in range(r, r + rows):
        if H[i, c] != 0.0 or H[i, c + 1] != 0.0:
            return True
    return False


@kernel
def row_entries(s: SeifArrays, ids: Ints, H: Floats, links: Ints) -> Ints:
    """Non-zeros of each full row of the block's variables once `connect` has run, the diagonal included, (n,)."""
    m = len(ids)
    entries = np.empty(3 + 2 * m, np.int64)
    active = 0
    for i in range(m):
        linked = touches(H, 0, 3, 3 + 2 * i)
        active += linked
        degree = s.degree[ids[i]] if ids[i] < s.counts[LANDMARKS] else 0
        entries[3 + 2 * i] = 2 + 2 * degree + 3 * linked
    for i in range(m):
        for j in range(i + 1, m):
            if links[i, j] == -1 and touches(H, 3 + 2 * i, 2, 3 + 2 * j):
                entries[3 + 2 * i] += 2
                entries[3 + 2 * j] += 2
        entries[4 + 2 * i] = entries[3 + 2 * i]
    entries[:3] = 3 + 2 * active
    return entries


@kernel
def connect(s: SeifArrays, ids: Ints, H: Floats, links: Ints) -> None:
    """Make a link for every pair of the block that has information in common and none yet."""
    for i in range(len(ids)):
        for j in range(i + 1, len(ids)):
            if links[i, j] == -1 and touches(H, 3 + 2 * i, 2, 3 + 2 * j):
                e = s.counts[LINKS]
                s.counts[LINKS] += 1
                links[i, j] = e
                s.q_link[e] = 0
                for y, other in ((ids[i], ids[j]), (ids[j], ids[i])):
                    k = s.degree[y]
                    s.neighbour[y, k], s.link[y, k] = other, e
                    s.degree[y] = k + 1
                    s.counts[DEGREE_MAX] = max(s.counts[DEGREE_MAX], k + 1)


@kernel
def quantise(H: Floats, b: Floats, mu: Floats, entries: Ints) -> tuple[Ints, Ints, bool]:
    """The block in quanta, its diagonal loaded by half a quantum for each non-zero of the full row.

    By Gershgorin's theorem the loading outweighs all rounding, so positive definite stays positive definite; b is
    loaded by load * mu so that the mean stays. entries (n,): non-zeros of each full row, the diagonal included.
    """
    n = len(b)
    q_H, q_b = np.empty((n, n), np.int64), np.empty(n, np.int64)
    fits = True
    for i in range(n):
        load = 0.5 * entries[i]
        for j in range(i, n):
            value = np.rint(H[i, j] * (1.0 / H_QUANTUM) + (load if i == j else 0.0))
            fits = fits and abs(value) < QUANTA_MAX // 2
            q_H[i, j] = q_H[j, i] = np.int64(value) if fits else 0
        value = np.rint((b[i] + load * H_QUANTUM * mu[i]) * (1.0 / B_QUANTUM))
        fits = fits and abs(value) < QUANTA_MAX // 2
        q_b[i] = np.int64(value) if fits else 0
    return q_H, q_b, fits


@kernel
def block_delta(ids: Ints, q_H: Ints, q_b: Ints, old_H: Ints, old_b: Ints) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """What changed in a block: the arrays of a FrameDelta, blocks and variables that did not change left out."""
    m = len(ids) + 1
    pairs = m * (m + 1) // 2
    rows, cols, H = np.empty(pairs, np.int64), np.empty(pairs, np.int64), np.empty(6 * pairs, np.int64)
    used = np.zeros(m, np.bool_)
    blocks = h = 0
    for v in range(m):
        r0, r1 = (0, 3) if v == 0 else (1 + 2 * v, 3 + 2 * v)
        for r in range(r0, r1):
            used[v] |= q_b[r] != old_b[r]
        for w in range(v, m):
            c0, c1 = (0, 3) if w == 0 else (1 + 2 * w, 3 + 2 * w)
            changed, start = False, h
            for r in range(r0, r1):
                for c in range(r if v == w else c0, c1):
                    H[h] = q_H[r, c] - old_H[r, c]
                    changed |= H[h] != 0
                    h += 1
            if changed:
                rows[blocks], cols[blocks] = v, w
                used[v] = used[w] = True
                blocks += 1
            else:
                h = start
    variables, position, b = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(2 * m + 1, np.int64)
    n = size = 0
    for v in range(m):
        if used[v]:
            variables[n] = 0 if v == 0 else ids[v - 1] + 1
            position[v] = n
            n += 1
            for r in range(0 if v == 0 else 1 + 2 * v, 3 + 2 * v):
                b[size] = q_b[r] - old_b[r]
                size += 1
    for k in range(blocks):
        rows[k], cols[k] = position[rows[k]], position[cols[k]]
    return variables[:n].copy(), rows[:blocks].copy(), cols[:blocks].copy(), H[:h].copy(), b[:size].copy()


@kernel
def published(s: SeifArrays, ids: Ints, links: Ints) -> tuple[Ints, Ints]:
    """The block in quanta as it was last published."""
    n, known = 3 + 2 * len(ids), s.counts[LANDMARKS]
    q_H, q_b = np.zeros((n, n), np.int64), np.zeros(n, np.int64)
    q_H[:3, :3], q_b[:3] = s.q_xx, s.q_b_x
    a = 0
    for i in range(len(ids)):
        at = 3 + 2 * i
        if a < s.counts[ACTIVE] and s.active[a] == ids[i]:
            q_H[:3, at : at + 2] = s.q_xa[a]
            a += 1
        if ids[i] < known:
            q_H[at : at + 2, at : at + 2], q_b[at : at + 2] = s.q_yy[ids[i]], s.q_b_y[ids[i]]
        for j in range(i + 1, len(ids)):
            if links[i, j] != -1:
                for r in range(2):
                    for c in range(2):
                        q_H[at + r, 3 + 2 * j + c] = s.q_link[links[i, j], r, c]
    return q_H, q_b


@kernel
def scatter(s: SeifArrays, ids: Ints, links: Ints, H: Floats, b: Floats, mu: Floats, q_H: Ints, q_b: Ints) -> None:
    """Write a block back."""
    s.H_xx[:], s.b_x[:], s.mu_x[:] = H[:3, :3], b[:3], mu[:3]
    s.q_xx[:], s.q_b_x[:] = q_H[:3, :3], q_b[:3]
    active = 0
    for i in range(len(ids)):
        y, at = ids[i], 3 + 2 * i
        if touches(H, 0, 3, at):
            s.active[active], s.H_xa[active] = y, H[:3, at : at + 2]
            s.q_xa[active] = q_H[:3, at : at + 2]
            active += 1
        s.H_yy[y], s.q_yy[y] = H[at : at + 2, at : at + 2], q_H[at : at + 2, at : at + 2]
        s.b_y[y], s.mu_y[y], s.q_b_y[y] = b[at : at + 2], mu[at : at + 2], q_b[at : at + 2]
        for j in range(i + 1, len(ids)):
            e, to = links[i, j], 3 + 2 * j
            if e != -1:
                for r in range(2):
                    for c in range(2):
                        s.H_link[e, r, c] = H[at + r, to + c]
                        s.q_link[e, r, c] = q_H[at + r, to + c]
    s.counts[ACTIVE] = active


@kernel
def published_total(s: SeifArrays) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """All that has been published, as the arrays of one FrameDelta; its cost follows the map."""
    n, links = s.counts[LANDMARKS], s.counts[LINKS]
    blocks = 1 + s.counts[ACTIVE] + n + links
    variables = np.arange(n + 1)
    rows, cols, H = np.zeros(blocks, np.int64), np.zeros(blocks, np.int64), np.empty(6 * blocks, np.int64)
    b = np.concatenate((s.q_b_x, s.q_b_y[:n].copy().ravel()))
    k = h = 0
    for r in range(3):
        for c in range(r, 3):
            H[h] = s.q_xx[r, c]
            h += 1
    for a in range(s.counts[ACTIVE]):
        k += 1
        cols[k] = s.active[a] + 1
        for r in range(3):
            H[h], H[h + 1] = s.q_xa[a, r, 0], s.q_xa[a, r, 1]
            h += 2
    for y in range(n):
        k += 1
        rows[k] = cols[k] = y + 1
        H[h], H[h + 1], H[h + 2] = s.q_yy[y, 0, 0], s.q_yy[y, 0, 1], s.q_yy[y, 1, 1]
        h += 3
        for i in np.argsort(s.neighbour[y, : s.degree[y]]):
            if s.neighbour[y, i] > y:
                k += 1
                rows[k], cols[k] = y + 1, s.neighbour[y, i] + 1
                for r in range(2):
                    H[h], H[h + 1] = s.q_link[s.link[y, i], r, 0], s.q_link[s.link[y, i], r, 1]
                    h += 2
    return variables, rows, cols, H[:h].copy(), b


@kernel
def is_covariance(A: Floats) -> bool:
    """Symmetric to rounding, and positive definite."""
    n = len(A)
    for i in range(n):
        for j in range(i):
            if not abs(A[i, j] - A[j, i]) <= ASYMMETRY_MAX * math.sqrt(abs(A[i, i] * A[j, j])):
                return False
    return cholesky_into(np.empty((n, n)), A, n)


@kernel
def check_reading(model: int, u: Floats, cov: Floats, z: Floats, Z: Floats) -> int:
    """OK, or which rule a reading breaks: finite numbers, symmetric positive definite covariances, positive ranges."""
    if not (np.all(np.isfinite(u)) and np.all(np.isfinite(cov)) and np.all(np.isfinite(z)) and np.all(np.isfinite(Z))):
        return NOT_FINITE
    if not is_covariance(cov):
        return BAD_ODOMETRY_COV
    for k in range(len(z)):
        if not is_covariance(Z[k]):
            return BAD_SIGHTING_COV
        if model == RANGE_BEARING and not z[k, 0] > 0.0:
            return BAD_RANGE
    return OK


@kernel
def accept_sightings(
    s: SeifArrays, H: Floats, mu: Floats, ids: Ints, model: int, at: Ints, z: Floats, Z: Floats,
    gate: float, patience: int, fresh: Ints,
) -> tuple[Ints, float, int, bool]:  # fmt: skip
    """Which sightings enter: (s,) of 0 or 1; the sum of squared normalised innovations of those, their number; PD.

    A sighting of a known landmark enters if its squared normalised innovation is at most `gate`, or if the landmark
    was refused `patience` times in a row: then the map is wrong, not the sighting.
    """
    accepted = np.ones(len(at), np.int64)
    known = 3
    for y in ids:
        known += 2 * (y < s.counts[LANDMARKS])
    L = np.empty((known, known))
    if known > 3 and not cholesky_into(L, H, known):
        return accepted, 0.0, 0, False
    total, used = 0.0, 0
    for k in range(len(at)):
        if at[k] >= known:
            continue
        value = squared_innovation(L, known, mu, model, z[k], Z[k], at[k])
        y = ids[(at[k] - 3) // 2]
        if value <= gate or fresh[(at[k] - 3) // 2] >= patience:
            fresh[(at[k] - 3) // 2] = 0
            if value <= gate:
                total += value
                used += 1
        else:
            accepted[k] = 0
            fresh[(at[k] - 3) // 2] += 1
    return accepted, total, used, True


@kernel
def seif_step(
    s: SeifArrays, model: int, moves: bool, u: Floats, cov: Floats, sighted: Ints, z: Floats, Z: Floats,
    active_max: int, others: int, gate: float, patience: int, growth_max: int,
) -> tuple[int, Floats, Ints, Ints, Ints, Ints, Ints]:  # fmt: skip
    """One step: motion (if `moves`), sightings of landmarks `sighted`, mean recovery, sparsification, delta.

    Landmark numbers from counts[LANDMARKS] on are new; capacities must suffice. growth_max: quanta by which a diagonal
    entry of H may grow at most.

    Returns: a code (OK ...), statistics (sum of squared innovations, sightings they come from, sightings refused), and
    the arrays of the FrameDelta.
    """
    none = np.empty(0, np.int64)
    statistics = np.zeros(3)
    code = check_reading(model, u, cov, z, Z)
    if code != OK:
        return code, statistics, none, none, none, none, none
    ids = block_ids(s.active[: s.counts[ACTIVE]], sighted)
    m, known = len(ids), s.counts[LANDMARKS]
    H, b, mu, links, pull = gather(s, ids)
    refusals = np.zeros(m, np.int64)
    for i in range(m):
        if ids[i] < known:
            refusals[i] = s.refusals[ids[i]]
    if moves:
        motion_update_into(H, b, mu, model, u, cov)
    at = 3 + 2 * np.searchsorted(ids, sighted)
    accepted, statistics[0], used, definite = accept_sightings(s, H, mu, ids, model, at, z, Z, gate, patience, refusals)
    if not definite:
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    statistics[1], statistics[2] = used, len(z) - np.sum(accepted)
    for k in range(len(z)):
        y = (at[k] - 3) // 2
        if ids[y] >= known and H[at[k], at[k]] == 0.0:
            mu[at[k] : at[k] + 2] = place(model, mu[:3], z[k])
        if accepted[k]:
            measurement_update_into(H, b, mu, model, z[k], Z[k], at[k])
    if not recover_mean_into(mu, H, b, pull):
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    drop = weakest_links(H, active_max)
    if len(drop) > 0 and not sparsify_into(H, b, mu, drop):
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    if not np.all(np.isfinite(mu)):
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    q_H, q_b, fits = quantise(H, b, mu, row_entries(s, ids, H, links))
    if not fits:
        return TOO_LARGE, statistics, none, none, none, none, none
    old_H, old_b = published(s, ids, links)
    for i in range(len(q_H)):
        if q_H[i, i] - old_H[i, i] > growth_max:
            return ABSURD, statistics, none, none, none, none, none
    for i in range(m):
        if ids[i] >= known:
            s.degree[ids[i]] = 0
            s.local[ids[i]] = -1
            s.counts[LANDMARKS] = ids[i] + 1
        s.refusals[ids[i]] = refusals[i]
    connect(s, ids, H, links)
    variables, rows, cols, values, b_values = block_delta(ids, q_H, q_b, old_H, old_b)
    scatter(s, ids, links, H, b, mu, q_H, q_b)
    relax_others(s, others)
    return OK, statistics, variables, rows, cols, values, b_values
