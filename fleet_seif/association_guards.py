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

from fleet_seif.dense import cholesky_into, inverse_2x2, solve_lower_into, solve_upper_into
from fleet_seif.jcbb import Problem, normal_cost
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


class Limits(NamedTuple):
    """The settings as kernels take them; gates are squared normalised innovations.

    joint_gates: by number of pairs, shape (m + 1,).
    """

    gate: float
    joint_gates: Floats
    birth_gate: float
    cost_unpaired: float
    ambiguity_margin: float
    nodes_max: int


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
    sightings = np.nonzero(hypothesis >= 0)[0]
    candidates, k = hypothesis[sightings], len(sightings)
    S, L, A, q = np.empty((2 * k, 2 * k)), np.empty((2 * k, 2 * k)), np.eye(2 * k), np.empty(2 * k)
    for a in range(k):
        q[2 * a], q[2 * a + 1] = p.r[sightings[a], candidates[a]]
        for b in range(k):
            for row in range(2):
                for column in range(2):
                    S[2 * a + row, 2 * b + column] = p.C[2 * candidates[a] + row, 2 * candidates[b] + column]
        for row in range(2):
            for column in range(2):
                S[2 * a + row, 2 * a + column] += p.Z[sightings[a], row, column]
    if not cholesky_into(L, S, 2 * k):
        A[:] = np.nan
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
    e = np.zeros(2)
    K = p.C[2 * j : 2 * j + 2, 2 * j : 2 * j + 2].copy()
    for row in range(2):
        for a in range(k):
            u[row, a] = 0.0
            for b in range(k):
                u[row, a] += p.C[2 * j + row, 2 * known.candidates[b // 2] + b % 2] * known.A[b, a]
        for b in range(k):
            column = 2 * known.candidates[b // 2] + b % 2
            e[row] += p.C[2 * j + row, column] * known.q[b]
            K[row, 0] -= u[row, b] * p.C[2 * j, column]
            K[row, 1] -= u[row, b] * p.C[2 * j + 1, column]
    return e[0], e[1], K[0, 0], K[1, 0], K[1, 1]


@kernel
def margins(p: Problem, hypothesis: Ints, known: Known, at: Limits) -> Floats:
    """By how much the joint cost grows when one sighting alone changes to the best candidate that is free, (m,).

    Rivals are within the birth gate of the sighting. Infinite where it has none; at least 0 where the hypothesis is
    the best of those whose pairs pass that gate.
    """
    m, n = p.d2.shape
    k = len(known.sightings)
    margin, u, free, place = np.full(m, np.inf), np.empty((2, 2 * k)), np.ones(n, np.int64), np.full(m, -1)
    for a in range(k):
        free[known.candidates[a]], place[known.sightings[a]] = 0, a
    for j in range(n if m > 0 else 0):
        if free[j] == 0 or not np.min(p.d2[:, j]) <= at.birth_gate:
            continue
        e0, e1, k00, k10, k11 = prediction_given(p, known, u, j)
        for i in range(m):
            if not p.d2[i, j] <= at.birth_gate:
                continue
            t00, t10, t11 = k00 + p.Z[i, 0, 0], k10 + p.Z[i, 1, 0], k11 + p.Z[i, 1, 1]
            v0, v1, now = p.r[i, j, 0] - e0, p.r[i, j, 1] - e1, at.cost_unpaired
            if hypothesis[i] >= 0:
                a = 2 * place[i]
                T = inverse_2x2(known.A[a : a + 2, a : a + 2])
                q0, q1 = known.q[a], known.q[a + 1]
                x00, x01 = u[0, a] * T[0, 0] + u[0, a + 1] * T[1, 0], u[0, a] * T[0, 1] + u[0, a + 1] * T[1, 1]
                x10, x11 = u[1, a] * T[0, 0] + u[1, a + 1] * T[1, 0], u[1, a] * T[0, 1] + u[1, a + 1] * T[1, 1]
                t00 += x00 * u[0, a] + x01 * u[0, a + 1]
                t10 += x10 * u[0, a] + x11 * u[0, a + 1]
                t11 += x10 * u[1, a] + x11 * u[1, a + 1]
                v0 += x00 * q0 + x01 * q1
                v1 += x10 * q0 + x11 * q1
                now_0, now_1 = T[0, 0] * q0 + T[0, 1] * q1, T[1, 0] * q0 + T[1, 1] * q1
                now = normal_cost(T[0, 0], T[1, 0], T[1, 1], now_0, now_1)[1] - p.log_det_Z[i]
            rival = normal_cost(t00, t10, t11, v0, v1)[1] - p.log_det_Z[i]
            margin[i] = min(margin[i], rival - now)
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
