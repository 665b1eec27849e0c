"""A whole fleet in one process, on a virtual clock and an in-memory network: the same cores as the real run.

Vehicles, the fusion node and the link model are driven by one queue of events in virtual time; nothing waits, and the
same seed gives the same run.
"""

import contextlib
import heapq
import itertools
import time
from collections.abc import Callable

import numpy as np

from fleet_seif.errors import NumericalError, ReadingRefused, RunError
from fleet_seif.link import LinkModel
from fleet_seif.messages import Epoch
from fleet_seif.records import Reading
from fusion.core import AskRange, Effect, FusionCore, PutAck
from scenarios.config import Scenario
from scenarios.output import stream_facts
from scenarios.recording import Log, Recording
from scenarios.report import FinishedRun
from vehicles.core import Identity, VehicleCore
from vehicles.drive import DriveResult, Notes

LATENCY_S = 1e-4
VEHICLE_TICK_S = 0.05
FUSION_TICK_S = 0.02
SILENCE_S = 120.0


class VirtualFleet:
    """One run. `drive` it, then read `fusion` and the results."""

    def __init__(self, scenario: Scenario, recording: Recording) -> None:
        self._scenario = scenario
        self._now_s = 0.0
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._progress_s = 0.0
        self.fusion = FusionCore(scenario.fleet.name, "fusion", scenario.fusion, expected=len(recording.logs))
        seeds = np.random.SeedSequence([scenario.run.seed, 0x1F1EE7])
        self.vehicles = {
            name: _VirtualVehicle(self, scenario, log, np.random.default_rng(seed))
            for (name, log), seed in zip(recording.logs.items(), seeds.spawn(len(recording.logs)), strict=True)
        }

    def at(self, when_s: float, action: Callable[[], None]) -> None:
        """Do something at a virtual time."""
        heapq.heappush(self._events, (when_s, next(self._order), action))

    @property
    def now_s(self) -> float:
        return self._now_s

    def drive(self, on_step: Callable[[str, int], None] = lambda vehicle, step: None) -> dict[str, DriveResult]:
        """Run until every vehicle's stream is folded and acknowledged.

        Raises RunError where nothing gets through for SILENCE_S of virtual time.
        """
        for vehicle in self.vehicles.values():
            vehicle.begin(on_step)
        self.at(FUSION_TICK_S, self._tick)
        folded = -1
        while not all(vehicle.core.done for vehicle in self.vehicles.values()):
            self._now_s, _, action = heapq.heappop(self._events)
            action()
            total = sum(s.next for s in self.fusion.ledger.streams.values()) + sum(
                v.core.outbox.last_acknowledged for v in self.vehicles.values()
            )
            if total > folded:
                folded, self._progress_s = total, self._now_s
            if self._now_s > self._progress_s + SILENCE_S:
                raise RunError(f"nothing got through for {SILENCE_S:.0f} s of virtual time: [link] loses too much")
        return {name: vehicle.result() for name, vehicle in self.vehicles.items()}

    def _tick(self) -> None:
        self.execute(self.fusion.tick(self._now_s))
        self.at(self._now_s + FUSION_TICK_S, self._tick)

    def execute(self, effects: list[Effect]) -> None:
        """Carry out what the fusion core wants."""
        for effect in effects:
            vehicle = self.vehicles[effect.vehicle]
            match effect:
                case PutAck(data=data):
                    vehicle.take_ack(data)
                case AskRange(epoch=epoch, data=data):
                    self.at(self._now_s + LATENCY_S, vehicle.answer(epoch, data))


class _VirtualVehicle:
    """A vehicle core with its readings and both directions of its link."""

    def __init__(self, fleet: VirtualFleet, scenario: Scenario, log: Log, rng: np.random.Generator) -> None:
        self._fleet = fleet
        self._log = log
        self._rate_hz = scenario.run.rate_hz
        up, down = rng.spawn(2)
        self._up, self._down = LinkModel(scenario.link, up), LinkModel(scenario.link, down)
        identity = Identity(
            fleet=scenario.fleet.name,
            vehicle=log.vehicle,
            epoch=Epoch(0, int(rng.integers(2**63))),
            start_pose=log.start_pose,
            start_pose_cov=log.start_pose_cov,
        )
        self.core = VehicleCore(identity, scenario.filter, scenario.publish)
        self._readings = iter(enumerate(log.readings(), start=1))
        self._notes = Notes()
        self._waiting = False

    def begin(self, on_step: Callable[[str, int], None]) -> None:
        self._on_step = on_step
        self.core.start(float(self._log.time_s[0]), self._log.sightings_at(0))
        self._notes.pose.append(self.core.pose)
        self._publish()
        self._fleet.at(0.0, self._step)
        self._fleet.at(VEHICLE_TICK_S, self._tick)

    def _step(self) -> None:
        if not self._rate_hz and self.core.outbox.full:
            self._waiting = True
            return
        step, reading = next(self._readings, (0, None))
        if reading is None:
            self.core.end()
            self._publish()
            return
        self._take(reading)
        self._on_step(self._log.vehicle, step)
        pause_s = 1.0 / self._rate_hz if self._rate_hz else LATENCY_S
        self._fleet.at(self._fleet.now_s + pause_s, self._step)

    def _take(self, reading: Reading) -> None:
        begin = time.perf_counter()
        with contextlib.suppress(ReadingRefused, NumericalError):  # counted by the core
            self.core.step(reading)
        middle = time.perf_counter()
        self._publish()
        self._notes.pose.append(self.core.pose)
        self._notes.filter_s.append(middle - begin)
        self._notes.publish_s.append(time.perf_counter() - middle)

    def _publish(self) -> None:
        fleet = self._fleet
        for data in self.core.release():
            self._send(self._up, lambda data=data: fleet.execute(  # type: ignore[misc]
                fleet.fusion.on_delta(self._log.vehicle, data, fleet.now_s)
            ))  # fmt: skip

    def _send(self, link: LinkModel, deliver: Callable[[], None]) -> None:
        for at_s in link.arrivals(self._fleet.now_s + LATENCY_S):
            self._fleet.at(at_s, deliver)

    def _tick(self) -> None:
        heartbeat = self.core.tick(self._fleet.now_s)
        if heartbeat is not None:
            fleet = self._fleet
            self._send(
                self._up,
                lambda: fleet.execute(fleet.fusion.on_heartbeat(self._log.vehicle, heartbeat, fleet.now_s)),
            )
        self._fleet.at(self._fleet.now_s + VEHICLE_TICK_S, self._tick)

    def take_ack(self, data: bytes) -> None:
        """An acknowledgement sets out."""
        self._send(self._down, lambda: self._acknowledged(data))

    def _acknowledged(self, data: bytes) -> None:
        self.core.on_ack(data)
        self._publish()
        if self._waiting and not self.core.outbox.full:
            self._waiting = False
            self._fleet.at(self._fleet.now_s, self._step)

    def answer(self, epoch: Epoch, data: bytes) -> Callable[[], None]:
        """A range query arrives: its replies can be lost or doubled, like those of a real one."""

        def reply() -> None:
            fleet, name = self._fleet, self._log.vehicle
            for message in self.core.on_range(data):
                for _ in self._up.arrivals(0.0):
                    fleet.execute(fleet.fusion.on_reply(name, message, fleet.now_s))
            fleet.execute(fleet.fusion.on_reply_done(name, epoch, fleet.now_s))

        return reply

    def result(self) -> DriveResult:
        core = self.core
        return self._notes.result(core.landmarks, core.filter.signatures, core.counters)


def run_virtual(
    name: str,
    scenario: Scenario,
    recording: Recording,
    progress: Callable[[str, int, int], None] = lambda vehicle, done, total: None,
) -> FinishedRun:
    """A whole run; progress is called with vehicle, done and total steps. Raises RunError where it cannot finish."""
    begin = time.monotonic()
    fleet = VirtualFleet(scenario, recording)
    drives = fleet.drive(lambda vehicle, step: progress(vehicle, step, recording.logs[vehicle].steps))
    return FinishedRun(
        name=name,
        scenario=scenario,
        recording=recording,
        ledger=fleet.fusion.ledger,
        drives=drives,
        streams=stream_facts(fleet.fusion, fleet.now_s),
        wall_s=time.monotonic() - begin,
        fusion=dict(fleet.fusion.counters),
    )
