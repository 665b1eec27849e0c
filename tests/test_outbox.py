"""Laws of the outbox: what was put is fixed, what is not put may get coarser, nothing is lost."""

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fleet_seif.config import PublishSettings
from fleet_seif.envelope import KIND_DELTA, KIND_SNAPSHOT, kind_of
from fleet_seif.information import FrameDelta, FrameTotal, delta_digest
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus, Hello, RangeRequest
from fleet_seif.wire import decode_message, decode_snapshot, encode_range
from fusion.ledger import Ledger, Receipt
from tests.drives import core_of, drive, square
from tests.reference import same
from tests.strategies import deltas, settled
from vehicles.outbox import Outbox

EPOCH = Epoch(3, 4)
WINDOW, OUTBOX_MAX = 5, 16
HELLO = Hello(
    software="t", life=0, placed=True, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)),
    sighting_information_max=1.0, sightings_max=9,
)  # fmt: skip


class OutboxMachine(RuleBasedStateMachine):
    """An outbox beside a list of everything that was appended, put and acknowledged."""

    def __init__(self) -> None:
        super().__init__()
        self.outbox = Outbox(PublishSettings(window=WINDOW, outbox_max=OUTBOX_MAX))
        self.total = FrameTotal()
        self.signatures: list[int] = []
        self.effects: list[tuple[bytes, int]] = []
        self.put: list[bytes] = []
        self.prefixes: list[bytes] = []
        self.acknowledged = 0
        self.ended = False

    def append(self, delta: FrameDelta, new: int) -> None:
        k, known = len(self.effects), len(self.signatures)
        self.signatures += range(50 + known, 50 + known + new)
        self.total.add(delta)
        end_pose = np.full(3, 0.5) if self.ended else None
        status = FrameStatus.ENDED if self.ended else FrameStatus.CONTINUED if k else FrameStatus.OPENED
        self.effects.append((delta_digest(self.total.delta()), len(self.signatures)))
        self.outbox.append(
            DeltaMessage(
                fleet="test", vehicle="v", epoch=EPOCH, first=k, last=k, step=k, time_s=float(k),
                parts=(FramePart(frame=0, status=status, delta=delta, end_pose=end_pose),),
                landmarks=tuple((known + i, 50 + known + i) for i in range(new)),
                hello=None if k else HELLO, end=self.ended,
            )
        )  # fmt: skip

    @precondition(lambda self: not self.ended)
    @rule(data=st.data(), count=st.integers(1, 12))
    def append_some(self, data: st.DataObject, count: int) -> None:
        for _ in range(count):
            new = data.draw(st.integers(0, 1))
            self.append(data.draw(deltas(variable_max=len(self.signatures) + new, bound=2**40)), new)

    @precondition(lambda self: self.effects and not self.ended)
    @rule()
    def end(self) -> None:
        self.ended = True
        self.append(FrameDelta.nothing(), 0)

    @rule()
    def release(self) -> None:
        for data in self.outbox.release():
            self.put.append(data)
        while len(self.prefixes) < len(self.put):
            ledger = Ledger("test", OUTBOX_MAX)
            for data in self.put[: len(self.prefixes) + 1]:
                ledger.accept(data)
            self.prefixes.append(ledger.stream("v", EPOCH).prefix_digest)

    @precondition(lambda self: self.put)
    @rule(data=st.data())
    def acknowledge(self, data: st.DataObject) -> None:
        k = data.draw(st.integers(0, len(self.put) - 1))
        assert self.outbox.acknowledge(decode_message(self.put[k]).last, self.prefixes[k])
        self.acknowledged = max(self.acknowledged, k + 1)

    @rule(beyond=st.integers(1, 3))
    def an_acknowledgement_of_what_was_never_put_is_refused(self, beyond: int) -> None:
        before = self.outbox.last_acknowledged
        assert not self.outbox.acknowledge(self.outbox.last_put + beyond, bytes(32))
        if self.acknowledged < len(self.put):
            assert not self.outbox.acknowledge(self.outbox.last_put, b"x" * 32)
        assert self.outbox.last_acknowledged == before

    @precondition(lambda self: self.put)
    @rule(data=st.data(), count=st.integers(1, 30))
    def an_answer_holds_what_was_put_and_is_asked_for(self, data: st.DataObject, count: int) -> None:
        first = data.draw(st.integers(0, self.outbox.last))
        last = data.draw(st.integers(first, self.outbox.last))
        found = self.answers(first, last, count)
        assert len(found) <= count
        kept = self.put[self.acknowledged :]
        asked = [d for d in kept if decode_message(d).last >= first and decode_message(d).first <= last]
        snapshot = self.acknowledged > 0 and first <= self.outbox.last_acknowledged
        assert [kind_of(d) for d in found[:1]] == ([KIND_SNAPSHOT] if snapshot else [KIND_DELTA] * bool(asked))
        assert found[int(snapshot) :] == asked[: count - snapshot]

    def answers(self, first: int, last: int, count: int) -> list[bytes]:
        request = RangeRequest(epoch=EPOCH, first=first, last=last, count=count)
        return self.outbox.answer(request, lambda: self.outbox.snapshot(self.total.delta(), self.signatures))

    @precondition(lambda self: self.put)
    @rule()
    def a_node_that_knows_nothing_gets_everything_that_was_put(self) -> None:
        ledger = Ledger("test", OUTBOX_MAX)
        for data in self.answers(0, self.outbox.last, 4096):
            receipt, stream = ledger.accept(data)
            assert receipt is Receipt.FOLDED, stream.fault
        stream = ledger.stream("v", EPOCH)
        assert stream.next == self.outbox.last_put + 1
        assert stream.prefix_digest == self.outbox.prefix_digest
        self.check_effect(ledger)

    def check_effect(self, ledger: Ledger) -> None:
        """A ledger's stream is the sum of the messages appended up to the last put."""
        stream = ledger.stream("v", EPOCH)
        digest, known = self.effects[self.outbox.last_put]
        assert delta_digest(stream.frames[0].total.delta()) == digest
        assert stream.signatures == self.signatures[:known]
        assert stream.ended == (self.ended and self.outbox.last_put == len(self.effects) - 1)
        assert (stream.frames[0].end_pose is not None) == stream.ended

    @invariant()
    def what_was_put_has_the_effect_of_what_was_appended(self) -> None:
        if self.put:
            ledger = Ledger("test", OUTBOX_MAX)
            for data in self.put:
                assert ledger.accept(data)[0] is Receipt.FOLDED
            self.check_effect(ledger)

    @invariant()
    def no_more_than_the_window_is_under_way_and_no_more_than_the_limit_is_kept(self) -> None:
        assert len(self.put) - self.acknowledged <= WINDOW
        assert self.outbox.full == (len(self.put) - self.acknowledged == WINDOW)
        assert len(self.outbox._sent) + len(self.outbox._unsent) <= OUTBOX_MAX

    @invariant()
    def a_heartbeat_names_the_last_message_put(self) -> None:
        beat = self.outbox.heartbeat("v", EPOCH, self.ended)
        assert beat.last == self.outbox.last_put == (decode_message(self.put[-1]).last if self.put else -1)
        assert beat.prefix_digest == (self.prefixes[-1] if self.put else bytes(32))
        assert beat.ended == (self.ended and self.outbox.last_put == len(self.effects) - 1)

    @invariant()
    def numbers_agree(self) -> None:
        assert self.outbox.last == len(self.effects) - 1
        last = decode_message(self.put[self.acknowledged - 1]).last if self.acknowledged else -1
        assert self.outbox.last_acknowledged == last


OutboxMachine.TestCase.settings = settings(settled, max_examples=30, stateful_step_count=15)
test_an_outbox_keeps_its_laws_under_any_sequence_of_calls = OutboxMachine.TestCase


def test_a_message_that_is_not_the_next_is_not_taken() -> None:
    machine = OutboxMachine()
    machine.append(FrameDelta.nothing(), 0)
    message = decode_message(machine.outbox.release()[0])
    with pytest.raises(ValueError, match="after 0"):
        machine.outbox.append(message)


def test_unsent_messages_above_the_limit_are_coalesced_and_an_ended_stream_still_gives_its_snapshot() -> None:
    """The last message, coalesced with others, is acknowledged, then asked for by a node that knows nothing."""
    machine = OutboxMachine()
    one = FrameDelta(
        variables=np.array([1]), rows=np.array([0]), cols=np.array([0]), H=np.array([1, 2, 3]), b=np.array([4, 5])
    )
    machine.append(FrameDelta.nothing(), 1)
    for k in range(OUTBOX_MAX - 1):
        machine.append(one, 0)
        if k == WINDOW:
            machine.release()
    machine.outbox._next_pair = len(machine.outbox._unsent) - 1  # the turn has come to the newest pair
    machine.end()
    while machine.outbox.last_put < machine.outbox.last:
        machine.release()
        assert machine.outbox.acknowledge(decode_message(machine.put[-1]).last, machine.prefixes[-1])
        machine.acknowledged = len(machine.put)
    last = decode_message(machine.put[-1])
    assert last.end
    assert last.first < last.last
    machine.a_node_that_knows_nothing_gets_everything_that_was_put()


def test_a_snapshot_of_a_vehicle_is_what_its_acknowledged_messages_leave_behind() -> None:
    log = drive(square(15, 5.0, 3), steps=20, seed=10)
    core = core_of("v", log.start_pose)
    core.start(0.0, log.start)
    for each in log.readings:
        core.step(each)
    core.end()
    put = core.release()
    ledger = Ledger("test", 10)
    for k, data in enumerate(put):
        _, stream = ledger.accept(data)
        assert core.outbox.acknowledge(k, stream.prefix_digest)
        snapshot = core.outbox.snapshot(core.filter.published(), core.filter.signatures)
        assert snapshot is not None
        parts = snapshot.message.parts
        assert delta_digest(parts[0].delta) == delta_digest(stream.frames[0].total.delta())
        assert [s for _, s in snapshot.message.landmarks] == stream.signatures
        assert (snapshot.message.step, snapshot.message.time_s) == (stream.step, stream.times_s[-1])
        assert snapshot.prefix_digest == stream.prefix_digest
        answer = core.on_range(encode_range(RangeRequest(epoch=core.identity.epoch, first=0, last=0, count=1)))
        assert same(decode_snapshot(answer[0]).message, snapshot.message)
    assert core.done
