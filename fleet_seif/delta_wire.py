"""Bytes of a frame delta: four integer columns; FORMAT.md sections 4 and 5 are the specification.

1. Writer and reader are one kernel each: a message has one delta or two of some hundred numbers, where every numpy
   call would cost more than its work.
2. The reader counts before it makes room: a column byte becomes at most 16 bytes (a block's row and column), and a
   block needs three bytes of values more.
3. No sum of steps can leave int64: each is tested as it grows. A variable is at most 2^31 - 1 and a place below 2^40
   (ENTRIES_MAX squared) before a step of at most STEP_MAX = 2^40 is added.
"""

from typing import Any, Final

import numpy as np

from fleet_seif.envelope import ENTRIES_MAX, STEP_MAX, fields_of
from fleet_seif.errors import WireError
from fleet_seif.information import QUANTA_MAX, VARIABLE_MAX, FrameDelta, block_size, variable_size
from fleet_seif.jit import kernel
from fleet_seif.records import Ints
from fleet_seif.varints import BYTES_MAX, VALUE_MAX, Bytes, _decode, _encode

COLUMNS: Final = ("variables", "blocks", "H", "b")

OK: Final = 0
NOT_INTEGERS: Final = 1  # ... 4, by column
TOO_MANY: Final = 5  # ... 8, by column
VARIABLES_NOT_ASCENDING: Final = 9
BLOCKS_NOT_ASCENDING: Final = 10
VARIABLE_TOO_LARGE: Final = 11
OUTSIDE_TRIANGLE: Final = 12
WRONG_NUMBER: Final = 13
VALUE_TOO_LARGE: Final = 14

TEXTS: Final = {
    **{NOT_INTEGERS + i: f"delta {name}: expected integers" for i, name in enumerate(COLUMNS)},
    **{TOO_MANY + i: f"delta {name}: more than {ENTRIES_MAX} entries" for i, name in enumerate(COLUMNS)},
    VARIABLES_NOT_ASCENDING: "delta variables: not ascending",
    BLOCKS_NOT_ASCENDING: "delta blocks: not ascending",
    VARIABLE_TOO_LARGE: f"delta: a variable above {VARIABLE_MAX}",
    OUTSIDE_TRIANGLE: "delta: a block outside the upper triangle",
    WRONG_NUMBER: "delta: number of values does not fit the blocks",
    VALUE_TOO_LARGE: "delta: a value reaches 2^60 quanta",
}


@kernel
def _write(variables: Ints, rows: Ints, cols: Ints, H: Ints, b: Ints) -> tuple[Bytes, int, int, int]:
    """The four columns one after the other, and where the first three end. Nothing where a value is too large."""
    steps = np.empty(len(variables) + len(rows), np.int64)
    last = 0
    for i in range(len(variables)):
        steps[i], last = variables[i] - last, variables[i]
    last = 0
    for k in range(len(rows)):
        place = rows[k] * len(variables) + cols[k]
        steps[len(variables) + k], last = place - last, place
    for numbers in (steps, H, b):
        for value in numbers:
            if not -VALUE_MAX < value < VALUE_MAX:
                return np.empty(0, np.uint8), -1, -1, -1
    out = np.empty(BYTES_MAX * (len(steps) + len(H) + len(b)), np.uint8)
    first = _encode(steps[: len(variables)], out)
    second = first + _encode(steps[len(variables) :], out[first:])
    third = second + _encode(H, out[second:])
    return out[: third + _encode(b, out[third:])].copy(), first, second, third


def pack_delta(delta: FrameDelta) -> tuple[bytes, bytes, bytes, bytes]:
    """The four columns of a delta. Raises ValueError for numbers of 2^61 or more in magnitude."""
    out, first, second, third = _write(delta.variables, delta.rows, delta.cols, delta.H, delta.b)
    if first < 0:
        raise ValueError("delta: its numbers must stay below 2^61 in magnitude")
    data = out.tobytes()
    return data[:first], data[first:second], data[second:third], data[third:]


@kernel
def _count(data: Bytes, begin: int, end: int) -> int:
    """Values in a column: its bytes without the top bit."""
    count = 0
    for i in range(begin, end):
        count += data[i] < 128
    return count


@kernel
def _sum_variables(steps: Ints) -> int:
    """Turn steps into variables in place; OK or what is wrong."""
    total = 0
    for i in range(len(steps)):
        if steps[i] > STEP_MAX or steps[i] < min(i, 1):
            return VARIABLES_NOT_ASCENDING
        total += steps[i]
        if total > VARIABLE_MAX:
            return VARIABLE_TOO_LARGE
        steps[i] = total
    return OK


@kernel
def _sum_places(steps: Ints, rows: Ints, cols: Ints, v: int) -> int:
    """Turn steps into rows and columns of v x v blocks; OK or what is wrong. rows may be the same array as steps."""
    place = 0
    for k in range(len(steps)):
        if steps[k] > STEP_MAX or steps[k] < min(k, 1):
            return BLOCKS_NOT_ASCENDING
        place += steps[k]
        if place >= v * v or place // v > place % v:
            return OUTSIDE_TRIANGLE
        rows[k], cols[k] = place // v, place % v
    return OK


@kernel
def _check_values(variables: Ints, rows: Ints, cols: Ints, H: Ints, b: Ints) -> int:
    """OK, or what is wrong with the number of values or their size."""
    needed_H = needed_b = 0
    for k in range(len(rows)):
        needed_H += block_size(variables[rows[k]], variables[cols[k]])
    for variable in variables:
        needed_b += variable_size(variable)
    if len(H) != needed_H or len(b) != needed_b:
        return WRONG_NUMBER
    for numbers in (H, b):
        for value in numbers:
            if not -QUANTA_MAX < value < QUANTA_MAX:
                return VALUE_TOO_LARGE
    return OK


@kernel
def _read(data: Bytes, first: int, second: int, third: int) -> tuple[int, Ints, int, int, int]:
    """Decode and check four columns that follow one another; the first three end at first, second, third.

    Returns OK or what is wrong; variables, rows, cols, H, b in one array; how many variables, blocks, values of H.
    """
    ends = (0, first, second, third, len(data))
    count = np.empty(4, np.int64)
    for i in range(4):
        count[i] = _count(data, ends[i], ends[i + 1])
        if count[i] > ENTRIES_MAX:
            return TOO_MANY + i, np.empty(0, np.int64), 0, 0, 0
    v, k, h = count[0], count[1], count[2]
    numbers = np.empty(v + 2 * k + h + count[3], np.int64)
    starts = (0, v, v + 2 * k, v + 2 * k + h)
    for i in range(4):
        if _decode(data[ends[i] : ends[i + 1]], numbers[starts[i] : starts[i] + count[i]]) != count[i]:
            return NOT_INTEGERS + i, numbers, 0, 0, 0
    variables, rows, cols = numbers[:v], numbers[v : v + k], numbers[v + k : v + 2 * k]
    fault = _sum_variables(variables)
    if fault == OK:
        fault = _sum_places(rows, rows, cols, v)
    if fault == OK:
        fault = _check_values(variables, rows, cols, numbers[starts[2] : starts[3]], numbers[starts[3] :])
    return fault, numbers, v, k, h


def read_delta(value: Any) -> FrameDelta:
    """A delta from its four columns, a tuple of bytes. Raises WireError, nothing else."""
    columns = fields_of(value, 4, "delta")
    for name, column in zip(COLUMNS, columns, strict=True):
        if type(column) is not bytes:
            raise WireError(f"delta {name}: expected integers")
    first = len(columns[0])
    second = first + len(columns[1])
    data = np.frombuffer(b"".join(columns), np.uint8)
    fault, numbers, v, k, h = _read(data, first, second, second + len(columns[2]))
    if fault != OK:
        raise WireError(TEXTS[fault])
    cols, H = v + k, v + 2 * k
    return FrameDelta(
        variables=numbers[:v], rows=numbers[v:cols], cols=numbers[cols:H], H=numbers[H : H + h], b=numbers[H + h :]
    )
