"""What frames say, as kernels take it: float64 blocks, each frame's own mean, and which joint variables it is about.

A frame's variables are its end pose (position 0, rows 0 to 2) and its landmarks (position p, rows 2 p + 1 and 2 p + 2).
Joint variables are numbered as the caller likes; the state is X, one line of three numbers each: (x m, y m, theta rad)
of a pose, (x m, y m, unused) of a landmark.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from fleet_seif.dense import cholesky_into, solve_lower_into, solve_upper_into
from fleet_seif.errors import NumericalError
from fleet_seif.information import B_QUANTUM, H_QUANTUM, POSE, FrameDelta, block_size, to_information
from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints
from fleet_seif.robust import huber_limit

A = TypeVar("A", Ints, Floats)
DENSE_ROWS_MAX: Final = 200
"""Rows of a frame up to which its own mean is found with a dense factor."""
PIECE_VARIABLES_MAX: Final = 64
"""Variables of a frame up to which it stays in one piece."""
COMPACT_LEAST: Final = 100_000
"""Values that may always be left behind before places are given anew."""


class SparseFactor:
    """A sparse factor of a symmetric positive definite matrix: factored once, solved with many."""

    def __init__(self, H: scipy.sparse.csr_array) -> None:
        options = {"SymmetricMode": True, "Equil": False}
        try:
            self._lu = scipy.sparse.linalg.splu(
                scipy.sparse.csc_matrix(H), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
            )
        except RuntimeError as error:
            raise NumericalError(f"information matrix of {H.shape[0]} rows is singular: {error}") from None
        if not np.array_equal(self._lu.perm_r, self._lu.perm_c) or not np.all(self._lu.U.diagonal() > 0):
            raise NumericalError(
                f"information matrix of {H.shape[0]} rows is not positive definite: a delta is missing or wrong"
            )

    def solve(self, b: Floats) -> Floats:
        return np.asarray(self._lu.solve(np.asarray(b, float)))


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One frame in floating point.

    rows, cols (k,): positions of each block, rows <= cols; starts (k + 1,): where its values begin. values: as in
    FrameDelta. mean (n,): m = H^-1 b. pieces (p, 2): the blocks first ... last - 1 of each piece the frame is cut into.
    limit, scale: see Frames.
    """

    rows: Ints
    cols: Ints
    starts: Ints
    values: Floats
    mean: Floats
    pieces: Ints
    limit: float
    scale: float


class Frames(NamedTuple):
    """Frames in common arrays. Those of frame f begin at `first_*[f]` and end before `end_*[f]`.

    first_*, end_* (f,): of its blocks, variables and rows.
    rows, cols, starts, values: the blocks; `starts` counts from the first value of all frames.
    mean: own means m_f. variable: the joint variable of each of a frame's variables.
    start (f,): the joint variable of T_f, -1 where it is given. given (f, 3): the given T_f, or the prior's mean.
    prior (f, 3, 3): information of the prior of T_f; zeros where there is none.
    limit (f,): chi-square from which on a frame is weighted down.
    scale (f,): how far things are away within the frame, m.
    """

    first_block: Ints
    end_block: Ints
    first_variable: Ints
    end_variable: Ints
    first_row: Ints
    end_row: Ints
    rows: Ints
    cols: Ints
    starts: Ints
    values: Floats
    mean: Floats
    variable: Ints
    start: Ints
    given: Floats
    prior: Floats
    limit: Floats
    scale: Floats


@kernel
def row_of(position: int) -> int:
    """First row of a frame's variable."""
    return 2 * position + 1 if position > 0 else 0


@kernel
def _unpack(variables: Ints, rows: Ints, cols: Ints, H: Ints) -> tuple[Ints, Floats]:
    """Where each block's values begin (and where the last one's end), and the values in SI units."""
    starts, values = np.zeros(len(rows) + 1, np.int64), np.empty(len(H))
    for k in range(len(rows)):
        starts[k + 1] = starts[k] + block_size(variables[rows[k]], variables[cols[k]])
    for i in range(len(H)):
        values[i] = H[i] * H_QUANTUM
    return starts, values


@kernel
def _dense_mean(rows: Ints, cols: Ints, values: Floats, b: Ints) -> Floats:
    """H^-1 b by a dense factor; empty where H is not positive definite."""
    n, at = len(b), 0
    A, L, x = np.zeros((n, n)), np.zeros((n, n)), np.empty(n)
    for k in range(len(rows)):
        i, j = row_of(rows[k]), row_of(cols[k])
        for r in range(3 if rows[k] == 0 else 2):
            for c in range(r if rows[k] == cols[k] else 0, 3 if cols[k] == 0 else 2):
                A[j + c, i + r] = values[at]
                at += 1
    if not cholesky_into(L, A, n):
        return np.empty(0)
    for i in range(n):
        x[i] = b[i] * B_QUANTUM
    solve_lower_into(x, L, n)
    solve_upper_into(x, L, n)
    return x


@kernel
def _cut(rows: Ints, cols: Ints, count: int, most: int) -> tuple[Ints, int]:
    """Runs of whole rows that touch at most `most` variables (or are one row): pieces (p, 2), sum of squared sizes."""
    pieces, met = np.empty((count, 2), np.int64), np.full(count, -1, np.int64)
    n, size, squares, begin, k = 0, 0, 0, 0, 0
    while k < len(rows):
        end, new = k, 0
        while end < len(rows) and rows[end] == rows[k]:
            new += 1 if met[cols[end]] != n else 0
            end += 1
        new += 1 if met[rows[k]] != n and cols[k] != rows[k] else 0
        if k > begin and size + new > most:
            pieces[n, 0], pieces[n, 1] = begin, k
            squares += size * size
            n, size, begin = n + 1, 0, k
            continue
        for i in range(k, end):
            met[cols[i]] = n
        met[rows[k]] = n
        size, k = size + new, end
    pieces[n, 0], pieces[n, 1] = begin, k
    return pieces[: n + 1].copy(), squares + size * size


def _pieces(rows: Ints, cols: Ints, count: int) -> Ints:
    """A frame in pieces: one where it is small, or so full that pieces would be more work than the whole."""
    pieces, squares = _cut(rows, cols, count, PIECE_VARIABLES_MAX)
    return pieces if squares < count * count else np.array([[0, len(rows)]])


def prepared(delta: FrameDelta) -> FrameRecord:
    """A frame's cumulative delta in floating point, with its mean.

    Raises NumericalError where it says nothing about its pose, or is not positive definite on its own.
    """
    if not len(delta.variables) or delta.variables[0] != POSE:
        raise NumericalError("a frame holds no information about its pose: nothing can be joined to it")
    starts, values = _unpack(delta.variables, delta.rows, delta.cols, delta.H)
    if len(delta.b) <= DENSE_ROWS_MAX:
        mean = _dense_mean(delta.rows, delta.cols, values, delta.b)
        if not len(mean):
            raise NumericalError(
                f"a frame's information matrix of {len(delta.b)} rows is not positive definite: "
                "a delta is missing or wrong"
            )
    else:
        info = to_information(delta)
        mean = SparseFactor(info.H).solve(info.b)
    pieces = _pieces(delta.rows, delta.cols, len(delta.variables))
    scale = max(np.max(np.abs(mean[:2])), np.max(np.abs(mean[3:]), initial=0.0))
    return FrameRecord(delta.rows, delta.cols, starts, values, mean, pieces, huber_limit(len(mean)), float(scale))


NO_FRAME: Final = FrameRecord(
    *(np.empty(0, np.int64),) * 2, np.zeros(1, np.int64), np.empty(0), np.empty(0), np.zeros((1, 2), np.int64),
    0.0, 0.0,
)  # fmt: skip
"""A frame without variables: what carries the prior of a start pose before its life has a frame."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A frame's record, with the joint variables it is about: see Frames."""

    record: FrameRecord
    variable: Ints
    start: int
    given: Floats
    prior: Floats


class _Heap(Generic[A]):
    """An array that grows at its end; what has been taken from it stays as it is."""

    def __init__(self, array: A) -> None:
        self._array: A = array
        self.size = len(array)

    def add(self, part: A) -> tuple[int, int]:
        """Where it begins and ends."""
        first, end = self.size, self.size + len(part)
        if end > len(self._array):
            larger = np.empty(max(2 * len(self._array), end), self._array.dtype)
            larger[:first] = self._array[:first]
            self._array = larger
        self._array[first:end] = part
        self.size = end
        return first, end

    def all(self) -> A:
        whole: A = self._array[: self.size]
        return whole


_LINE: Final = np.dtype(
    [(f"{end}_{what}", np.int64) for what in ("block", "variable", "row") for end in ("first", "end")]
    + [("start", np.int64), ("given", np.float64, 3), ("prior", np.float64, (3, 3))]
    + [("limit", np.float64), ("scale", np.float64)]
)
"""What Frames says of one frame."""


class FrameTable:
    """Frames by number, in arrays that only grow: a frame that is put again leaves its old place behind.

    generation: grows when places are given anew, once most of them have been left behind.
    """

    def __init__(self) -> None:
        self.placed: list[Placed] = []
        self.generation = 0
        self._clear()

    def _clear(self) -> None:
        self._rows, self._cols, self._starts, self._variable = (_Heap(np.empty(0, np.int64)) for _ in range(4))
        self._values, self._mean = (_Heap(np.empty(0)) for _ in range(2))
        self._lines = np.empty(0, _LINE)
        self._live = 0

    def put(self, numbers: Sequence[int], placed: Sequence[Placed]) -> None:
        """Give these numbers to these frames; numbers that are new follow each other."""
        for number, each in zip(numbers, placed, strict=True):
            if number == len(self.placed):
                self.placed.append(each)
            else:
                self._live -= len(self.placed[number].record.values)
                self.placed[number] = each
            self._live += len(each.record.values)
        if 2 * self._live + COMPACT_LEAST < self._values.size:
            self._clear()
            self.generation += 1
            self._live = sum(len(each.record.values) for each in self.placed)
            numbers, placed = range(len(self.placed)), self.placed
        more = len(self.placed) - len(self._lines)
        self._lines = np.concatenate([self._lines, np.zeros(more, _LINE)])  # those taken before stay as they are
        for number, each in zip(numbers, placed, strict=True):
            self._lines[number] = self._append(each)

    def _append(self, each: Placed) -> tuple[object, ...]:
        record = each.record
        at, _ = self._values.add(record.values)
        self._cols.add(record.cols)
        self._starts.add(record.starts[:-1] + at)
        spans = *self._rows.add(record.rows), *self._variable.add(each.variable), *self._mean.add(record.mean)
        return (*spans, each.start, each.given, each.prior, record.limit, record.scale)

    def frames(self, *, robust: bool) -> Frames:
        """All of them as they are now. robust: whether those that disagree are weighted down."""
        lines = {name: np.ascontiguousarray(self._lines[name]) for name in _LINE.names or ()}
        if not robust:
            lines["limit"][:] = math.inf
        return Frames(
            **lines, rows=self._rows.all(), cols=self._cols.all(), starts=self._starts.all(),
            values=self._values.all(), mean=self._mean.all(), variable=self._variable.all(),
        )  # fmt: skip
