"""A whole fleet in one process, on a virtual clock: the same cores as the real run, with simulated network and disks.

1. One queue of events in virtual time drives everything; nothing waits, and the same arguments give the same run.
2. Processes talk through LinkModels; what a process does (commit, put, acknowledge) it does effect by effect, and it
   can be killed before any of them.
3. A store is a MemoryStore: what was committed survives its process, what was not is gone. (That a file keeps this
   promise with torn writes is shown where the file is tested.)
4. A simulated robot stands still while its process is down: its next reading is the one after the last committed step.
"""

import contextlib
import heapq
import itertools
import time
from collections.abc import Callable, Sequence

import numpy as np

from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.link import LinkModel, LinkSettings
from fleet_seif.map_wire import encode_map
from fleet_seif.merge_records import Merges
from fleet_seif.messages import Epoch, JointMap
from fleet_seif.store import MemoryStore
from fusion.core import AskEvents, AskMap, AskRange, Effect, FusionCore, PutAck, PutMerges, PutStatus
from scenarios.config import Scenario
from scenarios.hostile import Liar
from scenarios.recording import Log, Recording
from vehicles.core import Identity, VehicleCore
from vehicles.drive import DriveResult, Notes

LATENCY_S = 1e-4
VEHICLE_TICK_S = 0.05
FUSION_TICK_S = 0.02

Action = Callable[[], None]


class Killed(Exception):
    """The process that was at work ends here."""


class Process:
    """What vehicles and fusion nodes have in common: a link, a disk, a clock of their own, and a life that can end.

    Subclasses say what is done on `_boot`, and forget everything that is not on the disk on `_die`.
    """

    def __init__(self, simulation: "Simulation", name: str, rng: np.random.Generator) -> None:
        self.name = name
        self.disk = MemoryStore()
        self.up = False
        self.starts = 0
        self.clock_offset_s = 0.0
        self.wiped = False
        self._simulation = simulation
        self._paused_until_s = 0.0
        self._rng = rng
        link = simulation.scenario.link
        self.outward = LinkModel(link, rng.spawn(1)[0], name)

    @property
    def clock_s(self) -> float:
        return self._simulation.now_s + self.clock_offset_s

    def boot(self) -> None:
        """Start, with what the disk holds."""
        if not self.up:
            self.up = True
            self.starts += 1
            self._guarded(self._boot)

    def kill(self, down_s: float, *, wipe: bool = False) -> None:
        """End now; start again after a while, without the disk's content where it is wiped."""
        if self.up:
            self.up = False
            self._die()
        if wipe:
            self.disk, self.wiped = MemoryStore(), True
        self._simulation.at(self._simulation.now_s + down_s, self.boot)

    def pause(self, for_s: float) -> None:
        self._paused_until_s = max(self._paused_until_s, self._simulation.now_s + for_s)

    def later(self, after_s: float, action: Action) -> None:
        """Do something after a while, unless this process has ended meanwhile; a paused one does it when it goes on."""
        start = self.starts

        def run() -> None:
            if not self.up or self.starts != start:
                return
            if self._simulation.now_s < self._paused_until_s:
                self._simulation.at(self._paused_until_s, run)
            else:
                self._guarded(action)

        self._simulation.at(self._simulation.now_s + after_s, run)

    def _guarded(self, action: Action) -> None:
        try:
            action()
        except Killed:
            self.kill(self._simulation.down_s)

    def receive(self, at_s: float, action: Action) -> None:
        """Something arrives; it is lost where this process is down or cut off then."""

        def run() -> None:
            if self.up and not self.outward.is_cut(self._simulation.now_s):
                self.later(0.0, action)

        self._simulation.at(at_s, run)

    def send(self, to: "Process", data: bytes, deliver: Callable[[bytes], None]) -> None:
        """Bytes over this process's link to another."""
        for at_s, copy in self.outward.arrivals(self._simulation.now_s, data):
            to.receive(at_s + LATENCY_S, lambda copy=copy: deliver(copy))  # type: ignore[misc]

    def commit(self, changes: Sequence[object]) -> None:
        if changes:
            self._simulation.boundary(self)
            self.disk.commit(changes)  # type: ignore[arg-type]
            self._simulation.boundary(self)

    def _boot(self) -> None:
        raise NotImplementedError

    def _die(self) -> None:
        raise NotImplementedError


class SimVehicle(Process):
    """A vehicle core with its readings."""

    def __init__(self, simulation: "Simulation", log: Log, rng: np.random.Generator) -> None:
        super().__init__(simulation, log.vehicle, rng)
        self.core: VehicleCore | None = None
        self.notes = Notes(log.steps, len(log.sighting_step))
        self._log = log
        self._readings = list(log.readings())
        self._liar = Liar(simulation.scenario.faults.hostile, log.vehicle)
        self._waiting = self._serving = False
        self._taken = 0

    def _boot(self) -> None:
        scenario, log = self._simulation.scenario, self._log
        identity = Identity(
            fleet=scenario.fleet.name,
            vehicle=log.vehicle,
            epoch=Epoch(1 if self.starts == 1 else self.starts * 1000, int(self._rng.integers(2**63))),
            start_pose=log.start_pose,
            start_pose_cov=log.start_pose_cov,
        )
        self.core = VehicleCore(
            identity, scenario.filter, scenario.publish, required=scenario.fusion.required_acks, durable=True
        )
        self.core.resume(self.disk.load())
        if self.core.outbox.last < 0:
            self.core.start(float(log.time_s[0]), log.sightings_at(0))
            self.notes.take(0, self.core.pose)
        self._taken = sum(reading.time_s <= self.core.time_s for reading in self._readings)
        self._waiting = self._serving = False
        self._serve_soon()
        self.later(0.0, self._step)
        self.later(VEHICLE_TICK_S, self._tick)

    def _die(self) -> None:
        self.core = None

    def _step(self) -> None:
        core, scenario = self.core, self._simulation.scenario
        assert core is not None
        if core.ended:
            return
        if not scenario.run.rate_hz and core.crowded:
            self._waiting = True
            return
        if self._taken == len(self._readings):
            core.end()
            core.filter.localise()
            self._serve_soon()
            return
        self._taken += 1
        step = self._taken
        begin = time.perf_counter()
        with contextlib.suppress(ReadingRefused, NumericalError):  # counted by the core
            core.step(self._readings[step - 1])
        took = time.perf_counter() - begin
        core.filter.localise()
        self.notes.take(step, core.pose, took)
        self._serve_soon()
        self._simulation.on_step(self.name, step)
        self.later(1.0 / scenario.run.rate_hz if scenario.run.rate_hz else LATENCY_S, self._step)

    def _serve_soon(self) -> None:
        """Commit and put, with whatever steps come until then."""
        if not self._serving:
            self._serving = True
            self.later(self._simulation.commit_s, self._serve)

    def _serve(self) -> None:
        self._serving = False
        core = self.core
        assert core is not None
        changes, mark = core.take_changes()
        self.commit(changes)
        core.note_commit(mark)
        begin = time.perf_counter()
        released = core.release()
        if released:
            self.notes.publish_s.append(time.perf_counter() - begin)
        for message in released:
            for data in self._liar(message):
                self._simulation.boundary(self)
                for node in self._simulation.nodes.values():
                    self.send(node, data, lambda copy, node=node: node.on_delta(self.name, copy))  # type: ignore[misc]
        if self._waiting and not core.crowded:
            self._waiting = False
            self.later(0.0, self._step)

    def _tick(self) -> None:
        assert self.core is not None
        for heartbeat in self.core.tick(self.clock_s):
            for node in self._simulation.nodes.values():
                self.send(node, heartbeat, lambda copy, node=node: node.on_heartbeat(self.name, copy))  # type: ignore[misc]
        self._serve_soon()
        self.later(VEHICLE_TICK_S, self._tick)

    def on_ack(self, data: bytes) -> None:
        assert self.core is not None
        self.core.on_ack(data)
        self._serve_soon()

    def answer(self, data: bytes) -> list[bytes]:
        if self.core is None:
            return []
        return [lie for message in self.core.on_range(data) for lie in self._liar(message)]

    @property
    def done(self) -> bool:
        return self.core is not None and self.core.done

    def result(self) -> DriveResult:
        """What it has to say after the run."""
        assert self.core is not None
        core = self.core
        return self.notes.result(core.landmarks, core.filter.signatures, core.assigned, core.counters)


class SimNode(Process):
    """A fusion core with its store."""

    def __init__(self, simulation: "Simulation", name: str, rng: np.random.Generator) -> None:
        super().__init__(simulation, name, rng)
        self.core: FusionCore | None = None
        self.served = b""
        self._effects: list[Effect] = []
        self._flushing = False

    def _boot(self) -> None:
        scenario, simulation = self._simulation.scenario, self._simulation
        self.core = FusionCore(scenario.fleet.name, self.name, scenario.fusion, expected=len(simulation.vehicles))
        self.core.restore(self.disk.load(), self.clock_s)
        simulation.on_boot(self)
        self._effects, self._flushing, self.served = [], False, b""
        self.later(FUSION_TICK_S, self._tick)

    def _die(self) -> None:
        self.core = None

    def _tick(self) -> None:
        assert self.core is not None
        self._take(self.core.tick(self.clock_s))
        self.later(FUSION_TICK_S, self._tick)

    def on_delta(self, vehicle: str, data: bytes) -> None:
        assert self.core is not None
        self._take(self.core.on_delta(vehicle, data, self.clock_s))
        self._simulation.on_event(self)

    def on_heartbeat(self, vehicle: str, data: bytes) -> None:
        assert self.core is not None
        self._take(self.core.on_heartbeat(vehicle, data, self.clock_s))

    def _take(self, effects: list[Effect]) -> None:
        """Effects wait for the next commit."""
        self._effects += effects
        if not self._flushing:
            self._flushing = True
            self.later(self._simulation.commit_s, self._flush)

    def _flush(self) -> None:
        assert self.core is not None
        self._flushing = False
        effects, self._effects = self._effects, []
        self.commit(self.core.ledger.take_changes())
        for effect in effects:
            self._simulation.boundary(self)
            self._execute(effect)

    def _execute(self, effect: Effect) -> None:
        simulation = self._simulation
        match effect:
            case PutAck(vehicle=vehicle, data=data):
                to = simulation.vehicles.get(vehicle)
                if to is not None:
                    simulation.on_ack_put(self, data)
                    self.send(to, data, to.on_ack)
            case PutStatus(data=data):
                for node in simulation.nodes.values():
                    if node is not self:
                        self.send(node, data, lambda copy, node=node: node.on_status(self.name, copy))  # type: ignore[misc]
            case AskRange(vehicle=vehicle, epoch=epoch, data=data, nodes=nodes):
                asked = (
                    [n for n in simulation.nodes.values() if n is not self]
                    if nodes
                    else [simulation.vehicles.get(vehicle)]
                )
                self._ask(vehicle, epoch, data, [each for each in asked if each is not None])
            case PutMerges(data=data):
                for other in simulation.nodes.values():
                    if other is not self:
                        self.send(other, data, lambda copy, other=other: other.on_merges(self.name, copy))  # type: ignore[misc]
            case AskMap(node=name):
                peer = simulation.nodes[name]
                if peer.served:
                    peer.send(self, peer.served, lambda copy: self.on_map(name, copy))
            case AskEvents(node=node):
                peer = simulation.nodes[node]
                replies = peer.core.answer_events() if peer.core is not None else []
                for reply in replies:
                    peer.send(self, reply, lambda copy: self.on_events(node, copy))

    def _ask(self, vehicle: str, epoch: Epoch, data: bytes, asked: Sequence["SimVehicle | SimNode"]) -> None:
        """A query takes LATENCY_S there and back; its replies can be lost, doubled or damaged like any message."""

        def reach() -> None:
            for each in asked:
                if not each.up or each.outward.is_cut(self._simulation.now_s):
                    continue
                replies = each.answer(data) if isinstance(each, SimVehicle) else each.answer_range(vehicle, data)
                for reply in replies:
                    for _, copy in each.outward.arrivals(self._simulation.now_s, reply):
                        self.receive(self._simulation.now_s, lambda copy=copy: self.on_reply(vehicle, copy))  # type: ignore[misc]
            self.later(LATENCY_S, lambda: self._done(vehicle, epoch))

        self.later(LATENCY_S, reach)

    def answer_range(self, vehicle: str, data: bytes) -> list[bytes]:
        return self.core.answer_range(vehicle, data) if self.core is not None else []

    def on_reply(self, vehicle: str, data: bytes) -> None:
        assert self.core is not None
        self._take(self.core.on_reply(vehicle, data, self.clock_s))
        self._simulation.on_event(self)

    def _done(self, vehicle: str, epoch: Epoch) -> None:
        assert self.core is not None
        self._take(self.core.on_reply_done(vehicle, epoch, self.clock_s))

    def on_status(self, node: str, data: bytes) -> None:
        assert self.core is not None
        self._take(self.core.on_status(node, data, self.clock_s))

    def serve(self, joint: JointMap, merges: Merges) -> None:
        """Serve a map; simulated nodes make none of their own accord."""
        assert self.core is not None
        self.served = encode_map(joint)
        self._take(self.core.on_served(joint, merges))

    def on_merges(self, node: str, data: bytes) -> None:
        assert self.core is not None
        self._take(self.core.on_merges(node, data))

    def on_map(self, node: str, data: bytes) -> None:
        assert self.core is not None
        self._take(self.core.on_map(node, data))

    def on_events(self, node: str, data: bytes) -> None:
        assert self.core is not None
        self._take(self.core.on_events(node, data))


class Simulation:
    """A fleet: run `advance` until it is `settled`. Attributes that are actions may be replaced by who watches.

    commit_s: how long steps and effects wait for a commit that they share. down_s: how long a process that is killed at
    a boundary stays down. kill_at: the numbers of the boundaries at which that happens.
    """

    def __init__(self, scenario: Scenario, recording: Recording, *, commit_s: float = LATENCY_S) -> None:
        self.scenario = scenario
        self.now_s = 0.0
        self.commit_s = commit_s
        self.down_s = 0.5
        self.kill_at: frozenset[int] = frozenset()
        self.boundaries = 0
        self.on_step: Callable[[str, int], None] = lambda vehicle, step: None
        self.on_event: Callable[[SimNode], None] = lambda node: None
        self.on_boot: Callable[[SimNode], None] = lambda node: None
        self.on_ack_put: Callable[[SimNode, bytes], None] = lambda node, data: None
        self._events: list[tuple[float, int, Action]] = []
        self._order = itertools.count()
        nodes, logs = scenario.fleet.node_names, recording.logs
        seeds = np.random.SeedSequence([scenario.run.seed, 0x1F1EE7]).spawn(len(logs) + len(nodes))
        rngs = [np.random.default_rng(seed) for seed in seeds]
        self.vehicles = {name: SimVehicle(self, log, rng) for (name, log), rng in zip(logs.items(), rngs, strict=False)}
        self.nodes = {name: SimNode(self, name, rng) for name, rng in zip(nodes, rngs[len(logs) :], strict=True)}
        for name, process in self.processes.items():
            self.at(scenario.faults.joins_s(name), process.boot)
        for fault in scenario.faults.events:
            if fault.what != "join":
                self.at(fault.at_s, self._happening(fault.what, fault.who, fault.for_s, fault.by_s))

    @property
    def processes(self) -> dict[str, Process]:
        return {**self.nodes, **self.vehicles}

    def _happening(self, what: str, who: str, for_s: float, by_s: float) -> Action:
        process = self.processes[who]
        match what:
            case "pause":
                return lambda: process.pause(for_s)
            case "clock":
                return lambda: setattr(process, "clock_offset_s", process.clock_offset_s + by_s)
            case _:
                return lambda: process.kill(for_s, wipe=what == "wipe")

    def at(self, when_s: float, action: Action) -> None:
        """Do something at a virtual time."""
        heapq.heappush(self._events, (when_s, next(self._order), action))

    def calm(self) -> None:
        """From now on links are perfect and nobody is killed; who is down comes up."""
        self.kill_at = frozenset()
        for process in self.processes.values():
            process.outward = LinkModel(LinkSettings(), np.random.default_rng(0), process.name)
            process.boot()

    def boundary(self, process: Process) -> None:
        """Between two effects of a process: the place to kill it."""
        self.boundaries += 1
        if self.boundaries in self.kill_at:
            raise Killed(process.name)

    def advance(self) -> None:
        """Handle the next event."""
        self.now_s, _, action = heapq.heappop(self._events)
        action()

    @property
    def settled(self) -> bool:
        """Whether every vehicle has ended and is acknowledged, and every node has all there is."""
        return all(v.done for v in self.vehicles.values()) and all(
            n.core is not None and n.core.complete for n in self.nodes.values()
        )

    def progress(self) -> int:
        """A number that changes as long as anything gets through."""
        nodes = [n.core for n in self.nodes.values() if n.core is not None]
        vehicles = [v.core for v in self.vehicles.values() if v.core is not None]
        folded = sum(s.next for core in nodes for s in core.ledger.streams.values())
        return folded + sum(core.steps + core.outbox.last_acknowledged for core in vehicles)
