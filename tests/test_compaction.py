"""Forgetting single messages: the same totals and digests, and what is left can still be passed on."""

import dataclasses
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif.config import FusionSettings
from fleet_seif.envelope import KIND_SNAPSHOT, kind_of
from fleet_seif.messages import DeltaMessage, Epoch, Heartbeat, NodeStatus, RangeRequest, Snapshot, StreamPosition
from fleet_seif.node_wire import encode_status
from fleet_seif.store import MemoryStore
from fleet_seif.streams import is_check_point
from fleet_seif.wire import (
    decode_heartbeat,
    decode_message,
    decode_snapshot,
    encode_heartbeat,
    encode_message,
    encode_range,
    encode_snapshot,
)
from fusion.compaction import LEAST, compact
from fusion.core import FusionCore, PutAck
from fusion.ledger import Ledger, Receipt
from fusion.stream import Stream
from tests import strategies
from tests.drives import FLEET, streams
from tests.strategies import settled

EPOCH = Epoch(1, 77)
LONG = 140


@cache
def ann() -> tuple[bytes, ...]:
    """Check points at 0, 64, 128 and the end, 141."""
    return streams(LONG)["ann"]


def state(ledger: Ledger) -> object:
    return ledger.map_digest(), ledger.ledger_digest(), [(s.next, s.checked, s.fault) for s in ledger.streams.values()]


def heartbeat(stream: Stream, checked: int) -> bytes:
    """What the vehicle of a stream says when it has put just that."""
    return encode_heartbeat(
        Heartbeat(
            fleet=FLEET, vehicle=stream.vehicle, epoch=stream.epoch, last=stream.next - 1,
            prefix_digest=stream.prefix_digest, checked=checked, checked_digest=stream.check_digests[checked],
            ended=stream.ended,
        )
    )  # fmt: skip


def compacted(ledger: Ledger, stream: Stream, checked: int, confirmed: int | None = None) -> bool:
    """Announce a check point and compact up to it; whether anything changed."""
    ledger.keep_witness(stream, checked, heartbeat(stream, checked))
    changes = compact(stream, stream.checked if confirmed is None else confirmed, "hub", None)
    ledger.replace(stream, changes)
    return bool(changes)


@given(strategies.streams(), st.data())
@settings(settled, max_examples=100)
def test_compaction_changes_no_digest_and_a_node_that_starts_from_it_goes_on_alike(
    messages: list[DeltaMessage], data: st.DataObject
) -> None:
    """At every check point in turn, before the messages that follow."""
    upto = data.draw(st.sampled_from([m.last for m in messages if is_check_point(m)]))
    disk, ledger, plain = MemoryStore(), Ledger(FLEET), Ledger(FLEET)
    for message in messages:
        ledger.accept(encode_message(message))
        plain.accept(encode_message(message))
        if message.last == upto:
            stream = ledger.stream("v", Epoch(1, 5))
            before = state(ledger)
            assert compacted(ledger, stream, upto) == (upto + 1 >= LEAST)
            assert state(ledger) == before
            assert ledger.bytes_held == sum(len(each) for each in stream.log)
    assert state(ledger) == state(plain)
    disk.commit(ledger.take_changes())
    again = Ledger(FLEET)
    again.restore(disk.load())
    assert state(again) == state(plain)
    if upto:
        assert kind_of(again.stream("v", Epoch(1, 5)).log[0]) == KIND_SNAPSHOT


@pytest.mark.parametrize("chain", [[64], [128], [64, 128], [64, 128, 141], [141]])
def test_a_snapshot_is_compacted_further_and_says_what_the_messages_said(chain: list[int]) -> None:
    ledger, plain = Ledger(FLEET), Ledger(FLEET)
    stream = None
    for k, data in enumerate(ann()):
        _, stream = ledger.accept(data)
        plain.accept(data)
        if k in chain:
            assert compacted(ledger, stream, k)
            assert (len(stream.log), stream.firsts) == (1, [0])
    assert stream is not None
    assert state(ledger) == state(plain)
    snapshot = decode_snapshot(stream.log[0])
    assert (snapshot.maker, snapshot.message.last) == ("hub", chain[-1])
    assert stream.bytes_at(chain[-1]) == stream.log[0]
    for k in range(chain[-1] + 1, len(ann())):
        assert stream.bytes_at(k) == ann()[k]


def held() -> tuple[Ledger, Stream]:
    ledger = Ledger(FLEET)
    for data in ann()[:140]:
        _, stream = ledger.accept(data)
    return ledger, stream


def test_nothing_is_forgotten_that_the_vehicle_has_not_announced_or_required_nodes_do_not_hold() -> None:
    ledger, stream = held()
    assert compact(stream, 200, "hub", None) == [], "nothing announced"
    assert not compacted(ledger, stream, 64, confirmed=63)
    assert not compacted(ledger, stream, 128, confirmed=127)
    assert compacted(ledger, stream, 128, confirmed=128)


def test_a_check_point_that_another_history_had_is_not_compacted_to() -> None:
    ledger, stream = held()
    ledger.keep_witness(stream, 100, heartbeat(stream, 64))  # a witness of 64 under a wrong number does no harm
    stream.check_digests.pop(64)
    assert compact(stream, 200, "hub", None) == []


def test_a_witness_only_gives_way_to_a_later_one() -> None:
    ledger, stream = held()
    late, early = heartbeat(stream, 128), heartbeat(stream, 64)
    ledger.keep_witness(stream, 128, late)
    ledger.keep_witness(stream, 64, early)
    assert stream.witness == late


def test_what_would_be_too_large_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    ledger, stream = held()
    before = state(ledger), list(stream.log)
    monkeypatch.setattr("fleet_seif.envelope.MESSAGE_MAX", 2000)
    assert not compacted(ledger, stream, 128)
    assert (state(ledger), stream.log) == before


# Several nodes.

SETTINGS = FusionSettings(compact_bytes=1, required_acks=("hub", "two"))


def core_with(messages: int, settings: FusionSettings = SETTINGS) -> FusionCore:
    core = FusionCore(FLEET, "hub", settings)
    for data in ann()[:messages]:
        core.on_delta("ann", data, 0.0)
    stream = core.ledger.stream("ann", EPOCH)
    core.on_heartbeat("ann", heartbeat(stream, stream.checked), 0.0)
    return core


def status_of_two(last: int) -> bytes:
    position = StreamPosition("ann", EPOCH, last, bytes(32), b"")
    return encode_status(NodeStatus(fleet=FLEET, node="two", streams=(position,), events=bytes(32)))


def test_single_messages_are_kept_until_every_required_node_has_them() -> None:
    core = core_with(70)
    stream = core.ledger.stream("ann", EPOCH)
    for last, gone in ((None, False), (63, False), (64, True)):
        if last is not None:
            core.on_status("two", status_of_two(last), 0.0)
        core.compact()
        assert (kind_of(stream.log[0]) == KIND_SNAPSHOT) == gone
    assert stream.firsts == [0, 65, 66, 67, 68, 69]


def test_a_ledger_is_compacted_when_it_has_grown_beyond_the_limit_and_twice_what_was_left() -> None:
    size = sum(map(len, ann()[:70]))
    core = core_with(70, FusionSettings(compact_bytes=size))
    stream = core.ledger.stream("ann", EPOCH)
    core.tick(1.0)
    assert len(stream.log) == 70
    core.on_delta("ann", ann()[70], 1.0)
    core.tick(1.0)
    assert len(stream.log) == 7
    assert core.ledger.bytes_held < size


def caught_up_from(core: FusionCore) -> Stream:
    """What a node that knows nothing makes of the answer of another."""
    late = FusionCore(FLEET, "late", SETTINGS)
    request = RangeRequest(fleet=FLEET, vehicle="ann", epoch=EPOCH, first=0, last=200, count=4096)
    for data in core.answer_range("ann", encode_range(request)):
        late.on_reply("ann", data, 0.0)
    assert late.counters["malformed"] == 0
    return late.ledger.stream("ann", EPOCH)


def test_a_node_catches_up_from_the_snapshot_of_another() -> None:
    core = core_with(70, FusionSettings())
    assert core.compact() > 0
    stream = caught_up_from(core)
    assert (stream.next, stream.prefix_digest) == (70, core.ledger.stream("ann", EPOCH).prefix_digest)


def test_a_node_catches_up_from_a_snapshot_that_is_older_than_the_last_witness() -> None:
    core = core_with(70, FusionSettings())
    core.compact()
    for data in ann()[70:130]:
        core.on_delta("ann", data, 0.0)
    stream = core.ledger.stream("ann", EPOCH)
    core.on_heartbeat("ann", heartbeat(stream, 128), 0.0)
    assert caught_up_from(core).next == 130


def test_a_snapshot_that_is_refused_leaves_the_voucher_of_the_one_that_is_held() -> None:
    core, node = core_with(70, FusionSettings()), FusionCore(FLEET, "two", FusionSettings())
    core.compact()
    request = RangeRequest(fleet=FLEET, vehicle="ann", epoch=EPOCH, first=0, last=200, count=4096)
    for data in core.answer_range("ann", encode_range(request)):
        node.on_reply("ann", data, 0.0)
    held = decode_snapshot(node.ledger.stream("ann", EPOCH).log[0])
    for data in ann()[70:130]:
        core.on_delta("ann", data, 0.0)
    said = heartbeat(core.ledger.stream("ann", EPOCH), 128)
    node.on_heartbeat("ann", said, 0.0)
    garbage = Snapshot(
        message=dataclasses.replace(held.message, last=128, landmarks=((9_999, 1),)),
        prefix_digest=decode_heartbeat(said).checked_digest, maker="three",
    )  # fmt: skip
    assert node.ledger.accept(encode_snapshot(garbage), "ann")[0] is Receipt.REFUSED
    assert caught_up_from(node).next == 70


def test_answers_to_other_nodes_stay_within_what_is_asked_for() -> None:
    core = core_with(70, FusionSettings())
    core.compact()

    def answer(first: int, last: int, count: int = 4096, fleet: str = FLEET, epoch: Epoch = EPOCH) -> list[bytes]:
        request = RangeRequest(fleet=fleet, vehicle="ann", epoch=epoch, first=first, last=last, count=count)
        return core.answer_range("ann", encode_range(request))

    assert answer(66, 68) == list(ann()[66:69])
    assert answer(66, 68, count=2) == list(ann()[66:68])
    assert [kind_of(data) for data in answer(3, 5)] == [2, KIND_SNAPSHOT]
    assert answer(70, 99) == answer(0, 9, fleet="g") == answer(0, 9, epoch=Epoch(1, 78)) == []


def test_a_compacted_ledger_still_tells_duplicates_and_acknowledges() -> None:
    core = core_with(70, FusionSettings(ack_every=1))
    core.compact()
    assert core.ledger.accept(ann()[3])[0] is Receipt.DUPLICATE
    effects = core.on_delta("ann", ann()[70], 0.0)
    assert any(isinstance(effect, PutAck) for effect in effects)


@given(st.integers(0, 69))
@settled
def test_evidence_after_compaction_leaves_the_prefix_before_it_or_nothing(k: int) -> None:
    """Two versions of a number that a snapshot covers: the snapshot goes, and the rest can be folded from messages."""
    core = core_with(70, FusionSettings())
    core.compact()
    pair = [ann()[k], encode_message(dataclasses.replace(decode_message(ann()[k]), innovation=1e3))]
    convict = FusionCore(FLEET, "two", SETTINGS)
    for data in [*ann()[:k], *pair]:
        convict.on_delta("ann", data, 0.0)
    proof = convict.ledger.stream("ann", EPOCH)
    assert core.ledger.accept_evidence(proof.evidence)
    stream = core.ledger.stream("ann", EPOCH)
    assert stream.next == (k if k > 64 else 0)
    for data in ann():
        core.on_delta("ann", data, 0.0)
    assert stream.next == k
    assert core.ledger.map_digest() == convict.ledger.map_digest()
    assert core.ledger.ledger_digest() == convict.ledger.ledger_digest()
