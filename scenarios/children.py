"""What the launched processes do: one fusion node, or one vehicle of a scenario."""

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fleet_seif.bus import Bus, ZenohBus, open_bus
from fleet_seif.config import FusionSettings
from fleet_seif.errors import RunError
from fleet_seif.link import FaultyBus, LinkSettings
from fleet_seif.signing import KeyRing, Role, Signer, load_key_ring, load_signer
from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.store import Put
from fleet_seif.warm_up import warm_up
from fusion import records
from fusion.core import FusionCore
from fusion.merges import run_digest
from fusion.service import FusionService, restore
from scenarios import output
from scenarios.config import Scenario
from scenarios.faults import FaultSettings
from scenarios.hostile import Liar, lying
from scenarios.source import record, vehicle_names
from vehicles import Vehicle
from vehicles import records as outbox_records
from vehicles.drive import drive

PROGRESS_S = 0.2
RELEASE = b"release"
SWITCH_S = 1e-4  # a step must not wait 5 ms for the threads that serve the network

Say = Callable[[dict[str, Any]], None]


def say_json(event: dict[str, Any]) -> None:
    """One event a line, for the launcher."""
    print(json.dumps(event), flush=True)  # noqa: T201


class Supervision:
    """What the launcher holds of a process: it ends when the launcher does, and it is told when the run begins.

    begin_s: when that was, on this process's monotonic clock; None before. A process by itself begins at once.
    released: whether nobody needs it any more, as far as the launcher knows.
    """

    def __init__(self, *, alone: bool = False) -> None:
        self.begin_s: float | None = time.monotonic() if alone else None
        self.released = alone
        self._go = threading.Event()
        if alone:
            self._go.set()
        else:
            threading.Thread(target=self._listen, name="supervised", daemon=True).start()

    def _listen(self) -> None:
        said = b""
        while some := os.read(sys.stdin.fileno(), 64):  # not sys.stdin.read: it would hold a lock at the end
            *lines, said = (said + some).split(b"\n")
            for line in lines:
                if line == RELEASE:
                    self.released = True
                elif self.begin_s is None:
                    self.begin_s = time.monotonic() - float(line)
                    self._go.set()
        os.kill(os.getpid(), signal.SIGTERM)

    def wait_for_go(self) -> None:
        """Until the launcher has said how long the run has been going on."""
        while not self._go.wait(0.1):  # in short waits: signals are handled in between
            pass

    @property
    def run_s(self) -> float:
        """Seconds since the run began; 0 before."""
        return 0.0 if self.begin_s is None else time.monotonic() - self.begin_s

    def clock(self, faults: FaultSettings, who: str) -> Callable[[], float]:
        """This process's clock, which may jump on purpose."""
        jumps = [fault for fault in faults.events if fault.what == "clock" and fault.who == who]
        if not jumps:
            return time.monotonic
        return lambda: time.monotonic() + sum(jump.by_s for jump in jumps if jump.at_s <= self.run_s)


def end_on_sigterm() -> None:
    """SIGTERM leaves through the with-blocks: a Zenoh session that is not closed keeps a process alive."""

    def leave(number: int, frame: object) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, leave)


@contextlib.contextmanager
def _with_link(
    bus: ZenohBus, link: LinkSettings, seed: Sequence[int], who: str, supervision: Supervision
) -> Iterator[Bus]:
    """The bus itself, or the bus behind a bad link."""
    if link.perfect:
        yield bus
        return
    number = int(np.random.SeedSequence(seed).generate_state(1)[0])
    faulty = FaultyBus(bus, link, number, who, lambda: supervision.run_s)
    try:
        yield faulty
    finally:
        faulty.stop()


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a process lives: on the bus, and on disk.

    listen, connect: endpoints. config: a Zenoh configuration file. store: a file. result: a folder for what the
    launcher reads afterwards. signing_key, key_ring: files of a fleet that signs its messages.
    """

    listen: Sequence[str] = ()
    connect: Sequence[str] = ()
    config: Path | None = None
    insecure: bool = False
    store: Path | None = None
    result: Path | None = None
    signing_key: Path | None = None
    key_ring: Path | None = None

    def signer(self, fleet: str, role: Role, name: str) -> Signer | None:
        """Its private key. Raises RunError where that is somebody else's."""
        return signer_of(self.signing_key, fleet, role, name)

    def keys(self) -> KeyRing | None:
        return None if self.key_ring is None else load_key_ring(self.key_ring)


def signer_of(path: Path | None, fleet: str, role: Role, name: str) -> Signer | None:
    """The private key in a file. Raises RunError where it is somebody else's."""
    if path is None:
        return None
    signer = load_signer(path)
    if (signer.fleet, signer.role, signer.name) != (fleet, role, name):
        raise RunError(
            f"private key {path} is that of {signer.role} {signer.name!r} of fleet {signer.fleet!r}, "
            f"this is {role} {name!r} of fleet {fleet!r}"
        )
    return signer


@contextlib.contextmanager
def _opened(path: Path | None, kind: str, schema: int) -> Iterator[SqliteStore | None]:
    if path is None:
        yield None
        return
    store = SqliteStore.open(path, kind, schema)
    try:
        yield store
    finally:
        store.close()


def run_fusion(
    *,
    fleet: str,
    name: str,
    settings: FusionSettings,
    link: LinkSettings,
    faults: FaultSettings,
    seed: int,
    place: Place,
    expected: int,
    say: Say,
    supervision: Supervision,
) -> None:
    """Host a router and fuse until every expected vehicle has ended (0: until told to stop)."""
    warm_up(lambda text: say({"event": "note", "text": text}))
    clock = supervision.clock(faults, name)
    with _opened(place.store, records.KIND, records.SCHEMA) as store:
        core = FusionCore(
            fleet, name, settings, expected, keys=place.keys(), signer=place.signer(fleet, Role.NODE, name)
        )
        if store is None:
            say({"event": "note", "text": "the ledger is kept in memory only: --store FILE keeps it for a restart"})
        else:
            restore(core, store, clock())
            held = sum(len(stream.log) for stream in core.ledger.streams.values())
            if held:
                say({"event": "note", "text": f"goes on with {held} messages that it has kept"})
        with _listening(place, store) as session, _with_link(session, link, [seed, 1], name, supervision) as bus:
            version = time.time_ns() // 1_000_000  # so that the maps of a node started again count as newer
            service = FusionService(
                bus, core, settings, clock, maps=session, first_version=version, store=store,
                signer=place.signer(fleet, Role.NODE, name), held=lambda: not supervision.released,
            )  # fmt: skip
            say({"event": "listening", "endpoint": session.endpoints()[0]})
            service.run(_teller(say, settings, expected, clock))
            if place.result is not None:
                _write_fusion(place.result / f"{name}.json", core, service)
    say({"event": "done", "digest": run_digest(core.ledger).hex()})


@contextlib.contextmanager
def _listening(place: Place, store: SqliteStore | None) -> Iterator[ZenohBus]:
    """A router; one that was told to take any port takes the one it had before, so that vehicles find it again."""
    note = records.NOTE + b"endpoint"
    before = dict(store.load(note, note + b"\0")).get(note, b"").decode() if store is not None else ""
    with contextlib.ExitStack() as stack:

        def opened(*listen: str) -> ZenohBus:
            bus = open_bus(
                listen=listen, connect=place.connect, config=place.config, insecure=place.insecure, mode="router"
            )
            return stack.enter_context(bus)

        bus = None
        if before and [endpoint.endswith(":0") for endpoint in place.listen] == [True]:
            with contextlib.suppress(RunError):  # somebody else has the port now
                bus = opened(before)
        bus = bus or opened(*place.listen)
        if store is not None:
            store.commit([Put(note, bus.endpoints()[0].encode())])
        yield bus


def _teller(
    say: Say, settings: FusionSettings, expected: int, clock: Callable[[], float]
) -> Callable[[FusionCore], None]:
    """Tells how far the node is, and once about every vehicle that falls silent or is quarantined."""
    told: set[str] = set()

    def tell(core: FusionCore) -> None:
        states = core.states(clock())
        for state in states:
            text = ""
            if state.fault:
                text = f"{state.name} is quarantined: {state.fault}"
            elif state.stalled:
                text = f"no word from {state.name} for {settings.stalled_s:.0f} s"
            else:
                told.discard(f"no word from {state.name} for {settings.stalled_s:.0f} s")
            if text and text not in told:
                told.add(text)
                say({"event": "note", "text": text})
        say({"event": "progress", "done": sum(s.ended for s in states), "total": max(expected, len(states))})

    return tell


def _write_fusion(path: Path, core: FusionCore, service: FusionService) -> None:
    facts = {
        "digest": run_digest(core.ledger).hex(),
        "streams": output.stream_facts(core, time.monotonic()),
        "fusion": {
            "maps_served": service.statistics.maps,
            "map_behind_s_p99": service.behind_p99_s(),
            "solve_s_p50": float(np.median(service.statistics.solve_s)) if service.statistics.solve_s else None,
            "final_map_s": service.statistics.final_s,
            "inbox_dropped": service.dropped,
            **core.counters,
        },
    }
    output.write_json(path, facts)


def run_vehicle(
    scenario: Scenario,
    *,
    name: str,
    place: Place,
    say: Say,
    supervision: Supervision,
    fresh: bool = False,
    life: int = 0,
) -> None:
    """One vehicle of a scenario, from its first reading (or the one after its last committed step) to the last
    acknowledgement."""
    sys.setswitchinterval(SWITCH_S)
    log = record(scenario, only=name).logs[name]
    warm_up(
        lambda text: say({"event": "note", "text": text}),
        frames=scenario.filter.frames,
        identities=scenario.filter.identities,
    )
    number = vehicle_names(scenario).index(name)
    fleet = scenario.fleet.name
    signer = place.signer(fleet, Role.VEHICLE, name)
    with (
        _opened(place.store, outbox_records.KIND, outbox_records.SCHEMA) as store,
        open_bus(connect=place.connect, config=place.config, insecure=place.insecure) as session,
        _with_link(session, scenario.link, [scenario.run.seed, 2, number], name, supervision) as bus,
        Vehicle(
            name,
            fleet=fleet,
            start_pose=log.start_pose,
            start_pose_cov=log.start_pose_cov,
            bus=lying(bus, Liar(scenario.faults.hostile, name, signer)),
            settings=scenario.filter,
            publish=scenario.publish,
            clock=supervision.clock(scenario.faults, name),
            store=store,
            fresh=fresh,
            life=life,
            required_acks=scenario.fusion.required_acks,
            signer=signer,
            keys=place.keys(),
        ) as vehicle,
    ):
        if vehicle.resumed:
            say({"event": "note", "text": f"goes on after step {vehicle.steps}"})
        say({"event": "ready"})
        supervision.wait_for_go()
        told_s = 0.0

        def tell(step: int) -> None:
            nonlocal told_s
            if step == log.steps or time.monotonic() >= told_s + PROGRESS_S:
                told_s = time.monotonic()
                say({"event": "progress", "done": step, "total": log.steps})

        rate_hz = scenario.run.rate_hz
        readings = list(log.readings())
        driven = drive(vehicle, log.sightings_at(0), float(log.time_s[0]), readings, rate_hz, tell)
        if vehicle.fault:
            say({"event": "note", "text": f"a fusion node takes no more of it: {vehicle.fault}"})
        if place.result is not None:
            output.write_drive(place.result / f"{name}.npz", driven)
        say({"event": "done"})
