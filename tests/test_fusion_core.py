"""The fusion core: acknowledgements, repairs and completion, in virtual time."""

import dataclasses

import numpy as np
import pytest

from fleet_seif.config import FilterSettings, FusionSettings, PublishSettings
from fleet_seif.envelope import KIND_DELTA, KIND_SNAPSHOT, kind_of
from fleet_seif.messages import Epoch
from fleet_seif.records import Reading, Sightings
from fleet_seif.wire import decode_ack, decode_message, decode_range, encode_message
from fusion.core import AskRange, FusionCore, PutAck
from tests.drives import put
from vehicles.core import Identity, VehicleCore

SETTINGS = FusionSettings(repair_after_s=0.1, repair_max_s=0.4, ack_every=4, ack_s=0.05)


def vehicle(name: str = "v1", window: int = 100) -> VehicleCore:
    identity = Identity(
        fleet="f", vehicle=name, epoch=Epoch(0, 7), start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3))
    )
    return VehicleCore(identity, FilterSettings(), PublishSettings(window=window))


def seen() -> Sightings:
    return Sightings(
        z=np.array([[1.0, 0.2], [1.5, -0.4]]), cov=np.tile(1e-3 * np.eye(2), (2, 1, 1)), signature=np.array([3, 8])
    )


def messages(core: VehicleCore, steps: int, *, end: bool = True) -> list[bytes]:
    """Everything a short drive publishes."""
    core.start(0.0, seen())
    for k in range(1, steps + 1):
        core.step(
            Reading(time_s=float(k), odometry=np.array([0.01, 0, 0]), odometry_cov=1e-4 * np.eye(3), sightings=seen())
        )
    if end:
        core.end()
    return put(core)


@pytest.fixture
def fusion() -> FusionCore:
    return FusionCore("f", "node", SETTINGS, expected=1)


def test_messages_in_order_are_acknowledged_in_batches(fusion: FusionCore) -> None:
    effects = [e for data in messages(vehicle(), 8) for e in fusion.on_delta("v1", data, 0.0)]
    acks = [decode_ack(e.data) for e in effects if isinstance(e, PutAck)]
    assert [ack.last for ack in acks] == [3, 7]
    late = [decode_ack(e.data).last for e in fusion.tick(0.06) if isinstance(e, PutAck)]
    assert late == [9]
    assert fusion.complete


def test_a_gap_is_asked_for_after_a_while_and_only_once_at_a_time(fusion: FusionCore) -> None:
    data = messages(vehicle(), 5)
    for k in (0, 1, 4, 5):
        assert not [e for e in fusion.on_delta("v1", data[k], 1.0) if isinstance(e, AskRange)]
    asks = [e for now_s in (1.05, 1.11, 1.2) for e in fusion.tick(now_s) if isinstance(e, AskRange)]
    assert len(asks) == 1
    request = decode_range(asks[0].data)
    assert (request.first, request.last) == (2, 3)


def test_a_repaired_gap_folds_what_was_parked(fusion: FusionCore) -> None:
    core = vehicle()
    data = messages(core, 5)
    for k in (0, 1, 4, 5, 6):
        fusion.on_delta("v1", data[k], 1.0)
    (ask,) = [e for e in fusion.tick(1.2) if isinstance(e, AskRange)]
    for reply in core.on_range(ask.data):
        fusion.on_reply("v1", reply, 1.3)
    fusion.on_reply_done("v1", Epoch(0, 7), 1.3)
    (state,) = fusion.states(1.3)
    assert (state.cut, state.parked, state.behind, state.gaps_repaired) == (6, 0, 0, 2)
    assert fusion.complete


def test_queries_without_an_answer_back_off_up_to_the_limit(fusion: FusionCore) -> None:
    data = messages(vehicle(), 3)
    fusion.on_delta("v1", data[2], 0.0)
    asked: list[float] = []
    for now_s in np.arange(0.0, 4.0, 0.01).tolist():
        for effect in fusion.tick(now_s):
            if isinstance(effect, AskRange):
                asked.append(now_s)
                fusion.on_reply_done("v1", effect.epoch, now_s)
    waits = np.diff(asked)
    assert np.all(np.diff(waits) > -0.02)
    assert waits[-1] == pytest.approx(0.4, abs=0.02)


def test_a_heartbeat_reveals_that_the_last_messages_were_lost(fusion: FusionCore) -> None:
    core = vehicle()
    data = messages(core, 3)
    fusion.on_delta("v1", data[0], 0.0)
    (heartbeat,) = core.tick(0.0)
    fusion.on_heartbeat("v1", heartbeat, 0.5)
    assert [decode_range(e.data).first for e in fusion.tick(0.7) if isinstance(e, AskRange)] == [1]


def test_a_heartbeat_shows_when_a_stream_is_not_what_its_vehicle_sent(fusion: FusionCore) -> None:
    core, other = vehicle(), vehicle()
    for data in messages(core, 3):
        fusion.on_delta("v1", data, 0.0)
    other.start(0.0, Sightings.none())
    for k in range(1, 4):
        other.step(Reading(time_s=float(k), odometry=np.zeros(3), odometry_cov=np.eye(3), sightings=Sightings.none()))
    other.end()
    put(other)
    for each, forks in ((core, 0), (other, 1)):
        (heartbeat,) = each.tick(9.0)
        fusion.on_heartbeat("v1", heartbeat, 9.0)
        assert fusion.counters["forks"] == forks


def test_a_heartbeat_repeats_an_acknowledgement_that_was_lost(fusion: FusionCore) -> None:
    core = vehicle()
    for data in messages(core, 3):
        fusion.on_delta("v1", data, 0.0)
    fusion.tick(1.0)
    (heartbeat,) = core.tick(2.0)
    (ack,) = [e for e in fusion.on_heartbeat("v1", heartbeat, 2.0) if isinstance(e, PutAck)]
    core.on_ack(ack.data)
    assert core.done


def test_a_node_that_lost_its_memory_catches_up_from_a_snapshot() -> None:
    first, core = FusionCore("f", "node", SETTINGS, expected=1), vehicle()
    data = messages(core, 70, end=False)
    for message in data:
        first.on_delta("v1", message, 0.0)
    core.on_ack(first.ack_now(first.ledger.stream("v1", Epoch(0, 7))).data)
    core.end()
    tail = put(core)
    second = FusionCore("f", "node", SETTINGS, expected=1)
    for message in tail:
        first.on_delta("v1", message, 1.0)
        second.on_delta("v1", message, 1.0)
    (ask,) = [e for e in second.tick(2.0) if isinstance(e, AskRange)]
    replies = core.on_range(ask.data)
    assert [kind_of(data) for data in replies[:2]] == [KIND_SNAPSHOT, KIND_DELTA]
    for reply in replies:
        second.on_reply("v1", reply, 2.0)
    assert second.complete
    assert second.ledger.map_digest() == first.ledger.map_digest()
    assert second.ledger.ledger_digest() == first.ledger.ledger_digest()


def test_bytes_that_are_not_ours_are_counted_and_change_nothing(fusion: FusionCore) -> None:
    data = messages(vehicle(), 2)
    fusion.on_delta("v1", data[0], 0.0)
    before = fusion.ledger.ledger_digest()
    assert fusion.on_delta("v1", b"nonsense", 0.0) == []
    assert fusion.on_heartbeat("v1", b"nonsense", 0.0) == []
    assert fusion.on_delta("v2", data[1], 0.0) == []
    assert fusion.ledger.ledger_digest() == before
    assert fusion.counters["malformed"] == 3


def test_a_silent_vehicle_counts_as_stalled_until_it_speaks_again(fusion: FusionCore) -> None:
    core = vehicle()
    data = messages(core, 3, end=False)
    fusion.on_delta("v1", data[0], 0.0)
    assert [state.stalled for now_s in (2.0, 3.5) for state in fusion.states(now_s)] == [False, True]
    fusion.on_delta("v1", data[1], 3.6)
    assert not fusion.states(3.7)[0].stalled


def test_a_vehicle_that_can_go_no_further_does_not_keep_the_fleet_from_finishing() -> None:
    """A message that skips a landmark number is refused: the stream stays at its prefix and the run can end."""
    fusion = FusionCore("f", "node", SETTINGS, expected=1)
    good = messages(vehicle(), 3)
    bad = encode_message(dataclasses.replace(decode_message(good[1]), landmarks=((7, 5),)))
    fusion.on_delta("v1", good[0], 0.0)
    before = fusion.ledger.map_digest()
    fusion.on_delta("v1", bad, 0.0)
    assert fusion.complete
    assert fusion.ledger.map_digest() == before
    assert not fusion.states(0.0)[0].healthy
    assert not [e for e in fusion.tick(9.0) if isinstance(e, AskRange)]
