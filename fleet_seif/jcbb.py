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
from typing import NamedTuple

import numpy as np

from fleet_seif.association_problem import UNPAIRED, Limits, Problem, normal_cost
from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints


class Work(NamedTuple):
    """Room for a search over m sightings and n candidates.

    compatible (m, n): the pair passes the individual gate. alive (n,): candidates with a compatible sighting.
    X (n, 2, 2m): rows that each candidate would add to the factor, two more columns a pair.
    seen (m + 1, n, 2), K (m + 1, n, 3): by number of pairs, what these say about a candidate's innovation, and what
    is left of its C_jj: (0, 0), (1, 0), (1, 1).
    free (n,), open (m,): candidates that are not taken and sightings that are not decided.

    By depth: sighting, the one that is decided there; costs, candidates (m, n + 1), what may become of it, the cheapest
    first, `choices` of them, `turn` of them had; chosen; cost, d2, pairs (m + 1,) of the prefix that leads there.
    """

    compatible: Ints
    alive: Ints
    X: Floats
    seen: Floats
    K: Floats
    free: Ints
    open: Ints
    sighting: Ints
    costs: Floats
    candidates: Ints
    choices: Ints
    turn: Ints
    chosen: Ints
    cost: Floats
    d2: Floats
    pairs: Ints


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
        compatible, places(some), np.empty((n, 2, 2 * m)), np.zeros((m + 1, n, 2)), K, np.ones(n, np.int64), open_,
        np.full(m, -1), np.empty((m, n + 1)), np.empty((m, n + 1), np.int64), np.zeros(m, np.int64),
        np.zeros(m, np.int64), np.full(m, UNPAIRED), np.zeros(m + 1), np.zeros(m + 1), np.zeros(m + 1, np.int64),
    )  # fmt: skip


@kernel
def growth(K: Floats, seen: Floats, p: Problem, pairs: int, i: int, j: int) -> tuple[float, float]:
    """By how much r' S^-1 r and the cost grow when (i, j) joins the first `pairs` pairs; infinite if not PD."""
    t00 = K[pairs, j, 0] + p.Z[i, 0, 0]
    t10 = K[pairs, j, 1] + p.Z[i, 1, 0]
    t11 = K[pairs, j, 2] + p.Z[i, 1, 1]
    v0, v1 = p.r[i, j, 0] - seen[pairs, j, 0], p.r[i, j, 1] - seen[pairs, j, 1]
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
def next_sighting(
    s: Work, p: Problem, depth: int, cost_unpaired: float, cost_left: float, d2_left: float, must: int
) -> int:
    """The open sighting to decide next: the one with the fewest candidates left, then the one with the cheapest.

    A pair whose own growth is cost_left or more, or more than d2_left, is in no hypothesis that counts. A sighting all
    of whose pairs are such stays unpaired, which leaves less for the others. -1: this takes more than is left, or it is
    the sighting that must be paired.
    """
    m, n = s.compatible.shape
    least, left = np.full(m, np.inf), np.zeros(m, np.int64)
    for i in range(m):
        if s.open[i] == 1:
            for j in range(n):
                if s.compatible[i, j] == 1 and s.free[j] == 1:
                    d2, cost = growth(s.K, s.seen, p, s.pairs[depth], i, j)
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
                if i == must:
                    return -1
        if settled > 0 and settled * cost_unpaired >= cost_left:
            return -1
    chosen = -1
    for i in range(m):
        if s.open[i] == 1 and (chosen == -1 or (left[i], least[i]) < (left[chosen], least[chosen])):
            chosen = i
    return chosen


@kernel
def open_level(s: Work, p: Problem, depth: int, levels: int, at: Limits, least: float, must: int) -> bool:
    """Choose a sighting for this depth and what may become of it, UNPAIRED included. False: nothing can come of it."""
    k = s.pairs[depth]
    cost_left, d2_left = least - s.cost[depth], at.joint_gates[k + levels - depth] - s.d2[depth]
    i = next_sighting(s, p, depth, at.cost_unpaired, cost_left, d2_left, must)
    if i == -1:
        return False
    count = 0
    if at.cost_unpaired < cost_left and i != must:
        insert_sorted(s.costs[depth], s.candidates[depth], 0, at.cost_unpaired, UNPAIRED)
        count = 1
    for j in range(len(s.free)):
        if s.compatible[i, j] == 1 and s.free[j] == 1:
            d2, cost = growth(s.K, s.seen, p, k, i, j)
            if cost < cost_left and d2 <= d2_left:
                insert_sorted(s.costs[depth], s.candidates[depth], count, cost, j)
                count += 1
    s.sighting[depth], s.choices[depth], s.turn[depth], s.open[i] = i, count, 0, 0
    return True


@kernel
def descend(s: Work, p: Problem, depth: int, least: float) -> bool:
    """Take back the last choice of this depth and make the next. False: there is none below `least`."""
    i, k, turn = s.sighting[depth], s.pairs[depth], s.turn[depth]
    if s.chosen[depth] >= 0:
        s.free[s.chosen[depth]] = 1
    s.chosen[depth] = UNPAIRED
    if turn == s.choices[depth] or s.cost[depth] + s.costs[depth, turn] >= least:
        s.open[i] = 1
        return False
    j = s.candidates[depth, turn]
    s.turn[depth], s.chosen[depth] = turn + 1, j
    s.cost[depth + 1] = s.cost[depth] + s.costs[depth, turn]
    s.d2[depth + 1], s.pairs[depth + 1] = s.d2[depth], k
    if j >= 0:
        s.d2[depth + 1] += growth(s.K, s.seen, p, k, i, j)[0]
        s.pairs[depth + 1], s.free[j] = k + 1, 0
        pair_into(s, p, k, i, j)
    return True


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
    p: Problem, at: Limits, nodes_max: int, must: int, barred: int, below: float
) -> tuple[Ints, float, int, bool]:
    """The hypothesis of least cost among those whose pairs pass the gate and which pass the joint gate of their number.

    Depth first, a sighting a level, its cheapest continuation first. A branch ends where its cost reaches the least
    found so far, or where it could not pass the joint gate even if all sightings left were paired at no distance.

    nodes_max: prefixes looked at after which the search ends, once it has been at the bottom; the best so far counts.
    must, barred: where a rival is looked for, the sighting that must be paired, and the candidate that it may not
    have; else -1. There only what costs less than `below` counts, and the bottom is not waited for.

    Returns the assignment (m,), its cost without what passes no gate (`below` where there is none), prefixes looked
    at, whether the search was cut short.
    """
    s = workspace(p, at.gate)
    if must >= 0:
        s.compatible[must, barred] = 0
    levels = len(places(s.open))
    best, least = np.full(len(p.d2), UNPAIRED), below
    if must == -1:
        least = min(below, levels * at.cost_unpaired)
    depth, nodes, bottom, opened = 0, 0, must >= 0, False
    while depth >= 0:
        if depth == levels:
            bottom = True
            if s.cost[depth] < least and s.d2[depth] <= at.joint_gates[s.pairs[depth]]:
                least = s.cost[depth]
                for level in range(levels):
                    best[s.sighting[level]] = s.chosen[level]
            depth, opened = depth - 1, True
            continue
        if not opened:
            if bottom and nodes >= nodes_max:
                return best, least, nodes, True
            nodes += 1
            opened = open_level(s, p, depth, levels, at, least, must)
        if opened and descend(s, p, depth, least):
            depth, opened = depth + 1, False
        else:
            depth, opened = depth - 1, True
    return best, least, nodes, False


@kernel
def cost_of_rival(p: Problem, at: Limits, hypothesis: Ints, least: float) -> tuple[Floats, bool]:
    """How much more the best hypothesis costs that gives a sighting to another candidate, and the rest to any, (m,).

    Only what is below the ambiguity margin is looked for; infinite where there is nothing. least: the cost of the
    hypothesis. All searches together look at nodes_max prefixes, each at its share of what is left of them; whether
    one of them was cut short is returned, too.
    """
    m, n = p.d2.shape
    more, contested = np.full(m, np.inf), np.zeros(m, np.int64)
    for i in range(m):
        for j in range(n):
            if hypothesis[i] != UNPAIRED and j != hypothesis[i] and p.d2[i, j] <= at.gate:
                contested[i] = 1
    chosen, nodes_left, any_cut_short = places(contested), at.nodes_max, False
    for k in range(len(chosen)):
        i, share = chosen[k], nodes_left // (len(chosen) - k)
        _, found, nodes, cut_short = search(p, at, share, i, hypothesis[i], least + at.ambiguity_margin)
        nodes_left -= nodes
        any_cut_short = any_cut_short or cut_short
        if found < least + at.ambiguity_margin:
            more[i] = found - least
    return more, any_cut_short
