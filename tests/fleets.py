"""Whole fleets in one process for tests, scored."""

from scenarios import virtual
from scenarios.config import load_scenario
from scenarios.report import FinishedRun, Outcome, evaluate
from scenarios.source import record


def run_virtual(name: str, *settings: str, seed: int | None = None) -> FinishedRun:
    """A finished virtual run of a scenario."""
    scenario = load_scenario(name, settings, seed)
    return virtual.run_virtual(name, scenario, record(scenario))


def outcome_of(name: str, *settings: str, seed: int | None = None) -> Outcome:
    """The same, evaluated."""
    return evaluate(run_virtual(name, *settings, seed=seed))
