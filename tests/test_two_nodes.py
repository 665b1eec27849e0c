"""Fusion nodes that share a fleet, by hand as the README says: each complete, and any of them enough."""

import asyncio
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleet_seif.client import connect
from fleet_seif.messages import JointMap
from scenarios.output import read_ledger
from tests.fleets import run_virtual
from tests.processes import COMMAND, PATIENCE_S, Child, Fleet, command, fleet_of, wait_until

STEPS = 100
SETTINGS = ("fleet.vehicles=2", f"world.steps={STEPS}", "world.landmarks=40", "run.rate_hz=50")
VEHICLES = ("v1", "v2")
EXPECTED = ("--expected", str(len(VEHICLES)))


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    with fleet_of("fleet", tmp_path, *SETTINGS) as fleet:
        yield fleet


@pytest.fixture(scope="module")
def digest() -> bytes:
    return run_virtual("fleet", *SETTINGS).ledger.map_digest()


def digest_at(fleet: Fleet, name: str) -> bytes:
    return read_ledger(fleet.store(name), "fleet").map_digest()


class Hub:
    """fleet-seif hub."""

    def __init__(self, connect: list[str] | None = None, listen: str = "tcp/127.0.0.1:0") -> None:
        links = [part for endpoint in connect or [] for part in ("--connect", endpoint)]
        self.process = subprocess.Popen(
            [*COMMAND, "hub", "--listen", listen, *links], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.endpoint = self.process.stdout.readline().removeprefix("listening on ").strip()

    def close(self) -> int:
        self.process.terminate()
        _, errors = self.process.communicate(timeout=PATIENCE_S)
        assert "Traceback" not in errors
        return self.process.returncode


class Subscriber:
    """Follows a fleet's maps on a thread of its own until the final one."""

    def __init__(self, endpoints: list[str]) -> None:
        self.maps: list[JointMap] = []
        self._thread = threading.Thread(target=lambda: asyncio.run(self._follow(endpoints)))
        self._thread.start()

    async def _follow(self, endpoints: list[str]) -> None:
        async with connect(endpoints) as client:
            async for joint in client.maps():
                self.maps.append(joint)

    def finish(self) -> JointMap:
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive(), "no final map"
        return self.maps[-1]


def steps_folded(joint: JointMap) -> int:
    return sum(state.cut + 1 for state in joint.vehicles)


def test_when_a_node_dies_for_good_the_others_go_on_with_the_one_that_is_left(fleet: Fleet, digest: bytes) -> None:
    first = fleet.node(*EXPECTED)
    second = fleet.node(*EXPECTED, name="fusion2", connect=[first.endpoint])
    endpoints = [first.endpoint, second.endpoint]
    vehicles = [fleet.vehicle(name, endpoints) for name in VEHICLES]
    subscriber = Subscriber(endpoints)
    wait_until(lambda: subscriber.maps and steps_folded(subscriber.maps[-1]) > STEPS / 2, "a map of some steps")
    followed = subscriber.maps[-1].node
    {"fusion": first, "fusion2": second}[followed].kill()
    left, survivor = ("fusion2", second) if followed == "fusion" else ("fusion", first)
    final = subscriber.finish()
    assert (final.node, final.map_digest) == (left, digest)
    assert len([joint for joint in subscriber.maps if joint.node == left]) > 2  # it did not only see the last one
    for process in [*vehicles, survivor]:
        process.finish()
    assert digest_at(fleet, left) == digest


@pytest.mark.slow
def test_two_nodes_hold_the_same_and_a_third_catches_up_from_a_compacted_one_alone(fleet: Fleet, digest: bytes) -> None:
    first = fleet.node(*EXPECTED)
    second = fleet.node(*EXPECTED, name="fusion2", connect=[first.endpoint])
    vehicles = [fleet.vehicle(name, [first.endpoint]) for name in VEHICLES]
    for process in [*vehicles, first, second]:
        process.finish()
    ledgers = [read_ledger(fleet.store(name), "fleet") for name in ("fusion", "fusion2")]
    assert {ledger.map_digest() for ledger in ledgers} == {digest}
    assert len({ledger.ledger_digest() for ledger in ledgers}) == 1

    compacted = command("ledger", "compact", str(fleet.store("fusion")))
    assert compacted.returncode == 0, compacted.stderr
    assert all(len(s.log) < STEPS / 2 for s in read_ledger(fleet.store("fusion"), "fleet").streams.values())
    again = fleet.node()  # it does not end by itself
    third = fleet.node(*EXPECTED, name="fusion3", connect=[again.endpoint])
    third.finish()
    assert read_ledger(fleet.store("fusion3"), "fleet").ledger_digest() == ledgers[0].ledger_digest()
    assert digest_at(fleet, "fusion3") == digest
    assert again.terminate() == 128 + 15


@pytest.mark.slow
def test_a_node_that_comes_late_catches_up_from_the_vehicles_snapshots(fleet: Fleet, digest: bytes) -> None:
    first = fleet.node()
    hub = Hub([first.endpoint])
    try:
        vehicles = [fleet.vehicle(name, [hub.endpoint], "--set", "run.rate_hz=25") for name in VEHICLES]
        wait_until(lambda: all((v.find("progress") or {"done": 0})["done"] > 70 for v in vehicles), "70 steps")
        first.kill()
        late = fleet.node(*EXPECTED, name="fusion2", connect=[hub.endpoint])
        for process in [*vehicles, late]:
            process.finish()
    finally:
        hub.close()
    ledger = read_ledger(fleet.store("fusion2"), "fleet")
    assert ledger.map_digest() == digest
    assert all(stream.snapshot_covers(63) for stream in ledger.streams.values())


@pytest.mark.slow
def test_a_node_that_starts_again_listens_where_it_did(fleet: Fleet, digest: bytes) -> None:
    node = fleet.node(*EXPECTED)
    endpoint = node.endpoint
    vehicles = [fleet.vehicle(name, [endpoint]) for name in VEHICLES]
    for vehicle in vehicles:
        vehicle.wait_for("progress")
    node.kill()
    again = fleet.node(*EXPECTED)
    assert again.endpoint == endpoint
    for process in [*vehicles, again]:
        process.finish()
    assert digest_at(fleet, "fusion") == digest


@pytest.mark.slow
def test_a_node_whose_port_is_taken_meanwhile_takes_another(fleet: Fleet) -> None:
    node = fleet.node()
    endpoint = node.endpoint
    node.kill()
    hub = Hub(listen=endpoint)
    try:
        assert hub.endpoint == endpoint
        assert fleet.node().endpoint != endpoint
    finally:
        hub.close()


@pytest.mark.slow
def test_a_hub_alone_routes_between_nodes_vehicles_and_subscribers(fleet: Fleet, digest: bytes) -> None:
    hub = Hub()
    try:
        nodes: list[Child] = [
            fleet.node(*EXPECTED, name=name, connect=[hub.endpoint]) for name in ("fusion", "fusion2")
        ]
        for node in nodes:
            assert node.endpoint
        subscriber = Subscriber([hub.endpoint])
        vehicles = [fleet.vehicle(name, [hub.endpoint]) for name in VEHICLES]
        assert subscriber.finish().map_digest == digest
        for process in [*vehicles, *nodes]:
            process.finish()
    finally:
        assert hub.close() == 128 + 15
    assert digest_at(fleet, "fusion") == digest_at(fleet, "fusion2") == digest
