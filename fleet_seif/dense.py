"""Small dense linear algebra for kernels: blocks of a few dozen rows, where a library call costs more than the work."""

import math

import numpy as np

from fleet_seif.jit import kernel
from fleet_seif.records import Floats


@kernel
def cholesky_into(L: Floats, A: Floats, n: int) -> bool:
    """Lower factor of the leading n x n block of symmetric A (its lower half is read), written into L.

    Returns False, with L unusable, where A is not positive definite to working precision.
    """
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@kernel
def solve_lower_into(v: Floats, L: Floats, n: int) -> None:
    """Solve L x = v for the leading n rows; x replaces v, shape (n,)."""
    for i in range(n):
        total = v[i]
        for k in range(i):
            total -= L[i, k] * v[k]
        v[i] = total / L[i, i]


@kernel
def solve_upper_into(v: Floats, L: Floats, n: int) -> None:
    """Solve L' x = v for the leading n rows; x replaces v, shape (n,)."""
    for i in range(n - 1, -1, -1):
        v[i] /= L[i, i]
        for k in range(i):
            v[k] -= L[i, k] * v[i]


@kernel
def inverse_2x2(A: Floats) -> Floats:
    """Inverse of a 2 x 2 matrix; not finite where A is singular."""
    determinant = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    return np.array([[A[1, 1] / determinant, -A[0, 1] / determinant], [-A[1, 0] / determinant, A[0, 0] / determinant]])


@kernel
def solve_3x3(A: Floats, B: Floats) -> Floats:
    """X with A X = B by Gaussian elimination with partial pivoting; A (3, 3), B (3, m). A need not be symmetric."""
    M, X = A.copy(), B.copy()
    for i in range(3):
        pivot = i
        for r in range(i + 1, 3):
            if abs(M[r, i]) > abs(M[pivot, i]):
                pivot = r
        for c in range(3):
            M[i, c], M[pivot, c] = M[pivot, c], M[i, c]
        for c in range(X.shape[1]):
            X[i, c], X[pivot, c] = X[pivot, c], X[i, c]
        for r in range(i + 1, 3):
            f = M[r, i] / M[i, i]
            for c in range(i, 3):
                M[r, c] -= f * M[i, c]
            for c in range(X.shape[1]):
                X[r, c] -= f * X[i, c]
    for i in range(2, -1, -1):
        for c in range(X.shape[1]):
            total = X[i, c]
            for k in range(i + 1, 3):
                total -= M[i, k] * X[k, c]
            X[i, c] = total / M[i, i]
    return X
