"""The runs that are measured: filters driven through worlds, in turns, and the steps of them that are looked at.

1. Filters that are compared read the same readings in the same process. They take turns of TURN steps, so that other
   work on the machine slows all of them alike, while each has the caches to itself for most of its turn.
2. Steps with six sightings are those of the last steps of a run: the map is complete, six landmarks are linked to the
   pose before the step, and nothing new is seen.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from typing import Final, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture

from fleet_seif.config import FilterSettings
from fleet_seif.filters import Filter
from fleet_seif.records import Floats, Reading
from fleet_seif.seif import Seif
from scenarios.experiments.isam2 import Isam2
from scenarios.experiments.worlds import World, paper_world

SEED: Final = 1
STEPS_PER_LANDMARK: Final = 20
STEPS_LEAST: Final = 4000
LAST: Final = 2000
"""Steps at the end of a run among which those with six sightings are looked for."""
SIX: Final = 6
TURN: Final = 200
SETTINGS: Final = FilterSettings(active_max=SIX, gate=1e12)
"""theta_x = 6; no gate in effect, as in the paper (the gate is computed all the same)."""


@cache
def world(landmarks: int, mild: bool) -> World:
    """The paper's world: 20 steps a landmark, at least STEPS_LEAST."""
    steps = max(STEPS_PER_LANDMARK * landmarks, STEPS_LEAST)
    return paper_world(landmarks, SEED, mild=mild, steps=steps)


Arguments = tuple[tuple[object, ...], dict[str, object]]


class TakesTurns(Protocol):
    """What is measured beside a filter."""

    def take(self, begin: int, end: int) -> None:
        """Go on from step `begin` to `end`, counted from the first that is measured."""


@dataclass(eq=False)
class Run:
    """One filter on its way through some readings. us: time of each step so far, by `clock`, which gives ns."""

    step: Callable[[Reading], object]
    readings: Sequence[Reading]
    us: list[float]
    clock: Callable[[], int] = time.perf_counter_ns

    def take(self, begin: int, end: int) -> None:
        for reading in self.readings[begin:end]:
            start = self.clock()
            self.step(reading)
            self.us.append((self.clock() - start) * 1e-3)


def started(made: Filter | Isam2, at: World, *, skip: int = 0) -> Run:
    """A new filter that has been through the first `skip` readings; the others are its run."""
    made.start(at.log.sightings_at(0))
    readings = list(at.log.readings())
    for reading in readings[:skip]:
        made.step(reading)
    return Run(made.step, readings[skip:], [])


def rounds_us(
    benchmark: BenchmarkFixture, call: Callable[..., object], arguments: Callable[[], Arguments], rounds: int
) -> list[float]:
    """Time of each round, us, in order: one call with what `arguments` gives, which is not timed."""
    benchmark.pedantic(call, setup=arguments, rounds=rounds, iterations=1)  # type: ignore[no-untyped-call]
    if benchmark.stats is None:
        pytest.skip("nothing was timed: --benchmark-disable")
    return [1e6 * seconds for seconds in benchmark.stats.stats.data]


def run_in_turns(benchmark: BenchmarkFixture, ours: Run, others: Sequence[TakesTurns]) -> None:
    """Take all through their readings. pytest-benchmark sees each step of ours as one round."""
    rounds = iter(range(len(ours.readings)))

    def next_reading() -> Arguments:
        k = next(rounds)
        if k % TURN == 0:
            for other in others:
                other.take(k, k + TURN)
        return (ours.readings[k],), {}

    ours.us.extend(rounds_us(benchmark, ours.step, next_reading, len(ours.readings)))


def interior(seif: Seif, readings: Sequence[Reading]) -> NDArray[np.bool_]:
    """Which steps have six sightings of known landmarks and begin with six linked to the pose, bool (T,).

    `seif` is taken through the readings.
    """
    chosen = np.zeros(len(readings), np.bool_)
    for k, reading in enumerate(readings):
        active, known = len(seif.active), len(seif.signatures)
        seif.step(reading)
        chosen[k] = active == SIX and len(reading.sightings.z) == SIX and len(seif.signatures) == known
    return chosen


def taken(at: World, steps: int) -> Seif:
    """A filter that has been through the first steps of a world."""
    seif = Seif(SETTINGS)
    seif.start(at.log.sightings_at(0))
    for reading in islice(at.log.readings(), steps):
        seif.step(reading)
    return seif


def median(values: Sequence[float] | Floats) -> float:
    return float(np.median(values))
