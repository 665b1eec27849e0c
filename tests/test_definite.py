"""Positive definite or not: against the eigenvalues of the dense matrix, wherever rounding cannot decide."""

from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_seif import definite
from fleet_seif.config import FilterSettings
from fleet_seif.definite import PRODUCTS_MAX, VARIABLES_MAX, is_positive_definite
from fleet_seif.errors import NumericalError
from fleet_seif.information import (
    H_QUANTUM,
    QUANTA_MAX,
    FrameDelta,
    FrameTotal,
    largest_growth,
    row_offsets,
    to_information,
)
from fleet_seif.records import Floats, Ints
from fleet_seif.seif import Seif
from tests import reference
from tests.drives import drive, square
from tests.strategies import deltas, settled, spd

CLEAR = 1e-10
"""An eigenvalue this far from zero, relative to the diagonal, is not a matter of rounding."""


def delta_of(H: Floats, variables: Ints | None = None) -> FrameDelta:
    """The blocks that are not zero of a matrix of a pose and landmarks, in quanta."""
    count = (len(H) - 1) // 2
    variables = np.arange(count) if variables is None else variables
    quanta = np.round(H / H_QUANTUM).astype(np.int64)
    first = row_offsets(np.arange(count))
    rows, cols, values = [], [], []
    for i in range(count):
        for j in range(i, count):
            block = quanta[first[i] : first[i + 1], first[j] : first[j + 1]]
            if np.any(block):
                rows.append(i)
                cols.append(j)
                values.append(block[np.triu_indices(len(block))] if i == j else block.ravel())
    return FrameDelta(
        variables=variables,
        rows=np.array(rows, np.int64),
        cols=np.array(cols, np.int64),
        H=np.concatenate([np.empty(0, np.int64), *values]),
        b=np.zeros(first[-1], np.int64),
    )


def expected(delta: FrameDelta) -> bool | None:
    """What the eigenvalues say once the diagonal is scaled to ones; None where that is too close to tell."""
    H = to_information(delta).H.toarray()
    diagonal = np.diag(H)
    if np.any(diagonal <= 0):
        return False
    scale = np.sqrt(diagonal)
    with np.errstate(over="ignore"):
        least = np.linalg.eigvalsh(H / scale / scale[:, None])[0]
    return None if abs(least) < CLEAR * len(H) else bool(least > 0)


def check(delta: FrameDelta) -> None:
    verdict = is_positive_definite(delta)
    if not len(delta.variables) or delta.variables[0] != 0:
        assert not verdict
    else:
        assert expected(delta) in (verdict, None)


def matrices(landmarks_max: int = 6) -> st.SearchStrategy[Floats]:
    """Positive definite ones of a pose and some landmarks."""
    return st.integers(0, landmarks_max).flatmap(lambda k: spd(3 + 2 * k))


def masks(count: int) -> st.SearchStrategy[Any]:
    """Which blocks of a matrix are kept: symmetric, the diagonal always."""
    return arrays(np.bool_, (count, count)).map(lambda A: A | A.T | np.eye(count, dtype=bool))


def masked(H: Floats, keep: Any) -> Floats:
    owner = np.repeat(np.arange(len(keep)), [3] + [2] * (len(keep) - 1))
    return np.asarray(H * keep[np.ix_(owner, owner)])


@st.composite
def sparse_matrices(draw: st.DrawFn) -> Floats:
    """Symmetric, with some blocks left out: definite or not."""
    H = draw(matrices(8))
    H = masked(H, draw(masks((len(H) - 1) // 2)))
    return np.asarray(H + draw(st.sampled_from([0.0, 0.0, 1.0, -0.05, -0.5])) * np.eye(len(H)))


@given(matrices())
@settled
def test_a_positive_definite_matrix_is_positive_definite(H: Floats) -> None:
    assert is_positive_definite(delta_of(H))


@given(sparse_matrices())
@settings(settled, max_examples=150)
def test_the_verdict_is_that_of_the_eigenvalues(H: Floats) -> None:
    check(delta_of(H))


@given(st.integers(1, 5), st.integers(1, 4), st.sampled_from([-1e-3, -1e-6, 0.0, 1e-6, 1e-3]), st.data())
@settings(settled, max_examples=100)
def test_the_verdict_on_a_nearly_singular_matrix_is_that_of_the_eigenvalues(
    landmarks: int, lacking: int, shift: float, data: st.DataObject
) -> None:
    n = 3 + 2 * landmarks
    A = data.draw(arrays(np.float64, (n, n - lacking), elements=st.floats(-2, 2)))
    check(delta_of(A @ A.T + shift * np.eye(n)))


@given(st.one_of(deltas(), deltas(variable_max=3), deltas(variable_max=3, bound=2**40)))
@settings(settled, max_examples=120)
def test_any_delta_gets_the_verdict_of_the_eigenvalues(delta: FrameDelta) -> None:
    check(delta)


@given(sparse_matrices(), st.randoms(use_true_random=False))
@settled
def test_the_verdict_does_not_depend_on_how_landmarks_are_numbered(H: Floats, random: Any) -> None:
    delta = delta_of(H)
    order = list(range((len(H) - 3) // 2))
    random.shuffle(order)
    rows = [0, 1, 2, *(3 + 2 * k + axis for k in order for axis in (0, 1))]
    numbers = np.array([0, *sorted(random.sample(range(1, 10_000), len(order)))])
    shuffled = delta_of(H[np.ix_(rows, rows)], numbers)
    if expected(delta) is not None:
        assert is_positive_definite(shuffled) == is_positive_definite(delta)


@cache
def published(steps: int = 60) -> tuple[FrameDelta, ...]:
    """What a filter publishes on a drive among forty landmarks."""
    log = drive(square(40, 5.0, 3), steps=steps, seed=1, most=6)
    seif = Seif(FilterSettings(active_max=4))
    return (seif.start(log.start).delta, *(seif.step(each).delta for each in log.readings))


def test_every_prefix_of_what_a_filter_publishes_is_positive_definite() -> None:
    total = FrameTotal()
    for delta in published():
        total.add(delta)
        assert is_positive_definite(total.delta())
        assert expected(total.delta()) is True


def test_with_one_delta_left_out_the_verdict_is_that_of_the_eigenvalues() -> None:
    total, refused = FrameTotal(), 0
    for delta in published():
        total.add(delta)
    for delta in published():
        total.subtract(delta)
        check(total.delta())
        refused += not is_positive_definite(total.delta())
        total.add(delta)
    assert 0 < refused < len(published())
    assert is_positive_definite(total.delta())


def test_no_variables_no_pose_or_a_variable_without_a_block_is_not_positive_definite() -> None:
    whole = delta_of(np.eye(7))
    assert is_positive_definite(whole)
    assert not is_positive_definite(FrameDelta.nothing())
    assert not is_positive_definite(delta_of(np.eye(7), np.array([1, 2, 3])))
    for missing in range(7):
        H = np.eye(7)
        H[missing, missing] = 0.0
        assert not is_positive_definite(delta_of(H))
    no_block = FrameDelta(variables=whole.variables, rows=whole.rows[:2], cols=whole.cols[:2], H=whole.H[:9], b=whole.b)
    assert not is_positive_definite(no_block)


def test_numbers_at_the_limit_beside_the_smallest_are_not_positive_definite() -> None:
    n = 43
    H = np.full((n, n), float(QUANTA_MAX // 2)) * H_QUANTUM
    H[np.diag_indices(n)] = H_QUANTUM
    assert not is_positive_definite(delta_of(H))
    H[np.diag_indices(n)] = QUANTA_MAX / 4 * 3 * H_QUANTUM
    check(delta_of(H))


def chain(count: int) -> FrameDelta:
    """A pose and landmarks, each linked to the one before; all eigenvalues between 1 and 5."""
    k = np.arange(count)
    rows, cols = np.sort(np.concatenate([k, k[:-1]])), np.zeros(2 * count - 1, np.int64)
    cols[0::2], cols[1::2] = k, k[1:]
    one = 2**28
    blocks = [[3 * one, 0, 0, 3 * one, 0, 3 * one], [one, 0, 0, one, 0, 0]]
    blocks += [[3 * one, 0, 3 * one], [one, 0, 0, one]] * (count - 1)
    H = np.array([value for block in blocks[:-1] for value in block], np.int64)
    return FrameDelta(variables=k, rows=rows, cols=cols, H=H, b=np.zeros(2 * count + 1, np.int64))


@pytest.mark.parametrize("count", [2, 63, 64, 65, 128, 129, 1000])
def test_a_chain_of_any_length_is_positive_definite_until_one_pivot_is_taken_away(count: int) -> None:
    delta = chain(count)
    assert is_positive_definite(delta)
    H = delta.H.copy()
    H[-1] = 2**26
    assert not is_positive_definite(FrameDelta(variables=delta.variables, rows=delta.rows, cols=delta.cols, H=H, b=H))


def test_a_pose_linked_to_every_landmark_costs_no_fill() -> None:
    count = 2000
    k = np.arange(count)
    rows, cols = np.concatenate([0 * k, k[1:]]), np.concatenate([k, k[1:]])
    bits = definite._links(count, rows, cols)
    order, blocks = definite._eliminate(bits)
    assert blocks == count - 1
    assert sorted(order.tolist()) == k.tolist()


def test_a_frame_that_is_too_large_to_tell_raises_and_says_what_to_do() -> None:
    many = np.arange(VARIABLES_MAX + 1)
    empty = np.empty(0, np.int64)
    with pytest.raises(NumericalError, match=f"at most {VARIABLES_MAX}"):
        is_positive_definite(FrameDelta(variables=many, rows=empty, cols=empty, H=empty, b=empty))
    count = int((3 * PRODUCTS_MAX) ** (1 / 3)) + 10
    rows, cols = np.triu_indices(count)
    H = np.zeros(4 * len(rows) + 1000, np.int64)
    with pytest.raises(NumericalError, match="active_max"):
        is_positive_definite(FrameDelta(variables=np.arange(count), rows=rows, cols=cols, H=H, b=H))


def test_the_kernel_is_compiled_once() -> None:
    is_positive_definite(chain(3))
    assert len(cast(Any, definite._verdict).signatures) == 1


@given(deltas())
@settled
def test_the_largest_growth_is_the_largest_entry_on_the_diagonal_or_zero(delta: FrameDelta) -> None:
    blocks, _ = reference.blocks_of(delta)
    diagonals = [int(x) for (row, col), block in blocks.items() if row == col for x in np.diag(block)]
    assert largest_growth(delta) == max([0, *diagonals])
