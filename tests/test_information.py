"""Fixed-point information: sums that do not depend on order, and their floating-point view."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.errors import NumericalError
from fleet_seif.information import (
    QUANTA_MAX,
    FrameDelta,
    FrameTotal,
    delta_digest,
    row_offsets,
    to_information,
)
from tests import reference
from tests.drives import sum_deltas
from tests.strategies import deltas, settled

SOME = st.lists(deltas(bound=2**56), max_size=6)
NEAR = st.lists(deltas(variable_max=6, bound=2**56), max_size=6)
"""Deltas that share variables."""


def total_of(parts: list[FrameDelta]) -> FrameTotal:
    total = FrameTotal()
    for delta in parts:
        total.add(delta)
    return total


def same(a: FrameDelta, b: FrameDelta) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name)) and getattr(a, name).dtype == getattr(b, name).dtype
        for name in ("variables", "rows", "cols", "H", "b")
    )


def one_block(value: int, variable: int = 1, b: int = 0) -> FrameDelta:
    return FrameDelta(
        variables=np.array([variable]),
        rows=np.array([0]),
        cols=np.array([0]),
        H=np.array([value, 0, 0]),
        b=np.array([b, 0]),
    )


@given(st.one_of(SOME, NEAR))
@settled
def test_a_total_is_the_sum_of_tables_of_blocks(parts: list[FrameDelta]) -> None:
    H, b = reference.blocks_of(total_of(parts).delta())
    expected_H, expected_b = reference.summed(parts)
    assert list(H) == sorted(expected_H)
    assert all(np.array_equal(H[place], expected_H[place]) for place in H)
    named = {v for place in expected_H for v in place} | set(expected_b)
    assert set(b) == named
    assert all(np.array_equal(vector, expected_b.get(v, np.zeros_like(vector))) for v, vector in b.items())


@given(st.one_of(SOME, NEAR).flatmap(lambda parts: st.tuples(st.just(parts), st.permutations(parts))))
@settled
def test_a_total_does_not_depend_on_the_order_of_additions(case: tuple[list[FrameDelta], list[FrameDelta]]) -> None:
    parts, shuffled = case
    assert same(total_of(parts).delta(), total_of(shuffled).delta())
    assert delta_digest(total_of(parts).delta()) == delta_digest(total_of(shuffled).delta())


@given(NEAR, st.lists(st.integers(0, 2), max_size=6))
@settled
def test_a_total_does_not_depend_on_how_additions_are_grouped(parts: list[FrameDelta], group: list[int]) -> None:
    groups: dict[int, list[FrameDelta]] = {}
    for delta, k in zip(parts, [*group, *[0] * len(parts)], strict=False):
        groups.setdefault(k, []).append(delta)
    grouped = [sum_deltas(each) for each in groups.values()]
    assert same(sum_deltas(grouped), sum_deltas(parts))


@given(st.one_of(SOME, NEAR), deltas(bound=2**56))
@settled
def test_subtracting_takes_back_what_was_added(parts: list[FrameDelta], more: FrameDelta) -> None:
    total = total_of(parts)
    before = total.delta()
    total.add(more)
    total.subtract(more)
    assert same(total.delta(), before)


@given(NEAR)
@settled
def test_a_total_is_a_delta_that_adds_up_to_itself(parts: list[FrameDelta]) -> None:
    whole = total_of(parts).delta()
    assert same(sum_deltas([whole]), whole)
    assert np.all(np.diff(whole.variables) > 0)
    assert np.all(whole.rows <= whole.cols)
    assert np.all(np.diff(whole.rows * len(whole.variables) + whole.cols) > 0)


@given(NEAR, st.sampled_from(["H", "b"]), st.sampled_from([1, -1]), st.integers(0, 3))
@settled
def test_a_sum_that_would_reach_the_limit_is_refused_and_changes_nothing(
    parts: list[FrameDelta], where: str, sign: int, short: int
) -> None:
    variable = 7  # beyond those of `parts`
    value = sign * (QUANTA_MAX - 1 - short)
    total = total_of([*parts, one_block(value, variable) if where == "H" else one_block(0, variable, b=value)])
    before = total.delta()
    step = sign * (short + 1)
    # The block of variable 1 comes first, so that something would have been written already.
    over = FrameDelta(
        variables=np.array([1, variable]),
        rows=np.array([0, 1]),
        cols=np.array([0, 1]),
        H=np.array([1, 0, 0, step if where == "H" else 0, 0, 0]),
        b=np.array([1, 0, step if where == "b" else 0, 0]),
    )
    with pytest.raises(NumericalError, match="2\\^60"):
        total.add(over)
    assert same(total.delta(), before)
    total.add(one_block(step - sign, variable) if where == "H" else one_block(0, variable, b=step - sign))
    assert not short or not same(total.delta(), before)


def test_a_total_grows_far_beyond_its_first_size() -> None:
    parts = [one_block(k + 1, variable=k + 1, b=-k) for k in range(1000)]
    whole = total_of(parts[::-1]).delta()
    assert whole.variables.tolist() == list(range(1, 1001))
    assert whole.H[::3].tolist() == list(range(1, 1001))
    assert whole.b[::2].tolist() == [-k for k in range(1000)]


def test_what_cancels_does_not_appear() -> None:
    total = total_of([one_block(5, 3), one_block(-5, 3), one_block(0, 2)])
    assert same(total.delta(), FrameDelta.nothing())


@given(NEAR)
@settled
def test_floating_point_information_is_symmetric_and_that_of_the_tables(parts: list[FrameDelta]) -> None:
    whole = sum_deltas(parts)
    info = to_information(whole)
    H, b = reference.dense(*reference.blocks_of(whole), whole.variables.tolist())
    assert info.offsets.tolist() == row_offsets(whole.variables).tolist()
    assert np.array_equal(info.H.toarray(), info.H.toarray().T)
    assert np.array_equal(info.H.toarray(), H)
    assert np.array_equal(info.b, b)


def test_a_quantum_is_two_to_the_minus_28_of_matrix_and_two_to_the_minus_24_of_vector() -> None:
    info = to_information(one_block(2**28, b=2**24))
    assert info.H.toarray().tolist() == [[1.0, 0.0], [0.0, 0.0]]
    assert info.b.tolist() == [1.0, 0.0]


@given(deltas(), deltas())
@settled
def test_deltas_have_one_digest_if_and_only_if_they_are_the_same(a: FrameDelta, b: FrameDelta) -> None:
    assert (delta_digest(a) == delta_digest(b)) == same(a, b)


def test_moving_a_number_between_columns_changes_the_digest() -> None:
    a = FrameDelta.nothing()
    x = np.array([1], np.int64)
    digests = set()
    for name in ("variables", "rows", "cols", "H", "b"):
        columns = {key: x if key == name else a.H for key in ("variables", "rows", "cols", "H", "b")}
        digests.add(delta_digest(FrameDelta(**columns)))
    assert len(digests) == 5
