"""Bytes of a frame delta: the kernels against the same rules written with numpy, one rule after the other."""

import itertools
from collections.abc import Iterator
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif import delta_wire
from fleet_seif.config import FilterSettings
from fleet_seif.delta_wire import COLUMNS, pack_delta, read_delta
from fleet_seif.envelope import ENTRIES_MAX, MESSAGE_MAX, STEP_MAX
from fleet_seif.errors import WireError
from fleet_seif.information import QUANTA_MAX, VARIABLE_MAX, FrameDelta, block_size, row_offsets
from fleet_seif.seif import Seif
from fleet_seif.varints import VALUE_MAX, decode_ints, encode_ints
from tests.drives import drive, square
from tests.strategies import deltas, settled

Columns = tuple[bytes, bytes, bytes, bytes]


def slow_pack(delta: FrameDelta) -> Columns:
    places = delta.rows * len(delta.variables) + delta.cols
    return (
        encode_ints(np.diff(delta.variables, prepend=0)),
        encode_ints(np.diff(places, prepend=0)),
        encode_ints(delta.H),
        encode_ints(delta.b),
    )


def slow_read(value: Columns) -> FrameDelta:
    columns = []
    for name, data in zip(COLUMNS, value, strict=True):
        numbers = decode_ints(data)
        if numbers is None or len(numbers) > ENTRIES_MAX:
            raise WireError(f"delta {name}: expected integers, at most {ENTRIES_MAX}")
        columns.append(numbers)
    steps, place_steps, H, b = columns
    for numbers in (steps, place_steps):
        if len(numbers) and (numbers[0] < 0 or np.any(numbers[1:] <= 0) or np.any(numbers > STEP_MAX)):
            raise WireError("not ascending")
    variables, places = np.cumsum(steps), np.cumsum(place_steps)
    if len(variables) and variables[-1] > VARIABLE_MAX:
        raise WireError(f"variable {variables[-1]}")
    rows, cols = np.divmod(places, max(len(variables), 1))
    if len(places) and (places[-1] >= len(variables) ** 2 or np.any(rows > cols)):
        raise WireError("a block outside the upper triangle")
    needed = sum(block_size(variables[i], variables[j]) for i, j in zip(rows, cols, strict=True))
    if len(H) != needed or len(b) != row_offsets(variables)[-1]:
        raise WireError("number of values does not fit")
    for numbers in (H, b):
        if len(numbers) and not -QUANTA_MAX < numbers.min() <= numbers.max() < QUANTA_MAX:
            raise WireError("a value reaches 2^60 quanta")
    return FrameDelta(variables=variables, rows=rows, cols=cols, H=H, b=b)


def outcome(read: Any, value: Columns) -> tuple[list[int], ...] | None:
    """What the delta holds, or None where it is refused."""
    try:
        delta = read(value)
    except WireError:
        return None
    arrays = (delta.variables, delta.rows, delta.cols, delta.H, delta.b)
    assert all(array.dtype == np.int64 for array in arrays)
    return tuple(array.tolist() for array in arrays)


def check(value: Columns) -> None:
    """Both readers say the same, and what is read is written as it was."""
    read = outcome(read_delta, value)
    assert read == outcome(slow_read, value), value
    if read is not None:
        assert pack_delta(read_delta(value)) == value


@cache
def real_delta() -> FrameDelta:
    """What a step of a filter publishes with ten landmarks in its local block."""
    log = drive(square(40, 5.0, 3), steps=30, seed=1, most=6)
    seif = Seif(FilterSettings(active_max=6))
    parts = [seif.start(log.start).delta, *(seif.step(each).delta for each in log.readings)]
    return parts[-1]


SMALL = FrameDelta(  # the pose and landmark 2, as in FORMAT.md, and landmark 130
    variables=np.array([0, 3, 131]),
    rows=np.array([0, 0, 1, 2]),
    cols=np.array([0, 1, 1, 2]),
    H=np.array([1, 0, 0, 2, 0, 3, -1, 0, 0, -2, 0, 0, 100, 0, -100, 9, 9, 9]),
    b=np.array([5, 0, 0, -7, 300, 0, QUANTA_MAX - 1]),
)


def damaged(value: Columns, bytes_tried: list[int]) -> Iterator[Columns]:
    """Every column with each byte replaced, left out, or another put before it, and cut at each place."""
    for i, column in enumerate(value):
        for at in range(len(column) + 1):
            before, after = column[:at], column[at:]
            changes = [before, before + after[1:]]
            for byte in bytes_tried:
                changes += [before + bytes([byte]) + after[1:], before + bytes([byte]) + after]
            for change in changes:
                yield cast(Columns, (*value[:i], change, *value[i + 1 :]))


@given(deltas())
@settings(settled, max_examples=150)
def test_a_delta_comes_back_as_it_was_and_its_bytes_are_those_of_the_columns(delta: FrameDelta) -> None:
    value = pack_delta(delta)
    assert value == slow_pack(delta)
    assert outcome(read_delta, value) is not None
    check(value)


def test_the_delta_of_a_filter_comes_back_as_it_was() -> None:
    value = pack_delta(real_delta())
    assert value == slow_pack(real_delta())
    assert len(real_delta().rows) > 30
    assert outcome(read_delta, value) is not None
    check(value)


def test_the_delta_that_says_nothing_is_four_empty_columns() -> None:
    assert pack_delta(FrameDelta.nothing()) == (b"", b"", b"", b"")
    check((b"", b"", b"", b""))


def test_any_single_byte_changed_put_in_or_left_out_is_refused_or_read_as_the_rules_say() -> None:
    for value in damaged(pack_delta(SMALL), list(range(256))):
        check(value)


def test_bytes_of_a_filters_delta_changed_put_in_or_left_out_are_refused_or_read_as_the_rules_say() -> None:
    for value in damaged(pack_delta(real_delta()), [0, 129]):
        check(value)


@given(st.tuples(*[st.binary(max_size=12)] * 4))
@settings(settled, max_examples=200)
def test_any_bytes_are_refused_or_read_as_the_rules_say(value: Columns) -> None:
    check(value)


STEPS = st.one_of(st.integers(0, 3), st.integers(-2, 2**31), st.sampled_from([STEP_MAX, STEP_MAX + 1, VALUE_MAX - 1]))


@given(st.lists(STEPS, max_size=4), st.lists(STEPS, max_size=6), st.data())
@settings(settled, max_examples=200)
def test_any_integers_are_refused_or_read_as_the_rules_say(
    variables: list[int], places: list[int], data: st.DataObject
) -> None:
    value = st.one_of(st.integers(-9, 9), st.sampled_from([QUANTA_MAX, -QUANTA_MAX, QUANTA_MAX - 1]))
    H = data.draw(st.lists(value, max_size=4 * len(places) + 2))
    b = data.draw(st.lists(value, min_size=2 * len(variables), max_size=2 * len(variables) + 1))
    columns = tuple(encode_ints(np.array(numbers, np.int64)) for numbers in (variables, places, H, b))
    check(cast(Columns, columns))


def columns_of(variables: list[int], places: list[int], H: list[int], b: list[int]) -> Columns:
    """Columns of these steps and values."""
    return cast(Columns, tuple(encode_ints(np.array(numbers, np.int64)) for numbers in (variables, places, H, b)))


ONES = b"\x02" * (ENTRIES_MAX + 1)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (columns_of([1], [], [], [0] * 2)[:3], "delta: expected 4 fields"),
        (list(columns_of([1], [], [], [0] * 2)), "delta: expected 4 fields"),
        (None, "delta: expected 4 fields"),
        (b"1234", "delta: expected 4 fields"),
        ((b"", b"", "", b""), "delta H: expected integers"),
        ((b"", bytearray(), b"", b""), "delta blocks: expected integers"),
        ((b"", b"", b"", None), "delta b: expected integers"),
        ((b"\x80", b"", b"", b""), "delta variables: expected integers"),
        ((b"", b"\x80\x00", b"", b""), "delta blocks: expected integers"),
        ((b"", b"", b"\xff" * 9, b""), "delta H: expected integers"),
        ((b"", b"", b"", b"\xff" * 8 + b"\x40"), "delta b: expected integers"),
        ((ONES, b"", b"", b""), "delta variables: more than 1048576 entries"),
        ((b"", b"", b"", ONES), "delta b: more than 1048576 entries"),
        (columns_of([3, 0], [], [], [0] * 4), "delta variables: not ascending"),
        (columns_of([-1], [], [], [0] * 2), "delta variables: not ascending"),
        (columns_of([STEP_MAX + 1], [], [], [0] * 2), "delta variables: not ascending"),
        (columns_of([1, 1], [0, 0], [0] * 6, [0] * 4), "delta blocks: not ascending"),
        (columns_of([1], [-1], [0] * 3, [0] * 2), "delta blocks: not ascending"),
        (columns_of([VARIABLE_MAX + 1], [], [], [0] * 2), "delta: a variable above 2147483647"),
        (columns_of([], [0], [0] * 3, []), "delta: a block outside the upper triangle"),
        (columns_of([1, 1], [2], [0] * 4, [0] * 4), "delta: a block outside the upper triangle"),
        (columns_of([1, 1], [4], [0] * 4, [0] * 4), "delta: a block outside the upper triangle"),
        (columns_of([1, 1], [1], [0] * 3, [0] * 4), "delta: number of values does not fit the blocks"),
        (columns_of([0], [], [], [0] * 2), "delta: number of values does not fit the blocks"),
        (columns_of([1], [0], [QUANTA_MAX, 0, 0], [0] * 2), "delta: a value reaches 2\\^60 quanta"),
        (columns_of([1], [], [], [0, -QUANTA_MAX]), "delta: a value reaches 2\\^60 quanta"),
    ],
)
def test_what_breaks_a_rule_is_refused_with_a_text_that_names_it(value: Any, text: str) -> None:
    with pytest.raises(WireError, match=f"^{text}$"):
        read_delta(value)


def test_as_many_entries_as_the_limit_are_read() -> None:
    variables = ONES[:ENTRIES_MAX]
    assert outcome(read_delta, (variables, b"", b"", b"")) is None  # b would need two million values
    half = b"\x02" * (ENTRIES_MAX // 2)
    delta = read_delta((half, b"", b"", bytes(ENTRIES_MAX)))
    assert delta.variables[[0, -1]].tolist() == [1, ENTRIES_MAX // 2]


@pytest.mark.parametrize("column", range(4))
@pytest.mark.parametrize("byte", [b"\x00", b"\x02", b"\x80", b"\xff", b"\xff" * 7 + b"\x3f"])
def test_a_whole_message_of_one_byte_over_and_over_is_refused(column: int, byte: bytes) -> None:
    value = [b"", b"", b"", b""]
    value[column] = byte * (MESSAGE_MAX // len(byte))
    with pytest.raises(WireError):
        read_delta(tuple(value))


@pytest.mark.parametrize("column", [0, 1])
@pytest.mark.parametrize("step", [STEP_MAX, VARIABLE_MAX * 2**8, VALUE_MAX - 1])
def test_steps_whose_sum_wraps_around_are_refused(column: int, step: int) -> None:
    """Their sums in int64 come back to a small number."""
    steps = [step] * min(2**64 // step, ENTRIES_MAX - 9)
    while (rest := 2**64 + 5 - sum(steps)) > VALUE_MAX - 1 and len(steps) < ENTRIES_MAX:
        steps.append(VALUE_MAX - 1)
    steps.append(min(rest, VALUE_MAX - 1))
    value = [encode_ints(np.array([1])), b"", b"", bytes(2)]
    value[column] = encode_ints(np.array(steps, np.int64))
    check(cast(Columns, tuple(value)))
    assert outcome(read_delta, cast(Columns, tuple(value))) is None


def test_what_is_read_takes_no_more_than_sixteen_times_the_room_of_its_bytes() -> None:
    places = np.array([i * 700 + j for i, j in itertools.combinations_with_replacement(range(700), 2)])
    sizes = np.where(np.isin(places, np.arange(700) * 701), 3, 4)
    value = (
        b"\x02" * 700,
        encode_ints(np.diff(places, prepend=0)),
        bytes(int(sizes.sum())),
        bytes(1400),
    )
    delta = read_delta(value)
    room = sum(array.nbytes for array in (delta.variables, delta.rows, delta.cols, delta.H, delta.b))
    assert room <= 16 * sum(map(len, value))
    assert delta.H.base is not None
    assert delta.H.base.nbytes == room


@pytest.mark.parametrize("value", [VALUE_MAX, -VALUE_MAX, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("where", ["H", "b"])
def test_a_number_too_large_for_a_column_is_not_written(value: int, where: str) -> None:
    numbers = {"H": np.array([1, 1, 1]), "b": np.array([1, 1])}
    numbers[where][-1] = value
    one = np.array([0])
    with pytest.raises(ValueError, match="2\\^61"):
        pack_delta(FrameDelta(variables=np.array([1]), rows=one, cols=one, **numbers))


def test_each_kernel_is_compiled_once_for_whatever_it_is_given() -> None:
    for value in (pack_delta(SMALL), (b"", b"", b"", b"")):
        pack_delta(read_delta(value))
    pack_delta(real_delta())
    for compiled in (delta_wire._read, delta_wire._write):
        assert len(cast(Any, compiled).signatures) == 1
