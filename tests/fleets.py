"""Whole fleets in one process for tests, scored."""

from scenarios.children import stream_facts
from scenarios.config import load_scenario
from scenarios.report import FinishedRun, Outcome, evaluate
from scenarios.source import record
from scenarios.virtual import VirtualFleet


def run_virtual(name: str, *settings: str, seed: int | None = None) -> FinishedRun:
    """A finished virtual run of a scenario."""
    scenario = load_scenario(name, settings, seed)
    recording = record(scenario)
    fleet = VirtualFleet(scenario, recording)
    drives = fleet.drive()
    return FinishedRun(
        name=name,
        scenario=scenario,
        recording=recording,
        ledger=fleet.fusion.ledger,
        drives=drives,
        streams=stream_facts(fleet.fusion),
        wall_s=0.0,
    )


def outcome_of(name: str, *settings: str, seed: int | None = None) -> Outcome:
    """The same, evaluated."""
    return evaluate(run_virtual(name, *settings, seed=seed))
