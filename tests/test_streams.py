"""Prefix digests, and coalescing: one message with the effect of several."""

import dataclasses
import hashlib
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif.information import FrameDelta, delta_digest
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus
from fleet_seif.streams import EMPTY_PREFIX, Coalescer, extend_prefix
from fleet_seif.wire import decode_message, encode_message
from fusion.ledger import Ledger, Receipt, Stream
from tests import strategies
from tests.drives import streams
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
    ledger = Ledger(messages[0].fleet, parked_max=10)
    for message in messages:
        receipt, stream = ledger.accept(encode_message(message))
        assert receipt is Receipt.FOLDED, stream.fault
    return ledger, stream


def effect(messages: list[DeltaMessage]) -> object:
    """All that folding leaves behind, but for what the bytes themselves were."""
    ledger, stream = folded(messages)
    frames = {
        number: (delta_digest(frame.total.delta()), None if frame.end_pose is None else frame.end_pose.tobytes())
        for number, frame in stream.frames.items()
    }
    assert stream.hello is not None
    return (
        frames, stream.signatures, stream.next, stream.step, stream.times_s[-1], stream.healthy, stream.ended,
        stream.hello.software, ledger.map_digest(),
    )  # fmt: skip


@given(strategies.streams(), CUTS)
@settings(settled, max_examples=100)
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


def test_a_frame_that_ended_and_was_corrected_in_one_message_has_ended_there() -> None:
    first, second, third = (decode_message(data) for data in streams()["ann"][:3])
    parts = [
        FramePart(frame=0, status=status, delta=FrameDelta.nothing(), end_pose=np.full(3, float(status)))
        for status in (FrameStatus.ENDED, FrameStatus.CORRECTED)
    ]
    later = [dataclasses.replace(m, parts=(part,)) for m, part in zip((second, third), parts, strict=True)]
    (part,) = coalesced(later).parts
    assert part.status is FrameStatus.ENDED
    assert part.end_pose is parts[1].end_pose
    assert [p.status for p in coalesced([first, *later]).parts] == [FrameStatus.OPENED, FrameStatus.ENDED]


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
