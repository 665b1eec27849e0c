"""One step of the sparse extended information filter, as one kernel over the filter's arrays.

A step gathers the dense block of the pose, the active and the sighted landmarks, works on that (local_updates),
recovers its mean given the rest of the map, and scatters what changed. Nothing here looks at the whole map, so a step
costs the same at any map size. On failure the arrays are as they were.
"""

import math
from typing import Final

import numpy as np

from fleet_seif.dense import cholesky_into, solve_lower_into, solve_upper_into
from fleet_seif.information import B_QUANTUM, H_QUANTUM, QUANTA_MAX
from fleet_seif.jit import kernel
from fleet_seif.local_updates import (
    RAW,
    forget_pose_into,
    link_strengths,
    measurement_update_into,
    motion_update_into,
    sparsify_into,
    squared_innovation,
    weakest_links,
)
from fleet_seif.models import RANGE_BEARING, place, pose_rows_seen
from fleet_seif.records import Floats, Ints
from fleet_seif.seif_arrays import (
    ACTIVE,
    DEGREE_MAX,
    LANDMARKS,
    LINKS,
    QUEUE_FIRST,
    QUEUE_LAST,
    QUEUED,
    SeifArrays,
    arrays,
)

ASYMMETRY_MAX: Final = 1e-9
SOFT_LEAST: Final = 1e-4
"""Strength below which a link that is being weakened is cut."""
LAG_MAX: Final = 1e-2
"""Shift of a mean, in units of its conditional sigma, squared, from which on its neighbours are relaxed too."""

OK: Final = 0
NOT_FINITE: Final = 1
BAD_ODOMETRY_COV: Final = 2
BAD_SIGHTING_COV: Final = 3
NOT_POSITIVE_DEFINITE: Final = 4
TOO_LARGE: Final = 5
BAD_RANGE: Final = 6
ABSURD: Final = 7

SEIF: Final = 0
EIF: Final = 1
ESEIF: Final = 2


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
    for r in range(3):
        b[r], mu[r] = s.b_x[r], s.mu_x[r]
        for c in range(3):
            H[r, c] = s.H_xx[r, c]
    for i in range(m):
        if ids[i] < known:
            s.local[ids[i]] = i + 1
    for a in range(s.counts[ACTIVE]):
        at = 1 + 2 * s.local[s.active[a]]
        for r in range(3):
            for c in range(2):
                H[r, at + c] = H[at + c, r] = s.H_xa[a, r, c]
    for i in range(m):
        y, at = ids[i], 3 + 2 * i
        if y >= known:
            continue
        b[at], b[at + 1] = s.b_y[y, 0], s.b_y[y, 1]
        mu[at], mu[at + 1] = s.mu_y[y, 0], s.mu_y[y, 1]
        for r in range(2):
            for c in range(2):
                H[at + r, at + c] = s.H_yy[y, r, c]
        half = s.first[y] - 1
        while half >= 0:
            e, side = half >> 1, half & 1
            other = s.ends[e, 1 - side]
            half = s.following[e, side] - 1
            j = s.local[other] - 1
            if j == -1:
                h01, h10 = s.H_link[e, 0, 1], s.H_link[e, 1, 0]
                if side == 1:
                    h01, h10 = h10, h01
                pull[at] += s.H_link[e, 0, 0] * s.mu_y[other, 0] + h01 * s.mu_y[other, 1]
                pull[at + 1] += h10 * s.mu_y[other, 0] + s.H_link[e, 1, 1] * s.mu_y[other, 1]
            elif side == 0:
                links[i, j] = e
                for r in range(2):
                    for c in range(2):
                        H[at + r, 3 + 2 * j + c] = H[3 + 2 * j + c, at + r] = s.H_link[e, r, c]
    for i in range(m):
        if ids[i] < known:
            s.local[ids[i]] = 0
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
def enqueue(s: SeifArrays, y: int) -> None:
    """Let a landmark's mean be relaxed, after those that wait already; it must not be one of them."""
    s.queue[y] = y + 1
    if s.counts[QUEUED] > 0:
        s.queue[s.counts[QUEUE_LAST]] = y + 1
    else:
        s.counts[QUEUE_FIRST] = y
    s.counts[QUEUE_LAST] = y
    s.counts[QUEUED] += 1


@kernel
def enqueue_neighbours(s: SeifArrays, y: int) -> None:
    """Those of a landmark that are not marked in `local`."""
    half = s.first[y] - 1
    while half >= 0:
        e, side = half >> 1, half & 1
        other = s.ends[e, 1 - side]
        half = s.following[e, side] - 1
        if s.queue[other] == 0 and s.local[other] == 0:
            enqueue(s, other)


@kernel
def lags(H_yy: Floats, d0: float, d1: float) -> bool:
    """Whether a landmark's mean has moved far enough for its neighbours to follow: d' H_yy d > LAG_MAX."""
    return bool(d0 * d0 * H_yy[0, 0] + 2.0 * d0 * d1 * H_yy[0, 1] + d1 * d1 * H_yy[1, 1] > LAG_MAX)


@kernel
def enqueue_around(s: SeifArrays, ids: Ints, known: int, mu: Floats, before: Floats) -> None:
    """The neighbours, outside the block, of its landmarks whose means have moved far."""
    for y in ids:
        s.local[y] = 1
    for i in range(len(ids)):
        at = 3 + 2 * i
        if ids[i] < known and lags(s.H_yy[ids[i]], mu[at] - before[at], mu[at + 1] - before[at + 1]):
            enqueue_neighbours(s, ids[i])
    for y in ids:
        s.local[y] = 0


@kernel
def relax(s: SeifArrays, y: int) -> tuple[float, float]:
    """Eq. (49), (50) for one landmark: mu_y = H_yy^-1 (b_y - the rest of its row). Returns by how much it moved."""
    r0, r1 = s.b_y[y, 0], s.b_y[y, 1]
    half = s.first[y] - 1
    while half >= 0:
        e, side = half >> 1, half & 1
        other = s.ends[e, 1 - side]
        half = s.following[e, side] - 1
        h01, h10 = s.H_link[e, 0, 1], s.H_link[e, 1, 0]
        if side == 1:
            h01, h10 = h10, h01
        r0 -= s.H_link[e, 0, 0] * s.mu_y[other, 0] + h01 * s.mu_y[other, 1]
        r1 -= h10 * s.mu_y[other, 0] + s.H_link[e, 1, 1] * s.mu_y[other, 1]
    for a in range(s.counts[ACTIVE]):
        if s.active[a] == y:
            for c in range(3):
                r0 -= s.H_xa[a, c, 0] * s.mu_x[c]
                r1 -= s.H_xa[a, c, 1] * s.mu_x[c]
    h00, h01, h10, h11 = s.H_yy[y, 0, 0], s.H_yy[y, 0, 1], s.H_yy[y, 1, 0], s.H_yy[y, 1, 1]
    determinant = h00 * h11 - h01 * h10
    new0 = h11 / determinant * r0 + -h01 / determinant * r1
    new1 = -h10 / determinant * r0 + h00 / determinant * r1
    d0, d1 = new0 - s.mu_y[y, 0], new1 - s.mu_y[y, 1]
    s.mu_y[y, 0], s.mu_y[y, 1] = new0, new1
    return d0, d1


@kernel
def relax_queued(s: SeifArrays, count: int) -> None:
    """Relax up to `count` of the landmarks that wait; where one moves far, its neighbours wait next."""
    for _ in range(min(count, s.counts[QUEUED])):
        y = s.counts[QUEUE_FIRST]
        s.counts[QUEUE_FIRST] = s.queue[y] - 1
        s.queue[y] = 0
        s.counts[QUEUED] -= 1
        d0, d1 = relax(s, y)
        if lags(s.H_yy[y], d0, d1):
            enqueue_neighbours(s, y)


@kernel
def relocate_into(
    H: Floats, b: Floats, mu: Floats, pull: Floats, model: int, at: Ints, z: Floats, Z: Floats, held: Ints
) -> bool:  # fmt: skip
    """ESEIF: forget where the pose is, and find it again from the sightings that were held back.

    They are linearised at the mean of all that is known, before any of it is forgotten. False, leaving the block
    unusable, where H is not PD.
    """
    H_all, b_all = H.copy(), b.copy()
    for k in range(len(z)):
        if held[k]:
            measurement_update_into(H_all, b_all, mu, model, z[k], Z[k], at[k])
    if not recover_mean_into(mu, H_all, b_all, pull):
        return False
    forget_pose_into(H, b, model)
    for k in range(len(z)):
        if held[k]:
            measurement_update_into(H, b, mu, model, z[k], Z[k], at[k])
    return True


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
                s.ends[e, 0], s.ends[e, 1] = ids[i], ids[j]
                for side in range(2):
                    y = s.ends[e, side]
                    s.following[e, side] = s.first[y]
                    s.first[y] = 1 + 2 * e + side
                    s.degree[y] += 1
                    s.counts[DEGREE_MAX] = max(s.counts[DEGREE_MAX], s.degree[y])


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
def block_delta(names: Ints, q_H: Ints, q_b: Ints, old_H: Ints, old_b: Ints) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """What changed in a block: the arrays of a FrameDelta, blocks and variables that did not change left out.

    names (m,): what the landmarks of the block are called there, in its order. Of H, upper triangles.
    """
    m = len(names) + 1
    pairs = m * (m + 1) // 2
    rows, cols, H = np.empty(pairs, np.int64), np.empty(pairs, np.int64), np.empty(6 * pairs, np.int64)
    used, order, at = np.zeros(m, np.bool_), np.argsort(names), np.zeros(m, np.int64)
    for v in range(1, m):
        at[v] = 3 + 2 * order[v - 1]
    blocks = h = 0
    for v in range(m):
        r0, size_r = at[v], 3 if v == 0 else 2
        for r in range(r0, r0 + size_r):
            used[v] |= q_b[r] != old_b[r]
        for w in range(v, m):
            c0, size_c, changed, start = at[w], 3 if w == 0 else 2, False, h
            for r in range(r0, r0 + size_r):
                for c in range(r if v == w else c0, c0 + size_c):
                    H[h] = q_H[r, c] - old_H[r, c] if r <= c else q_H[c, r] - old_H[c, r]
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
            variables[n] = 0 if v == 0 else names[order[v - 1]] + 1
            position[v] = n
            n += 1
            for r in range(at[v], at[v] + (3 if v == 0 else 2)):
                b[size] = q_b[r] - old_b[r]
                size += 1
    for k in range(blocks):
        rows[k], cols[k] = position[rows[k]], position[cols[k]]
    return variables[:n].copy(), rows[:blocks].copy(), cols[:blocks].copy(), H[:h].copy(), b[:size].copy()


@kernel
def published(s: SeifArrays, ids: Ints, links: Ints) -> tuple[Ints, Ints]:
    """The block in quanta as it was last published; the upper triangle of H."""
    n, known = 3 + 2 * len(ids), s.counts[LANDMARKS]
    q_H, q_b = np.zeros((n, n), np.int64), np.zeros(n, np.int64)
    for r in range(3):
        q_b[r] = s.q_b_x[r]
        for c in range(3):
            q_H[r, c] = s.q_xx[r, c]
    a = 0
    for i in range(len(ids)):
        y, at = ids[i], 3 + 2 * i
        if a < s.counts[ACTIVE] and s.active[a] == y:
            for r in range(3):
                q_H[r, at], q_H[r, at + 1] = s.q_xa[a, r, 0], s.q_xa[a, r, 1]
            a += 1
        if y < known:
            for r in range(2):
                q_b[at + r] = s.q_b_y[y, r]
                q_H[at + r, at], q_H[at + r, at + 1] = s.q_yy[y, r, 0], s.q_yy[y, r, 1]
        for j in range(i + 1, len(ids)):
            e, to = links[i, j], 3 + 2 * j
            if e != -1:
                for r in range(2):
                    q_H[at + r, to], q_H[at + r, to + 1] = s.q_link[e, r, 0], s.q_link[e, r, 1]
    return q_H, q_b


@kernel
def scatter(s: SeifArrays, ids: Ints, links: Ints, H: Floats, b: Floats, mu: Floats, q_H: Ints, q_b: Ints) -> None:
    """Write a block back."""
    for r in range(3):
        s.b_x[r], s.mu_x[r], s.q_b_x[r] = b[r], mu[r], q_b[r]
        for c in range(3):
            s.H_xx[r, c], s.q_xx[r, c] = H[r, c], q_H[r, c]
    active = 0
    for i in range(len(ids)):
        y, at = ids[i], 3 + 2 * i
        if touches(H, 0, 3, at):
            s.active[active] = y
            for r in range(3):
                for c in range(2):
                    s.H_xa[active, r, c], s.q_xa[active, r, c] = H[r, at + c], q_H[r, at + c]
            active += 1
        for r in range(2):
            s.b_y[y, r], s.mu_y[y, r], s.q_b_y[y, r] = b[at + r], mu[at + r], q_b[at + r]
            for c in range(2):
                s.H_yy[y, r, c], s.q_yy[y, r, c] = H[at + r, at + c], q_H[at + r, at + c]
        for j in range(i + 1, len(ids)):
            e, to = links[i, j], 3 + 2 * j
            if e != -1:
                for r in range(2):
                    for c in range(2):
                        s.H_link[e, r, c], s.q_link[e, r, c] = H[at + r, to + c], q_H[at + r, to + c]
    s.counts[ACTIVE] = active


@kernel
def higher_neighbours(s: SeifArrays, y: int) -> tuple[Ints, Ints]:
    """The neighbours of a landmark with higher numbers, and the links to them."""
    others, edges = np.empty(s.degree[y], np.int64), np.empty(s.degree[y], np.int64)
    found, half = 0, s.first[y] - 1
    while half >= 0:
        e, side = half >> 1, half & 1
        if side == 0:
            others[found], edges[found] = s.ends[e, 1], e
            found += 1
        half = s.following[e, side] - 1
    return others[:found], edges[:found]


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
        others, edges = higher_neighbours(s, y)
        for i in np.argsort(others):
            k += 1
            rows[k], cols[k] = y + 1, others[i] + 1
            for r in range(2):
                H[h], H[h + 1] = s.q_link[edges[i], r, 0], s.q_link[edges[i], r, 1]
                h += 2
    return variables, rows, cols, H[:h].copy(), b


@kernel
def is_covariance(A: Floats) -> bool:
    """Symmetric to rounding, and positive definite."""
    n = len(A)
    if n == 2:
        if not abs(A[1, 0] - A[0, 1]) <= ASYMMETRY_MAX * math.sqrt(abs(A[0, 0] * A[1, 1])) or not A[0, 0] > 0.0:
            return False
        low = A[1, 0] / math.sqrt(A[0, 0])
        return bool(A[1, 1] - low * low > 0.0)
    for i in range(n):
        for j in range(i):
            if not abs(A[i, j] - A[j, i]) <= ASYMMETRY_MAX * math.sqrt(abs(A[i, i] * A[j, j])):
                return False
    return cholesky_into(np.empty((n, n)), A, n)


@kernel
def check_reading(model: int, u: Floats, cov: Floats, z: Floats, Z: Floats) -> int:
    """OK, or which rule a reading breaks: finite numbers, symmetric positive definite covariances, positive ranges."""
    for array in (u, cov.ravel(), z.ravel(), Z.ravel()):
        for value in array:
            if not math.isfinite(value):
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
    gate: float, patience: int, fresh: Ints, full: Ints,
) -> tuple[Ints, float, int, bool]:  # fmt: skip
    """Which sightings enter: (s,) of 0 or 1; the sum of squared normalised innovations of those, their number; PD.

    A sighting of a known landmark enters if its squared normalised innovation is at most `gate`, or if the landmark
    was refused `patience` times in a row: then the map is wrong, not the sighting. One of a landmark that is `full`
    never does.
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
        if full[(at[k] - 3) // 2]:
            accepted[k] = 0
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
def full_landmarks(s: SeifArrays, ids: Ints, links: Ints, neighbours_max: int) -> Ints:
    """Which landmarks of the block would have more neighbours than they may if it became linked throughout, (m,)."""
    m = len(ids)
    full = np.zeros(m, np.int64)
    for i in range(m):
        if ids[i] < s.counts[LANDMARKS]:
            more = 0
            for j in range(m):
                more += j != i and links[min(i, j), max(i, j)] == -1
            full[i] = s.degree[ids[i]] + more > neighbours_max
    return full


@kernel
def held_back(H: Floats, ids: Ints, known: int, at: Ints, accepted: Ints, active_max: int, least: int) -> Ints:
    """The sightings that ESEIF keeps for relocating the pose, (s,) of 0 or 1; none where it need not or cannot.

    It need not where at most active_max landmarks would be linked to the pose. It cannot where fewer than `least` known
    landmarks are in view.
    """
    m = len(ids)
    linked, chosen = np.zeros(m, np.int64), np.zeros(m, np.int64)
    held = np.zeros(len(at), np.int64)
    for i in range(m):
        linked[i] = touches(H, 0, 3, 3 + 2 * i)
    for k in range(len(at)):
        linked[(at[k] - 3) // 2] |= accepted[k]
    if np.sum(linked) <= active_max:
        return held
    count = 0
    for k in range(len(at)):
        i = (at[k] - 3) // 2
        if accepted[k] and ids[i] < known and (chosen[i] or count < active_max):
            count += 1 - chosen[i]
            chosen[i] = held[k] = 1
    return held if count >= least else np.zeros(len(at), np.int64)


@kernel
def sparsify_block(H: Floats, b: Floats, mu: Floats, active_max: int, measure: int, soften: float) -> bool:
    """Cut the weakest links beyond active_max, or weaken them (`soften` < 1). False where H is not PD."""
    strength = link_strengths(H, measure)
    drop = weakest_links(strength, active_max)
    if len(drop) == 0:
        return True
    if soften < 1.0:
        weak = drop[strength[drop] < SOFT_LEAST]
        if len(weak) > 0 and not sparsify_into(H, b, mu, weak, 1.0):
            return False
        drop = drop[strength[drop] >= SOFT_LEAST]
        if len(drop) == 0:
            return True
    return sparsify_into(H, b, mu, drop, soften)


@kernel
def seif_step(
    floats: Floats, ints: Ints, model: int, moves: bool, u: Floats, cov: Floats, sighted: Ints, z: Floats, Z: Floats,
    kind: int, active_max: int, measure: int, soften: float, others: int, gate: float, patience: int,
    neighbours_max: int, growth_max: int, called: Ints,
) -> tuple[int, Floats, Ints, Ints, Ints, Ints, Ints]:  # fmt: skip
    """One step: motion (if `moves`), sightings of landmarks `sighted`, mean recovery, sparsification, delta.

    Landmark numbers from counts[LANDMARKS] on are new; capacities must suffice. growth_max: quanta by which a diagonal
    entry of H may grow at most. called: what each landmark is called in the delta; empty: its number. The other
    settings are those of FilterSettings.

    Returns: a code (OK ...), statistics (sum of squared innovations, sightings they come from, sightings refused), and
    the arrays of the FrameDelta.
    """
    s = arrays(floats, ints)
    none = np.empty(0, np.int64)
    statistics = np.zeros(3)
    code = check_reading(model, u, cov, z, Z)
    if code != OK:
        return code, statistics, none, none, none, none, none
    ids = block_ids(s.active[: s.counts[ACTIVE]], sighted)
    m, known = len(ids), s.counts[LANDMARKS]
    H, b, mu, links, pull = gather(s, ids)
    if kind != EIF and s.counts[DEGREE_MAX] + m > neighbours_max:
        full = full_landmarks(s, ids, links, neighbours_max)
        cut = np.flatnonzero((full > 0) & (link_strengths(H, RAW) > 0.0))
        if len(cut) > 0 and not sparsify_into(H, b, mu, cut, 1.0):
            return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    else:
        full = np.zeros(m, np.int64)
    refusals = np.zeros(m, np.int64)
    for i in range(m):
        if ids[i] < known:
            refusals[i] = s.refusals[ids[i]]
    if moves:
        motion_update_into(H, b, mu, model, u, cov)
    at = 3 + 2 * np.searchsorted(ids, sighted)
    accepted, statistics[0], used, definite = accept_sightings(
        s, H, mu, ids, model, at, z, Z, gate, patience, refusals, full
    )
    if not definite:
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    statistics[1], statistics[2] = used, len(z) - np.sum(accepted)
    held = np.zeros(len(z), np.int64)
    if kind == ESEIF:
        held = held_back(H, ids, known, at, accepted, active_max, pose_rows_seen(model) - 1)
    for k in range(len(z)):
        y = (at[k] - 3) // 2
        if ids[y] >= known and H[at[k], at[k]] == 0.0:
            mu[at[k] : at[k] + 2] = place(model, mu[:3], z[k])
        if accepted[k] and not held[k]:
            measurement_update_into(H, b, mu, model, z[k], Z[k], at[k])
    if np.any(held) and not relocate_into(H, b, mu, pull, model, at, z, Z, held):
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    before = mu.copy()
    if not recover_mean_into(mu, H, b, pull):
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    if kind == SEIF and not sparsify_block(H, b, mu, active_max, measure, soften):
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    for i in range(len(mu)):
        if not math.isfinite(mu[i]):
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
            s.counts[LANDMARKS] = ids[i] + 1
        s.refusals[ids[i]] = refusals[i]
    connect(s, ids, H, links)
    names = called[ids] if len(called) > 0 else ids
    variables, rows, cols, values, b_values = block_delta(names, q_H, q_b, old_H, old_b)
    scatter(s, ids, links, H, b, mu, q_H, q_b)
    if others > 0:
        enqueue_around(s, ids, known, mu, before)
        relax_queued(s, others)
    return OK, statistics, variables, rows, cols, values, b_values


@kernel
def blanket(s: SeifArrays, numbers: Ints) -> Ints:
    """The combined Markov blanket of the pose and these landmarks, ascending; see Seif.blanket_covariance."""
    ids = s.active[: s.counts[ACTIVE]].copy()
    for number in numbers:
        ids = joined_blanket(s, ids, number)
    return ids


@kernel
def joined_blanket(s: SeifArrays, ids: Ints, number: int) -> Ints:
    """The set `ids`, ascending, with one more landmark and its neighbours.

    Where these do not meet the set, a breadth-first search from the landmark finds a shortest path to it; its cost
    follows what lies in between.
    """
    n = s.counts[LANDMARKS]
    found, reached = np.empty(n, np.int64), 1
    found[0], s.local[number] = number, number + 1
    at, neighbours, meets = 0, 1, -1
    while meets == -1 and at < reached:
        y = found[at]
        here = np.searchsorted(ids, y)
        if here < len(ids) and ids[here] == y:
            meets = y
        half = s.first[y] - 1
        while half >= 0:
            e, side = half >> 1, half & 1
            other = s.ends[e, 1 - side]
            half = s.following[e, side] - 1
            if s.local[other] == 0:
                s.local[other] = y + 1  # reached from there
                found[reached] = other
                reached += 1
        if at == 0:
            neighbours = reached
        at += 1
    ids = block_ids(ids, found[:neighbours])
    while meets != -1 and meets != number:
        ids = block_ids(ids, np.array([meets]))
        meets = s.local[meets] - 1
    for k in range(reached):
        s.local[found[k]] = 0
    return ids
