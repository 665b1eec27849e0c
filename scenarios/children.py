"""What the launched processes do: one fusion node, or one vehicle of a scenario."""

import contextlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fleet_seif.bus import Bus, ZenohBus, open_bus
from fleet_seif.config import FusionSettings
from fleet_seif.link import FaultyBus, LinkSettings
from fleet_seif.warm_up import warm_up
from fusion.core import FusionCore
from fusion.service import FusionService
from scenarios import output
from scenarios.config import Scenario
from scenarios.source import record, vehicle_names
from vehicles import Vehicle
from vehicles.drive import drive

PROGRESS_S = 0.2
SWITCH_S = 1e-4  # a step must not wait 5 ms for the threads that serve the network

Say = Callable[[dict[str, Any]], None]


def say_json(event: dict[str, Any]) -> None:
    """One event a line, for the launcher."""
    print(json.dumps(event), flush=True)  # noqa: T201


def supervise() -> Callable[[], None]:
    """End this process when its standard input does: the launcher holds the other end.

    Returns a function that waits until the launcher has written something there: every process is ready.
    """
    go = threading.Event()

    def listen() -> None:
        while os.read(sys.stdin.fileno(), 1):  # not sys.stdin.read: it would hold a lock at the end
            go.set()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=listen, name="supervised", daemon=True).start()
    return lambda: _wait(go)


def _wait(go: threading.Event) -> None:
    while not go.wait(0.1):  # in short waits: signals are handled in between
        pass


def end_on_sigterm() -> None:
    """SIGTERM leaves through the with-blocks: a Zenoh session that is not closed keeps a process alive."""

    def leave(number: int, frame: object) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, leave)


@contextlib.contextmanager
def _with_link(bus: ZenohBus, link: LinkSettings, seed: Sequence[int]) -> Iterator[Bus]:
    """The bus itself, or the bus behind a bad link."""
    if link.perfect:
        yield bus
        return
    faulty = FaultyBus(bus, link, int(np.random.SeedSequence(seed).generate_state(1)[0]))
    try:
        yield faulty
    finally:
        faulty.stop()


def run_fusion(
    *,
    fleet: str,
    settings: FusionSettings,
    link: LinkSettings,
    seed: int,
    listen: Sequence[str],
    config: Path | None,
    insecure: bool,
    expected: int,
    result: Path | None,
    say: Say,
) -> None:
    """Host a router and fuse until every expected vehicle has ended (0: until told to stop)."""
    warm_up(lambda text: say({"event": "note", "text": text}))
    with (
        open_bus(listen=listen, config=config, insecure=insecure, mode="router") as session,
        _with_link(session, link, [seed, 1]) as bus,
    ):
        core = FusionCore(fleet, "fusion", settings, expected)
        version = time.time_ns() // 1_000_000  # so that the maps of a node started again count as newer
        service = FusionService(bus, core, settings, maps=session, first_version=version)
        say({"event": "listening", "endpoint": session.endpoints()[0]})

        silent: set[str] = set()

        def tell(core: FusionCore) -> None:
            nonlocal silent
            now_silent = {state.name for state in core.states(time.monotonic()) if state.stalled}
            if now_silent - silent:
                text = f"no word from {', '.join(sorted(now_silent))} for {settings.stalled_s:.0f} s"
                say({"event": "note", "text": text})
            silent = now_silent
            streams = core.ledger.streams.values()
            done, total = sum(s.ended for s in streams), max(expected, len(streams))
            say({"event": "progress", "done": done, "total": total})

        service.run(tell)
        if result is not None:
            _write_fusion(result, core, service)
        say({"event": "done", "digest": core.ledger.map_digest().hex()})


def _write_fusion(result: Path, core: FusionCore, service: FusionService) -> None:
    output.write_ledger(result / "ledger.bin", core.ledger)
    facts = {
        "digest": core.ledger.map_digest().hex(),
        "streams": output.stream_facts(core, time.monotonic()),
        "fusion": {
            "maps_served": service.statistics.maps,
            "map_behind_s_p99": service.behind_p99_s(),
            "solve_s_p50": float(np.median(service.statistics.solve_s)) if service.statistics.solve_s else None,
            "inbox_dropped": service.statistics.dropped,
            **core.counters,
        },
    }
    output.write_json(result / "fusion.json", facts)


def run_vehicle(
    scenario: Scenario,
    *,
    name: str,
    connect: Sequence[str],
    config: Path | None,
    insecure: bool,
    result: Path | None,
    say: Say,
    wait_for_go: Callable[[], None],
) -> None:
    """One vehicle of a scenario, from its first reading to the last acknowledgement."""
    sys.setswitchinterval(SWITCH_S)
    log = record(scenario, only=name).logs[name]
    warm_up(lambda text: say({"event": "note", "text": text}))
    number = vehicle_names(scenario).index(name)
    with (
        open_bus(connect=connect, config=config, insecure=insecure) as session,
        _with_link(session, scenario.link, [scenario.run.seed, 2, number]) as bus,
        Vehicle(
            name,
            fleet=scenario.fleet.name,
            start_pose=log.start_pose,
            start_pose_cov=log.start_pose_cov,
            bus=bus,
            settings=scenario.filter,
            publish=scenario.publish,
        ) as vehicle,
    ):
        say({"event": "ready"})
        wait_for_go()
        told_s = 0.0

        def tell(step: int) -> None:
            nonlocal told_s
            if step == log.steps or time.monotonic() >= told_s + PROGRESS_S:
                told_s = time.monotonic()
                say({"event": "progress", "done": step, "total": log.steps})

        rate_hz = scenario.run.rate_hz
        driven = drive(vehicle, log.sightings_at(0), float(log.time_s[0]), log.readings(), rate_hz, tell)
        if result is not None:
            output.write_drive(result / f"{name}.npz", driven)
        say({"event": "done"})
