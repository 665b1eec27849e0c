"""Laws of the outbox: what was put is fixed, what is not put may get coarser, nothing is lost."""

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fleet_seif.config import PublishSettings
from fleet_seif.envelope import KIND_DELTA, KIND_SNAPSHOT, body_digest, kind_of
from fleet_seif.information import FrameDelta, FrameTotal, delta_digest
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus, Hello, RangeRequest
from fleet_seif.store import Change, MemoryStore
from fleet_seif.streams import EMPTY_PREFIX, extend_prefix, is_check_point
from fleet_seif.wire import decode_message, decode_snapshot, encode_range
from fusion.ledger import Ledger, Receipt
from tests.drives import core_of, drive, put, square
from tests.reference import same
from tests.strategies import STEP_INFORMATION, STRONG, definite_deltas, pose_block, settled
from vehicles.outbox import Outbox
from vehicles.records import ENDS, MESSAGE, TRIMMED, EpochRecord, Trimmed, numbered
from vehicles.records import EPOCH as EPOCH_TABLE

EPOCH = Epoch(3, 4)
WINDOW, OUTBOX_MAX = 5, 16
SETTINGS = PublishSettings(window=WINDOW, outbox_max=OUTBOX_MAX)
HELLO = Hello(
    software="t", life=0, placed=True, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)),
    start_information=1.0, step_information_max=STEP_INFORMATION,
)  # fmt: skip


def record() -> EpochRecord:
    return EpochRecord(epoch=EPOCH, life=0, base=(), ended=0, names=0)


class OutboxMachine(RuleBasedStateMachine):
    """An outbox with its store, beside a list of everything that was appended, put and acknowledged."""

    settings = SETTINGS
    required: tuple[str, ...] = ()
    nodes: tuple[str, ...] = ("a", "b")

    def __init__(self) -> None:
        super().__init__()
        self.outbox = Outbox(self.settings, record(), required=self.required)
        self.store = MemoryStore()
        self.pending: tuple[list[Change], int] | None = None
        self.total = FrameTotal()
        self.seen: set[int] = set()
        self.signatures: list[int] = []
        self.effects: list[tuple[FrameDelta, int]] = []
        self.put: list[bytes] = []
        self.ever_put: list[bytes] = []
        self.prefixes: list[bytes] = []
        self.acked: dict[str, int] = {}
        self.trimmed = 0
        self.ended = self.closed = False

    @property
    def acknowledged(self) -> int:
        """Messages put that the nodes whose word counts hold."""
        counts = [self.acked.get(node, 0) for node in self.required] if self.required else [0, *self.acked.values()]
        return max(min(counts) if self.required else max(counts), self.trimmed)

    def append(self, delta: FrameDelta, new: int) -> None:
        k, known = len(self.effects), len(self.signatures)
        self.signatures += range(50 + known, 50 + known + new)
        self.total.add(delta)
        end_pose = np.full(3, 0.5) if self.ended else None
        status = FrameStatus.ENDED if self.ended else FrameStatus.CONTINUED if k else FrameStatus.OPENED
        self.effects.append((self.total.delta(), len(self.signatures)))
        self.outbox.append(
            DeltaMessage(
                fleet="test", vehicle="v", epoch=EPOCH, first=k, last=k, step=k, time_s=float(k),
                parts=(FramePart(frame=0, status=status, delta=delta, end_pose=end_pose),),
                landmarks=tuple((known + i, 50 + known + i) for i in range(new)),
                hello=None if k else HELLO, end=self.ended,
            )
        )  # fmt: skip

    @precondition(lambda self: not self.ended and not self.closed)
    @rule(data=st.data(), count=st.integers(1, 40))
    def append_some(self, data: st.DataObject, count: int) -> None:
        new = data.draw(st.integers(0, 2))
        delta = data.draw(definite_deltas(len(self.signatures) + new, self.seen))
        for k in range(count):
            self.append(delta, 0 if k else new)

    @precondition(lambda self: self.effects and not self.ended and not self.closed)
    @rule()
    def end(self) -> None:
        self.ended = True
        self.append(FrameDelta.nothing(), 0)

    @precondition(lambda self: self.pending is None)
    @rule()
    def begin_a_commit(self) -> None:
        self.pending = self.outbox.take_changes(), self.outbox.commits

    @precondition(lambda self: self.pending is not None)
    @rule()
    def finish_a_commit(self) -> None:
        assert self.pending is not None
        changes, mark = self.pending
        self.pending = None
        self.store.commit(changes)
        self.outbox.note_commit(mark)

    def commit(self) -> None:
        if self.pending is None:
            self.begin_a_commit()
        self.finish_a_commit()

    @rule()
    def release(self) -> None:
        kept = dict(self.store.load()).values()
        for data in self.outbox.release():
            assert data in kept, "put before it was committed"
            self.put.append(data)
            if len(self.put) > len(self.ever_put):
                self.ever_put.append(data)
            assert data == self.ever_put[len(self.put) - 1], "not what a process before this one has put"
            digest = body_digest(data)
            self.prefixes.append(extend_prefix(self.prefixes[-1] if self.prefixes else EMPTY_PREFIX, digest))

    @precondition(lambda self: self.put)
    @rule(data=st.data())
    def acknowledge(self, data: st.DataObject) -> None:
        k = data.draw(st.integers(0, len(self.put) - 1))
        self.acknowledge_put(data.draw(st.sampled_from(self.nodes)), k)

    def acknowledge_put(self, node: str, k: int) -> None:
        assert self.outbox.acknowledge(node, decode_message(self.put[k]).last, self.prefixes[k])
        self.acked[node] = max(self.acked.get(node, 0), k + 1)
        points = [i for i in range(self.acknowledged) if is_check_point(decode_message(self.put[i]))]
        self.trimmed = max(self.trimmed, points[-1] + 1 if points else 0)

    @rule(beyond=st.integers(1, 3))
    def an_acknowledgement_of_what_was_never_put_is_refused(self, beyond: int) -> None:
        before = self.outbox.last_acknowledged
        assert not self.outbox.acknowledge("a", self.outbox.last_put + beyond, bytes(32))
        if max(self.acked.get("a", 0), self.trimmed) < len(self.put):
            assert not self.outbox.acknowledge("a", self.outbox.last_put, b"x" * 32)
        assert self.outbox.last_acknowledged == before

    @precondition(lambda self: self.effects)
    @rule()
    def restart(self) -> None:
        """A crash: what was not committed is gone. The next process goes on in another epoch, and closes this one."""
        kept = dict(self.store.load())
        stored = kept.get(numbered(EPOCH_TABLE, 0))
        known = record() if stored is None else EpochRecord.read(stored)
        self.outbox = Outbox(self.settings, known, required=self.required)
        trimmed = kept.get(numbered(TRIMMED, 0))
        messages = [kept[key] for key in sorted(kept) if key[:1] == MESSAGE]
        ends = {int.from_bytes(k[9:], "big"): np.frombuffer(v) for k, v in kept.items() if k[:1] == ENDS}
        self.outbox.restore(None if trimmed is None else Trimmed.read(trimmed), ends, messages)
        last = -1 if trimmed is None else decode_message(Trimmed.read(trimmed).newest).last
        self.trimmed = sum(decode_message(data).last <= last for data in self.put)
        self.put, self.prefixes = self.put[: self.trimmed], self.prefixes[: self.trimmed]
        self.effects = self.effects[: self.outbox.last + 1]
        self.signatures = self.signatures[: self.effects[-1][1] if self.effects else 0]
        self.pending, self.acked, self.closed = None, {}, True
        self.ended = self.outbox.ended
        if self.effects:
            self.outbox.close((self.effects[-1][0],), self.signatures)

    @precondition(lambda self: self.put)
    @rule(data=st.data(), count=st.integers(1, 30))
    def an_answer_holds_what_was_put_and_is_asked_for(self, data: st.DataObject, count: int) -> None:
        first = data.draw(st.integers(0, self.outbox.last))
        last = data.draw(st.integers(first, self.outbox.last))
        found = self.answers(first, last, count)
        assert len(found) <= count
        kept = self.put[self.trimmed :]
        asked = [d for d in kept if decode_message(d).last >= first and decode_message(d).first <= last]
        snapshot = self.trimmed > 0 and first <= decode_message(self.put[self.trimmed - 1]).last
        assert [kind_of(d) for d in found[:1]] == ([KIND_SNAPSHOT] if snapshot else [KIND_DELTA] * bool(asked))
        assert found[int(snapshot) :] == asked[: count - snapshot]

    def answers(self, first: int, last: int, count: int) -> list[bytes]:
        request = RangeRequest(fleet="test", vehicle="v", epoch=EPOCH, first=first, last=last, count=count)
        return self.outbox.answer(request, lambda: (self.effects[-1][0],), self.signatures)

    @precondition(lambda self: self.put)
    @rule()
    def a_node_that_knows_nothing_gets_everything_that_was_put(self) -> None:
        ledger = Ledger("test")
        for data in self.answers(0, self.outbox.last, 4096):
            receipt, stream = ledger.accept(data, sender="v")
            assert receipt is Receipt.FOLDED, stream.fault
        stream = ledger.stream("v", EPOCH)
        assert stream.next == self.outbox.last_put + 1
        assert stream.prefix_digest == self.outbox.prefix_digest
        self.check_effect(ledger)

    def check_effect(self, ledger: Ledger) -> None:
        """A ledger's stream is the sum of the messages appended up to the last put."""
        stream = ledger.stream("v", EPOCH)
        total, known = self.effects[self.outbox.last_put]
        assert stream.life is not None
        assert delta_digest(stream.life.frames[0].total.delta()) == delta_digest(total)
        assert stream.life.signatures == self.signatures[:known]
        assert stream.ended == (self.ended and self.outbox.last_put == len(self.effects) - 1)
        assert (stream.life.frames[0].end_pose is not None) == stream.ended

    @invariant()
    def what_was_put_has_the_effect_of_what_was_appended(self) -> None:
        if self.put:
            ledger = Ledger("test")
            for data in self.put:
                assert ledger.accept(data)[0] is Receipt.FOLDED
            self.check_effect(ledger)

    @invariant()
    def no_more_than_the_window_is_under_way_and_no_more_than_the_limit_is_kept(self) -> None:
        assert len(self.put) - self.acknowledged <= WINDOW
        assert self.outbox.full == (len(self.put) - self.acknowledged == WINDOW)
        assert len(self.outbox._sent) == len(self.put) - self.trimmed
        unsent = len(self.outbox._unsent)
        assert self.closed or unsent <= 1 or len(self.outbox._sent) + unsent <= OUTBOX_MAX

    @invariant()
    def a_heartbeat_names_the_last_message_put_and_the_last_check_point(self) -> None:
        beat = self.outbox.heartbeat("test", "v")
        assert (beat.fleet, beat.vehicle, beat.epoch) == ("test", "v", EPOCH)
        assert beat.last == self.outbox.last_put == (decode_message(self.put[-1]).last if self.put else -1)
        assert beat.prefix_digest == (self.prefixes[-1] if self.put else EMPTY_PREFIX)
        points = [i for i, data in enumerate(self.put) if is_check_point(decode_message(data))]
        assert beat.checked == (decode_message(self.put[points[-1]]).last if points else -1)
        assert beat.checked_digest == (self.prefixes[points[-1]] if points else EMPTY_PREFIX)
        assert beat.ended == (self.ended and self.outbox.last_put == len(self.effects) - 1)

    @invariant()
    def numbers_agree(self) -> None:
        assert self.outbox.last == len(self.effects) - 1
        last = decode_message(self.put[self.acknowledged - 1]).last if self.acknowledged else -1
        assert self.outbox.last_acknowledged == last
        assert self.outbox.done == (last == self.outbox.last)


class OutboxOfRequiredNodes(OutboxMachine):
    required = ("a", "c")
    nodes = ("a", "b", "c")


class OutboxOfSeveralSteps(OutboxMachine):
    """What is put covers three steps, but for the hello, the end, and what a process before this one has left."""

    settings = PublishSettings(window=WINDOW, outbox_max=OUTBOX_MAX, every_steps=3)

    @invariant()
    def what_was_put_is_whole(self) -> None:
        for data in self.put if not self.closed else []:
            message = decode_message(data)
            assert message.end or message.hello or message.last - message.first + 1 >= 3


OutboxOfSeveralSteps.TestCase.settings = settings(settled, max_examples=30, stateful_step_count=20)
OutboxMachine.TestCase.settings = settings(settled, max_examples=30, stateful_step_count=20)
OutboxOfRequiredNodes.TestCase.settings = settings(settled, max_examples=30, stateful_step_count=20)
test_an_outbox_keeps_its_laws_under_any_sequence_of_calls = OutboxMachine.TestCase
test_an_outbox_whose_messages_cover_several_steps_keeps_its_laws = OutboxOfSeveralSteps.TestCase
test_an_outbox_that_several_nodes_must_acknowledge_keeps_its_laws = OutboxOfRequiredNodes.TestCase


def test_a_message_that_is_not_the_next_is_not_taken() -> None:
    machine = OutboxMachine()
    machine.append(FrameDelta.nothing(), 0)
    machine.commit()
    message = decode_message(machine.outbox.release()[0])
    with pytest.raises(ValueError, match="after 0"):
        machine.outbox.append(message)


def test_unsent_messages_above_the_limit_are_coalesced_and_an_ended_stream_still_gives_its_snapshot() -> None:
    """The last message, coalesced with others, is acknowledged, then asked for by a node that knows nothing."""
    machine = OutboxMachine()
    one = FrameDelta(
        variables=np.array([1]), rows=np.array([0]), cols=np.array([0]), H=np.array([3, 2, 3]), b=np.array([4, 5])
    )
    machine.append(pose_block(STRONG), 1)
    for k in range(OUTBOX_MAX - 1):
        machine.append(one, 0)
        if k == WINDOW:
            machine.commit()
            machine.release()
    machine.outbox._next_pair = len(machine.outbox._unsent) - 1  # the turn has come to the newest pair
    machine.end()
    machine.commit()
    while machine.outbox.last_put < machine.outbox.last:
        machine.release()
        machine.acknowledge_put("a", len(machine.put) - 1)
    last = decode_message(machine.put[-1])
    assert last.end
    assert last.first < last.last
    machine.a_node_that_knows_nothing_gets_everything_that_was_put()


def test_a_snapshot_of_a_vehicle_is_what_its_messages_up_to_an_acknowledged_check_point_leave_behind() -> None:
    log = drive(square(15, 5.0, 3), steps=70, seed=10)
    core = core_of("v", log.start_pose, frames="single")
    core.start(0.0, log.start)
    for each in log.readings:
        core.step(each)
    core.end()
    ledger = Ledger("test")
    points: list[int] = []
    for k, data in enumerate(put(core)):
        _, stream = ledger.accept(data)
        assert core.outbox.acknowledge("hub", k, stream.prefix_digest)
        snapshot = core.outbox.snapshot(core.filter.published, core.filter.signatures)
        assert snapshot is not None
        if stream.checked != k:
            assert snapshot.message.last == points[-1]
            continue
        points.append(k)
        parts = snapshot.message.parts
        assert stream.life is not None
        assert delta_digest(parts[0].delta) == delta_digest(stream.life.frames[0].total.delta())
        assert [s for _, s in snapshot.message.landmarks] == stream.life.signatures
        assert (snapshot.message.step, snapshot.message.time_s) == (stream.step, stream.times_s[-1])
        assert snapshot.prefix_digest == stream.prefix_digest
        request = RangeRequest(fleet="test", vehicle="v", epoch=core.identity.epoch, first=0, last=0, count=1)
        assert same(decode_snapshot(core.on_range(encode_range(request))[0]).message, snapshot.message)
    assert points == [0, 64, 71]
    assert core.done


def test_of_more_nodes_than_the_limit_only_the_first_and_the_required_are_kept_track_of() -> None:
    for required in ((), ("late",)):
        outbox = Outbox(PublishSettings(nodes_max=1), record(), required=required)
        machine = OutboxMachine()
        machine.outbox = outbox
        machine.append(pose_block(STRONG), 0)
        machine.append(FrameDelta.nothing(), 0)
        machine.commit()
        machine.release()
        outbox.acknowledge("a", 0, machine.prefixes[0])
        outbox.acknowledge("late", 1, machine.prefixes[1])
        assert outbox.last_acknowledged == (1 if required else 0)
