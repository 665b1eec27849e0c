"""A whole step, delta included: against the size of the map, and against the bare factorisations it needs.

Steps have six sightings of known landmarks and begin with six landmarks linked to the pose, on a complete map, in the
paper's world with mild noise. Each is timed as its caller sees it: one call of Seif.step in a loop over the readings.
"""

from collections.abc import Sequence
from itertools import compress

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from fleet_seif.records import Reading
from fleet_seif.seif import Seif
from tests.benchmarks import bare
from tests.benchmarks.captured import Captured, captures
from tests.benchmarks.conftest import Ratio
from tests.benchmarks.runs import LAST, SETTINGS, Run, interior, median, run_in_turns, started, taken, world

SIZES = (50, 500, 5000)
LANDMARKS = 200
HOT = 20
"""Repetitions of the bare solves of one step."""


def last_steps(landmarks: int) -> Run:
    """A filter whose run is the last steps of the world."""
    at = world(landmarks, True)
    return started(Seif(SETTINGS), at, skip=at.log.steps - LAST)


def median_of_six(run: Run, landmarks: int) -> float:
    at = world(landmarks, True)
    return median(list(compress(run.us, interior(taken(at, at.log.steps - LAST), run.readings))))


@pytest.mark.timeout(600)
@pytest.mark.benchmark(group="whole step, at N = 5000")
def test_a_step_against_the_number_of_landmarks(benchmark: BenchmarkFixture, ratio: Ratio) -> None:
    runs = {size: last_steps(size) for size in SIZES}
    ours = runs[SIZES[-1]]
    run_in_turns(benchmark, ours, [run for run in runs.values() if run is not ours])
    us = {size: median_of_six(run, size) for size, run in runs.items()}
    benchmark.extra_info["median us of a step with six sightings, by N"] = us
    for size in SIZES[1:]:
        ratio(f"step_at_{size}_landmarks_over_{SIZES[0]}", us[size] / us[SIZES[0]])


class BareRun:
    """The solves of the steps with six sightings, many times over each, and once in the loop of a second filter."""

    def __init__(self, found: Sequence[Captured | None], seif: Seif, readings: Sequence[Reading]) -> None:
        self.systems = [
            c and {name: bare.chosen(c, solves) for name, solves in bare.DEFINITIONS.items()} for c in found
        ]
        self.seif, self.readings = seif, readings
        self.hot_us: dict[str, list[float]] = {name: [] for name in bare.DEFINITIONS}
        self.once_us: dict[str, list[float]] = {name: [] for name in bare.DEFINITIONS}

    def take(self, begin: int, end: int) -> None:
        names = list(bare.DEFINITIONS)
        for k, (reading, systems) in enumerate(zip(self.readings[begin:end], self.systems[begin:end], strict=True)):
            self.seif.step(reading)
            if systems is not None:
                name = names[k % len(names)]
                self.once_us[name].append(bare.once_us(systems[name]))
        for systems in self.systems[begin:end]:
            if systems is not None:
                for name in names:
                    self.hot_us[name].append(bare.cost_us(systems[name], HOT))


@pytest.mark.timeout(600)
@pytest.mark.benchmark(group="whole step, at N = 200")
def test_a_step_against_the_bare_factorisations(benchmark: BenchmarkFixture, ratio: Ratio) -> None:
    found = captures(LANDMARKS, True, LAST)
    ours, second = last_steps(LANDMARKS), last_steps(LANDMARKS)
    beside = BareRun(found, taken(world(LANDMARKS, True), world(LANDMARKS, True).log.steps - LAST), second.readings)
    run_in_turns(benchmark, ours, [beside])
    step_us = median(np.array(ours.us)[[c is not None for c in found]])
    benchmark.extra_info["median us of a step with six sightings"] = step_us
    for name in bare.DEFINITIONS:
        hot, once = median(beside.hot_us[name]), median(beside.once_us[name])
        benchmark.extra_info[f"bare us, {name}: in its own loop; once between steps"] = (hot, once)
        ratio(f"step_over_bare_{name}", step_us / hot)
        ratio(f"step_over_bare_{name}_once_between_steps", step_us / once)
