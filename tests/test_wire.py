"""Bytes on the wire: every record comes back, one form each, and everything else is a WireError."""

import dataclasses
import hashlib
import itertools
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from fleet_seif import envelope, map_wire, wire
from fleet_seif.envelope import DIGEST, DIGEST_END, HEADER, MAGIC, PIECE_BYTES, VERSION
from fleet_seif.errors import WireError
from fleet_seif.information import QUANTA_MAX, VARIABLE_MAX
from fleet_seif.messages import FrameStatus
from fleet_seif.varints import encode_ints
from tests import strategies
from tests.drives import streams
from tests.reference import same
from tests.strategies import settled


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of message: how it is written and read, and what to write."""

    number: int
    encode: Callable[[Any], bytes]
    decode: Callable[[bytes], Any]
    records: SearchStrategy[Any]


PIECES = st.builds(
    map_wire.Piece, node=strategies.NAMES, version=strategies.SEQUENCES, index=st.integers(0, 9),
    count=st.integers(10, 4096), data=st.binary(max_size=60),
)  # fmt: skip


def encode_piece(p: map_wire.Piece) -> bytes:
    return envelope.seal(envelope.KIND_PIECE, (p.node, p.version, p.index, p.count, p.data))


KINDS = {
    "delta": Kind(envelope.KIND_DELTA, wire.encode_message, wire.decode_message, strategies.messages()),
    "heartbeat": Kind(envelope.KIND_HEARTBEAT, wire.encode_heartbeat, wire.decode_heartbeat, strategies.heartbeats()),
    "ack": Kind(envelope.KIND_ACK, wire.encode_ack, wire.decode_ack, strategies.acks()),
    "range": Kind(envelope.KIND_RANGE, wire.encode_range, wire.decode_range, strategies.ranges()),
    "snapshot": Kind(envelope.KIND_SNAPSHOT, wire.encode_snapshot, wire.decode_snapshot, strategies.snapshots()),
    "piece": Kind(envelope.KIND_PIECE, encode_piece, map_wire.read_piece, PIECES),
    "map": Kind(envelope.KIND_MAP, map_wire.encode_map, map_wire.decode_map, strategies.maps()),
}
RECORDS = st.sampled_from(sorted(KINDS)).flatmap(lambda name: st.tuples(st.just(KINDS[name]), KINDS[name].records))


def sealed(kind: int, body: bytes) -> bytes:
    """A body under a header and digest that are right, without a signature."""
    head = MAGIC + bytes([VERSION, kind])
    return head + hashlib.blake2b(head + body, digest_size=DIGEST).digest() + b"\0" + body


def body_of(data: bytes) -> bytes:
    return data[DIGEST_END + 1 :]


def fields_of(data: bytes) -> Any:
    return msgpack.unpackb(body_of(data), strict_map_key=False)


def refused(decode: Callable[[bytes], Any], data: bytes) -> bool:
    try:
        decode(data)
    except WireError:
        return True
    return False


# Round trips.


@given(RECORDS)
@settings(settled, max_examples=200)
def test_a_record_comes_back_as_it_was(case: tuple[Kind, Any]) -> None:
    kind, record = case
    data = kind.encode(record)
    assert same(kind.decode(data), record)
    assert kind.encode(kind.decode(data)) == data
    assert envelope.kind_of(data) == kind.number


@pytest.mark.parametrize("vehicle", sorted(streams()))
def test_messages_of_a_filter_come_back_as_they_were(vehicle: str) -> None:
    for data in streams()[vehicle]:
        assert wire.encode_message(wire.decode_message(data)) == data


def test_a_map_without_landmarks_and_vehicles_comes_back() -> None:
    fields = [["f", "n", 0, True, False, bytes(32), bytes(32)], [b"", b"", -1], [], [], [[], b"", b""], [], {}]
    joint = map_wire.decode_map(sealed(envelope.KIND_MAP, msgpack.packb(fields)))
    assert joint.landmark_mean.shape == (0, 2)
    assert joint.pose_cov.shape == (0, 3, 3)


@given(RECORDS)
@settled
def test_the_digest_in_a_message_is_that_of_kind_version_and_body(case: tuple[Kind, Any]) -> None:
    kind, record = case
    data = kind.encode(record)
    assert data[DIGEST_END] == 0
    assert envelope.body_digest(data) == hashlib.blake2b(data[:HEADER] + body_of(data), digest_size=DIGEST).digest()


# Damage.


@given(RECORDS)
@settings(settled, max_examples=40)
def test_every_truncation_is_refused(case: tuple[Kind, Any]) -> None:
    kind, record = case
    data = kind.encode(record)
    assert all(refused(kind.decode, data[:n]) for n in range(len(data)))
    assert refused(kind.decode, data + b"\0")


@given(RECORDS)
@settings(settled, max_examples=25)
def test_every_flip_of_a_single_bit_is_refused(case: tuple[Kind, Any]) -> None:
    kind, record = case
    data = bytearray(kind.encode(record))
    for bit in range(8 * len(data)):
        data[bit // 8] ^= 1 << bit % 8
        assert refused(kind.decode, bytes(data)), f"bit {bit}"
        data[bit // 8] ^= 1 << bit % 8


def test_every_flip_of_a_single_bit_of_a_filters_message_is_refused() -> None:
    whole = streams()["ann"][1]
    data = bytearray(whole)
    for bit in range(0, 8 * len(data), 3):
        data[bit // 8] ^= 1 << bit % 8
        assert refused(wire.decode_message, bytes(data)), f"bit {bit}"
        data[bit // 8] ^= 1 << bit % 8
    assert bytes(data) == whole


@given(st.sampled_from(sorted(KINDS)), st.sampled_from(sorted(KINDS)), st.data())
@settled
def test_a_message_of_one_kind_is_not_read_as_another(name: str, other: str, data: st.DataObject) -> None:
    assume(name != other)
    assert refused(KINDS[other].decode, KINDS[name].encode(data.draw(KINDS[name].records)))


# Bodies that a peer made up and sealed well.


def check_refused_or_canonical(kind: Kind, data: bytes) -> None:
    try:
        record = kind.decode(data)
    except WireError:
        return
    assert kind.encode(record) == data


@given(st.sampled_from(sorted(KINDS)), st.binary(max_size=80))
@settings(settled, max_examples=150)
def test_random_bytes_under_a_right_digest_are_refused_or_are_canonical(name: str, body: bytes) -> None:
    check_refused_or_canonical(KINDS[name], sealed(KINDS[name].number, body))


@given(st.sampled_from(sorted(KINDS)), strategies.msgpack_values())
@settings(settled, max_examples=150)
def test_any_msgpack_under_a_right_digest_is_refused_or_is_canonical(name: str, value: Any) -> None:
    check_refused_or_canonical(KINDS[name], sealed(KINDS[name].number, msgpack.packb(value)))


def replaced(value: Any, steps: list[int], new: Any) -> Any:
    """The value with one of its leaves or branches replaced, chosen by a walk down."""
    if not steps or not isinstance(value, list) or not value:
        return new
    k = steps[0] % len(value)
    return [*value[:k], replaced(value[k], steps[1:], new), *value[k + 1 :]]


NASTY = st.one_of(
    strategies.msgpack_values(),
    st.sampled_from([0, 1, -1, 2**31, 2**53 + 1, 2**63, 2**64 - 1, -(2**63), True, None, "", b"", 0.0, float("nan")]),
    st.lists(st.integers(-(2**62), 2**62 - 1), max_size=8).map(
        lambda v: encode_ints(np.clip(np.array(v, np.int64), 1 - 2**61, 2**61 - 1))
    ),
    st.lists(st.floats(), min_size=9, max_size=9).map(lambda v: np.array(v).tobytes()),
)


@given(RECORDS, st.lists(st.integers(0, 20), min_size=1, max_size=6), NASTY)
@settings(settled, max_examples=250)
def test_a_valid_message_with_one_field_replaced_is_refused_or_is_canonical(
    case: tuple[Kind, Any], steps: list[int], new: Any
) -> None:
    kind, record = case
    fields = replaced(fields_of(kind.encode(record)), steps, new)
    check_refused_or_canonical(kind, sealed(kind.number, msgpack.packb(fields)))


NOT_CANONICAL = {
    "a long form of a small integer": lambda body: body.replace(b"\xa1r", b"\xd9\x01r", 1),
    "a float of 32 bits": lambda body: body.replace(b"\xcb" + bytes(8), b"\xca" + bytes(4), 1),
    "bytes after the end": lambda body: body + b"\xc0",
    "a long form of a list": lambda body: b"\xdc\x00\x10" + body[3:] if body[:1] == b"\xdc" else b"\xdc\x00\x10" + body,
    "an extension": lambda body: b"\xd4\x05\x00",
    "a time": lambda body: b"\xd6\xff" + bytes(4),
    "a text that is not UTF-8": lambda body: body.replace(b"\xa1r", b"\xa1\xff", 1),
}


@pytest.mark.parametrize("change", list(NOT_CANONICAL.values())[:4], ids=list(NOT_CANONICAL)[:4])
def test_another_way_to_write_the_same_is_refused(change: Callable[[bytes], bytes]) -> None:
    message = dataclasses.replace(wire.decode_message(streams()["ann"][1]), fleet="r", time_s=0.0)
    data = wire.encode_message(message)
    body = change(body_of(data))
    if body == body_of(data):
        body = b"\xdd\x00\x00\x00\x10" + body[3:]
    assert refused(wire.decode_message, sealed(envelope.KIND_DELTA, body))


@pytest.mark.parametrize("change", list(NOT_CANONICAL.values())[4:], ids=list(NOT_CANONICAL)[4:])
def test_msgpack_of_types_that_no_message_has_is_refused(change: Callable[[bytes], bytes]) -> None:
    message = dataclasses.replace(wire.decode_message(streams()["ann"][1]), fleet="r")
    body = change(body_of(wire.encode_message(message)))
    assert refused(wire.decode_message, sealed(envelope.KIND_DELTA, body))


def test_deep_nesting_is_refused() -> None:
    for depth in (100, 600, 100_000):
        assert refused(wire.decode_message, sealed(envelope.KIND_DELTA, b"\x91" * depth + b"\xc0"))


def test_lists_that_claim_to_be_long_are_refused() -> None:
    assert refused(wire.decode_message, sealed(envelope.KIND_DELTA, (b"\xdd" + (2**20).to_bytes(4, "big")) * 500))


# Limits, each by a message that is right but for one number.


def delta_message(variables: list[int], blocks: list[int], H: list[int], b: list[int]) -> bytes:
    """A message whose delta has these columns, written as steps; numbers may be anything that int64 holds."""
    whole = fields_of(streams()["ann"][1])

    def steps(numbers: list[int]) -> bytes:
        return encode_ints(np.array([b - a for a, b in itertools.pairwise([0, *numbers])], np.int64))

    column = [steps(variables), steps(blocks), encode_ints(np.array(H, np.int64)), encode_ints(np.array(b, np.int64))]
    whole[7] = [[0, 1, column, None]]
    return sealed(envelope.KIND_DELTA, msgpack.packb(whole))


def test_a_delta_made_by_hand_is_read() -> None:
    part = wire.decode_message(delta_message([0, 3], [0, 1, 3], [1] * 15, [2] * 5)).parts[0]
    assert part.delta.variables.tolist() == [0, 3]
    assert list(zip(part.delta.rows.tolist(), part.delta.cols.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 1)]


@pytest.mark.parametrize(
    ("variables", "blocks", "H", "b"),
    [
        ([3, 3], [], [], [0] * 4),
        ([3, 2], [], [], [0] * 4),
        ([-1], [], [], [0] * 2),
        ([VARIABLE_MAX + 1], [], [], [0] * 2),
        ([1, 2], [2], [0] * 4, [0] * 4),
        ([1, 2], [4], [0] * 4, [0] * 4),
        ([1, 2], [-1], [0] * 4, [0] * 4),
        ([1, 2], [0, 0], [0] * 6, [0] * 4),
        ([1, 2], [1], [0] * 3, [0] * 4),
        ([1, 2], [1], [0] * 5, [0] * 4),
        ([1, 2], [1], [0] * 4, [0] * 3),
        ([], [0], [0] * 3, []),
        ([1], [0], [QUANTA_MAX, 0, 0], [0] * 2),
        ([1], [0], [-QUANTA_MAX, 0, 0], [0] * 2),
        ([1], [], [], [QUANTA_MAX, 0]),
    ],
)
def test_a_delta_that_breaks_a_rule_is_refused(
    variables: list[int], blocks: list[int], H: list[int], b: list[int]
) -> None:
    assert refused(wire.decode_message, delta_message(variables, blocks, H, b))


def test_steps_that_wrap_around_to_a_small_variable_are_refused() -> None:
    """Each step is below the limit of a step, and their sum passes 2^64."""
    step = VARIABLE_MAX * 2**20
    steps = [step] * (2**64 // step)
    steps.append(2**64 + 5 - sum(steps))
    with np.errstate(over="ignore"):
        variables = np.cumsum(np.array(steps, np.int64))
    assert variables[-1] == 5
    assert np.any(variables < 0)
    whole = fields_of(streams()["ann"][1])
    whole[7] = [[0, 1, [encode_ints(np.array(steps)), b"", b"", encode_ints(np.zeros(2 * len(steps), np.int64))], None]]
    assert refused(wire.decode_message, sealed(envelope.KIND_DELTA, msgpack.packb(whole)))


@pytest.mark.parametrize("field", [5, 6])
@pytest.mark.parametrize("value", [0.0, -1.0, 1.0000001e9, float("inf"), float("nan"), 1])
def test_information_that_no_vehicle_may_declare_is_refused(field: int, value: float) -> None:
    whole = fields_of(streams()["ann"][0])
    whole[14][field] = value
    assert refused(wire.decode_message, sealed(envelope.KIND_DELTA, msgpack.packb(whole)))


@pytest.mark.parametrize("checked", [-2, 6])
def test_a_heartbeat_of_a_check_point_that_has_not_been_put_is_refused(checked: int) -> None:
    fields = ["f", "v", [1, 2], 5, bytes(32), checked, bytes(32), False]
    assert refused(wire.decode_heartbeat, sealed(envelope.KIND_HEARTBEAT, msgpack.packb(fields)))


def test_a_message_above_the_size_limit_is_refused_unread() -> None:
    assert refused(wire.decode_message, MAGIC + bytes([VERSION, envelope.KIND_DELTA]) + bytes(envelope.MESSAGE_MAX))


@pytest.mark.parametrize("field", [4, 3])
def test_a_message_that_ends_before_it_starts_or_lacks_its_hello_is_refused(field: int) -> None:
    whole = fields_of(streams()["ann"][1])
    whole[field] = 0
    assert refused(wire.decode_message, sealed(envelope.KIND_DELTA, msgpack.packb(whole)))


def test_another_format_version_says_so() -> None:
    data = bytearray(streams()["ann"][0])
    data[3] = VERSION + 1
    with pytest.raises(WireError, match=f"format {VERSION + 1}"):
        wire.decode_message(bytes(data))


@pytest.mark.parametrize("cov", [-np.eye(3), np.eye(3) + np.eye(3, k=1), np.diag([1.0, 1.0, 0.0])])
def test_a_start_covariance_that_is_no_covariance_is_refused(cov: Any) -> None:
    whole = fields_of(streams()["ann"][0])
    whole[14][4] = np.asarray(cov, float).tobytes()
    assert refused(wire.decode_message, sealed(envelope.KIND_DELTA, msgpack.packb(whole)))


def test_a_snapshot_starts_at_sequence_zero() -> None:
    for k in (0, 1):
        fields = [fields_of(streams()["ann"][k]), bytes(32), None]
        assert refused(wire.decode_snapshot, sealed(envelope.KIND_SNAPSHOT, msgpack.packb(fields))) == (k == 1)


# Pieces.


@given(st.binary(max_size=300), strategies.SEQUENCES, st.data())
@settled
def test_pieces_in_any_order_make_the_whole_again(data: bytes, version: int, order: st.DataObject) -> None:
    whole = data * 500
    encoded = map_wire.map_pieces(whole, "hub", version)
    pieces = order.draw(st.permutations([map_wire.read_piece(piece) for piece in encoded]))
    assert {(p.node, p.version, p.count) for p in pieces} <= {("hub", version, len(pieces))}
    assert b"".join(p.data for p in sorted(pieces, key=lambda p: p.index)) == whole
    assert all(len(p.data) <= PIECE_BYTES for p in pieces)


@given(st.integers(0, 255), st.binary(max_size=10))
@settled
def test_the_kind_of_bytes_that_are_not_ours_is_zero(kind: int, rest: bytes) -> None:
    assert envelope.kind_of(b"FSX" + bytes([VERSION, kind]) + rest) == 0
    assert envelope.kind_of(b"") == 0


def test_frame_statuses_keep_their_numbers_on_the_wire() -> None:
    assert [(s.name, s.value) for s in FrameStatus] == [("OPENED", 0), ("CONTINUED", 1), ("ENDED", 2), ("CORRECTED", 3)]
