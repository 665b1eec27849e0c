"""Seeded chaos on whole simulated fleets: equality in the end, and proof that broken promises would be noticed."""

from collections.abc import Sequence

import pytest

from fleet_seif.store import Change, MemoryStore
from scenarios import chaos
from scenarios.chaos import Decision, Schedule
from scenarios.chaos_runs import Arena, Tally, read_schedule, run_seeds, seed_range
from scenarios.config import Scenario, ScenarioError, load_scenario
from scenarios.faults import Fault, Hostile
from scenarios.simulation import SimNode

SMALL = ("fleet.vehicles=2", "world.landmarks=8", "world.steps=12")
TINY = ("fleet.vehicles=1", "world.landmarks=6", "world.steps=4", "fusion.ack_every=1")


def scenario(*settings: str) -> Scenario:
    return load_scenario("fleet", settings)


@pytest.fixture(scope="module")
def small() -> Arena:
    return Arena(scenario(*SMALL))


@pytest.fixture(scope="module")
def tiny() -> Arena:
    return Arena(scenario(*TINY))


def test_seeds_of_chaos_end_with_equal_maps(small: Arena) -> None:
    tally = Tally()
    for seed in range(60):
        tally.add(small.run(small.schedule(seed)))
    assert tally.failures == []
    assert tally.kills > 60


def test_seeds_of_chaos_without_identities_end_with_equal_maps() -> None:
    """Frames of 12 steps: kills fall on their ends, and on what is decided again after them."""
    changed = ("fleet.vehicles=2", "world.routes=coverage", "world.steps=40", "noise.turn_std_rad=0.1")
    arena = Arena(load_scenario("three_air_vehicles_unknown", (*changed, "filter.frame_steps_max=12")))
    tally = Tally()
    for seed in range(6):
        tally.add(arena.run(arena.schedule(seed)))
    assert tally.failures == []
    assert tally.kills > 6


def test_a_kill_before_any_effect_loses_nothing(tiny: Arena) -> None:
    tally = Tally()
    for seed in (1, 2, 3):
        tally.add(tiny.run_every_boundary(tiny.schedule(seed).model_copy(update={"kills": ()})))
    assert tally.failures == []
    assert tally.seeds > 90


def test_a_seed_gives_the_same_run_every_time(small: Arena) -> None:
    first, second = (small.run(small.schedule(17)) for _ in range(2))
    assert first == second
    assert first.events > 100


@pytest.mark.parametrize("lie", ["indefinite", "absurd", "foreign", "equivocate", "garbage"])
def test_a_liar_leaves_the_others_as_they_are(small: Arena, lie: str) -> None:
    hostile = (Hostile(who="v2", lie=lie, from_step=5),)
    assert small.run(Schedule(seed=3, nodes=3, hostile=hostile)).failures == []


def test_a_node_whose_disk_is_gone_catches_up(small: Arena) -> None:
    faults = (Fault(at_s=0.1, what="wipe", who="fusion", for_s=0.1),)
    assert small.run(Schedule(seed=4, nodes=1, faults=faults)).failures == []


def test_clocks_that_jump_change_nothing(small: Arena) -> None:
    faults = tuple(Fault(at_s=0.05, what="clock", who=who, by_s=by_s) for who, by_s in (("v1", -5.0), ("fusion", 9.0)))
    assert small.run(Schedule(seed=5, faults=faults)).failures == []


def test_operators_decisions_reach_every_node(small: Arena) -> None:
    decisions = (
        Decision(at_s=0.02, node="fusion", action="retract", vehicle="v1"),
        Decision(at_s=0.08, node="fusion2", action="restore", vehicle="v1"),
        Decision(at_s=0.08, node="fusion2", action="retract", vehicle="v2"),
    )
    assert small.run(Schedule(seed=6, nodes=2, decisions=decisions)).failures == []


def test_a_disk_that_forgets_is_noticed(small: Arena, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same schedule, on disks that keep nothing: what was acknowledged is gone after a kill."""
    faults = (Fault(at_s=0.09, what="kill", who="fusion", for_s=0.01),)
    schedule = Schedule(seed=7, nodes=2, faults=faults)
    assert small.run(schedule).failures == []

    def forget(self: MemoryStore, changes: Sequence[Change]) -> None:
        pass

    monkeypatch.setattr(MemoryStore, "commit", forget)
    ((_, reason, _),) = small.run(schedule).failures
    assert "has lost it" in reason


def test_acknowledging_before_committing_is_noticed(tiny: Arena, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of effects matters: with acknowledgements first, a kill between them and the commit loses a message."""

    def acknowledge_first(self: SimNode) -> None:
        assert self.core is not None
        self._flushing = False
        effects, self._effects = self._effects, []
        for effect in effects:
            self._simulation.boundary(self)
            self._execute(effect)
        self.commit(self.core.ledger.take_changes())

    monkeypatch.setattr(SimNode, "_flush", acknowledge_first)
    tally = tiny.run_every_boundary(Schedule(seed=8, nodes=1))
    assert any("has lost it" in reason for _, reason, _ in tally.failures)


def test_what_fails_is_shrunk_to_the_least_that_fails_and_replays(
    small: Arena, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A check that dislikes kills of v1: of a whole schedule one kill stays."""
    faults = (
        Fault(at_s=0.02, what="kill", who="v1", for_s=0.05),
        Fault(at_s=0.03, what="pause", who="v2", for_s=0.05),
        Fault(at_s=0.04, what="clock", who="fusion", by_s=1.0),
    )
    real = chaos.run_schedule

    def dislike(schedule: Schedule, *rest: object) -> chaos.ChaosRun:
        done = real(schedule, *rest)  # type: ignore[arg-type]
        if any(fault.what == "kill" for fault in schedule.faults):
            raise chaos.ChaosError("v1 was killed")
        return done

    monkeypatch.setattr("scenarios.chaos_runs.run_schedule", dislike)
    ((seed, reason, least),) = small.run(Schedule(seed=9, faults=faults, kills=(60,))).failures
    assert (seed, reason) == (9, "v1 was killed")
    replayed = read_schedule(least)
    assert replayed.faults == faults[:1]
    assert not replayed.kills
    assert small.run(replayed).failures[0][1] == reason


def test_seeds_are_spread_over_processes() -> None:
    said: list[str] = []
    tally = run_seeds(scenario(*TINY), range(8), 2, said.append)
    assert (tally.seeds, tally.failures) == (8, [])


@pytest.mark.parametrize("text", ["", "1..", "a..b", "-3..4", "1..2..3"])
def test_a_malformed_range_of_seeds_is_refused_by_name(text: str) -> None:
    with pytest.raises(ScenarioError, match="--seeds"):
        seed_range(text)


def test_ranges_of_seeds_include_both_ends() -> None:
    assert (seed_range("3..5"), seed_range("7")) == (range(3, 6), range(7, 8))


@pytest.mark.parametrize("text", ["", "{}", '{"seed": 1, "nodez": 2}'])
def test_a_malformed_schedule_is_refused_by_name(text: str) -> None:
    with pytest.raises(ScenarioError, match="--schedule"):
        read_schedule(text)
