"""Prefix digests, and coalescing: one message with the effect of several."""

import dataclasses
import hashlib
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif.information import FrameDelta, delta_digest
from fleet_seif.messages import Continues, DeltaMessage, Epoch, FramePart, FrameStatus
from fleet_seif.streams import (
    CHECK_EVERY,
    EMPTY_PREFIX,
    Coalescer,
    Stop,
    contradiction,
    extend_prefix,
    is_check_point,
)
from fleet_seif.wire import decode_message, encode_message
from fusion.ledger import Ledger, Receipt
from fusion.stream import Stream
from tests import strategies
from tests.drives import streams
from tests.histories import HONEST, MAIN
from tests.strategies import settled

CUTS = st.sets(st.integers(1, 30))


def coalesced(messages: list[DeltaMessage]) -> DeltaMessage:
    coalescer = Coalescer(messages[0])
    for message in messages[1:]:
        coalescer.add(message)
    return coalescer.message()


def cut(messages: list[DeltaMessage], cuts: set[int]) -> list[DeltaMessage]:
    """The messages coalesced between cuts."""
    edges = [0, *sorted(c for c in cuts if c < len(messages)), len(messages)]
    return [coalesced(messages[a:b]) for a, b in itertools.pairwise(edges)]


def folded(messages: list[DeltaMessage]) -> tuple[Ledger, Stream]:
    """A ledger that has taken the bytes of all of them."""
    ledger = Ledger(messages[0].fleet)
    for message in messages:
        receipt, stream = ledger.accept(encode_message(message))
        assert receipt is Receipt.FOLDED, stream.fault
    return ledger, stream


def end_after(last: DeltaMessage) -> DeltaMessage:
    """The last message of a stream, which says nothing else; all is checked there."""
    return dataclasses.replace(
        last, first=last.last + 1, last=last.last + 1, parts=(), landmarks=(), hello=None, end=True
    )


def effect(messages: list[DeltaMessage]) -> object:
    """All that folding leaves behind, but for what the bytes themselves were and where they were checked."""
    _, stream = folded(messages)
    checked, _ = folded(messages if messages[-1].end else [*messages, end_after(messages[-1])])
    assert stream.life is not None
    frames = {
        number: (delta_digest(frame.total.delta()), None if frame.end_pose is None else frame.end_pose.tobytes())
        for number, frame in stream.life.frames.items()
    }
    assert stream.hello is not None
    return (
        frames, stream.life.signatures, stream.next, stream.step, stream.times_s[-1], stream.healthy, stream.ended,
        stream.hello.software, checked.map_digest(),
    )  # fmt: skip


@given(strategies.streams(), CUTS)
@settled
def test_coalesced_messages_have_the_effect_of_the_messages_themselves(
    messages: list[DeltaMessage], cuts: set[int]
) -> None:
    assert effect(cut(messages, cuts)) == effect(messages)


@given(st.sampled_from(sorted(streams())), CUTS)
@settled
def test_coalesced_messages_of_a_filter_have_the_effect_of_the_messages_themselves(
    vehicle: str, cuts: set[int]
) -> None:
    messages = [decode_message(data) for data in streams()[vehicle]]
    assert effect(cut(messages, cuts)) == effect(messages)


@given(strategies.streams(), CUTS, CUTS)
@settled
def test_coalescing_what_was_coalesced_before_has_the_same_effect(
    messages: list[DeltaMessage], cuts: set[int], again: set[int]
) -> None:
    assert effect(cut(cut(messages, cuts), again)) == effect(messages)


@given(strategies.streams())
@settled
def test_statistics_add_up(messages: list[DeltaMessage]) -> None:
    whole = coalesced(messages)
    assert whole.innovation == sum(m.innovation for m in messages)
    assert whole.innovation_dof == sum(m.innovation_dof for m in messages)
    assert whole.refused == sum(m.refused for m in messages)
    assert (whole.first, whole.last) == (0, len(messages) - 1)


@given(strategies.streams())
@settled
def test_health_and_aliases_survive_coalescing(messages: list[DeltaMessage]) -> None:
    marked = [dataclasses.replace(m, aliases=((m.first, m.first, True),)) for m in messages]
    marked[-1] = dataclasses.replace(marked[-1], healthy=False)
    whole = coalesced(marked)
    assert whole.aliases == tuple((m.first, m.first, True) for m in messages)
    assert not whole.healthy


def check_points(messages: list[DeltaMessage]) -> set[int]:
    return {m.last for m in messages if is_check_point(m)}


@given(strategies.streams(), st.lists(st.integers(1, 70), min_size=6, max_size=6), CUTS)
@settled
def test_check_points_are_multiples_of_64_and_where_frames_or_the_stream_end(
    messages: list[DeltaMessage], widths: list[int], cuts: set[int]
) -> None:
    """Numbers are stretched, so that the messages cover ranges as coalesced ones do."""
    expected, first, stretched = set(), 0, []
    for message, width in zip(messages, widths, strict=False):
        last = first + width - 1
        stretched.append(dataclasses.replace(message, first=first, last=last))
        ends = any(p.status in (FrameStatus.ENDED, FrameStatus.CORRECTED) for p in message.parts)
        if message.end or ends or any(n % CHECK_EVERY == 0 for n in range(first, last + 1)):
            expected.add(last)
        first = last + 1
    assert check_points(stretched) == expected
    assert 0 in {m.first for m in stretched if is_check_point(m)}
    grouped = cut(stretched, cuts)
    held = {m.last for m in grouped}
    for point in check_points(stretched):
        assert min(n for n in held if n >= point) in check_points(grouped)


def test_a_large_correction_is_taken_alone_and_coalesced() -> None:
    """Coalesced with the end of its frame, and with another correction, it is a correction still."""
    messages = [dataclasses.replace(m) for m in HONEST["ann", MAIN][:5]]
    huge = dataclasses.replace(messages[4].parts[0], delta=strategies.pose_block(2**50))
    messages[4] = dataclasses.replace(messages[4], parts=(huge, *messages[4].parts[1:]))
    again = dataclasses.replace(
        messages[4], first=5, last=5, step=5, parts=(dataclasses.replace(huge, delta=strategies.pose_block(2**49)),)
    )
    assert effect([*messages, again]) == effect(cut([*messages, again], {2}))


def test_a_frame_that_ended_and_was_corrected_is_said_to_have_ended_and_then_to_be_corrected() -> None:
    first, second, third = (decode_message(data) for data in streams()["ann"][:3])
    parts = [
        FramePart(frame=0, status=status, delta=FrameDelta.nothing(), end_pose=np.full(3, float(status)))
        for status in (FrameStatus.ENDED, FrameStatus.CORRECTED)
    ]
    later = [dataclasses.replace(m, parts=(part,)) for m, part in zip((second, third), parts, strict=True)]
    ended, corrected = coalesced(later).parts
    assert (ended.status, corrected.status) == (FrameStatus.ENDED, FrameStatus.CORRECTED)
    assert (ended.end_pose is parts[0].end_pose, corrected.end_pose is parts[1].end_pose) == (True, True)
    assert [p.status for p in coalesced([first, *later]).parts] == [
        FrameStatus.OPENED, FrameStatus.ENDED, FrameStatus.CORRECTED
    ]  # fmt: skip


def test_corrections_come_after_everything_else_that_is_coalesced() -> None:
    main = HONEST["ann", MAIN]
    said = [(part.frame, part.status) for part in coalesced(main[1:6]).parts]
    assert said == [
        (0, FrameStatus.ENDED), (1, FrameStatus.OPENED), (1, FrameStatus.ENDED), (2, FrameStatus.OPENED),
        (0, FrameStatus.CORRECTED),
    ]  # fmt: skip


def test_only_the_next_message_of_the_same_epoch_is_taken() -> None:
    first, second, third = (decode_message(data) for data in streams()["ann"][:3])
    coalescer = Coalescer(first)
    for wrong in (first, third, dataclasses.replace(second, epoch=Epoch(2, 77))):
        with pytest.raises(ValueError, match="does not follow"):
            coalescer.add(wrong)
    coalescer.add(second)
    assert coalescer.message().last == 1


def test_a_single_message_is_left_as_it_was() -> None:
    for data in streams()["bob"]:
        assert encode_message(coalesced([decode_message(data)])) == data


def test_the_prefix_digest_is_a_chain_of_hashes_from_zeros() -> None:
    digests = [bytes([k]) * 32 for k in range(3)]
    prefix = EMPTY_PREFIX
    for digest in digests:
        expected = hashlib.blake2b(prefix + digest, digest_size=32).digest()
        prefix = extend_prefix(prefix, digest)
        assert prefix == expected
    assert bytes(32) == EMPTY_PREFIX


@given(st.lists(st.integers(0, 3), min_size=2, max_size=5).filter(lambda x: len(set(x)) > 1))
@settled
def test_the_prefix_digest_depends_on_the_order(order: list[int]) -> None:
    def chained(numbers: list[int]) -> bytes:
        prefix = EMPTY_PREFIX
        for k in numbers:
            prefix = extend_prefix(prefix, np.full(32, k, np.uint8).tobytes())
        return prefix

    assert (chained(order) == chained(order[::-1])) == (order == order[::-1])


# What contradicts what.

EPOCHS = st.sampled_from([Epoch(1, 5), Epoch(2, 6), Epoch(3, 7)])


@st.composite
def claims(draw: st.DrawFn) -> DeltaMessage:
    """A message of one of three epochs; a first one may continue another epoch."""
    epoch = draw(EPOCHS)
    first = draw(st.integers(0, 4))
    hello = None
    if first == 0:
        other = draw(EPOCHS.filter(lambda e: e != epoch))
        continues = Continues(epoch=other, last=draw(st.integers(0, 4)), prefix_digest=bytes(32))
        whole = decode_message(streams()["ann"][0]).hello
        assert whole is not None
        hello = dataclasses.replace(whole, continues=draw(st.sampled_from([None, continues])))
    message = decode_message(streams()["ann"][1])
    return dataclasses.replace(message, epoch=epoch, first=first, last=first + draw(st.integers(0, 3)), hello=hello)


@given(claims(), claims())
@settings(settled, max_examples=200)
def test_who_contradicts_whom_does_not_depend_on_the_order(a: DeltaMessage, b: DeltaMessage) -> None:
    assert contradiction(a, b) == contradiction(b, a)
    assert contradiction(a, dataclasses.replace(b, vehicle="bob")) is None


@given(claims(), claims())
@settings(settled, max_examples=200)
def test_a_contradiction_stops_an_epoch_of_one_of_the_two_at_a_number_that_one_of_them_speaks_of(
    a: DeltaMessage, b: DeltaMessage
) -> None:
    """Against a reference: the numbers of each epoch that a message says something about, as (epoch, number)."""
    stop = contradiction(a, b)
    if a.epoch == b.epoch:
        both = set(range(a.first, a.last + 1)) & set(range(b.first, b.last + 1))
        expected = Stop("ann", a.epoch, min(a.first, b.first)) if both else None
        assert stop == expected
        return
    of = {m.epoch: None if m.hello is None else m.hello.continues for m in (a, b)}
    if stop is None:
        continued = [c.epoch for c in of.values() if c is not None]
        assert len(set(continued)) == len(continued)
        for m, other in ((a, b), (b, a)):
            c = of[other.epoch]
            assert c is None or c.epoch != m.epoch or m.last <= c.last
    else:
        limits = [c.last + 1 for c in of.values() if c is not None and c.epoch == stop.epoch]
        assert limits
        assert stop.sequence <= min(limits)
