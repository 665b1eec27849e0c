"""Readings for a scenario: from its simulated world or its data set."""

from dataclasses import replace

from scenarios import mrclam
from scenarios.config import Scenario, ScenarioError
from scenarios.detection import detected, without_signatures
from scenarios.mrclam_files import DatasetError
from scenarios.recording import Recording
from scenarios.world import simulate


def vehicle_names(scenario: Scenario) -> tuple[str, ...]:
    """The vehicles of a scenario, in fleet order."""
    if scenario.dataset is not None:
        return mrclam.robots(scenario.dataset)
    return tuple(f"v{i + 1}" for i in range(scenario.fleet.vehicles))


def check_names(scenario: Scenario) -> None:
    """Raise ScenarioError where [faults] or [link] names a process that does not take part."""
    try:
        known = {*vehicle_names(scenario), *scenario.fleet.node_names}
    except DatasetError as error:
        raise ScenarioError(str(error)) from None
    named = {
        "faults.events": {fault.who for fault in scenario.faults.events},
        "faults.hostile": {hostile.who for hostile in scenario.faults.hostile},
        "link.cuts": {who for cut in scenario.link.cuts for who in cut.who},
        "fusion.required_acks": set(scenario.fusion.required_acks),
    }
    for table, names in named.items():
        if names - known:
            raise ScenarioError(
                f"[{table}] {', '.join(sorted(names - known))}: the processes are {', '.join(sorted(known))}"
            )


def record(scenario: Scenario, only: str | None = None) -> Recording:
    """Every reading of a scenario's vehicles, or of one of them. The same arguments give the same readings.

    Raises ScenarioError for a vehicle that does not take part or a data set that cannot be read.
    """
    try:
        names = vehicle_names(scenario)
        recording = _simulated(scenario) if scenario.dataset is None else mrclam.load(scenario.dataset, only=only)
    except DatasetError as error:
        raise ScenarioError(str(error)) from None
    if scenario.detection.signatures == "none":
        recording = without_signatures(recording, names, scenario.run.seed)
    if only is None:
        return recording
    if only not in recording.logs:
        raise ScenarioError(f"no vehicle {only!r} in this scenario: its vehicles are {', '.join(names)}")
    return replace(recording, logs={only: recording.logs[only]})


def _simulated(scenario: Scenario) -> Recording:
    assert scenario.world is not None
    world, noise, seed = scenario.world, scenario.noise, scenario.run.seed
    try:
        recording = simulate(world, noise, vehicle_names(scenario), seed)
    except ValueError as error:  # settings that are fine each, but not together
        raise ScenarioError(f"[world] {error}") from None
    return detected(recording, world, noise, scenario.detection, seed)
