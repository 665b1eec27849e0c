"""A scenario run in one process, on a virtual clock: see `simulation`."""

import time
from collections.abc import Callable

from fleet_seif.errors import RunError
from scenarios.config import Scenario
from scenarios.output import stream_facts
from scenarios.recording import Recording
from scenarios.report import FinishedRun
from scenarios.simulation import Simulation

SILENCE_S = 120.0


def run_virtual(
    name: str,
    scenario: Scenario,
    recording: Recording,
    progress: Callable[[str, int, int], None] = lambda vehicle, done, total: None,
) -> FinishedRun:
    """A whole run; progress is called with vehicle, done and total steps.

    Raises RunError where nothing gets through for SILENCE_S of virtual time.
    """
    begin = time.monotonic()
    fleet = Simulation(scenario, recording)
    fleet.on_step = lambda vehicle, step: progress(vehicle, step, recording.logs[vehicle].steps)
    last, last_s = -1, 0.0
    while not fleet.settled:
        fleet.advance()
        if fleet.now_s > last_s + 1.0:
            made = fleet.progress()
            if made != last:
                last, last_s = made, fleet.now_s
            elif fleet.now_s > last_s + SILENCE_S:
                raise RunError(f"nothing got through for {SILENCE_S:.0f} s of virtual time: [link] loses too much")
    cores = [node.core for node in fleet.nodes.values() if node.core is not None]
    if len({core.ledger.map_digest() for core in cores}) > 1:
        raise RunError("the fusion nodes hold different maps at the end: please report this")
    return FinishedRun(
        name=name,
        scenario=scenario,
        recording=recording,
        ledger=cores[0].ledger,
        drives={vehicle: each.result() for vehicle, each in fleet.vehicles.items()},
        streams=stream_facts(cores[0], fleet.now_s),
        wall_s=time.monotonic() - begin,
        fusion=dict(cores[0].counters),
    )
