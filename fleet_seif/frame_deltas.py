"""Deltas of one frame from elsewhere: a dense posterior in quanta, and a delta whose landmarks bear other numbers."""

import numpy as np

from fleet_seif.errors import NumericalError
from fleet_seif.information import POSE, QUANTA_MAX, FrameDelta, block_size, row_offsets, variable_size
from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints
from fleet_seif.seif_step import quantise


@kernel
def _sorted_blocks(variables: Ints, rows: Ints, cols: Ints, H: Ints, b: Ints) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """Put variables that are not in order, and their blocks, in order."""
    order = np.argsort(variables)
    rank, starts = np.empty(len(order), np.int64), np.empty(len(order), np.int64)
    at = 0
    for v in range(len(variables)):
        starts[v] = at
        at += variable_size(variables[v])
    new_b, at = np.empty(len(b), np.int64), 0
    for k in range(len(order)):
        v = order[k]
        rank[v] = k
        for i in range(variable_size(variables[v])):
            new_b[at] = b[starts[v] + i]
            at += 1
    count = len(rows)
    keys, offsets, at = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for k in range(count):
        low, high = rank[rows[k]], rank[cols[k]]
        keys[k] = min(low, high) * len(order) + max(low, high)
        offsets[k] = at
        at += block_size(variables[rows[k]], variables[cols[k]])
    by_key = np.argsort(keys)
    new_rows, new_cols, new_H, at = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(len(H), np.int64), 0
    for n in range(count):
        k = by_key[n]
        low, high = rank[rows[k]], rank[cols[k]]
        new_rows[n], new_cols[n] = min(low, high), max(low, high)
        o = offsets[k]
        if low > high:  # two landmarks in the other order: the block transposed
            new_H[at], new_H[at + 1], new_H[at + 2], new_H[at + 3] = H[o], H[o + 2], H[o + 1], H[o + 3]
            at += 4
        else:
            for i in range(block_size(variables[rows[k]], variables[cols[k]])):
                new_H[at] = H[o + i]
                at += 1
    return variables[order], new_rows, new_cols, new_H, new_b


def renumbered(delta: FrameDelta, numbers: Ints) -> FrameDelta:
    """The same delta where landmark n is called numbers[n]; the pose keeps its place. numbers (m,), each different."""
    variables = delta.variables.copy()
    landmarks = variables != POSE
    variables[landmarks] = numbers[variables[landmarks] - 1] + 1
    if np.all(variables[1:] > variables[:-1]):
        return FrameDelta(variables=variables, rows=delta.rows, cols=delta.cols, H=delta.H, b=delta.b)
    variables, rows, cols, H, b = _sorted_blocks(variables, delta.rows, delta.cols, delta.H, delta.b)
    return FrameDelta(variables=variables, rows=rows, cols=cols, H=H, b=b)


@kernel
def _blocks(variables: Ints, offsets: Ints, q_H: Ints) -> tuple[Ints, Ints, Ints]:
    """The non-zero blocks of the upper triangle of a dense matrix."""
    m = len(variables)
    pairs = m * (m + 1) // 2
    rows, cols, H = np.empty(pairs, np.int64), np.empty(pairs, np.int64), np.empty(6 * pairs, np.int64)
    n = h = 0
    for i in range(m):
        for j in range(i, m):
            start, found = h, False
            for r in range(offsets[i], offsets[i + 1]):
                for c in range(r if i == j else offsets[j], offsets[j + 1]):
                    H[h] = q_H[r, c]
                    found |= H[h] != 0
                    h += 1
            if found:
                rows[n], cols[n] = i, j
                n += 1
            else:
                h = start
    return rows[:n].copy(), cols[:n].copy(), H[:h].copy()


def quantised(variables: Ints, H: Floats, b: Floats, mean: Floats) -> FrameDelta:
    """A dense posterior of a frame as one cumulative delta, loaded as MATHS.md section 12 says, so positive definite.

    Args:
        variables: the pose (0) and landmarks (number + 1), ascending, shape (v,).
        H, b, mean: rows in this order, shapes (n, n), (n,), (n,); H symmetric positive definite, H mean = b.

    Raises NumericalError where a value does not fit the fixed point.
    """
    entries = np.count_nonzero(H, axis=1) + (np.diag(H) == 0.0)
    q_H, q_b, fits = quantise(H, b, mean, entries.astype(np.int64))
    if not fits:
        raise NumericalError(f"a frame's posterior exceeds {QUANTA_MAX // 2} quanta (H 2^-28, b 2^-24)")
    rows, cols, values = _blocks(variables, row_offsets(variables), q_H)
    return FrameDelta(variables=variables, rows=rows, cols=cols, H=values, b=q_b)
