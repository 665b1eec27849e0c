"""Information in fixed point: the quanta, a change of a frame (`FrameDelta`) and the sum of changes (`FrameTotal`).

1. A frame's variables are its pose (number 0, three rows) and its landmarks (number n + 1, two rows each).
2. H is kept as int64 multiples of 2^-28, b of 2^-24; magnitudes stay below 2^60 quanta.
3. A delta is Q(C_n) - Q(C_(n-1)) of cumulative values, so a sum telescopes; integer addition makes any order the same.
4. Only the upper triangle is kept, blocks in row-major order: NaN and asymmetry cannot be written down.
"""

import dataclasses
import hashlib
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.sparse

from fleet_seif.errors import NumericalError
from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints

H_QUANTUM: Final = 2.0**-28
B_QUANTUM: Final = 2.0**-24
QUANTA_MAX: Final = 2**60
POSE: Final = 0
VARIABLE_MAX: Final = 2**31 - 1


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameDelta:
    """A change of one frame's cumulative (H, b), in quanta.

    variables (v,): ascending variable numbers.
    rows, cols (k,): positions in `variables` of each block, rows <= cols, in row-major order.
    H: the blocks' values one after the other: upper triangle of a diagonal block (6 or 3), all of another (6 or 4).
    b: three values for the pose, two for a landmark, in the order of `variables`.
    """

    variables: Ints
    rows: Ints
    cols: Ints
    H: Ints
    b: Ints

    @staticmethod
    def nothing() -> "FrameDelta":
        empty = np.empty(0, np.int64)
        return FrameDelta(variables=empty, rows=empty, cols=empty, H=empty, b=empty)


@kernel
def block_size(row_variable: int, col_variable: int) -> int:
    """Values a block holds on the wire."""
    if row_variable == col_variable:
        return 6 if row_variable == POSE else 3
    return 6 if row_variable == POSE else 4


@kernel
def variable_size(variable: int) -> int:
    """Rows of a variable."""
    return 3 if variable == POSE else 2


@kernel
def _largest_diagonal(variables: Ints, rows: Ints, cols: Ints, H: Ints) -> int:
    largest = at = 0
    for k in range(len(rows)):
        row, col = variables[rows[k]], variables[cols[k]]
        if row == col:
            n = variable_size(row)
            i = at
            for r in range(n):
                largest = max(largest, H[i])
                i += n - r
        at += block_size(row, col)
    return largest


def quanta(information: float) -> int:
    """Whole quanta of H in an amount of information: limits are compared, and added up, as integers."""
    return int(information / H_QUANTUM)


def largest_growth(delta: FrameDelta) -> int:
    """The largest entry on the diagonal of a delta's H, in quanta, at least 0."""
    return _largest_diagonal(delta.variables, delta.rows, delta.cols, delta.H)


@kernel
def _hash(key: int, mask: int) -> int:
    return ((key >> 32) * 73856093 + (key & 0xFFFFFFFF) * 19349663) & mask


@kernel
def _find(keys: Ints, key: int) -> int:
    """Slot of a key, or of the free place where it would go. Free slots hold -1; keys is a power of two long."""
    mask = len(keys) - 1
    slot = _hash(key, mask)
    while keys[slot] != -1 and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@kernel
def _apply(
    keys: Ints, offsets: Ints, values: Ints, used: Ints, variables: Ints, rows: Ints, cols: Ints, H: Ints, b: Ints
) -> bool:
    """Add a delta to a table of blocks; False, with nothing changed, where a sum would leave the range."""
    for write in (False, True):
        at = 0
        for k in range(len(rows) + len(variables)):
            if k < len(rows):
                row, col = variables[rows[k]], variables[cols[k]]
                size, source, start = block_size(row, col), H, at
                key = (row << 32) | (col + 1)
            else:
                if k == len(rows):
                    at = 0
                row = variables[k - len(rows)]
                size, source, start = variable_size(row), b, at
                key = row << 32
            at += size
            slot = _find(keys, key)
            if keys[slot] == -1 and write:
                keys[slot] = key
                offsets[slot] = used[1]
                used[0] += 1
                used[1] += size
            for i in range(size):
                old = values[offsets[slot] + i] if keys[slot] != -1 else 0
                total = old + source[start + i]
                if write:
                    values[offsets[slot] + i] = total
                elif not -QUANTA_MAX < total < QUANTA_MAX:
                    return False
    return True


@kernel
def _rehash(keys: Ints, offsets: Ints, new_keys: Ints, new_offsets: Ints) -> None:
    for i in range(len(keys)):
        if keys[i] != -1:
            slot = _find(new_keys, keys[i])
            new_keys[slot], new_offsets[slot] = keys[i], offsets[i]


@kernel
def _copy_unless_zero(out: Ints, values: Ints) -> bool:
    """Copy values to the beginning of `out` and say so, unless all are zero."""
    found = False
    for i in range(len(values)):
        out[i] = values[i]
        found |= values[i] != 0
    return found


@kernel
def _export(keys: Ints, offsets: Ints, values: Ints, order: Ints) -> tuple[Ints, Ints, Ints, Ints, Ints]:
    """Non-zero blocks and vectors, slots in `order`: block rows, cols, values; vector variables, values."""
    rows, cols = np.empty(len(order), np.int64), np.empty(len(order), np.int64)
    H, names, b = np.empty(6 * len(order), np.int64), np.empty(len(order), np.int64), np.empty(3 * len(order), np.int64)
    n = h = v = w = 0
    for slot in order:
        row, col = keys[slot] >> 32, (keys[slot] & 0xFFFFFFFF) - 1
        at = offsets[slot]
        if col == -1:
            size = variable_size(row)
            if _copy_unless_zero(b[w:], values[at : at + size]):
                names[v] = row
                v, w = v + 1, w + size
        else:
            size = block_size(row, col)
            if _copy_unless_zero(H[h:], values[at : at + size]):
                rows[n], cols[n] = row, col
                n, h = n + 1, h + size
    return rows[:n].copy(), cols[:n].copy(), H[:h].copy(), names[:v].copy(), b[:w].copy()


@kernel
def _triplets(variables: Ints, rows: Ints, cols: Ints, H: Ints, offsets: Ints) -> tuple[Ints, Ints, Floats]:
    """Full symmetric (i, j, value) triplets of the blocks; rows, cols and offsets index `variables`."""
    count = 0
    for k in range(len(rows)):
        size_r, size_c = variable_size(variables[rows[k]]), variable_size(variables[cols[k]])
        count += size_r * size_c if rows[k] == cols[k] else 2 * size_r * size_c
    i, j, value = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    n = h = 0
    for k in range(len(rows)):
        size_r, size_c = variable_size(variables[rows[k]]), variable_size(variables[cols[k]])
        for r in range(size_r):
            for c in range(r if rows[k] == cols[k] else 0, size_c):
                x = H[h] * H_QUANTUM
                h += 1
                i[n], j[n], value[n] = offsets[rows[k]] + r, offsets[cols[k]] + c, x
                n += 1
                if i[n - 1] != j[n - 1]:
                    i[n], j[n], value[n] = j[n - 1], i[n - 1], x
                    n += 1
    return i, j, value


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameInformation:
    """One frame's information in floating point, rows in the order of `variables` (pose first).

    H (n, n): symmetric CSR; b (n,). Variables whose rows are all zero do not appear.
    """

    variables: Ints
    offsets: Ints
    H: scipy.sparse.csr_array
    b: Floats


def row_offsets(variables: Ints) -> Ints:
    """First row of each variable, and the number of rows at the end, shape (v + 1,)."""
    return np.concatenate([[0], np.cumsum(np.where(variables == POSE, 3, 2))]).astype(np.int64)


class FrameTotal:
    """The sum of one frame's deltas. Adding is exact, so the order of additions leaves no trace."""

    def __init__(self) -> None:
        self._keys = np.full(64, -1, np.int64)
        self._offsets = np.zeros(64, np.int64)
        self._values = np.zeros(256, np.int64)
        self._used = np.zeros(2, np.int64)  # slots, values
        self._delta: FrameDelta | None = None

    def add(self, delta: FrameDelta) -> None:
        """Fold one delta. Raises NumericalError, with nothing changed, where a sum would reach 2^60 quanta."""
        if not len(delta.variables):
            return
        self._reserve(len(delta.rows) + len(delta.variables), len(delta.H) + len(delta.b))
        if not _apply(
            self._keys, self._offsets, self._values, self._used,
            delta.variables, delta.rows, delta.cols, delta.H, delta.b,
        ):  # fmt: skip
            raise NumericalError(
                "a frame total would exceed 2^60 quanta (H 2^-28, b 2^-24): the vehicle claims absurd information"
            )
        self._delta = None

    def subtract(self, delta: FrameDelta) -> None:
        """Take back one delta that was added."""
        self.add(dataclasses.replace(delta, H=-delta.H, b=-delta.b))

    def _reserve(self, slots: int, values: int) -> None:
        if 2 * (self._used[0] + slots) > len(self._keys):
            size = len(self._keys)
            while size < 4 * (self._used[0] + slots):
                size *= 2
            keys, offsets = np.full(size, -1, np.int64), np.zeros(size, np.int64)
            _rehash(self._keys, self._offsets, keys, offsets)
            self._keys, self._offsets = keys, offsets
        if self._used[1] + values > len(self._values):
            grown = np.zeros(2 * (len(self._values) + values), np.int64)
            grown[: self._used[1]] = self._values[: self._used[1]]
            self._values = grown

    def delta(self) -> FrameDelta:
        """The whole total as one delta from nothing, without blocks that are zero, in canonical order.

        Made anew only after a change; the arrays are shared, so treat them as read-only.
        """
        if self._delta is None:
            self._delta = self._export()
        return self._delta

    def _export(self) -> FrameDelta:
        taken = np.flatnonzero(self._keys != -1)
        order = taken[np.argsort(self._keys[taken])]
        rows, cols, H, names, b = _export(self._keys, self._offsets, self._values, order)
        variables = np.unique(np.concatenate([rows, cols, names]))
        full_b = np.zeros(row_offsets(variables)[-1], np.int64)
        starts = row_offsets(variables)[np.searchsorted(variables, names)]
        sizes = np.where(names == POSE, 3, 2)
        full_b[np.repeat(starts - np.cumsum(sizes) + sizes, sizes) + np.arange(len(b))] = b
        return FrameDelta(
            variables=variables,
            rows=np.searchsorted(variables, rows).astype(np.int64),
            cols=np.searchsorted(variables, cols).astype(np.int64),
            H=H,
            b=full_b,
        )


def to_information(delta: FrameDelta) -> FrameInformation:
    """A cumulative delta as floating-point H and b."""
    offsets = row_offsets(delta.variables)
    n = int(offsets[-1])
    i, j, value = _triplets(delta.variables, delta.rows, delta.cols, delta.H, offsets)
    H = scipy.sparse.coo_array((value, (i, j)), shape=(n, n)).tocsr()
    return FrameInformation(variables=delta.variables, offsets=offsets, H=H, b=delta.b.astype(np.float64) * B_QUANTUM)


def delta_digest(delta: FrameDelta) -> bytes:
    """32 bytes that identify a delta's content."""
    digest = hashlib.blake2b(digest_size=32)
    for part in (delta.variables, delta.rows, delta.cols, delta.H, delta.b):
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(np.ascontiguousarray(part, "<i8").tobytes())
    return digest.digest()
