"""The joint hypothesis of least cost: which landmark each sighting of a step belongs to, all decided at once.

Neira & Tardos, IEEE Trans. Robotics and Automation 17(6), 2001 (JCBB), with a price for what stays unpaired instead of
the greatest number of pairs. A hypothesis pairs sightings i with candidates j, each at most once. Its stacked
innovation r has covariance S = C (rows of its candidates) + blockdiag(Z_i); its cost

    r' S^-1 r + log(det S / prod det Z_i) + cost_unpaired * (number unpaired)

Extending a hypothesis by a pair adds two rows (x, L_T) to the Cholesky factor of S. With v its innovation given the
pairs before it and T = C_jj - x x' + Z_i what is left of its covariance, the cost grows by

    v' T^-1 v + log(det T / det Z_i)        both terms at least 0, since T - Z_i is positive semidefinite

so the cost of a prefix is a lower bound of all that extends it (MATHS.md 19). The rows x do not depend on the sighting:
they are kept for every candidate, two columns longer with each pair, and a pair is tried with a dozen multiplications.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from fleet_seif.jit import kernel
from fleet_seif.models import innovation_numbers
from fleet_seif.records import Floats, Ints

UNPAIRED: Final = -1


class Problem(NamedTuple):
    """What one decision is about, for m sightings and n candidates.

    r: innovation of every pair, angles wrapped, m and rad, shape (m, n, 2).
    Z: noise covariance of the sightings, shape (m, 2, 2). C: joint covariance of the predictions, shape (2n, 2n).
    log_det_Z: shape (m,).
    d2: squared normalised innovation of every pair by itself, shape (m, n).
    """

    r: Floats
    Z: Floats
    C: Floats
    log_det_Z: Floats
    d2: Floats


@kernel
def problem(model: int, z: Floats, Z: Floats, h: Floats, C: Floats) -> Problem:
    """Innovations of all pairs, and what each amounts to by itself; infinite where S is not positive definite."""
    m, n = len(z), len(h)
    r, log_det_Z, d2 = np.empty((m, n, 2)), np.empty(m), np.full((m, n), np.inf)
    for i in range(m):
        log_det_Z[i] = math.log(Z[i, 0, 0] * Z[i, 1, 1] - Z[i, 1, 0] * Z[i, 1, 0])
        for j in range(n):
            r0, r1 = innovation_numbers(model, z[i, 0], z[i, 1], h[j, 0], h[j, 1])
            r[i, j, 0], r[i, j, 1] = r0, r1
            s00 = C[2 * j, 2 * j] + Z[i, 0, 0]
            s10 = C[2 * j + 1, 2 * j] + Z[i, 1, 0]
            s11 = C[2 * j + 1, 2 * j + 1] + Z[i, 1, 1]
            det = s00 * s11 - s10 * s10
            if s00 > 0.0 and det > 0.0:
                d2[i, j] = (s11 * r0 * r0 - 2.0 * s10 * r0 * r1 + s00 * r1 * r1) / det
    return Problem(r, Z, C, log_det_Z, d2)


@kernel
def is_sound(p: Problem) -> bool:
    """Whether every pair has a finite innovation with a positive definite covariance, and so has every noise."""
    m, n = p.d2.shape
    for i in range(m):
        if not math.isfinite(p.log_det_Z[i]) or not p.Z[i, 0, 0] > 0.0:
            return False
        for j in range(n):
            if not math.isfinite(p.d2[i, j]):
                return False
    return True


@kernel
def normal_cost(t00: float, t10: float, t11: float, v0: float, v1: float) -> tuple[float, float]:
    """v' T^-1 v of a symmetric T, and the same with log det T; infinite where T is not positive definite."""
    det = t00 * t11 - t10 * t10
    if not (t00 > 0.0 and det > 0.0):
        return np.inf, np.inf
    d2 = (t11 * v0 * v0 - 2.0 * t10 * v0 * v1 + t00 * v1 * v1) / det
    return d2, d2 + math.log(det)


@kernel
def pair_cost(p: Problem, i: int, j: int) -> float:
    """r' S^-1 r + log(det S / det Z) of one pair by itself."""
    a = 2 * j
    s00, s10, s11 = p.C[a, a] + p.Z[i, 0, 0], p.C[a + 1, a] + p.Z[i, 1, 0], p.C[a + 1, a + 1] + p.Z[i, 1, 1]
    _, cost = normal_cost(s00, s10, s11, p.r[i, j, 0], p.r[i, j, 1])
    return cost - float(p.log_det_Z[i])


class Work(NamedTuple):
    """Room for a search over m sightings and n candidates.

    compatible (m, n): the pair passes the individual gate. alive (n,): candidates with a compatible sighting.
    X (n, 2, 2m): rows that each candidate would add to the factor, two more columns a pair.
    seen (m + 1, n, 2), K (m + 1, n, 3): by number of pairs, what these say about a candidate's innovation, and what
    is left of its C_jj: (0, 0), (1, 0), (1, 1).
    free (n,), open (m,): candidates that are not taken and sightings that are not decided.
    costs, candidates (m, n + 1): by depth, what may become of its sighting, the cheapest first.
    """

    compatible: Ints
    alive: Ints
    X: Floats
    seen: Floats
    K: Floats
    free: Ints
    open: Ints
    costs: Floats
    candidates: Ints


@kernel
def places(marked: Ints) -> Ints:
    """Where `marked` is 1, ascending."""
    found, count = np.empty(len(marked), np.int64), 0
    for i in range(len(marked)):
        if marked[i] == 1:
            found[count] = i
            count += 1
    return found[:count]


@kernel
def workspace(p: Problem, gate: float) -> Work:
    """For a search that begins: nothing is taken, decided or known."""
    m, n = p.d2.shape
    compatible = np.zeros((m, n), np.int64)
    open_, some = np.zeros(m, np.int64), np.zeros(n, np.int64)
    K = np.empty((m + 1, n, 3))
    for j in range(n):
        K[0, j, 0], K[0, j, 1] = p.C[2 * j, 2 * j], p.C[2 * j + 1, 2 * j]
        K[0, j, 2] = p.C[2 * j + 1, 2 * j + 1]
        for i in range(m):
            if p.d2[i, j] <= gate:
                compatible[i, j] = open_[i] = some[j] = 1
    return Work(
        compatible, places(some), np.empty((n, 2, 2 * m)), np.zeros((m + 1, n, 2)), K, np.ones(n, np.int64),
        open_, np.empty((m, n + 1)), np.empty((m, n + 1), np.int64),
    )  # fmt: skip


@kernel
def growth(s: Work, p: Problem, pairs: int, i: int, j: int) -> tuple[float, float]:
    """By how much r' S^-1 r and the cost grow when (i, j) joins the first `pairs` pairs; infinite if not PD."""
    t00 = s.K[pairs, j, 0] + p.Z[i, 0, 0]
    t10 = s.K[pairs, j, 1] + p.Z[i, 1, 0]
    t11 = s.K[pairs, j, 2] + p.Z[i, 1, 1]
    v0, v1 = p.r[i, j, 0] - s.seen[pairs, j, 0], p.r[i, j, 1] - s.seen[pairs, j, 1]
    d2, cost = normal_cost(t00, t10, t11, v0, v1)
    return d2, cost - p.log_det_Z[i]


@kernel
def pair_into(s: Work, p: Problem, pairs: int, i: int, j: int) -> None:
    """Let (i, j) be pair number `pairs`: two more columns of X for every candidate, and what follows for it."""
    k = 2 * pairs
    l00 = math.sqrt(s.K[pairs, j, 0] + p.Z[i, 0, 0])
    l10 = (s.K[pairs, j, 1] + p.Z[i, 1, 0]) / l00
    l11 = math.sqrt(s.K[pairs, j, 2] + p.Z[i, 1, 1] - l10 * l10)
    w0 = (p.r[i, j, 0] - s.seen[pairs, j, 0]) / l00
    w1 = (p.r[i, j, 1] - s.seen[pairs, j, 1] - l10 * w0) / l11
    for c in s.alive:
        if s.free[c] == 0:
            continue
        for row in range(2):
            x0, x1 = p.C[2 * c + row, 2 * j], p.C[2 * c + row, 2 * j + 1]
            for a in range(k):
                x0 -= s.X[c, row, a] * s.X[j, 0, a]
                x1 -= s.X[c, row, a] * s.X[j, 1, a]
            x0 /= l00
            x1 = (x1 - l10 * x0) / l11
            s.X[c, row, k], s.X[c, row, k + 1] = x0, x1
            s.seen[pairs + 1, c, row] = s.seen[pairs, c, row] + x0 * w0 + x1 * w1
        x00, x01, x10, x11 = s.X[c, 0, k], s.X[c, 0, k + 1], s.X[c, 1, k], s.X[c, 1, k + 1]
        s.K[pairs + 1, c, 0] = s.K[pairs, c, 0] - x00 * x00 - x01 * x01
        s.K[pairs + 1, c, 1] = s.K[pairs, c, 1] - x10 * x00 - x11 * x01
        s.K[pairs + 1, c, 2] = s.K[pairs, c, 2] - x10 * x10 - x11 * x11


@kernel
def next_sighting(s: Work, p: Problem, pairs: int, cost_unpaired: float, cost_left: float, d2_left: float) -> int:
    """The open sighting to decide next: the one with the fewest candidates left, then the one with the cheapest.

    A pair whose own growth is cost_left or more, or more than d2_left, is in no hypothesis that counts. A sighting all
    of whose pairs are such stays unpaired, which leaves less for the others. -1: this takes more than is left.
    """
    m, n = s.compatible.shape
    least, left = np.full(m, np.inf), np.zeros(m, np.int64)
    for i in range(m):
        if s.open[i] == 1:
            for j in range(n):
                if s.compatible[i, j] == 1 and s.free[j] == 1:
                    d2, cost = growth(s, p, pairs, i, j)
                    if d2 <= d2_left and cost < cost_left:
                        left[i] += 1
                        least[i] = min(least[i], cost)
    settled, before = 0, -1
    while settled != before:
        before, settled = settled, 0
        for i in range(m):
            if s.open[i] == 1 and not least[i] < cost_left - before * cost_unpaired:
                left[i] = 0
                settled += 1
        if settled > 0 and settled * cost_unpaired >= cost_left:
            return -1
    chosen = -1
    for i in range(m):
        if s.open[i] == 1 and (chosen == -1 or (left[i], least[i]) < (left[chosen], least[chosen])):
            chosen = i
    return chosen


@kernel
def children_into(
    s: Work, p: Problem, depth: int, pairs: int, i: int, cost_unpaired: float, cost_left: float, d2_left: float
) -> int:
    """What may become of sighting i, the cheapest first, and how many choices that are; UNPAIRED is one of them."""
    count = 0
    if cost_unpaired < cost_left:
        insert_sorted(s.costs[depth], s.candidates[depth], 0, cost_unpaired, UNPAIRED)
        count = 1
    for j in range(len(s.free)):
        if s.compatible[i, j] == 1 and s.free[j] == 1:
            d2, cost = growth(s, p, pairs, i, j)
            if cost < cost_left and d2 <= d2_left:
                insert_sorted(s.costs[depth], s.candidates[depth], count, cost, j)
                count += 1
    return count


@kernel
def insert_sorted(costs: Floats, values: Ints, count: int, cost: float, value: int) -> None:
    """Put a cost and its value among the first `count`, which ascend; behind equal ones."""
    at = count
    while at > 0 and costs[at - 1] > cost:
        costs[at], values[at] = costs[at - 1], values[at - 1]
        at -= 1
    costs[at], values[at] = cost, value


@kernel
def search(
    p: Problem, gate: float, joint_gates: Floats, cost_unpaired: float, nodes_max: int
) -> tuple[Ints, int, bool]:
    """The hypothesis of least cost among those whose pairs pass `gate` and which pass the joint gate of their number.

    Depth first, a sighting a level, its cheapest continuation first. A branch ends where its cost reaches the least
    found so far, or where it could not pass the joint gate even if all sightings left were paired at no distance.

    joint_gates: limit of r' S^-1 r by number of pairs, ascending, shape (m + 1,).
    nodes_max: prefixes looked at after which the search ends, once it has been at the bottom; the best so far counts.

    Returns the assignment (m,), prefixes looked at, whether the search was cut short.
    """
    m = len(p.d2)
    s = workspace(p, gate)
    levels = len(places(s.open))
    children, following = np.zeros(levels, np.int64), np.zeros(levels, np.int64)
    sighting, chosen = np.full(levels, -1), np.full(levels, UNPAIRED)
    cost, d2, pairs = np.zeros(levels + 1), np.zeros(levels + 1), np.zeros(levels + 1, np.int64)
    best, least = np.full(m, UNPAIRED), levels * cost_unpaired
    depth, nodes, bottom, opened = 0, 0, False, False
    while depth >= 0:
        if depth == levels:
            bottom = True
            if cost[depth] < least and d2[depth] <= joint_gates[pairs[depth]]:
                least = cost[depth]
                for level in range(levels):
                    best[sighting[level]] = chosen[level]
            depth, opened = depth - 1, True
            continue
        k = pairs[depth]
        if not opened:
            if bottom and nodes >= nodes_max:
                return best, nodes, True
            nodes += 1
            cost_left, d2_left = least - cost[depth], joint_gates[k + levels - depth] - d2[depth]
            i = next_sighting(s, p, k, cost_unpaired, cost_left, d2_left)
            if i == -1:
                depth, opened = depth - 1, True
                continue
            sighting[depth], following[depth] = i, 0
            children[depth] = children_into(s, p, depth, k, i, cost_unpaired, cost_left, d2_left)
            s.open[i] = 0
        i = sighting[depth]
        if chosen[depth] >= 0:
            s.free[chosen[depth]] = 1
        chosen[depth] = UNPAIRED
        turn = following[depth]
        if turn == children[depth] or cost[depth] + s.costs[depth, turn] >= least:
            s.open[i] = 1
            depth, opened = depth - 1, True
            continue
        j = s.candidates[depth, turn]
        following[depth] += 1
        chosen[depth] = j
        cost[depth + 1] = cost[depth] + s.costs[depth, turn]
        d2[depth + 1], pairs[depth + 1] = d2[depth], k
        if j >= 0:
            d2[depth + 1] += growth(s, p, k, i, j)[0]
            pairs[depth + 1] = k + 1
            s.free[j] = 0
            pair_into(s, p, k, i, j)
        depth, opened = depth + 1, False
    return best, nodes, False
