"""Laws of the ledger: whatever the network does, what is folded is a prefix of each stream, exactly once."""

import dataclasses
from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.errors import WireError
from fleet_seif.information import QUANTA_MAX, FrameDelta, delta_digest
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus, Snapshot
from fleet_seif.records import Sightings
from fleet_seif.streams import Coalescer
from fleet_seif.wire import decode_message, encode_message, encode_snapshot
from fusion.ledger import Ledger, Receipt, Stream
from tests import reference, strategies
from tests.drives import FLEET, VEHICLES, core_of, streams
from tests.strategies import settled
from vehicles.core import Identity, VehicleCore

EPOCH = Epoch(1, 77)
ALL = [(vehicle, k) for vehicle in VEHICLES for k in range(len(streams()[vehicle]))]
ARRIVALS = st.lists(st.sampled_from(ALL), max_size=60)
"""What arrives, with gaps, duplicates and in any order."""
SHUFFLED = st.permutations(ALL)


def message(vehicle: str, k: int) -> DeltaMessage:
    return decode_message(streams()[vehicle][k])


def fed(arrivals: Sequence[tuple[str, int]], parked_max: int = 1000) -> Ledger:
    ledger = Ledger(FLEET, parked_max)
    for vehicle, k in arrivals:
        ledger.accept(streams()[vehicle][k], sender=vehicle)
    return ledger


@cache
def in_order() -> Ledger:
    return fed(ALL)


@cache
def prefix_totals(vehicle: str) -> list[bytes]:
    """Digest of the sum of the first n deltas, for each n, by a ledger that sees nothing else."""
    ledger, digests = Ledger(FLEET, 1), []
    for data in streams()[vehicle]:
        _, stream = ledger.accept(data)
        digests.append(total(stream))
    return digests


def total(stream: Stream) -> bytes:
    return delta_digest(stream.frames[0].total.delta())


def prefix(seen: set[int]) -> int:
    """How many of 0, 1, 2 ... are there."""
    n = 0
    while n in seen:
        n += 1
    return n


def check_prefixes(ledger: Ledger, arrived: dict[str, set[int]]) -> None:
    for (vehicle, _), stream in ledger.streams.items():
        n = prefix(arrived[vehicle])
        assert stream.next == n
        assert set(stream.parked) == {k for k in arrived[vehicle] if k > n}
        assert stream.log == list(streams()[vehicle][:n])
        if n:
            assert total(stream) == prefix_totals(vehicle)[n - 1]


# Order, duplication, loss.


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_a_total_is_the_sum_of_the_deltas_of_the_prefix(vehicle: str) -> None:
    stream = in_order().stream(vehicle, EPOCH)
    deltas = [part.delta for k in range(stream.next) for part in message(vehicle, k).parts]
    H, b = reference.blocks_of(stream.frames[0].total.delta())
    expected_H, expected_b = reference.summed(deltas)
    assert H.keys() == expected_H.keys()
    assert all(np.array_equal(H[place], expected_H[place]) for place in H)
    assert all(np.array_equal(vector, expected_b[v]) for v, vector in b.items())


@given(ARRIVALS, SHUFFLED)
@settings(settled, max_examples=100)
def test_any_order_with_duplicates_and_losses_made_good_gives_the_same_digests(
    arrivals: list[tuple[str, int]], repair: list[tuple[str, int]]
) -> None:
    ledger = fed([*arrivals, *repair])
    assert ledger.map_digest() == in_order().map_digest()
    assert ledger.ledger_digest() == in_order().ledger_digest()
    assert [s.fault for s in ledger.streams.values()] == [None] * len(VEHICLES)


@given(ARRIVALS)
@settled
def test_at_every_moment_exactly_the_contiguous_prefix_is_folded(arrivals: list[tuple[str, int]]) -> None:
    ledger = Ledger(FLEET, parked_max=1000)
    arrived: dict[str, set[int]] = {vehicle: set() for vehicle in VEHICLES}
    for vehicle, k in arrivals:
        before = prefix(arrived[vehicle])
        receipt, _ = ledger.accept(streams()[vehicle][k], sender=vehicle)
        if k in arrived[vehicle]:
            assert receipt is Receipt.DUPLICATE
        else:
            assert receipt is (Receipt.FOLDED if k == before else Receipt.PARKED)
        arrived[vehicle].add(k)
        check_prefixes(ledger, arrived)


@given(ARRIVALS)
@settled
def test_equal_prefixes_have_equal_digests_whatever_else_arrived(arrivals: list[tuple[str, int]]) -> None:
    ledger = fed(arrivals)
    plain = fed([(vehicle, k) for (vehicle, _), s in ledger.streams.items() for k in range(s.next)])
    assert ledger.map_digest() == plain.map_digest()
    assert ledger.ledger_digest() == plain.ledger_digest()


@given(ARRIVALS, st.integers(1, 3))
@settled
def test_no_more_is_parked_than_the_limit_and_what_was_dropped_can_come_again(
    arrivals: list[tuple[str, int]], parked_max: int
) -> None:
    ledger = Ledger(FLEET, parked_max)
    for vehicle, k in arrivals:
        ledger.accept(streams()[vehicle][k])
        assert all(len(stream.parked) <= parked_max for stream in ledger.streams.values())
    for vehicle, k in ALL:
        ledger.accept(streams()[vehicle][k])
    assert ledger.map_digest() == in_order().map_digest()
    assert ledger.ledger_digest() == in_order().ledger_digest()


def test_a_message_beyond_the_parking_limit_is_refused_and_counted() -> None:
    ledger = fed([("ann", 0), ("ann", 3), ("ann", 4)], parked_max=2)
    receipt, stream = ledger.accept(streams()["ann"][5])
    assert receipt is Receipt.REFUSED
    assert stream.refused == 1
    assert ledger.accept(streams()["ann"][3])[0] is Receipt.DUPLICATE
    assert (stream.next, sorted(stream.parked)) == (1, [3, 4])


def test_duplicates_are_counted_and_change_nothing() -> None:
    ledger = fed(ALL)
    for vehicle, k in ALL:
        assert ledger.accept(streams()[vehicle][k])[0] is Receipt.DUPLICATE
    assert [s.duplicates for s in ledger.streams.values()] == [len(streams()[v]) for v in VEHICLES]
    assert ledger.map_digest() == in_order().map_digest()


@given(strategies.streams(), st.data())
@settled
def test_streams_of_many_frames_do_not_depend_on_order_either(
    messages: list[DeltaMessage], data: st.DataObject
) -> None:
    straight, mixed = Ledger(FLEET, 100), Ledger(FLEET, 100)
    for each in messages:
        assert straight.accept(encode_message(each))[0] is Receipt.FOLDED
    for each in data.draw(st.permutations([*messages, *messages])):
        mixed.accept(encode_message(each))
    assert mixed.map_digest() == straight.map_digest()
    assert mixed.ledger_digest() == straight.ledger_digest()
    ends = [
        {f: frame.end_pose for f, frame in ledger.stream("v", Epoch(1, 5)).frames.items()}
        for ledger in (straight, mixed)
    ]
    np.testing.assert_equal(ends[0], ends[1])


# What the digests say.


def test_the_map_digest_does_not_depend_on_the_nonce_of_an_epoch() -> None:
    ledger = Ledger(FLEET, 10)
    for vehicle, k in ALL:
        ledger.accept(encode_message(dataclasses.replace(message(vehicle, k), epoch=Epoch(1, 78))))
    assert ledger.map_digest() == in_order().map_digest()
    assert ledger.ledger_digest() != in_order().ledger_digest()


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_digests_change_with_every_message_that_says_something(vehicle: str) -> None:
    ledger, seen = fed([(v, k) for v, k in ALL if v != vehicle]), set()
    for data in streams()[vehicle][:-1]:
        ledger.accept(data)
        seen.add((ledger.map_digest(), ledger.ledger_digest()))
    assert len({m for m, _ in seen}) == len({d for _, d in seen}) == len(streams()[vehicle]) - 1


def test_a_stream_of_which_nothing_is_folded_leaves_the_digests_alone() -> None:
    ledger = fed(ALL)
    ledger.stream("dee", EPOCH)
    assert ledger.map_digest() == in_order().map_digest()
    assert ledger.ledger_digest() == in_order().ledger_digest()


def test_a_vehicle_that_says_it_is_not_healthy_is_not_in_the_map() -> None:
    ledger = fed([(v, k) for v, k in ALL if v != "bob"])
    without = ledger.map_digest()
    for k in range(3):
        ledger.accept(encode_message(dataclasses.replace(message("bob", k), healthy=False)))
    assert ledger.map_digest() == without
    assert [s.vehicle for s in ledger.placed()] == ["ann", "cem"]


# Messages that are refused.


@pytest.mark.parametrize("sender", [None, "ann"])
def test_a_message_of_another_fleet_is_refused_and_leaves_nothing(sender: str | None) -> None:
    ledger = Ledger(FLEET, 10)
    with pytest.raises(WireError, match="fleet"):
        ledger.accept(encode_message(dataclasses.replace(message("ann", 0), fleet="other")), sender)
    assert not ledger.streams


@pytest.mark.parametrize("snapshot", [False, True])
def test_a_message_under_the_key_of_another_vehicle_is_refused_and_leaves_nothing(snapshot: bool) -> None:
    ledger = Ledger(FLEET, 10)
    data = encode_snapshot(Snapshot(message=message("ann", 0), prefix_digest=bytes(32)))
    with pytest.raises(WireError, match="key of 'bob'"):
        ledger.accept(data if snapshot else streams()["ann"][0], sender="bob")
    assert not ledger.streams


def altered(vehicle: str, k: int) -> bytes:
    return encode_message(dataclasses.replace(message(vehicle, k), innovation=message(vehicle, k).innovation + 1.0))


@given(st.integers(0, 11), st.integers(1, 12))
@settled
def test_a_second_body_for_a_number_is_refused_and_counted_and_the_first_stays(k: int, folded: int) -> None:
    ledger = fed([("ann", i) for i in range(folded)])
    ledger.accept(streams()["ann"][k])
    before = ledger.map_digest(), ledger.ledger_digest()
    receipt, stream = ledger.accept(altered("ann", k))
    assert receipt is Receipt.REFUSED
    assert stream.refused == 1
    assert (ledger.map_digest(), ledger.ledger_digest()) == before
    for data in streams()["ann"]:
        ledger.accept(data)
    assert ledger.stream("ann", EPOCH).next == len(streams()["ann"])
    assert total(ledger.stream("ann", EPOCH)) == prefix_totals("ann")[-1]


def coalesced(vehicle: str, first: int, last: int) -> bytes:
    coalescer = Coalescer(message(vehicle, first))
    for k in range(first + 1, last + 1):
        coalescer.add(message(vehicle, k))
    return encode_message(coalescer.message())


@given(st.integers(0, 10), st.integers(0, 10), st.integers(1, 11))
@settled
def test_a_range_that_overlaps_what_was_folded_is_refused(a: int, b: int, folded: int) -> None:
    first, last = min(a, b), max(a, b) + 1
    ledger = fed([("ann", i) for i in range(folded)])
    before = ledger.map_digest()
    receipt, _ = ledger.accept(coalesced("ann", first, last))
    expected = Receipt.REFUSED if first < folded else Receipt.FOLDED if first == folded else Receipt.PARKED
    assert receipt is expected
    assert (ledger.map_digest() == before) == (receipt is not Receipt.FOLDED)


def test_parked_ranges_that_overlap_do_not_count_anything_twice() -> None:
    ledger = fed([("ann", 0)])
    ledger.accept(coalesced("ann", 2, 5))
    ledger.accept(streams()["ann"][3])
    ledger.accept(streams()["ann"][6])
    _, stream = ledger.accept(streams()["ann"][1])
    assert stream.next == 7
    assert not stream.parked
    assert stream.refused == 1
    assert total(stream) == prefix_totals("ann")[6]


# Streams that break.


def one_block(variable: int, value: int) -> FrameDelta:
    return FrameDelta(
        variables=np.array([variable]), rows=np.array([0]), cols=np.array([0]),
        H=np.array([value, 0, 0]), b=np.array([0, 0]),
    )  # fmt: skip


def part(frame: int, status: FrameStatus, delta: FrameDelta) -> FramePart:
    ends = status in (FrameStatus.ENDED, FrameStatus.CORRECTED)
    return FramePart(frame=frame, status=status, delta=delta, end_pose=np.zeros(3) if ends else None)


NOTHING = FrameDelta.nothing()
BIG = QUANTA_MAX - 1
CONTINUED, OPENED, ENDED, CORRECTED = (
    FrameStatus.CONTINUED, FrameStatus.OPENED, FrameStatus.ENDED, FrameStatus.CORRECTED,
)  # fmt: skip
BROKEN: dict[str, dict[str, object]] = {
    "a landmark number is skipped": {"landmarks": ((9_000, 1),)},
    "a landmark number comes again": {"landmarks": ((0, 1),)},
    "a delta is about a landmark without a name": {"parts": (part(0, CONTINUED, one_block(9_000, 1)),)},
    "a frame goes on that never opened": {"parts": (part(1, CONTINUED, NOTHING),)},
    "a frame ends that never opened": {"parts": (part(1, ENDED, NOTHING),)},
    "a frame is corrected that never opened": {"parts": (part(1, CORRECTED, NOTHING),)},
    "a frame opens twice": {"parts": (part(0, OPENED, NOTHING),)},
    "a sum overflows": {"parts": tuple(part(0, CONTINUED, one_block(1, BIG)) for _ in range(2))},
    "a sum of a new frame overflows": {
        "parts": (part(1, OPENED, one_block(1, BIG)), part(1, CONTINUED, one_block(1, BIG)))
    },
}


@pytest.mark.parametrize("fields", BROKEN.values(), ids=BROKEN.keys())
@pytest.mark.parametrize("early", [False, True])
def test_a_broken_stream_stays_at_its_prefix_with_a_fault_and_others_go_on(
    fields: dict[str, object], early: bool
) -> None:
    """The broken message is number 5, folded at once or from where it was parked."""
    good = [("ann", k) for k in range(5)]
    bad = encode_message(dataclasses.replace(message("ann", 5), **fields))  # type: ignore[arg-type]
    ledger = fed([("bob", 0), *([("ann", 6)] if early else []), *good[: 3 if early else 5]])
    receipt, stream = ledger.accept(bad)
    assert receipt is (Receipt.PARKED if early else Receipt.REFUSED)
    for vehicle, k in good[3:] if early else []:
        ledger.accept(streams()[vehicle][k])
    assert stream.fault is not None
    assert stream.refused == 1
    assert ledger.map_digest() == fed([("bob", 0), *good]).map_digest()
    for data in streams()["ann"][5:]:
        assert ledger.accept(data)[0] is Receipt.REFUSED
    for k in range(1, 5):
        assert ledger.accept(streams()["bob"][k])[0] is Receipt.FOLDED
    assert ledger.map_digest() == fed([("bob", k) for k in range(5)] + good).map_digest()


def test_nothing_follows_the_end_of_a_stream() -> None:
    ledger = fed(ALL)
    after = len(streams()["ann"])
    more = dataclasses.replace(message("ann", 1), first=after, last=after)
    receipt, stream = ledger.accept(encode_message(more))
    assert receipt is Receipt.REFUSED
    assert stream.ended
    assert ledger.map_digest() == in_order().map_digest()


# Snapshots.


def snapshot(vehicle: str, n: int) -> bytes:
    """Messages 0 .. n of a vehicle as one, with the digest of that prefix."""
    stream = fed([(vehicle, k) for k in range(n + 1)]).stream(vehicle, EPOCH)
    body = decode_message(coalesced(vehicle, 0, n))
    return encode_snapshot(Snapshot(message=body, prefix_digest=stream.prefix_digest))


@given(st.integers(0, 13), st.sets(st.integers(0, 13)))
@settled
def test_a_snapshot_replaces_a_shorter_prefix_and_leaves_a_longer_one(n: int, before: set[int]) -> None:
    ledger = fed([("ann", k) for k in sorted(before)])
    held = prefix(before)
    receipt, stream = ledger.accept(snapshot("ann", n), sender="ann")
    assert receipt is (Receipt.DUPLICATE if held > n else Receipt.FOLDED)
    reached = prefix(before | set(range(n + 1)))
    assert stream.next == reached
    assert total(stream) == prefix_totals("ann")[reached - 1]
    same = fed([("ann", k) for k in range(reached)])
    assert ledger.map_digest() == same.map_digest()
    assert ledger.ledger_digest() == same.ledger_digest()
    assert set(stream.parked) == {k for k in before if k > reached}


@given(ARRIVALS, st.lists(st.tuples(st.sampled_from(VEHICLES), st.integers(0, 13)), max_size=3), st.data())
@settled
def test_snapshots_among_messages_in_any_order_give_the_same_digests(
    arrivals: list[tuple[str, int]], snapshots: list[tuple[str, int]], data: st.DataObject
) -> None:
    pieces = [streams()[v][k] for v, k in arrivals] + [snapshot(v, n) for v, n in snapshots]
    ledger = Ledger(FLEET, 1000)
    for piece in [*data.draw(st.permutations(pieces)), *(streams()[v][k] for v, k in ALL)]:
        ledger.accept(piece)
    assert ledger.map_digest() == in_order().map_digest()
    assert ledger.ledger_digest() == in_order().ledger_digest()
    assert sum(s.refused for s in ledger.streams.values()) == 0


def test_messages_that_a_snapshot_covers_are_duplicates() -> None:
    ledger = Ledger(FLEET, 10)
    ledger.accept(snapshot("ann", 6))
    assert [ledger.accept(data)[0] for data in streams()["ann"][:7]] == [Receipt.DUPLICATE] * 7
    assert ledger.accept(streams()["ann"][7])[0] is Receipt.FOLDED


def test_a_snapshot_that_cannot_be_folded_leaves_the_stream_as_it_was() -> None:
    ledger = fed([("ann", k) for k in range(4)])
    before = ledger.map_digest(), ledger.ledger_digest()
    body = dataclasses.replace(decode_message(coalesced("ann", 0, 8)), landmarks=((5, 5),))
    receipt, stream = ledger.accept(encode_snapshot(Snapshot(message=body, prefix_digest=bytes(32))))
    assert receipt is Receipt.REFUSED
    assert stream.refused == 1
    assert (ledger.map_digest(), ledger.ledger_digest()) == before
    assert ledger.accept(streams()["ann"][4])[0] is Receipt.FOLDED


def test_a_folded_message_is_found_by_any_sequence_number_it_covers() -> None:
    ledger = fed([("ann", 0)])
    whole = coalesced("ann", 1, 4)
    _, stream = ledger.accept(whole)
    ledger.accept(streams()["ann"][5])
    assert stream.bytes_at(0) == streams()["ann"][0]
    assert [stream.bytes_at(k) for k in range(1, 5)] == [whole] * 4
    assert stream.bytes_at(5) == streams()["ann"][5]


def test_every_run_of_a_vehicle_starts_a_stream_of_its_own() -> None:
    ledger = fed([("ann", k) for k in range(3)])
    core = core_of("ann", np.zeros(3))
    core.identity = dataclasses.replace(core.identity, epoch=Epoch(2, 9), life=1)
    core.start(0.0, Sightings.none())
    ledger.accept(core.release()[0])
    assert [(s.vehicle, s.life) for s in ledger.placed()] == [("ann", 0), ("ann", 1)]


def test_a_vehicle_that_starts_again_without_its_outbox_is_kept_but_not_placed() -> None:
    """Its new epoch is of the same life; placing both would count its start twice."""
    ledger = Ledger("fleet", 10)
    first, again = (streams_of_epoch(Epoch(counter, 5)) for counter in (1, 2))
    for data in first:
        ledger.accept(data)
    before = ledger.map_digest()
    for data in again:
        ledger.accept(data)
    assert [stream.epoch.counter for stream in ledger.placed()] == [1]
    assert len(ledger.streams) == 2
    assert ledger.map_digest() == before


def test_the_number_of_epochs_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.ledger.STREAMS_MAX", 1)
    ledger = Ledger("fleet", 10)
    ledger.accept(streams_of_epoch(Epoch(1, 5))[0])
    with pytest.raises(WireError, match="no more are taken"):
        ledger.accept(streams_of_epoch(Epoch(2, 5))[0])


def streams_of_epoch(epoch: Epoch) -> list[bytes]:
    """A short stream of vehicle v in fleet "fleet"."""
    identity = Identity(
        fleet="fleet", vehicle="v", epoch=epoch, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3))
    )
    core = VehicleCore(identity, FilterSettings(), PublishSettings())
    seen = Sightings(z=np.array([[1.0, 0.2]]), cov=np.array([1e-3 * np.eye(2)]), signature=np.array([3]))
    core.start(0.0, seen)
    core.end()
    return core.release()
