"""The fusion service on real Zenoh: bursts, silence, and vehicles that would spoil the map of all."""

import dataclasses
import threading

import numpy as np
import pytest

from fleet_seif.bus import open_bus
from fleet_seif.config import FilterSettings, FusionSettings, PublishSettings
from fleet_seif.keys import Keys
from fleet_seif.messages import Epoch
from fleet_seif.records import Sightings
from fleet_seif.wire import decode_message, encode_message
from fusion.core import Effect, FusionCore
from fusion.mapping import make_map, map_input
from fusion.service import FusionService
from tests.conftest import Network
from vehicles.core import Identity, VehicleCore

SETTINGS = FusionSettings(map_s=0.02, stalled_s=0.2)


def stream(name: str) -> list[bytes]:
    identity = Identity(
        fleet="f", vehicle=name, epoch=Epoch(0, 1), start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3))
    )
    core = VehicleCore(identity, FilterSettings(), PublishSettings())
    core.start(0.0, Sightings(z=np.array([[1.0, 0.2]]), cov=np.array([1e-3 * np.eye(2)]), signature=np.array([3])))
    core.end()
    return core.release()


def test_every_event_of_a_burst_is_handled(network: Network) -> None:
    service = FusionService(network.bus, FusionCore("f", "node", SETTINGS), SETTINGS)
    handled: list[int] = []

    def event(i: int) -> list[Effect]:
        handled.append(i)
        return []

    for i in range(1000):
        service._post(lambda i=i: event(i))  # type: ignore[misc]
    for _ in range(10):
        service._work()
    assert handled == list(range(1000))


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


def test_a_vehicle_whose_information_is_indefinite_is_left_out_and_the_others_are_mapped() -> None:
    core = FusionCore("f", "node", SETTINGS)
    for data in stream("good"):
        core.on_delta("good", data, 0.0)
    message = decode_message(stream("bad")[0])
    part = message.parts[0]
    negated = dataclasses.replace(part, delta=dataclasses.replace(part.delta, H=-part.delta.H))
    core.on_delta("bad", encode_message(dataclasses.replace(message, parts=(negated,))), 0.0)
    joint = make_map(map_input(core, 0.0), 0, SETTINGS, final=True)
    assert joint.poses == ("good",)
    assert joint.counters["lives_left_out"] == 1


def test_a_final_map_that_cannot_be_solved_is_an_error(network: Network) -> None:
    core = FusionCore("f", "node", SETTINGS, expected=1)
    message = decode_message(stream("bad")[0])
    part = message.parts[0]
    negated = dataclasses.replace(part, delta=dataclasses.replace(part.delta, H=-part.delta.H))
    core.on_delta("bad", encode_message(dataclasses.replace(message, parts=(negated,))), 0.0)
    core.on_delta("bad", stream("bad")[1], 0.0)
    service = FusionService(network.bus, core, SETTINGS)
    with pytest.raises(ArithmeticError):
        service.run()
