"""Where a step's time goes, in a real loop: `python -m tests.benchmarks.profile` prints what PROFILE.md shows.

The filter runs as always, but its kernel is `staged_step`, which reads the clock between its parts. Filters with and
without the clocks take turns. Medians over steps with six sightings: their sum is not quite the median of the whole.
"""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final, NamedTuple
from unittest.mock import patch

import numpy as np
from threadpoolctl import threadpool_limits

from fleet_seif import seif_step as kernels
from fleet_seif.filters import checked_reading
from fleet_seif.records import Floats, Ints, Reading
from fleet_seif.seif import Seif
from fleet_seif.seif_arrays import LANDMARKS, LINKS
from tests.benchmarks.captured import captures, only
from tests.benchmarks.runs import LAST, TURN, interior, median, taken, world
from tests.benchmarks.stages import STAGES, STAMPS, staged_step

SIZE: Final = 200
ROUNDS: Final = 5
PHASES: Final = ("Python before the kernel", "dispatch in", *STAGES, "dispatch out", "Python after the kernel")
REPEATS: Final = 2000


class Times(NamedTuple):
    """Of the last step, ns: called, returned (2,); stamps (STAMPS, 2), (s, ns)."""

    ends: list[int]
    stamps: Ints

    def all(self) -> list[int]:
        return [self.ends[0], *(1_000_000_000 * self.stamps[:, 0] + self.stamps[:, 1]).tolist(), self.ends[1]]


@contextmanager
def staged() -> Iterator[Times]:
    """Within it, every filter runs `staged_step`."""
    times = Times([0, 0], np.zeros((STAMPS, 2), np.int64))

    def timed(*arguments: Any) -> Any:
        times.ends[0] = time.perf_counter_ns()
        answer = staged_step(times.stamps, *arguments)
        times.ends[1] = time.perf_counter_ns()
        return answer

    with patch.object(kernels, "seif_step", timed):
        yield times


def phases_us(seif: Seif, readings: Sequence[Reading]) -> list[list[float]]:
    """The time of each of PHASES in each step, us."""
    found = []
    with staged() as times:
        for reading in readings:
            begin = time.perf_counter_ns()
            seif.step(reading)
            end = time.perf_counter_ns()
            found.append((np.diff([begin, *times.all(), end]) * 1e-3).tolist())
    return found


def steps_us(seif: Seif, readings: Sequence[Reading]) -> list[float]:
    found = []
    for reading in readings:
        begin = time.perf_counter_ns()
        seif.step(reading)
        found.append((time.perf_counter_ns() - begin) * 1e-3)
    return found


def measured() -> tuple[Floats, Floats]:
    """Steps with six sightings, ROUNDS runs: time of each phase (T, len(PHASES)); whole steps without clocks (T,)."""
    at = world(SIZE, True)
    first = at.log.steps - LAST
    readings = list(at.log.readings())[first:]
    six = interior(taken(at, first), readings)
    phases: list[Floats] = []
    plain: list[Floats] = []
    for _ in range(ROUNDS):
        with_clocks, without = taken(at, first), taken(at, first)
        some, others = [], []
        for k in range(0, LAST, TURN):
            some += phases_us(with_clocks, readings[k : k + TURN])
            others += steps_us(without, readings[k : k + TURN])
        phases.append(np.array(some)[six])
        plain.append(np.array(others)[six])
    return np.concatenate(phases), np.concatenate(plain)


def each_us(call: Callable[[], object]) -> float:
    """Median time of one call, in a loop of its own."""
    found = []
    for _ in range(REPEATS):
        begin = time.perf_counter_ns()
        call()
        found.append((time.perf_counter_ns() - begin) * 1e-3)
    return median(found)


def python_us() -> dict[str, float]:
    """What of the Python around the kernel can be called on its own."""
    at = world(SIZE, True)
    seif = taken(at, at.log.steps - 1)
    reading = next(r for r in at.log.readings() if len(r.sightings.z) == 6)
    signature, counts, seen = reading.sightings.signature, seif._s.counts, reading.sightings
    return {
        "checked_reading": each_us(lambda: checked_reading(reading.odometry, reading.odometry_cov, seen)),
        "Names.numbers": each_us(lambda: seif._names.numbers(signature)),
        "reading a count from an array, each of four": each_us(lambda: int(counts[LANDMARKS])),
        "a call and the clock itself": each_us(lambda: None),
    }


def shapes() -> str:
    """Sizes in the steps that are measured."""
    found = only(captures(SIZE, True, LAST))
    rows, cut = median([float(len(c.before.b)) for c in found]), median([float(len(c.dropped)) for c in found])
    seif = taken(world(SIZE, True), world(SIZE, True).log.steps)
    links = 2.0 * float(seif._s.counts[LINKS]) / float(seif._s.counts[LANDMARKS])
    medians = f"medians: {rows:.0f} rows in the block, {cut:.0f} landmarks cut; {links:.0f} neighbours each"
    return f"{len(found)} steps a run; {medians}"


def table() -> str:
    """The report, Markdown."""
    phases, plain = measured()
    us, whole = np.median(phases, axis=0), median(phases.sum(axis=1))
    lines = ["| part | us | % |", "|---|---|---|"]
    lines += [f"| {name} | {each:.2f} | {100.0 * each / whole:.1f} |" for name, each in zip(PHASES, us, strict=True)]
    lines += [
        f"| sum of these | {us.sum():.2f} | {100.0 * us.sum() / whole:.1f} |",
        f"| whole step, clocks included | {whole:.2f} | 100 |",
        f"| whole step without clocks | {median(plain):.2f} | {100.0 * median(plain) / whole:.1f} |",
        "",
        shapes() + ".",
        "",
        "| of the Python, in a loop of its own | us |",
        "|---|---|",
    ]
    lines += [f"| {name} | {each:.2f} |" for name, each in python_us().items()]
    return "\n".join(lines)


if __name__ == "__main__":
    with threadpool_limits(limits=1, user_api="blas"):
        sys.stdout.write(table() + "\n")
