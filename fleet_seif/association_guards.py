"""What is doubtful about a hypothesis: sightings that another candidate fits nearly as well, or that are near one.

With A = S^-1 of a hypothesis' pairs, i one of them (2 rows) and o the others, what the others say about i comes without
leaving it out: the innovation of pair i given the others has the covariance A_ii^-1 and the value A_ii^-1 (A r)_i. Of
any other candidate j, with c = C_j: over the pairs and u = c A (2 rows each),

    covariance of its prediction given o    C_jj - c A c' + u_i A_ii^-1 u_i'
    what o say about it                     c A r - u_i A_ii^-1 (A r)_i

and given all pairs the same without the last terms (MATHS.md 19).
"""

from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np

from fleet_seif.association_problem import Limits, Problem, normal_cost
from fleet_seif.dense import cholesky_into, solve_lower_into, solve_upper_into
from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints


class Verdict(IntEnum):
    """What becomes of a sighting."""

    PAIRED = 0
    AMBIGUOUS = 1
    NEAR = 2
    NEW = 3


PAIRED: Final = int(Verdict.PAIRED)
AMBIGUOUS: Final = int(Verdict.AMBIGUOUS)
NEAR: Final = int(Verdict.NEAR)
NEW: Final = int(Verdict.NEW)


class Known(NamedTuple):
    """A hypothesis of k pairs as its inverse.

    sightings, candidates (k,): its pairs. A (2k, 2k): S^-1. q (2k,): A r. d2: r' A r.
    """

    sightings: Ints
    candidates: Ints
    A: Floats
    q: Floats
    d2: float


@kernel
def leave_one_out(p: Problem, hypothesis: Ints) -> Known:
    """What is needed to look at each sighting given all others; hypothesis (m,): candidate or -1."""
    sightings, candidates, k = np.empty(len(hypothesis), np.int64), np.empty(len(hypothesis), np.int64), 0
    for i in range(len(hypothesis)):
        if hypothesis[i] >= 0:
            sightings[k], candidates[k] = i, hypothesis[i]
            k += 1
    sightings, candidates = sightings[:k], candidates[:k]
    S, L, A, q = np.empty((2 * k, 2 * k)), np.empty((2 * k, 2 * k)), np.eye(2 * k), np.empty(2 * k)
    for a in range(k):
        q[2 * a], q[2 * a + 1] = p.r[sightings[a], candidates[a], 0], p.r[sightings[a], candidates[a], 1]
        for b in range(k):
            for row in range(2):
                for column in range(2):
                    S[2 * a + row, 2 * b + column] = p.C[2 * candidates[a] + row, 2 * candidates[b] + column]
        for row in range(2):
            for column in range(2):
                S[2 * a + row, 2 * a + column] += p.Z[sightings[a], row, column]
    cholesky_into(L, S, 2 * k)
    for row in range(2 * k):
        solve_lower_into(A[row], L, 2 * k)
        solve_upper_into(A[row], L, 2 * k)
    r = q.copy()
    solve_lower_into(q, L, 2 * k)
    solve_upper_into(q, L, 2 * k)
    d2 = 0.0
    for a in range(2 * k):
        d2 += r[a] * q[a]
    return Known(sightings, candidates, A, q, d2)


@kernel
def prediction_given(p: Problem, known: Known, u: Floats, j: int) -> tuple[float, float, float, float, float]:
    """Of candidate j given all pairs: what they say about its innovation (2), what is left of C_jj: 00, 10, 11.

    u (2, 2k): is overwritten with c A.
    """
    k = 2 * len(known.candidates)
    e0, e1 = 0.0, 0.0
    k00, k10, k11 = p.C[2 * j, 2 * j], p.C[2 * j + 1, 2 * j], p.C[2 * j + 1, 2 * j + 1]
    for a in range(k):
        u[0, a], u[1, a] = 0.0, 0.0
    for b in range(k):
        column = 2 * known.candidates[b // 2] + b % 2
        c0, c1 = p.C[2 * j, column], p.C[2 * j + 1, column]
        e0 += c0 * known.q[b]
        e1 += c1 * known.q[b]
        for a in range(k):
            u[0, a] += c0 * known.A[b, a]
            u[1, a] += c1 * known.A[b, a]
    for b in range(k):
        column = 2 * known.candidates[b // 2] + b % 2
        k00 -= u[0, b] * p.C[2 * j, column]
        k10 -= u[1, b] * p.C[2 * j, column]
        k11 -= u[1, b] * p.C[2 * j + 1, column]
    return e0, e1, k00, k10, k11


@kernel
def swap_cost(
    p: Problem, known: Known, u: Floats, given: tuple[float, float, float, float, float], i: int, j: int, pair: int
) -> float:
    """By how much the joint cost grows when sighting i, pair number `pair`, takes the free candidate j instead.

    given, u: of j, from `prediction_given`.
    """
    a, b = 2 * pair, 2 * pair + 1
    det = known.A[a, a] * known.A[b, b] - known.A[b, a] * known.A[b, a]
    t00, t10, t11 = known.A[b, b] / det, -known.A[b, a] / det, known.A[a, a] / det
    q0, q1 = known.q[a], known.q[b]
    e0, e1, k00, k10, k11 = given
    x00, x01 = u[0, a] * t00 + u[0, b] * t10, u[0, a] * t10 + u[0, b] * t11
    x10, x11 = u[1, a] * t00 + u[1, b] * t10, u[1, a] * t10 + u[1, b] * t11
    k00 += x00 * u[0, a] + x01 * u[0, b] + p.Z[i, 0, 0]
    k10 += x10 * u[0, a] + x11 * u[0, b] + p.Z[i, 1, 0]
    k11 += x10 * u[1, a] + x11 * u[1, b] + p.Z[i, 1, 1]
    e0, e1 = e0 - x00 * q0 - x01 * q1, e1 - x10 * q0 - x11 * q1
    _, rival = normal_cost(k00, k10, k11, p.r[i, j, 0] - e0, p.r[i, j, 1] - e1)
    _, now = normal_cost(t00, t10, t11, t00 * q0 + t10 * q1, t10 * q0 + t11 * q1)
    return rival - now


@kernel
def margins(p: Problem, hypothesis: Ints, known: Known, at: Limits) -> Floats:
    """By how much the joint cost grows when one sighting alone changes to the best candidate that is free, (m,).

    Rivals are within the birth gate of the sighting. Infinite where it has none; negative where a rival that the
    method may not take would be better.
    """
    m, n = p.d2.shape
    margin, free, pair = np.full(m, np.inf), np.ones(n, np.int64), np.full(m, -1)
    u = np.empty((2, len(known.q)))
    for a in range(len(known.sightings)):
        free[known.candidates[a]], pair[known.sightings[a]] = 0, a
    for j in range(n):
        near = 0
        for i in range(m):
            near += p.d2[i, j] <= at.birth_gate
        if free[j] == 0 or near == 0:
            continue
        given = prediction_given(p, known, u, j)
        for i in range(m):
            if p.d2[i, j] <= at.birth_gate:
                if pair[i] >= 0:
                    more = swap_cost(p, known, u, given, i, j, pair[i])
                else:
                    e0, e1, k00, k10, k11 = given
                    _, cost = normal_cost(
                        k00 + p.Z[i, 0, 0], k10 + p.Z[i, 1, 0], k11 + p.Z[i, 1, 1], p.r[i, j, 0] - e0, p.r[i, j, 1] - e1
                    )
                    more = cost - p.log_det_Z[i] - at.cost_unpaired
                margin[i] = min(margin[i], more)
    return margin


@kernel
def verdicts(p: Problem, hypothesis: Ints, margin: Floats, at: Limits) -> Ints:
    """The guards' word on each sighting, (m,).

    Paired with a margin below `ambiguity_margin`: AMBIGUOUS. Unpaired, but within the birth gate of a candidate that no
    sighting is paired with for certain: NEAR. Neither of both: PAIRED or NEW.
    """
    m, n = p.d2.shape
    verdict, free = np.full(m, NEW), np.ones(n, np.int64)
    for i in range(m):
        if hypothesis[i] >= 0:
            verdict[i] = AMBIGUOUS if margin[i] < at.ambiguity_margin else PAIRED
            if verdict[i] == PAIRED:
                free[hypothesis[i]] = 0
    for i in range(m):
        for j in range(n):
            if hypothesis[i] < 0 and free[j] == 1 and p.d2[i, j] <= at.birth_gate:
                verdict[i] = NEAR
    return verdict
