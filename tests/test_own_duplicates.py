"""Landmarks that a vehicle has begun twice: patterns that agree are found, nothing where it could be another one."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_seif import own_duplicates as own_duplicates_module
from fleet_seif.consistent import Candidates
from fleet_seif.local_map import LocalMap, kept
from fleet_seif.merge_records import MergeRules, Reason
from fleet_seif.own_duplicates import PAIRS_MAX, RULES, nearest_m, own_duplicates
from fleet_seif.records import Floats, Ints
from tests.strategies import finite, settled

NOISE_M = 0.02
"""Of each landmark by itself."""
PATTERN = np.array([[0.0, 0.0], [1.1, 0.2], [2.3, -0.4], [0.4, 1.3], [1.7, 1.6], [3.1, 1.0], [-0.9, 0.7]])


def twice(first: Floats, second: Floats, drift_m: float, key: int = 100) -> LocalMap:
    """Landmarks, and others that were begun later: those are uncertain against the first by a common drift."""
    n, m = len(first), len(second)
    P = np.zeros((3 + 2 * (n + m), 3 + 2 * (n + m)))
    P[3:, 3:] = NOISE_M**2 * np.eye(2 * (n + m))
    P[3 + 2 * n :, 3 + 2 * n :] += drift_m**2 * np.tile(np.eye(2), (m, m))
    keys = np.concatenate([np.arange(n), key + np.arange(m)])
    return LocalMap(np.concatenate([np.zeros(3), first.ravel(), second.ravel()]), P, keys)


def in_one_go(a: int, b: int) -> bool:
    """Whether two were sighted together: all that were begun at the same time."""
    return (a < 100) == (b < 100)


def met(local: LocalMap, together: Callable[[int, int], bool] = in_one_go) -> Ints:
    """Twice, if together."""
    keys = local.keys[local.keys >= 0].tolist()
    return np.array([2 * (a != b and together(a, b)) for a in keys for b in keys], np.int64).reshape(2 * (len(keys),))


def found(local: LocalMap, together: Callable[[int, int], bool] = in_one_go) -> set[tuple[int, int]]:
    return {(min(pair), max(pair)) for pair in own_duplicates(local, met(local, together)).pairs}


SHIFTS = arrays(np.float64, (2,), elements=finite(2.0))
"""In standard deviations."""
NOISES = arrays(np.float64, PATTERN.shape, elements=finite(2.0))


@given(SHIFTS, NOISES, st.integers(3, len(PATTERN)), st.floats(0.05, 0.4))
@settled
def test_a_pattern_begun_again_is_found_wherever_its_drift_has_put_it(
    shift: Floats, noise: Floats, count: int, drift_m: float
) -> None:
    """The drift is known only to a good part of the way to the next landmark, which each by itself might be."""
    again = (PATTERN + drift_m * shift + NOISE_M * noise)[:count]
    assert found(twice(PATTERN, again, drift_m)) == {(k, 100 + k) for k in range(count)}


@given(SHIFTS, NOISES, st.floats(0.05, 0.4), st.sets(st.integers(0, len(PATTERN) - 1)))
@settled
def test_landmarks_that_were_sighted_together_are_never_one(
    shift: Floats, noise: Floats, drift_m: float, seen: set[int]
) -> None:
    local = twice(PATTERN, PATTERN + drift_m * shift + NOISE_M * noise, drift_m)

    def together(a: int, b: int) -> bool:
        return in_one_go(a, b) or (abs(a - b) == 100 and min(a, b) in seen)

    pairs = found(local, together)
    assert not any(together(a, b) for a, b in pairs)
    assert pairs <= {(k, 100 + k) for k in range(len(PATTERN))}


@given(st.permutations(range(2 * len(PATTERN))), SHIFTS, NOISES)
@settled
def test_the_order_of_landmarks_does_not_matter(order: list[int], shift: Floats, noise: Floats) -> None:
    local = twice(PATTERN, PATTERN + 0.3 * shift + NOISE_M * noise, 0.3)
    assert found(kept(local, np.array(order, np.int64))) == found(local)


@pytest.mark.parametrize(("count", "drift_m", "is_found"), [(1, 0.5, False), (2, 0.5, False), (3, 0.5, True)])
def test_it_takes_three_pairs_that_agree_where_each_could_be_a_neighbour(
    count: int, drift_m: float, is_found: bool
) -> None:
    again = PATTERN[:count] + np.array([0.4, -0.3])
    assert found(twice(PATTERN, again, drift_m)) == ({(k, 100 + k) for k in range(count)} if is_found else set())


@pytest.mark.parametrize(("drift_m", "is_found"), [(0.1, True), (0.165, True), (0.17, False), (1.0, False)])
def test_a_pair_by_itself_is_one_where_it_and_three_sigmas_do_not_reach_half_way_to_the_next_landmark(
    drift_m: float, is_found: bool
) -> None:
    """The next landmark is 1.118 m away: twice 0.05 m and 3 sigmas of 0.1697 m, those of drift and noise together."""
    again = PATTERN[:1] + np.array([0.05, 0.0])
    assert found(twice(PATTERN[:3], again, drift_m)) == ({(0, 100)} if is_found else set())


def test_a_landmark_that_was_begun_three_times_is_one_where_the_next_was_sighted_together_with_each() -> None:
    """They are each other's second nearest; two of them lie further apart than the gate allows."""
    centre, first, second = np.zeros((1, 2)), np.array([[0.09, 0.0]]), np.array([[0.0, 0.09]])
    others = np.array([[1.0, 0.2], [-0.3, 1.1]])
    local = twice(np.concatenate([centre, others]), np.concatenate([first, second]), 0.02)

    def together(a: int, b: int) -> bool:
        return (in_one_go(a, b) and {a, b} != {100, 101}) or ({a, b} & {1, 2} != set() and a != b)

    assert {(0, 100), (0, 101)} <= found(local, together)


def test_a_pair_by_itself_beyond_the_gate_is_two() -> None:
    for off, is_found in ((4.9, True), (5.1, False)):
        again = PATTERN[:1] + np.array([off * np.hypot(0.02, np.sqrt(2.0) * NOISE_M), 0.0])
        assert bool(found(twice(PATTERN, again, 0.02))) == is_found


def test_what_could_not_be_told_is_a_share_of_the_landmarks() -> None:
    """Two of seven landmarks begun again, each of which could be a neighbour: four of nine are unclear."""
    again = PATTERN[:2] + np.array([0.4, -0.3])
    local = twice(PATTERN, again, 0.5)
    assert 4 / 9 <= own_duplicates(local, met(local)).unclear <= 1.0
    local = twice(PATTERN, PATTERN[:3] + 0.1, 0.1)
    assert own_duplicates(local, met(local)).unclear == 0.0


def test_where_two_landmarks_are_all_there_is_nothing_says_how_far_the_next_may_be() -> None:
    assert found(twice(np.array([[5.0, 0.0]]), np.array([[8.0, 0.0]]), 2.0)) == set()


def grid(columns: int, rows: int) -> Floats:
    return np.array([[float(x), float(y)] for x in range(columns) for y in range(rows)])


@pytest.mark.parametrize("drift_m", [0.4, 1.0])
def test_nothing_is_found_where_two_alignments_fit_as_well(drift_m: float) -> None:
    """A part of a grid begun again, half way between two columns."""
    assert found(twice(grid(6, 4), grid(4, 4) + np.array([0.5, 0.0]), drift_m)) == set()


def test_on_a_grid_it_is_found_where_the_drift_is_small() -> None:
    again = grid(4, 4) + np.array([0.05, 0.02])
    assert found(twice(grid(6, 4), again, 0.05)) == {(4 * x + y, 100 + 4 * x + y) for x in range(4) for y in range(4)}


def test_what_is_searched_at_a_time_and_in_all_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the drift is as large as the world every landmark may be every other one of the other time."""
    sizes = []

    def counted(pairs: Candidates, mean: Floats, rules: MergeRules) -> tuple[list[Reason | None], Floats]:
        sizes.append(len(pairs.D))
        return [None] * len(pairs.D), np.zeros(len(pairs.D))

    monkeypatch.setattr(own_duplicates_module, "judged", counted)
    places = np.random.default_rng(2).uniform(0.0, 10.0, (70, 2))
    assert found(twice(places, places + 1.0, 10.0)) == set()
    assert max(sizes) <= RULES.group_max
    assert sum(sizes) == PAIRS_MAX


def test_provisional_landmarks_take_no_part() -> None:
    local = twice(PATTERN, PATTERN, 0.1)
    keys: Ints = np.where(local.keys >= 100, -2 - local.keys, local.keys)
    assert found(LocalMap(local.mean, local.P, keys)) == set()


def test_of_none_or_one_landmark_there_is_no_duplicate() -> None:
    for n in (0, 1):
        local = twice(PATTERN[:n], PATTERN[:0], 0.1)
        assert own_duplicates(local, met(local)).pairs == []


@given(arrays(np.float64, st.tuples(st.integers(0, 6), st.just(2)), elements=finite(9.0)), st.integers(1, 3))
@settled
def test_nearest_is_the_kth_of_all_other_distances(places: Floats, k: int) -> None:
    apart = [sorted(float(np.hypot(*(q - p))) for j, q in enumerate(places) if j != i) for i, p in enumerate(places)]
    expected = [each[k - 1] if len(each) >= k else np.inf for each in apart]
    np.testing.assert_allclose(nearest_m(places, k), expected, rtol=1e-12)
