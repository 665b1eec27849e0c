"""Seeded chaos: whole fleets in one process with faults drawn from a seed, which must come to the same map in the end.

1. A seed and a scenario give a `Schedule`: how bad the links are, what happens to which process and when, before which
   effects a process is killed, who lies, what operators decide. The world and the readings are those of the scenario.
2. Faults end, everybody is up, and then all must come to rest with equal digests: those of a run without faults, but
   for a liar's share.
3. Meanwhile, and at every restart: what a node has acknowledged it still holds; every map that could be served can be
   solved from positive definite information.
4. Of a schedule that fails as little as possible is kept that still fails; it is printed and can be run again.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fleet_seif.config import NotNegative, Settings
from fleet_seif.errors import NumericalError
from fleet_seif.information import delta_digest
from fleet_seif.link import LinkSettings
from fleet_seif.messages import Action, Epoch
from fleet_seif.wire import decode_ack
from fusion.mapping import make_map, map_input
from scenarios.config import Scenario
from scenarios.faults import Fault, FaultSettings, Hostile
from scenarios.recording import Recording
from scenarios.simulation import SimNode, Simulation

PATIENCE_S = 60.0
SAMPLES = 2
KILLS_MAX = 4
FAULTS_MAX = 6


class Decision(Settings):
    """An operator of a node retracts or restores a vehicle."""

    at_s: NotNegative
    node: str
    action: Literal["retract", "restore"]
    vehicle: str


class Schedule(Settings):
    """All that goes wrong in one run. kills: numbers of the effects before which the process at work is killed."""

    seed: int
    nodes: int = 2
    commit_s: float = 1e-4
    link: LinkSettings = LinkSettings()
    faults: tuple[Fault, ...] = ()
    kills: tuple[int, ...] = ()
    hostile: tuple[Hostile, ...] = ()
    decisions: tuple[Decision, ...] = ()


class ChaosError(AssertionError):
    """Something that must always hold did not."""


def draw_schedule(seed: int, scenario: Scenario, recording: Recording) -> Schedule:
    """The schedule of a seed."""
    rng = np.random.default_rng([0xC4A05, seed])
    steps = max(log.steps for log in recording.logs.values())
    span_s = steps / (scenario.run.rate_hz or 100.0)
    nodes = int(rng.integers(1, 4))
    node_names = scenario.model_copy(
        update={"fleet": scenario.fleet.model_copy(update={"nodes": nodes})}
    ).fleet.node_names
    everybody = [*recording.logs, *node_names]

    def when() -> float:
        return round(float(rng.uniform(0, 1.5 * span_s)), 4)

    def one_of(names: list[str]) -> str:
        return names[int(rng.integers(len(names)))]

    def fault() -> Fault:
        what = str(rng.choice(["kill", "kill", "kill", "pause", "clock", "wipe"]))
        who = one_of(list(node_names)) if what == "wipe" else one_of(everybody)
        for_s = round(float(rng.uniform(0.01, span_s)), 4)
        return Fault(at_s=when(), what=what, who=who, for_s=for_s, by_s=round(float(rng.normal(0, 3)), 3))

    def cut() -> dict[str, Any]:
        who = (one_of(everybody),) if rng.random() < 0.8 else ()
        return {"from_s": when(), "for_s": round(float(rng.uniform(0.01, span_s)), 4), "who": who}

    bad = rng.random() < 0.8
    link = LinkSettings.model_validate({
        "loss": round(float(rng.choice([0.0, 0.05, 0.3, 0.6])), 2) if bad else 0.0,
        "duplication": round(float(rng.choice([0.0, 0.2])), 2) if bad else 0.0,
        "corruption": round(float(rng.choice([0.0, 0.0, 0.1])), 2) if bad else 0.0,
        "jitter_s": float(rng.choice([0.0, 0.02, 0.3])) if bad else 0.0,
        "reorder": bool(rng.random() < 0.8),
        "cuts": [cut() for _ in range(int(rng.integers(0, 3)))],
    })  # fmt: skip
    lies = ("indefinite", "absurd", "foreign", "equivocate", "garbage")
    hostile: list[Hostile] = []
    if len(recording.logs) > 1 and rng.random() < 0.25:
        lie = lies[int(rng.integers(len(lies)))]
        from_step = int(rng.integers(1, steps + 1))
        hostile = [Hostile(who=one_of(list(recording.logs)), lie=lie, from_step=from_step)]
    decisions = [
        Decision(at_s=when(), node=one_of(list(node_names)), action=action, vehicle=one_of(list(recording.logs)))
        for action in ("retract", "restore")
        if rng.random() < 0.1
    ]
    return Schedule(
        seed=seed,
        nodes=nodes,
        commit_s=float(rng.choice([1e-4, 0.005, 0.05])),
        link=link,
        faults=tuple(fault() for _ in range(int(rng.integers(0, FAULTS_MAX + 1)))),
        kills=tuple(sorted({int(n) for n in rng.integers(1, 40 * steps, int(rng.integers(0, KILLS_MAX + 1)))})),
        hostile=tuple(hostile),
        decisions=tuple(decisions),
    )


@dataclass
class ChaosRun:
    """What came of one schedule."""

    boundaries: int = 0
    events: int = 0
    virtual_s: float = 0.0
    kills: int = 0


@dataclass
class _Watcher:
    """Holds a simulation to what must always be true."""

    fleet: Simulation
    rng: np.random.Generator
    samples: int = SAMPLES
    acked: dict[tuple[str, str, Epoch], int] = field(default_factory=dict)

    def on_ack(self, node: SimNode, data: bytes) -> None:
        ack = decode_ack(data)
        key = (node.name, ack.vehicle, ack.epoch)
        self.acked[key] = max(self.acked.get(key, -1), ack.last)

    def on_boot(self, node: SimNode) -> None:
        """What it acknowledged before it was killed it holds after; a wiped disk has forgotten, an equivocator's
        messages are taken back."""
        assert node.core is not None
        for (name, vehicle, epoch), last in list(self.acked.items()):
            if name != node.name:
                continue
            if node.wiped:
                del self.acked[name, vehicle, epoch]
                continue
            stream = node.core.ledger.streams.get((vehicle, epoch))
            stopped = any(s.stop is not None for s in node.core.ledger.streams.values() if s.vehicle == vehicle)
            if not stopped and (stream is None or stream.next <= last):
                raise ChaosError(f"{name} acknowledged message {last} of {vehicle} {epoch} and has lost it")
        node.wiped = False

    def on_event(self, node: SimNode) -> None:
        if self.samples and self.rng.random() < 0.02:
            self.samples -= 1
            self.check_maps(node)

    def check_maps(self, node: SimNode) -> None:
        """Every life is positive definite as checked, and a map can be made."""
        assert node.core is not None
        taken = map_input(node.core, node.clock_s)
        if not taken.checked:
            return
        try:
            make_map(taken, 0, final=False)
        except NumericalError as error:
            raise ChaosError(f"{node.name} could serve no map: {error}") from None


def contributions(node: SimNode, vehicles: set[str]) -> dict[str, list[bytes]]:
    """Digests of what these vehicles' lives have contributed, as a node has checked it."""
    assert node.core is not None
    found: dict[str, list[bytes]] = {}
    for _, stream in sorted(node.core.ledger.streams.items()):
        if stream.vehicle in vehicles and stream.life is not None and stream.hello and stream.hello.continues is None:
            frames = stream.life.checked.frames
            found[stream.vehicle] = [delta_digest(frames[number]) for number in sorted(frames)]
    return found


def reference(scenario: Scenario, recording: Recording) -> dict[str, list[bytes]]:
    """The contributions of a run in which nothing goes wrong."""
    fleet = Simulation(_with(scenario, Schedule(seed=0, nodes=1)), recording)
    while not fleet.settled:
        fleet.advance()
    return contributions(fleet.nodes["fusion"], set(recording.logs))


def _with(scenario: Scenario, schedule: Schedule) -> Scenario:
    fleet = scenario.fleet.model_copy(update={"nodes": schedule.nodes})
    return scenario.model_copy(update={
        "fleet": fleet,
        "link": schedule.link,
        "fusion": scenario.fusion.model_copy(update={"required_acks": fleet.node_names}),
        "faults": FaultSettings(events=schedule.faults, hostile=schedule.hostile),
        "run": scenario.run.model_copy(update={"seed": schedule.seed, "rate_hz": scenario.run.rate_hz or 100.0}),
    })  # fmt: skip


def run_schedule(
    schedule: Schedule, scenario: Scenario, recording: Recording, expected: dict[str, list[bytes]]
) -> ChaosRun:
    """Run one schedule to its end. Raises ChaosError where something does not hold."""
    fleet = Simulation(_with(scenario, schedule), recording, commit_s=schedule.commit_s)
    watcher = _Watcher(fleet, np.random.default_rng([schedule.seed, 1]))
    fleet.on_ack_put, fleet.on_event, fleet.on_boot = watcher.on_ack, watcher.on_event, watcher.on_boot
    fleet.kill_at = frozenset(schedule.kills)
    for decision in schedule.decisions:
        fleet.at(decision.at_s, _decides(fleet, decision))
    times = [
        *(fault.at_s + fault.for_s for fault in schedule.faults),
        *(c.from_s + c.for_s for c in schedule.link.cuts),
    ]
    steps = max(log.steps for log in recording.logs.values())
    calm_s = max([*times, *(d.at_s for d in schedule.decisions), 1.5 * steps / fleet.scenario.run.rate_hz])
    fleet.at(calm_s, fleet.calm)
    done = ChaosRun()
    while fleet.now_s < calm_s or not _at_rest(fleet, schedule):
        fleet.advance()
        done.events += 1
        if fleet.now_s > calm_s + PATIENCE_S:
            raise ChaosError(f"not at rest {PATIENCE_S:.0f} s after the last fault: {_where(fleet)}")
    honest = set(recording.logs) - {hostile.who for hostile in schedule.hostile}
    for node in fleet.nodes.values():
        found = contributions(node, honest)
        wrong = [name for name in sorted(honest) if found.get(name) != expected[name]]
        if wrong:
            raise ChaosError(f"{node.name} holds another sum of {', '.join(wrong)} than a run without faults")
    watcher.check_maps(fleet.nodes["fusion"])
    done.boundaries, done.virtual_s = fleet.boundaries, float(fleet.now_s)
    done.kills = sum(process.starts - 1 for process in fleet.processes.values())
    return done


def _decides(fleet: Simulation, decision: Decision) -> Callable[[], None]:
    def decide() -> None:
        node = fleet.nodes[decision.node]
        if node.core is not None:
            node.core.ledger.issue(decision.node, Action(decision.action), vehicle=decision.vehicle)

    return decide


def _at_rest(fleet: Simulation, schedule: Schedule) -> bool:
    """Whether everything is delivered and all nodes are equal."""
    cores = [node.core for node in fleet.nodes.values()]
    liars = {hostile.who for hostile in schedule.hostile}
    if any(core is None for core in cores) or not all(v.done for v in fleet.vehicles.values() if v.name not in liars):
        return False
    ledgers = [core.ledger for core in cores if core is not None]
    if not all(core.over(v) for core in cores if core is not None for v in fleet.vehicles if v not in liars):
        return False
    if len({ledger.ledger_digest() for ledger in ledgers}) > 1:
        return False
    if (
        len({frozenset((s.key, s.quarantine) for s in ledger.streams.values() if s.quarantine) for ledger in ledgers})
        > 1
    ):
        return False
    if len({ledger.map_digest() for ledger in ledgers}) > 1:
        raise ChaosError("equal ledgers give different maps")
    return True


def _where(fleet: Simulation) -> str:
    words = []
    for node in fleet.nodes.values():
        if node.core is None:
            words.append(f"{node.name} is down")
            continue
        for state in node.core.states(node.clock_s):
            fault = f" ({state.fault})" if state.fault else ""
            words.append(
                f"{node.name}: {state.name} {state.epoch.counter} cut {state.cut} behind {state.behind}{fault}"
            )
    words += [f"{v.name} not done" for v in fleet.vehicles.values() if not v.done]
    return "; ".join(words)


def smaller(schedule: Schedule) -> Iterator[Schedule]:
    """Schedules with one thing less."""
    for name in ("faults", "kills", "hostile", "decisions"):
        items = getattr(schedule, name)
        if len(items) > 1:
            yield schedule.model_copy(update={name: ()})
        for i in range(len(items)):
            yield schedule.model_copy(update={name: items[:i] + items[i + 1 :]})
    link = schedule.link
    for name in ("loss", "duplication", "corruption", "jitter_s"):
        if getattr(link, name):
            yield schedule.model_copy(update={"link": link.model_copy(update={name: 0.0})})
    for i in range(len(link.cuts)):
        yield schedule.model_copy(update={"link": link.model_copy(update={"cuts": link.cuts[:i] + link.cuts[i + 1 :]})})
    named = f'"fusion{schedule.nodes}"' in schedule.model_dump_json()
    if schedule.nodes > 1 and not schedule.decisions and not named:
        yield schedule.model_copy(update={"nodes": schedule.nodes - 1})


def shrink(schedule: Schedule, fails: Callable[[Schedule], bool]) -> Schedule:
    """As little of a failing schedule as still fails."""
    while True:
        less = next((each for each in smaller(schedule) if _fails(each, fails)), None)
        if less is None:
            return schedule
        schedule = less


def _fails(schedule: Schedule, fails: Callable[[Schedule], bool]) -> bool:
    try:
        return fails(schedule)
    except KeyError:  # it names a node that is no longer there
        return False
