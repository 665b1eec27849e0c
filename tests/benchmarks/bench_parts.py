"""The parts of a step, each on its own: REPEATS times on what a step of a real run works on.

A line of pytest-benchmark's table is REPEATS = 100 repetitions: read 100 us as 1 us. The ratios are to the bare
recovery solve (a Cholesky factor of the same block and one right-hand side), without the copying of the block.
"""

import time

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from fleet_seif.seif import Seif
from tests.benchmarks import bare, profile
from tests.benchmarks.captured import Captured, captures, only
from tests.benchmarks.conftest import Ratio
from tests.benchmarks.parts import PARTS, REPEATS, copy_block
from tests.benchmarks.runs import LAST, SETTINGS, Arguments, median, rounds_us, world

LANDMARKS = 200
ROUNDS = 300


@pytest.fixture(scope="module")
def captured() -> list[Captured]:
    return only(captures(LANDMARKS, True, LAST))[:ROUNDS]


@pytest.mark.benchmark(group="parts of a step, 100 times")
@pytest.mark.parametrize("name", PARTS)
def test_a_part(name: str, benchmark: BenchmarkFixture, ratio: Ratio, captured: list[Captured]) -> None:
    part, copies = PARTS[name]
    left = iter(captured)
    solve_us: list[float] = []
    copy_us: list[float] = []
    part(captured[0], 1)
    copy_block(captured[0], 1)

    def next_step() -> Arguments:
        step = next(left)
        solve_us.append(bare.cost_us(bare.chosen(step, ("recover",)), REPEATS))
        begin = time.perf_counter_ns()
        copy_block(step, REPEATS)
        copy_us.append((time.perf_counter_ns() - begin) * 1e-3 / REPEATS)
        return (step, REPEATS), {}

    part_us = median(rounds_us(benchmark, part, next_step, len(captured))) / REPEATS - copies * median(copy_us)
    benchmark.extra_info["us"] = part_us
    ratio(f"part_{name}_over_recovery_solve", part_us / median(solve_us))


def test_the_step_with_a_clock_in_it_is_the_step() -> None:
    """Same map, same delta at every step, to the bit: what the profile shows is what the filter does."""
    at = world(50, True)
    plain, staged = Seif(SETTINGS), Seif(SETTINGS)
    with profile.staged():
        staged.start(at.log.sightings_at(0))
    plain.start(at.log.sightings_at(0))
    for reading in at.log.readings():
        expected = plain.step(reading)
        with profile.staged():
            found = staged.step(reading)
        for name in ("variables", "rows", "cols", "H", "b"):
            assert np.array_equal(getattr(found.delta, name), getattr(expected.delta, name))
    assert staged.state() == plain.state()
