"""The fusion core: acknowledgements, repairs and completion, in virtual time."""

import dataclasses
import itertools

import numpy as np
import pytest

from fleet_seif.config import FilterSettings, FusionSettings, PublishSettings
from fleet_seif.envelope import KIND_DELTA, KIND_SNAPSHOT, body_digest, kind_of
from fleet_seif.messages import Action, Epoch, Heartbeat
from fleet_seif.node_wire import encode_status
from fleet_seif.records import Reading, Sightings
from fleet_seif.store import MemoryStore
from fleet_seif.streams import EMPTY_PREFIX, extend_prefix
from fleet_seif.wire import decode_ack, decode_message, decode_range, encode_heartbeat, encode_message
from fusion.core import QUERY_LOST_S, AskEvents, AskRange, Effect, FusionCore, PutAck, PutStatus
from tests.drives import put
from vehicles.core import Identity, VehicleCore

SETTINGS = FusionSettings(repair_after_s=0.1, repair_max_s=0.4, ack_every=4, ack_s=0.05)


def vehicle(name: str = "v1", window: int = 100) -> VehicleCore:
    identity = Identity(
        fleet="f", vehicle=name, epoch=Epoch(0, 7), start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3))
    )
    return VehicleCore(identity, FilterSettings(), PublishSettings(window=window), durable=True)


def seen() -> Sightings:
    return Sightings(
        z=np.array([[1.0, 0.2], [1.5, -0.4]]), cov=np.tile(1e-3 * np.eye(2), (2, 1, 1)), signature=np.array([3, 8])
    )


def messages(core: VehicleCore, steps: int, *, end: bool = True, store: MemoryStore | None = None) -> list[bytes]:
    """Everything a short drive publishes."""
    core.start(0.0, seen())
    for k in range(1, steps + 1):
        core.step(
            Reading(time_s=float(k), odometry=np.array([0.01, 0, 0]), odometry_cov=1e-4 * np.eye(3), sightings=seen())
        )
    if end:
        core.end()
    return put(core, store)


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
    bad = broken(good[1])
    fusion.on_delta("v1", good[0], 0.0)
    before = fusion.ledger.map_digest()
    fusion.on_delta("v1", bad, 0.0)
    assert fusion.complete
    assert fusion.ledger.map_digest() == before
    assert not fusion.states(0.0)[0].healthy
    assert not [e for e in fusion.tick(9.0) if isinstance(e, AskRange)]


def test_a_vehicle_is_told_why_a_node_takes_no_more_of_it(fusion: FusionCore) -> None:
    core = vehicle()
    good = messages(core, 3)
    fusion.on_delta("v1", good[0], 0.0)
    effects = fusion.on_delta("v1", broken(good[1]), 0.0) + fusion.tick(1.0)
    for effect in effects:
        if isinstance(effect, PutAck):
            assert "landmarks must be numbered" in decode_ack(effect.data).fault
            core.on_ack(effect.data)
    assert "landmarks must be numbered" in core.faults["node"]
    assert core.done
    assert fusion.states(0.0)[0].fault == fusion.ledger.stream("v1", Epoch(0, 7)).quarantine


def broken(data: bytes) -> bytes:
    """The message with a landmark number that does not follow."""
    return encode_message(dataclasses.replace(decode_message(data), landmarks=((7, 5),)))


def test_no_more_queries_are_under_way_than_the_limit_and_one_that_is_lost_gives_way() -> None:
    fusion = FusionCore("f", "node", SETTINGS.model_copy(update={"queries_max": 2}))
    for n in range(3):
        late = dataclasses.replace(decode_message(messages(vehicle(), 3)[2]), epoch=Epoch(n, 7))
        fusion.on_delta("v1", encode_message(late), 0.0)
    assert len(asks(fusion.tick(1.0))) == 2
    assert asks(fusion.tick(1.0 + QUERY_LOST_S / 2)) == []
    assert len(asks(fusion.tick(1.0 + QUERY_LOST_S))) == 2
    fusion.on_delta("v2", messages(vehicle("v2"), 3)[2], 6.0)
    assert [effect.vehicle for effect in asks(fusion.tick(7.0))] == ["v2"]  # each vehicle has queries of its own


def asks(effects: list[Effect]) -> list[AskRange]:
    return [effect for effect in effects if isinstance(effect, AskRange)]


def test_after_progress_it_asks_on_at_once() -> None:
    fusion = FusionCore("f", "node", SETTINGS.model_copy(update={"repair_batch": 2}))
    core = vehicle()
    data = messages(core, 10)
    fusion.on_delta("v1", data[9], 0.0)
    (ask,) = asks(fusion.tick(1.0))
    firsts = []
    while True:
        firsts.append(decode_range(ask.data).first)
        for reply in core.on_range(ask.data):
            fusion.on_reply("v1", reply, 1.0)
        following = asks(fusion.on_reply_done("v1", Epoch(0, 7), 1.0))
        if not following:
            break
        (ask,) = following
    assert firsts == [0, 2, 4, 6, 8]


def test_an_epoch_that_waits_for_an_earlier_one_makes_its_node_ask_for_that() -> None:
    """All that a node without memory hears is the newest epoch; the hello in it names the one before."""
    store = MemoryStore()
    first = vehicle()
    messages(first, 5, end=False, store=store)
    core = vehicle()
    core.resume(store.load())
    sent = put(core, store)
    fusion = FusionCore("f", "node", SETTINGS)
    fusion.on_delta("v1", sent[-1], 0.0)
    assert decode_message(sent[-1]).hello is not None
    asked = asks(fusion.tick(1.0) + fusion.tick(1.2))
    assert [(e.epoch, decode_range(e.data).last) for e in asked] == [(Epoch(0, 7), 5)]
    for data in sent[:-1]:
        fusion.on_delta("v1", data, 1.0)
    assert [state.cut for state in fusion.states(1.0)] == [5, 0]


# Several nodes.


def status_of(core: FusionCore, now_s: float) -> bytes:
    (put_status,) = [e for e in core.tick(now_s) if isinstance(e, PutStatus)]
    return put_status.data


def exchange(nodes: list[FusionCore], now_s: float) -> None:
    """Every node hears the status of every other, and gets what it asks nodes for."""
    told = [(node, encode_status(node.status())) for node in nodes]
    for listener in nodes:
        effects = [e for node, data in told for e in listener.on_status(node.node, data, now_s)]
        effects += listener.tick(now_s + 0.2)
        for effect in effects:
            for other in nodes:
                if other is listener:
                    continue
                if isinstance(effect, AskRange) and effect.nodes:
                    for data in other.answer_range(effect.vehicle, effect.data):
                        listener.on_reply(effect.vehicle, data, now_s)
                    listener.on_reply_done(effect.vehicle, effect.epoch, now_s)
                if isinstance(effect, AskEvents) and effect.node == other.node:
                    for data in other.answer_events():
                        listener.on_events(other.node, data)


def three_nodes() -> list[FusionCore]:
    return [FusionCore("f", name, SETTINGS) for name in ("a", "b", "c")]


def settled_state(nodes: list[FusionCore]) -> tuple[bytes, bytes, list[str]]:
    """What all nodes agree on after some rounds."""
    for round_s in range(1, 12):
        exchange(nodes, 10.0 * round_s)
    states = [
        (n.ledger.map_digest(), n.ledger.ledger_digest(), [s.quarantine for _, s in sorted(n.ledger.streams.items())])
        for n in nodes
    ]
    assert states[1:] == states[:1] * (len(nodes) - 1)
    return states[0]


def test_nodes_get_from_each_other_what_each_of_them_lacks() -> None:
    nodes, plain = three_nodes(), FusionCore("f", "plain", SETTINGS)
    for name, (node, gaps) in zip(("v1", "v2"), ((nodes[0], ()), (nodes[1], (2, 3))), strict=True):
        for k, data in enumerate(messages(vehicle(name), 6)):
            if k not in gaps:
                node.on_delta(name, data, 0.0)
            else:
                nodes[2].on_delta(name, data, 0.0)
            plain.on_delta(name, data, 0.0)
    nodes[2].on_delta("v2", messages(vehicle("v2"), 6)[0], 0.0)
    nodes[2].on_delta("v2", messages(vehicle("v2"), 6)[1], 0.0)
    map_digest, ledger_digest, _ = settled_state(nodes)
    assert map_digest == plain.ledger.map_digest()
    assert ledger_digest == plain.ledger.ledger_digest()


def test_decisions_and_evidence_reach_every_node() -> None:
    nodes = three_nodes()
    data = messages(vehicle(), 5)
    for node in nodes:
        for each in data:
            node.on_delta("v1", each, 0.0)
    before = nodes[1].ledger.map_digest()
    nodes[0].ledger.issue("op", Action.RETRACT, vehicle="v9")
    nodes[2].on_delta("v1", encode_message(dataclasses.replace(decode_message(data[3]), step=9)), 0.0)
    map_digest, _, quarantines = settled_state(nodes)
    assert quarantines == ["it contradicts itself from message 3 on"]
    assert nodes[1].ledger.events == nodes[0].ledger.events
    assert map_digest != before


def test_two_versions_of_a_message_that_reached_one_node_each_are_found_when_nodes_compare() -> None:
    nodes = three_nodes()
    data = messages(vehicle(), 5)
    other = encode_message(dataclasses.replace(decode_message(data[3]), step=9))
    for node, version in zip(nodes, (data[3], other, data[3]), strict=True):
        for k, each in enumerate(data):
            node.on_delta("v1", version if k == 3 else each, 0.0)
    assert settled_state(nodes)[2] == ["it contradicts itself from message 3 on"]


def test_two_decisions_that_took_the_same_number_on_two_nodes_come_to_one() -> None:
    nodes = three_nodes()
    nodes[0].ledger.issue("op", Action.RETRACT, vehicle="v1")
    nodes[1].ledger.issue("op", Action.RETRACT, vehicle="v2")
    settled_state(nodes)


def test_the_status_of_the_node_itself_or_of_another_fleet_or_under_another_name_is_left_alone() -> None:
    a, b, _ = three_nodes()
    a.on_delta("v1", messages(vehicle(), 1)[0], 0.0)
    data = status_of(a, 1.0)
    assert a.on_status("a", data, 1.0) == []
    assert b.on_status("c", data, 1.0) == []
    assert FusionCore("g", "b", SETTINGS).on_status("a", data, 1.0) == []
    assert b.counters["malformed"] == 1
    assert not b.ledger.streams


def test_without_an_answer_vehicle_and_nodes_are_asked_in_turn() -> None:
    a, b, _ = three_nodes()
    core = vehicle()
    data = messages(core, 5)
    for each in data:
        a.on_delta("v1", each, 0.0)
    b.on_status("a", status_of(a, 0.0), 0.0)
    b.on_heartbeat("v1", core.tick(0.0)[0], 0.0)
    asked: list[bool] = []
    for now_s in np.arange(0.2, 4.0, 0.01).tolist():
        for effect in asks(b.tick(now_s)):
            asked.append(effect.nodes)
            b.on_reply_done("v1", effect.epoch, now_s)
    assert len(asked) > 4
    assert all(x != y for x, y in itertools.pairwise(asked))


def test_a_status_is_put_again_and_again() -> None:
    core = FusionCore("f", "a", SETTINGS)
    at = [
        now_s for now_s in np.arange(0.0, 3.0, 0.05).tolist() if any(isinstance(e, PutStatus) for e in core.tick(now_s))
    ]
    assert np.diff(at) == pytest.approx([SETTINGS.status_s] * (len(at) - 1), abs=0.051)
    assert len(at) >= 5


# What one vehicle says late, again, or absurdly.


def test_an_older_heartbeat_does_not_hide_what_a_newer_one_said(fusion: FusionCore) -> None:
    core = vehicle()
    data = messages(core, 3, end=False)
    (old,) = core.tick(0.0)
    core.end()
    put(core)
    (new,) = core.tick(9.0)
    for each in data:
        fusion.on_delta("v1", each, 0.0)
    for heartbeat in (new, old):
        fusion.on_heartbeat("v1", heartbeat, 9.0)
    assert [decode_range(e.data).first for e in asks(fusion.tick(9.5))] == [4]


def test_a_vehicle_that_starts_again_after_it_was_quarantined_does_not_keep_the_fleet_from_finishing(
    fusion: FusionCore,
) -> None:
    store, core = MemoryStore(), vehicle()
    sent = messages(core, 5, end=False, store=store)
    for data in [*sent[:3], broken(sent[3])]:
        fusion.on_delta("v1", data, 0.0)
    assert fusion.complete
    core = vehicle()
    core.resume(store.load())
    core.end()
    for data in put(core, store)[-2:]:
        fusion.on_delta("v1", data, 1.0)
    first, second = fusion.states(1.0)
    assert "message 3" in first.fault
    assert second.fault == first.fault
    assert fusion.complete


def test_a_vehicle_whose_statistics_are_absurd_does_not_stop_compaction() -> None:
    """Degrees of freedom that add up to more than 2^64."""
    fusion = FusionCore("f", "node", SETTINGS)
    first, second = (decode_message(data) for data in messages(vehicle(), 1, end=False))
    prefix, checked = EMPTY_PREFIX, EMPTY_PREFIX
    for k in range(2100):
        message = dataclasses.replace(second, first=k, last=k, parts=(), landmarks=(), innovation_dof=2**53)
        data = encode_message(dataclasses.replace(first, innovation_dof=2**53) if k == 0 else message)
        fusion.on_delta("v1", data, 0.0)
        prefix = extend_prefix(prefix, body_digest(data))
        if k == 2048:
            checked = prefix
    beat = Heartbeat(
        fleet="f", vehicle="v1", epoch=Epoch(0, 7), last=2099, prefix_digest=prefix, checked=2048,
        checked_digest=checked, ended=False,
    )  # fmt: skip
    fusion.on_heartbeat("v1", encode_heartbeat(beat), 0.0)
    fusion.compact()
