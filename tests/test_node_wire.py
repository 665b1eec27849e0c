"""What fusion nodes tell each other: every record comes back, one form each, and everything else is a WireError."""

from collections.abc import Callable
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif import envelope, merge_wire, node_wire
from fleet_seif.messages import Action, Evidence, LandmarkName, NodeStatus, OperatorEvent
from tests import strategies
from tests.golden import MERGES, MERGES_EMPTY
from tests.reference import same
from tests.strategies import settled
from tests.test_wire import NASTY, Kind, check_refused_or_canonical, fields_of, refused, replaced, sealed

KINDS = {
    "event": Kind(envelope.KIND_EVENT, node_wire.encode_event, node_wire.decode_event, strategies.events()),
    "status": Kind(envelope.KIND_STATUS, node_wire.encode_status, node_wire.decode_status, strategies.statuses()),
    "evidence": Kind(
        envelope.KIND_EVIDENCE, node_wire.encode_evidence, node_wire.decode_evidence, strategies.evidences()
    ),
    "merges": Kind(
        envelope.KIND_MERGES, merge_wire.encode_merges, merge_wire.decode_merges, strategies.merge_reports()
    ),
}
RECORDS = st.sampled_from(sorted(KINDS)).flatmap(lambda name: st.tuples(st.just(KINDS[name]), KINDS[name].records))
FORCE = OperatorEvent(
    fleet="f", number=1, operator="op", action=Action.FORCE,
    landmarks=(LandmarkName("a", 0, 1), LandmarkName("b", 0, 0)),
)  # fmt: skip
RETRACT = OperatorEvent(fleet="f", number=1, operator="op", action=Action.RETRACT, vehicle="a")
STATUS = NodeStatus(fleet="f", node="n", streams=(), events=bytes(32))


@given(RECORDS)
@settings(settled, max_examples=100)
def test_a_record_comes_back_as_it_was(case: tuple[Kind, Any]) -> None:
    kind, record = case
    data = kind.encode(record)
    assert same(kind.decode(data), record)
    assert kind.encode(kind.decode(data)) == data
    assert envelope.kind_of(data) == kind.number


@given(RECORDS)
@settings(settled, max_examples=20)
def test_every_truncation_and_every_flip_of_a_bit_is_refused(case: tuple[Kind, Any]) -> None:
    kind, record = case
    data = bytearray(kind.encode(record))
    assert all(refused(kind.decode, bytes(data[:n])) for n in range(len(data)))
    for bit in range(8 * len(data)):
        data[bit // 8] ^= 1 << bit % 8
        assert refused(kind.decode, bytes(data)), f"bit {bit}"
        data[bit // 8] ^= 1 << bit % 8


@given(st.sampled_from(sorted(KINDS)), strategies.msgpack_values())
@settings(settled, max_examples=200)
def test_any_msgpack_under_a_right_digest_is_refused_or_is_canonical(name: str, value: Any) -> None:
    check_refused_or_canonical(KINDS[name], sealed(KINDS[name].number, msgpack.packb(value)))


@given(RECORDS, st.lists(st.integers(0, 20), min_size=1, max_size=5), NASTY)
@settings(settled, max_examples=300)
def test_a_valid_record_with_one_field_replaced_is_refused_or_is_canonical(
    case: tuple[Kind, Any], steps: list[int], new: Any
) -> None:
    kind, record = case
    fields = replaced(fields_of(kind.encode(record)), steps, new)
    check_refused_or_canonical(kind, sealed(kind.number, msgpack.packb(fields)))


def event_with(event: OperatorEvent, place: int, value: object) -> bytes:
    fields = fields_of(node_wire.encode_event(event))
    fields[place] = value
    return sealed(envelope.KIND_EVENT, msgpack.packb(fields))


A, B = ["a", 0, 1], ["b", 0, 0]


@pytest.mark.parametrize(
    "data",
    [
        event_with(FORCE, 4, "a"),
        event_with(FORCE, 4, [B, A]),
        event_with(FORCE, 4, [A, A]),
        event_with(FORCE, 4, [A]),
        event_with(FORCE, 4, [A, B, B]),
        event_with(FORCE, 3, "retract"),
        event_with(FORCE, 3, "FORCE"),
        event_with(FORCE, 3, 0),
        event_with(RETRACT, 4, [A, B]),
        event_with(RETRACT, 4, "a/b"),
        event_with(RETRACT, 4, None),
        event_with(RETRACT, 1, 0),
        event_with(RETRACT, 1, 2**53 + 1),
        event_with(RETRACT, 2, ""),
    ],
)
def test_an_event_that_breaks_a_rule_is_refused(data: bytes) -> None:
    assert refused(node_wire.decode_event, data)


def test_the_events_that_the_others_change_are_read() -> None:
    for event in (FORCE, RETRACT):
        assert node_wire.decode_event(node_wire.encode_event(event)) == event


def position(evidence: object = b"", last: object = -1) -> list[object]:
    return ["v", [1, 2], last, bytes(32), evidence]


@pytest.mark.parametrize(
    ("streams", "events"),
    [
        ([position(b"x")], bytes(32)),
        ([position(None)], bytes(32)),
        ([position(last=-2)], bytes(32)),
        ([position()] * (node_wire.STREAMS_MAX + 1), bytes(32)),
        ([], b""),
        ([], bytes(31)),
        ([], [[1, "op"]]),
        ([], None),
    ],
)
def test_a_status_that_breaks_a_rule_is_refused(streams: list[object], events: object) -> None:
    def status(streams: list[object], events: object) -> bytes:
        return sealed(envelope.KIND_STATUS, msgpack.packb(["f", "n", streams, events]))

    assert not refused(node_wire.decode_status, status([position(), position(bytes(32), 5)], bytes(range(32))))
    assert refused(node_wire.decode_status, status(streams, events))


@pytest.mark.parametrize("fields", [[b"a"], [b"a", "b"], [b"a", None], [b"a", bytes(envelope.DELTA_MAX + 1)]])
def test_evidence_that_is_not_two_messages_is_refused(fields: list[object]) -> None:
    assert refused(node_wire.decode_evidence, sealed(envelope.KIND_EVIDENCE, msgpack.packb(fields)))


@pytest.mark.parametrize("decode", [kind.decode for kind in KINDS.values()], ids=list(KINDS))
def test_one_kind_is_not_read_as_another(decode: Callable[[bytes], Any]) -> None:
    written = [node_wire.encode_event(FORCE), node_wire.encode_status(STATUS)]
    written.append(node_wire.encode_evidence(Evidence(first=b"", second=b"")))
    written.append(merge_wire.encode_merges(MERGES_EMPTY))
    assert sum(refused(decode, data) for data in written) == 3


@pytest.mark.parametrize(
    ("at", "value"),
    [
        (1, [["merged", 1]]),  # what is merged is not kept apart
        (1, [["few", 0]]),
        (1, [["few", 1]] * 7),
        (2, [[["v", 0, 0], ["w", 0, 0], "few", -1.0]]),
        (2, [[["v", 0, 0], ["w", 0, 0], "few", float("inf")]]),
        (2, [[["v", 0, 0], ["w", 0, 0], "few", 1]]),
        (2, [[["v", 0, 0], ["w", 0, 0], "few", 1.0]] * 49),
        (3, [["n", [], []]] * 33),
        (3, [["a/b", [], []]]),
    ],
)
def test_a_report_of_merges_that_breaks_a_rule_is_refused(at: int, value: object) -> None:
    data = merge_wire.encode_merges(MERGES)
    assert refused(
        merge_wire.decode_merges, sealed(envelope.KIND_MERGES, msgpack.packb(replaced(fields_of(data), [at], value)))
    )
