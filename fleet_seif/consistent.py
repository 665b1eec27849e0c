"""Sets of candidate pairs that can all be true at once: the search that decides which landmarks of two maps are one.

A candidate k says that two landmarks are one: their difference D_k is an error with covariance S_kk, and S is the joint
covariance of all differences. Two ways to find what agrees:

- `grown`: joint compatibility (Neira & Tardos 2001), greedy from a seed. Every pair taken conditions all others, so the
  drift that two maps have against each other is found by the first pairs, and the others must agree with it.
- `largest_clique`: pairwise geometric consistency. Two candidates agree where the distance between their landmarks is
  the same in both maps; the largest set in which all agree with all, exact up to a budget.

The gain of a pair is how much better "one landmark" explains what is seen than "another landmark that happens to lie
there", as a logarithm: with the density rho of landmarks, per m^2,

    gain = -ln(2 pi rho |S|^(1/2)) - d' S^-1 d / 2
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_seif.jit import kernel
from fleet_seif.joint_covariance import diagonal_blocks
from fleet_seif.records import Floats, Ints

CLIQUE_BUDGET: Final = 20_000
"""Branches after which the largest clique found so far counts."""

Bools = NDArray[np.bool_]


class Candidates(NamedTuple):
    """Pairs that may be one landmark.

    D (m, 2): differences, m. S (2 m, 2 m): their joint covariance. ends (m, 2): which classes; has (n, l): which lives
    a class has a landmark of. density (m,): of landmarks there, per m^2.
    """

    D: Floats
    S: Floats
    ends: Ints
    has: Bools
    density: Floats


class Found(NamedTuple):
    """A consistent set: candidates in the order in which they were taken, and the sum of their gains."""

    members: Ints
    gain: float


def gains(d2: Floats, S: Floats, density: Floats) -> Floats:
    """The gain of each pair, shape (m,), from d' S^-1 d (m,) and S (m, 2, 2)."""
    return np.asarray(-np.log(2.0 * math.pi * density * np.sqrt(np.linalg.det(S))) - d2 / 2.0)


@kernel
def _fit(d: Floats, B: Floats, k: int, density: float) -> tuple[float, float]:
    """Squared distance and gain of a pair; infinite and minus infinite where nothing is left to be compared.

    B (m, 3): xx, xy, yy of each covariance.
    """
    det = B[k, 0] * B[k, 2] - B[k, 1] * B[k, 1]
    if not det > 0.0:
        return np.inf, -np.inf
    d2 = (B[k, 2] * d[k, 0] ** 2 - 2.0 * B[k, 1] * d[k, 0] * d[k, 1] + B[k, 0] * d[k, 1] ** 2) / det
    return d2, -math.log(2.0 * math.pi * density * math.sqrt(det)) - d2 / 2.0


@kernel
def _condition_into(d: Floats, B: Floats, rows: Floats, S: Floats, p: int, count: int) -> None:
    """All pairs given that p is true too: two more rows of the block Cholesky factor of S, in place.

    rows (2 m, 2 m): those of the `count` pairs taken so far come first.
    """
    u, w = S[2 * p].copy(), S[2 * p + 1].copy()
    for q in range(2 * count):
        u -= rows[q, 2 * p] * rows[q]
        w -= rows[q, 2 * p + 1] * rows[q]
    first = math.sqrt(B[p, 0])
    below = B[p, 1] / first
    second = math.sqrt(B[p, 2] - below * below)
    e_0 = d[p, 0] / first
    e_1 = (d[p, 1] - below * e_0) / second
    u /= first
    w = (w - below * u) / second
    rows[2 * count], rows[2 * count + 1] = u, w
    for k in range(len(d)):
        i = 2 * k
        d[k, 0] -= u[i] * e_0 + w[i] * e_1
        d[k, 1] -= u[i + 1] * e_0 + w[i + 1] * e_1
        B[k, 0] -= u[i] * u[i] + w[i] * w[i]
        B[k, 1] -= u[i] * u[i + 1] + w[i] * w[i + 1]
        B[k, 2] -= u[i + 1] * u[i + 1] + w[i + 1] * w[i + 1]


@kernel
def _may_join(label: Ints, lives: Bools, a: int, b: int) -> bool:
    """Whether two landmarks are in groups that have no life in common."""
    a, b = label[a], label[b]
    if a == b:
        return False
    for v in range(lives.shape[1]):
        if lives[a, v] and lives[b, v]:
            return False
    return True


@kernel
def _grown_into(
    members: Ints, D: Floats, S: Floats, ends: Ints, has: Bools, density: Floats, seed: int, gate: float
) -> tuple[int, float]:
    """See `grown`. Returns how many members there are, and the sum of their gains."""
    m = len(D)
    label, lives, taken = np.arange(len(has)), has.copy(), np.zeros(m, np.bool_)
    d, B, rows = D.copy(), np.empty((m, 3)), np.empty((2 * m, 2 * m))
    for k in range(m):
        B[k, 0], B[k, 1], B[k, 2] = S[2 * k, 2 * k], S[2 * k, 2 * k + 1], S[2 * k + 1, 2 * k + 1]
    count, total, p = 0, 0.0, seed
    while p >= 0:
        total += _fit(d, B, p, density[p])[1]
        members[count], taken[p] = p, True
        _condition_into(d, B, rows, S, p, count)
        count += 1
        kept, gone = label[ends[p, 0]], label[ends[p, 1]]
        for n in range(len(label)):
            if label[n] == gone:
                label[n] = kept
        for v in range(has.shape[1]):
            lives[kept, v] = lives[kept, v] or lives[gone, v]
        p, best = -1, 0.0
        for k in range(m):
            if not taken[k] and _may_join(label, lives, ends[k, 0], ends[k, 1]):
                d2, gain = _fit(d, B, k, density[k])
                if d2 <= gate and gain > best:
                    p, best = k, gain
    return count, total


def grown(c: Candidates, seed: int, gate: float) -> Found:
    """What can be true with a seed: the pair with the largest gain given those taken, one after the other.

    A pair is taken where its squared distance given those before is at most `gate`, its gain is positive, and it puts
    no two landmarks of one life together.
    """
    members = np.empty(len(c.D), np.int64)
    count, gain = _grown_into(members, c.D, c.S, c.ends, c.has, c.density, seed, gate)
    return Found(members[:count].copy(), gain)


def agreeing(c: Candidates, place: Floats, gate: float) -> Bools:
    """Which candidates agree pairwise, (m, m): no landmark twice of one life, and distances are the same in both maps.

    With n the direction from candidate i to k (place (m, 2): where they are), the difference between the two maps'
    distances is n'(D_k - D_i), whose variance is n'(S_ii + S_kk - S_ik - S_ki) n.
    """
    m = len(c.D)
    along = place[None] - place[:, None]
    length = np.linalg.norm(along, axis=2)
    n = along / np.where(length > 0.0, length, 1.0)[..., None]
    S = c.S.reshape(m, 2, m, 2).transpose(0, 2, 1, 3)
    own = diagonal_blocks(c.S)
    V = own[:, None] + own[None] - S - S.transpose(0, 1, 3, 2)
    e = np.einsum("ikx,ikx->ik", n, c.D[None] - c.D[:, None])
    fits = e**2 <= gate * np.maximum(np.einsum("ikx,ikxy,iky->ik", n, V, n), 0.0)
    a, b = c.ends[:, 0], c.ends[:, 1]
    for one, one_other in ((a, b), (b, a)):
        for two, two_other in ((a, b), (b, a)):
            rivals = np.any(c.has[one_other][:, None] & c.has[two_other][None], axis=2)
            fits &= ~((one[:, None] == two[None]) & rivals)
    return np.asarray(fits & ~np.eye(m, dtype=bool))


def largest_clique(fits: Bools, budget: int = CLIQUE_BUDGET) -> Ints:
    """The largest set of which all agree with all, ascending: branch and bound, colours as the bound (Tomita 2003)."""
    near = [sum(1 << k for k in np.flatnonzero(row).tolist()) for row in fits]
    best: list[int] = []
    spent = 0

    def expand(chosen: list[int], open_: int) -> None:
        nonlocal best, spent
        spent += 1
        for k, bound in reversed(_coloured(open_, near)):
            if len(chosen) + bound <= len(best) or spent > budget:
                return
            more = [*chosen, k]
            if open_ & near[k]:
                expand(more, open_ & near[k])
            elif len(more) > len(best):
                best = more
            open_ &= ~(1 << k)

    expand([], (1 << len(fits)) - 1)
    return np.array(sorted(best), np.int64)


def _coloured(open_: int, near: list[int]) -> list[tuple[int, int]]:
    """Candidates with the number of colours that they and those before them need: no clique is larger."""
    found, colour = [], 0
    while open_:
        colour += 1
        left = open_
        while left:
            k = (left & -left).bit_length() - 1
            found.append((k, colour))
            open_ &= ~(1 << k)
            left &= ~(1 << k) & ~near[k]
    return found
