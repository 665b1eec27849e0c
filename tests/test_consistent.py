"""The search for sets that agree, against slow and obvious ways."""

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_seif.consistent import Bools, Candidates, gains, grown, largest_clique
from fleet_seif.records import Floats
from tests.strategies import finite, settled, spd

GATE = 13.8


@st.composite
def candidates(draw: st.DrawFn) -> Candidates:
    """Pairs between the landmarks of two or three lives, one landmark a class, with any joint covariance."""
    lives = draw(st.integers(2, 3))
    n = draw(st.integers(lives, 7))
    of = [i % lives for i in range(n)]
    possible = [(a, b) for a, b in itertools.combinations(range(n), 2) if of[a] != of[b]]
    ends = draw(st.lists(st.sampled_from(possible), min_size=1, max_size=8, unique=True))
    m = len(ends)
    S = draw(spd(2 * m, least=0.01)) * 0.01
    D = 0.3 * draw(arrays(np.float64, (m, 2), elements=finite(1.0)))
    has = np.zeros((n, lives), bool)
    has[np.arange(n), of] = True
    return Candidates(D, (S + S.T) / 2, np.array(ends, np.int64), has, np.full(m, draw(st.floats(0.1, 5.0))))


def conditional(c: Candidates, k: int, members: list[int]) -> tuple[Floats, Floats]:
    """Difference and covariance of a pair given that others are true."""
    i = [2 * k, 2 * k + 1]
    j = [row for p in members for row in (2 * p, 2 * p + 1)]
    if not j:
        return c.D[k], c.S[np.ix_(i, i)]
    pull = c.S[np.ix_(i, j)] @ np.linalg.inv(c.S[np.ix_(j, j)])
    return c.D[k] - pull @ c.D[members].ravel(), c.S[np.ix_(i, i)] - pull @ c.S[np.ix_(j, i)]


def may_join(c: Candidates, k: int, members: list[int]) -> bool:
    """Whether a pair joins two groups that have no life in common."""
    groups = [{i} for i in range(len(c.has))]
    for p in members:
        a, b = (next(g for g in groups if end in g) for end in c.ends[p].tolist())
        groups.remove(b)
        a |= b
    a, b = (next(g for g in groups if end in g) for end in c.ends[k].tolist())
    return a is not b and not np.any(np.any(c.has[list(a)], axis=0) & np.any(c.has[list(b)], axis=0))


@given(candidates(), st.data())
@settings(settled, max_examples=100)
def test_a_set_grows_by_the_largest_gain_given_those_taken(c: Candidates, data: st.DataObject) -> None:
    seed = data.draw(st.integers(0, len(c.D) - 1))
    found = grown(c, seed, GATE)
    members: list[int] = []
    total = 0.0
    for k in found.members.tolist():
        if members:
            best = max(_gain(c, other, members) for other in range(len(c.D)) if other not in members)
            assert _gain(c, k, members) >= best - 1e-6
            assert best > 0.0
        total += _plain_gain(c, k, members)
        members.append(k)
    assert members[0] == seed
    np.testing.assert_allclose(found.gain, total, rtol=1e-6, atol=1e-6)
    rest = [_gain(c, other, members) for other in range(len(c.D)) if other not in members]
    assert max(rest, default=0.0) <= 1e-6


def _plain_gain(c: Candidates, k: int, members: list[int]) -> float:
    d, S = conditional(c, k, members)
    d2 = np.array([d @ np.linalg.solve(S, d)])
    return float(gains(d2, S[None], c.density[k : k + 1])[0])


def _gain(c: Candidates, k: int, members: list[int]) -> float:
    """0 where it may not be taken."""
    d, S = conditional(c, k, members)
    fits = d @ np.linalg.solve(S, d) <= GATE
    return _plain_gain(c, k, members) if fits and may_join(c, k, members) else 0.0


@given(st.integers(0, 9), st.data())
@settings(settled, max_examples=100)
def test_the_largest_clique_is_that_of_trying_all_sets(n: int, data: st.DataObject) -> None:
    upper = np.triu(data.draw(arrays(np.bool_, (n, n))), 1)
    fits: Bools = upper | upper.T
    found = largest_clique(fits)
    assert all(fits[a, b] for a, b in itertools.combinations(found.tolist(), 2))
    sets = itertools.chain.from_iterable(itertools.combinations(range(n), k) for k in range(n + 1))
    assert len(found) == max(len(s) for s in sets if all(fits[a, b] for a, b in itertools.combinations(s, 2)))
