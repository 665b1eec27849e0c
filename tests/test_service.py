"""The fusion service on real Zenoh: bursts, silence, and vehicles that would spoil the map of all."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from fleet_seif.bus import OnPut, OnQuery, Priority, open_bus
from fleet_seif.config import FilterSettings, FusionSettings, PublishSettings
from fleet_seif.keys import Keys
from fleet_seif.messages import Epoch
from fleet_seif.records import Sightings
from fleet_seif.store import Change, MemoryStore, Put, StoreError
from fleet_seif.wire import decode_ack, decode_message, encode_message
from fusion import records
from fusion.core import Effect, FusionCore
from fusion.mapping import make_map, map_input
from fusion.service import FusionService, restore
from tests.conftest import Network
from tests.drives import core_of, put, reading, sighting
from vehicles.core import Identity, VehicleCore

SETTINGS = FusionSettings(map_s=0.02, stalled_s=0.2)


def stream(name: str) -> list[bytes]:
    identity = Identity(
        fleet="f", vehicle=name, epoch=Epoch(0, 1), start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3))
    )
    core = VehicleCore(identity, FilterSettings(), PublishSettings())
    core.start(0.0, Sightings(z=np.array([[1.0, 0.2]]), cov=np.array([1e-3 * np.eye(2)]), signature=np.array([3])))
    core.end()
    return put(core)


def test_every_event_of_a_burst_is_handled_once_and_in_order(network: Network) -> None:
    service = FusionService(network.bus, FusionCore("f", "node", SETTINGS), SETTINGS)
    handled: list[tuple[str, bytes]] = []

    def handle(name: str, data: bytes, now_s: float) -> list[Effect]:
        handled.append((name, data))
        return []

    put_event = service._post(handle, lambda key: key)
    burst = [bytes([i // 250, i % 250]) for i in range(1000)]
    for data in burst:
        put_event("v1", data)
    for _ in range(10):
        service._work()
    assert handled == [("v1", data) for data in burst]
    assert service.dropped == 0


def test_a_vehicle_that_falls_silent_is_shown_stalled_without_any_news(network: Network) -> None:
    service = FusionService(network.bus, FusionCore("f", "node", SETTINGS), SETTINGS)
    stalled = threading.Event()
    worker = threading.Thread(target=service.run)
    worker.start()
    with open_bus(connect=[network.endpoint]) as client:
        client.put(Keys("f").deltas("v1"), stream("v1")[0])
        for _ in range(500):
            if any(state.stalled for state in service.newest.vehicles):
                stalled.set()
                break
            stalled.wait(0.02)
    service.stop()
    worker.join()
    assert stalled.is_set()


def negated(data: bytes) -> bytes:
    """The message with the negative of its information."""
    message = decode_message(data)
    parts = tuple(replace(p, delta=replace(p.delta, H=-p.delta.H)) for p in message.parts)
    return encode_message(replace(message, parts=parts))


def test_a_vehicle_whose_information_is_indefinite_is_left_out_and_the_others_are_mapped() -> None:
    core = FusionCore("f", "node", SETTINGS, expected=2)
    for data in stream("good"):
        core.on_delta("good", data, 0.0)
    core.on_delta("bad", negated(stream("bad")[0]), 0.0)
    for final in (False, True):
        joint = make_map(map_input(core, 0.0), 0, final=final)
        assert (joint.poses, joint.canonical, joint.final) == (("good",), True, final)
        assert ["positive definite" in state.fault for state in joint.vehicles] == [True, False]
    assert core.complete


def longer(name: str) -> list[bytes]:
    """A stream of a few steps; only the first and the last message are check points."""
    core = core_of(name, np.zeros(3), fleet="f")
    core.start(0.0, sighting((1.0, 0.2), 3))
    for k in range(1, 5):
        core.step(reading(float(k), sighting((1.0, 0.2), 3), (0.0, 0.0, 0.0)))
    core.end()
    return put(core)


def test_a_live_map_holds_all_that_is_folded_and_the_final_one_what_has_been_checked() -> None:
    core = FusionCore("f", "node", SETTINGS)
    maps = []
    for data in longer("v1"):
        core.on_delta("v1", data, 0.0)
        maps += [make_map(map_input(core, 0.0), 0, final=final) for final in (False, True)]
    live, final = maps[0::2], maps[1::2]
    assert [joint.canonical for joint in live] == [True, False, False, False, False, True]
    assert all(joint.canonical for joint in final)
    spreads = [float(joint.landmark_cov.trace(axis1=1, axis2=2).sum()) for joint in (*live, *final)]
    assert spreads[:5] == sorted(spreads[:5], reverse=True)
    assert len(set(spreads[:5])) == 5
    assert spreads[6:11] == [spreads[0]] * 5
    assert spreads[11] == spreads[5]


def test_where_the_live_map_cannot_be_solved_the_checked_one_is_served() -> None:
    core = FusionCore("f", "node", SETTINGS)
    first, second = longer("v1")[:2]
    core.on_delta("v1", first, 0.0)
    before = make_map(map_input(core, 0.0), 0, final=False)
    strong = decode_message(second).parts[0]
    spoiled = replace(strong, delta=replace(strong.delta, H=-(2**50) * np.ones_like(strong.delta.H)))
    core.on_delta("v1", encode_message(replace(decode_message(second), parts=(spoiled,))), 0.0)
    assert core.states(0.0)[0].fault == ""
    joint = make_map(map_input(core, 0.0), 1, final=False)
    assert joint.canonical
    assert np.array_equal(joint.landmark_mean, before.landmark_mean)


def test_where_nobody_can_be_believed_the_final_map_is_empty_and_says_why(network: Network) -> None:
    core = FusionCore("f", "node", SETTINGS, expected=1)
    core.on_delta("bad", negated(stream("bad")[0]), 0.0)
    final = FusionService(network.bus, core, SETTINGS).run()
    assert final.final
    assert len(final.landmark_mean) == 0
    assert "not positive definite" in final.vehicles[0].fault


# With a store.


class Silence:
    """A bus on which nobody is; what is put is kept."""

    def __init__(self) -> None:
        self.puts: list[tuple[str, bytes]] = []

    def put(self, key: str, payload: bytes, priority: Priority = "data") -> None:
        self.puts.append((key, payload))

    def subscribe(self, key: str, handler: OnPut) -> None: ...

    def answer(self, key: str, handler: OnQuery) -> None: ...

    def ask(self, key: str, payload: bytes, on_reply: Callable[[bytes], None], on_done: Callable[[], None]) -> None:
        on_done()

    def announce(self, key: str) -> None: ...

    def watch(self, key: str, handler: Callable[[str, bool], None]) -> None: ...

    def close(self) -> None: ...


class Disk(MemoryStore):
    """A store that notes what had been put on the bus when it was asked to commit, and fails if told to."""

    def __init__(self, bus: Silence) -> None:
        super().__init__()
        self.bus = bus
        self.full = False

    def commit(self, changes: Sequence[Change]) -> None:
        if self.full:
            raise StoreError("the disk is full")
        super().commit(changes)

    @property
    def messages(self) -> int:
        return sum(key[:1] == records.MESSAGE for key, _ in self.load())


def acks_in(bus: Silence) -> list[int]:
    return [decode_ack(data).last for key, data in bus.puts if key.endswith("/ack")]


def test_what_is_acknowledged_is_in_the_store() -> None:
    bus = Silence()
    disk = Disk(bus)
    settings = FusionSettings(ack_every=1)
    core = FusionCore("f", "node", settings)
    service = FusionService(bus, core, settings, store=disk)
    take = service._post(core.on_delta, lambda key: key)
    for data in longer("v1"):
        take("v1", data)
        service._work()
        assert acks_in(bus)[-1] == disk.messages - 1
    again = FusionCore("f", "node", settings)
    restore(again, disk, 0.0)
    assert again.ledger.ledger_digest() == core.ledger.ledger_digest()
    assert again.ledger.map_digest() == core.ledger.map_digest()


def test_a_store_that_fails_ends_the_service_and_nothing_is_acknowledged() -> None:
    bus = Silence()
    disk = Disk(bus)
    disk.full = True
    settings = FusionSettings(ack_every=1)
    core = FusionCore("f", "node", settings)
    service = FusionService(bus, core, settings, store=disk)
    service._post(core.on_delta, lambda key: key)("v1", stream("v1")[0])
    with pytest.raises(StoreError, match="full"):
        service.run()
    assert acks_in(bus) == []


def test_a_store_of_another_node_or_fleet_is_refused() -> None:
    disk = MemoryStore()
    restore(FusionCore("f", "node", SETTINGS), disk, 0.0)
    restore(FusionCore("f", "node", SETTINGS), disk, 0.0)
    for fleet, node in (("f", "other"), ("g", "node")):
        with pytest.raises(StoreError, match="f/node"):
            restore(FusionCore(fleet, node, SETTINGS), disk, 0.0)


@pytest.mark.parametrize("damage", ["foreign", "bytes"])
def test_a_store_with_what_its_node_never_put_there_is_refused(damage: str) -> None:
    core = FusionCore("f", "node", SETTINGS)
    for data in longer("v1"):
        core.on_delta("v1", data, 0.0)
    disk = MemoryStore()
    disk.commit(core.ledger.take_changes())
    keys = [key for key, _ in disk.load(records.MESSAGE)]
    other = core_of("v1", np.zeros(3), fleet="g")
    other.start(0.0, Sightings.none())
    bad = {"foreign": put(other)[0], "bytes": b"nonsense"}
    disk.commit([Put(keys[2], bad[damage])])
    with pytest.raises(StoreError, match="Move it away"):
        restore(FusionCore("f", "node", SETTINGS), disk, 0.0)
