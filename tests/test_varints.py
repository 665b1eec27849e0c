"""Integers as bytes: one form for each list, and every other form refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.varints import VALUE_MAX, decode_ints, encode_ints
from tests.strategies import settled

VALUES = st.one_of(st.integers(-200, 200), st.integers(1 - VALUE_MAX, VALUE_MAX - 1))
EDGES = [sign * 2**k + d for k in (0, 6, 7, 13, 14, 55, 60) for d in (-1, 0, 1) for sign in (1, -1)]


def slow_bytes(values: list[int]) -> bytes:
    """The definition in the module's docstring, with Python's integers."""
    out = bytearray()
    for v in values:
        u = 2 * v if v >= 0 else -2 * v - 1
        groups = [(u >> shift) & 127 for shift in range(0, max(u.bit_length(), 1), 7)]
        out += bytes([g | 128 for g in groups[:-1]] + groups[-1:])
    return bytes(out)


@given(st.lists(VALUES))
@settled
def test_bytes_are_those_of_the_definition_and_give_the_values_back(values: list[int]) -> None:
    data = encode_ints(np.array(values, np.int64))
    assert data == slow_bytes(values)
    back = decode_ints(data)
    assert back is not None
    assert back.tolist() == values


@pytest.mark.parametrize("value", [*EDGES, VALUE_MAX - 1, 1 - VALUE_MAX, 0])
def test_values_at_the_edges_of_a_byte_and_of_the_range_come_back(value: int) -> None:
    data = encode_ints(np.array([value], np.int64))
    assert data == slow_bytes([value])
    back = decode_ints(data)
    assert back is not None
    assert back.tolist() == [value]


@given(st.binary(max_size=40))
@settled
def test_bytes_are_refused_or_are_what_their_values_encode_to(data: bytes) -> None:
    values = decode_ints(data)
    assert values is None or encode_ints(values) == data


@given(st.lists(VALUES, min_size=1), st.integers(1, 8))
@settled
def test_a_last_value_that_is_cut_short_is_refused(values: list[int], cut: int) -> None:
    data = encode_ints(np.array(values, np.int64))
    last = encode_ints(np.array(values[-1:], np.int64))
    if cut < len(last):
        assert decode_ints(data[:-cut]) is None


@pytest.mark.parametrize(
    "data",
    [b"\x80\x00", b"\xff\x00", b"\x81\x80\x00", b"\x80", b"\xff" * 9, b"\xff" * 9 + b"\x01", b"\xff" * 8 + b"\x40"],
)
def test_a_form_that_is_not_the_shortest_or_too_large_is_refused(data: bytes) -> None:
    assert decode_ints(data) is None


@pytest.mark.parametrize("value", [VALUE_MAX, -VALUE_MAX, 2**63 - 1, -(2**63)])
def test_a_value_that_is_too_large_is_neither_written_nor_read(value: int) -> None:
    with pytest.raises(ValueError, match="2\\^61"):
        encode_ints(np.array([value], np.int64))
    assert decode_ints(slow_bytes([value])) is None


def test_no_values_are_no_bytes() -> None:
    assert encode_ints(np.empty(0, np.int64)) == b""
    back = decode_ints(b"")
    assert back is not None
    assert back.tolist() == []
