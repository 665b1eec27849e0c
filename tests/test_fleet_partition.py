"""A fleet whose network is cut: complete again within HEALED_S of the first heartbeat that gets through.

Run as a program this is somebody who listens beside the fusion node: `python -m tests.test_fleet_partition ENDPOINT`.
"""

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from fleet_seif.bus import open_bus
from fleet_seif.client import MapAssembler
from fleet_seif.config import FusionSettings
from fleet_seif.keys import Keys
from fleet_seif.link import Cut, FaultyBus, LinkSettings
from fleet_seif.wire import decode_ack, decode_heartbeat
from fusion.core import FusionCore
from fusion.service import FusionService
from scenarios.config import load_scenario
from scenarios.output import read_ledger
from scenarios.source import record
from tests.conftest import Network
from tests.fleets import run_virtual
from tests.netns import ADDRESS, Cable, two_namespaces, unavailable
from tests.processes import PATIENCE_S, fleet_of, wait_until
from vehicles import Vehicle

HEALED_S = 2.0
CUTS_S = [int(cut_s) for cut_s in os.environ.get("FLEET_SEIF_CUTS_S", "1 5 20").split()]
HUB = f"tcp/{ADDRESS['a']}:7447"
KEYS = Keys("fleet")
RATE_HZ = 20


@dataclass
class Heard:
    """Numbers heard beside the fusion node, each with its time on the machine's monotonic clock."""

    heartbeats: list[tuple[float, int]] = field(default_factory=list)
    acks: list[tuple[float, int]] = field(default_factory=list)
    behind: list[tuple[float, int]] = field(default_factory=list)

    def after(self, since_s: float) -> dict[str, float]:
        """When the first heartbeat came after a time, and how long after it all that it announced was acknowledged, and
        a map was served with nothing missing, s."""
        at_s, last = _first(self.heartbeats, lambda each: each[0] > since_s, "a heartbeat")
        acked_s, _ = _first(self.acks, lambda each: each[0] > since_s and each[1] >= last, "an acknowledgement")
        shown_s, _ = _first(self.behind, lambda each: each[0] > at_s and each[1] == 0, "a map that is not behind")
        return {"heartbeat": at_s - since_s, "acknowledged": acked_s - at_s, "map": shown_s - at_s}


def _first(
    heard: list[tuple[float, int]], condition: Callable[[tuple[float, int]], bool], what: str
) -> tuple[float, int]:
    wait_until(lambda: any(condition(each) for each in list(heard)), what)
    return next(each for each in heard if condition(each))


def listen(endpoint: str) -> None:
    """Say what is heard, a JSON line each."""
    maps = MapAssembler()
    lock = threading.Lock()

    def say(kind: str, number: int) -> None:
        with lock:
            print(json.dumps([kind, time.monotonic(), number]), flush=True)

    def on_map(data: bytes) -> None:
        joint = maps.take(data)
        if joint is not None and joint.vehicles:
            say("behind", sum(state.behind for state in joint.vehicles))

    with open_bus(connect=[endpoint], insecure=True) as bus:
        bus.subscribe(KEYS.heartbeats("v1"), lambda _, data: say("heartbeats", decode_heartbeat(data).last))
        bus.subscribe(KEYS.acks("v1"), lambda _, data: say("acks", decode_ack(data).last))
        bus.subscribe(KEYS.map("*"), lambda _, data: on_map(data))
        say("ready", 0)
        sys.stdin.read()


@contextlib.contextmanager
def listener(cable: Cable) -> Iterator[Heard]:
    heard = Heard()
    process = cable.start("a", [sys.executable, "-m", "tests.test_fleet_partition", HUB])
    assert process.stdout is not None
    lines = process.stdout

    def read() -> None:
        for line in lines:
            kind, time_s, number = json.loads(line)
            getattr(heard, kind).append((time_s, number))

    assert json.loads(lines.readline())[0] == "ready"
    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield heard
    finally:
        process.communicate()
        reader.join()


@pytest.fixture
def cable() -> Iterator[Cable]:
    if unavailable():
        pytest.skip(f"network namespaces are not permitted here: {unavailable()}")
    with two_namespaces() as cable:
        yield cable


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(240)
@pytest.mark.parametrize("cut_s", CUTS_S)
def test_a_fleet_is_complete_soon_after_a_partition(cable: Cable, tmp_path: Path, cut_s: int) -> None:
    settings = ("fleet.vehicles=1", f"world.steps={RATE_HZ * (cut_s + 10)}", f"run.rate_hz={RATE_HZ}")
    with fleet_of("fleet", tmp_path, *settings) as fleet:
        beyond = ("--insecure",)
        node = fleet.node("--expected", "1", *beyond, listen=HUB, prefix=cable.command("a", []))
        assert node.endpoint
        vehicle = fleet.vehicle("v1", [HUB], *beyond, prefix=cable.command("b", []))
        with listener(cable) as heard:
            heard.after(time.monotonic())
            cable.cut()
            time.sleep(cut_s)
            cable.heal()
            found = heard.after(time.monotonic())
            print(f"cut {cut_s} s: " + ", ".join(f"{name} after {value:.2f} s" for name, value in found.items()))
            vehicle.finish()
        node.finish()
    assert max(found["acknowledged"], found["map"]) < HEALED_S
    assert (
        read_ledger(fleet.store("fusion"), "fleet").map_digest() == run_virtual("fleet", *settings).ledger.map_digest()
    )


def test_a_fleet_is_complete_soon_after_its_link_was_cut(network: Network) -> None:
    settings = ("fleet.vehicles=1", "world.steps=60", f"run.rate_hz={RATE_HZ}")
    scenario = load_scenario("fleet", settings)
    log = record(scenario).logs["v1"]
    core = FusionCore("fleet", "fusion", FusionSettings(), expected=1)
    service = FusionService(network.bus, core, FusionSettings())
    fusing = threading.Thread(target=service.run)
    fusing.start()
    heard, maps = Heard(), MapAssembler()

    def on_map(data: bytes) -> None:
        joint = maps.take(data)
        if joint is not None:
            heard.behind.append((time.monotonic(), sum(state.behind for state in joint.vehicles)))

    network.bus.subscribe(
        KEYS.heartbeats("v1"), lambda _, data: heard.heartbeats.append((time.monotonic(), decode_heartbeat(data).last))
    )
    network.bus.subscribe(KEYS.acks("v1"), lambda _, data: heard.acks.append((time.monotonic(), decode_ack(data).last)))
    network.bus.subscribe(KEYS.map("*"), lambda _, data: on_map(data))
    cut = Cut(from_s=0.5, for_s=1.5)
    try:
        with open_bus(connect=[network.endpoint]) as session:
            begin_s = time.monotonic()
            link = FaultyBus(session, LinkSettings(cuts=(cut,)), 1, "v1")
            with Vehicle("v1", fleet="fleet", bus=link, start_pose=log.start_pose) as vehicle:
                vehicle.start(log.sightings_at(0), time_s=float(log.time_s[0]))
                for step, reading in enumerate(log.readings(), start=1):
                    time.sleep(max(0.0, begin_s + step / RATE_HZ - time.monotonic()))
                    vehicle.step(reading.odometry, reading.odometry_cov, reading.sightings, time_s=reading.time_s)
                vehicle.end()
                assert vehicle.wait_until_acknowledged(PATIENCE_S)
            link.stop()
        fusing.join(PATIENCE_S)
    finally:
        service.stop()
        fusing.join()
    cut_s, healed_s = begin_s + cut.from_s, begin_s + cut.from_s + cut.for_s
    assert not [at_s for at_s, _ in heard.heartbeats if cut_s + 0.2 < at_s < healed_s]
    found = heard.after(healed_s)
    assert max(found["acknowledged"], found["map"]) < HEALED_S
    assert core.ledger.map_digest() == run_virtual("fleet", *settings).ledger.map_digest()


if __name__ == "__main__":
    listen(sys.argv[1])
