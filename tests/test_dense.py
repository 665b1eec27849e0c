"""Small dense linear algebra against numpy."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_seif.dense import cholesky_into, inverse_2x2, solve_3x3, solve_lower_into, solve_upper_into
from fleet_seif.records import Floats
from tests.strategies import finite, settled, spd, vectors


@given(st.integers(1, 8).flatmap(spd))
@settled
def test_a_factor_times_its_transpose_is_the_matrix(A: Floats) -> None:
    n = len(A)
    L = np.zeros((n, n))
    assert cholesky_into(L, A, n)
    np.testing.assert_allclose(L @ L.T, A, atol=1e-12 * np.max(A))
    assert np.array_equal(L, np.tril(L))


@given(spd(6), st.integers(1, 6))
@settled
def test_only_the_leading_rows_and_the_lower_half_are_read(A: Floats, n: int) -> None:
    hidden = np.tril(A)
    hidden[np.triu_indices(6, 1)] = np.nan
    hidden[n:] = np.nan
    L, expected = np.zeros((6, 6)), np.zeros((n, n))
    assert cholesky_into(L, hidden, n)
    assert cholesky_into(expected, A[:n, :n].copy(), n)
    assert np.array_equal(L[:n, :n], expected)


@given(spd(5), st.integers(0, 4))
@settled
def test_a_matrix_with_a_direction_of_negative_information_is_not_factored(A: Floats, k: int) -> None:
    values, vectors = np.linalg.eigh(A)
    values[k] *= -1.0
    assert not cholesky_into(np.empty((5, 5)), (vectors * values) @ vectors.T, 5)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, -np.inf])
def test_a_pivot_that_is_not_above_zero_is_refused(value: float) -> None:
    A = np.diag([1.0, value])
    assert not cholesky_into(np.empty((2, 2)), A, 2)


@given(st.integers(1, 8).flatmap(lambda n: st.tuples(spd(n), vectors(n))))
@settled
def test_two_triangular_solves_solve_the_system(case: tuple[Floats, Floats]) -> None:
    A, v = case
    n = len(A)
    L, x = np.empty((n, n)), v.copy()
    assert cholesky_into(L, A, n)
    solve_lower_into(x, L, n)
    np.testing.assert_allclose(np.tril(L) @ x, v, atol=1e-12)
    solve_upper_into(x, L, n)
    np.testing.assert_allclose(A @ x, v, atol=1e-10)


@given(arrays(float, (2, 2), elements=finite(10.0)))
@settled
def test_a_2x2_matrix_times_its_inverse_is_the_identity(A: Floats) -> None:
    assume(abs(np.linalg.det(A)) > 1e-3)
    np.testing.assert_allclose(A @ inverse_2x2(A), np.eye(2), atol=1e-9)


def test_the_inverse_of_a_singular_2x2_matrix_is_not_finite() -> None:
    assert not np.any(np.isfinite(inverse_2x2(np.ones((2, 2)))))


@given(arrays(float, (3, 3), elements=finite(10.0)), arrays(float, (3, 4), elements=finite(10.0)))
@settled
def test_a_3x3_system_is_solved_whatever_its_pivots(A: Floats, B: Floats) -> None:
    assume(np.linalg.cond(A) < 1e6)
    before = A.copy(), B.copy()
    np.testing.assert_allclose(A @ solve_3x3(A, B), B, atol=1e-8)
    assert np.array_equal(A, before[0])
    assert np.array_equal(B, before[1])


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 2, 0], [2, 1, 0], [0, 2, 1]])
def test_a_3x3_permutation_is_solved_exactly(order: list[int]) -> None:
    P, B = np.eye(3)[order], np.arange(6.0).reshape(3, 2)
    assert np.array_equal(P @ solve_3x3(P, B), B)
