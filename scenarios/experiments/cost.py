"""What a step costs against the number of landmarks: time and memory (Fig. 11 and 12 of the SEIF paper).

1. The paper's world with N = 50 .. 500 landmarks: EKF, SEIF and, where gtsam is installed, iSAM2 read the same steps,
   one after the other in this process, with single-threaded BLAS. Measured are the last of 8 N steps: a route has then
   passed every landmark several times. iSAM2 keeps the path, so that its step goes on growing; in a longer run it would
   take longer, the others would not.
2. The strip, to N = 1,000,000, SEIF alone: every step has six sightings, one of them of a new landmark. Every step
   after the first 500 is measured; a row of the table takes those since the row before it.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fleet_seif.config import FilterSettings
from fleet_seif.ekf import Ekf
from fleet_seif.errors import NumericalError
from fleet_seif.jit import one_thread
from fleet_seif.records import Floats
from fleet_seif.seif import Seif
from scenarios.experiments import drawing, isam2
from scenarios.experiments.measures import GATE_OFF, drive
from scenarios.experiments.strip import Strip
from scenarios.experiments.study import Progress, Row, csv_of, png_of, write_csv
from scenarios.experiments.worlds import World, paper_world

NAME: Final = "cost"
TITLE: Final = "Time and memory against the number of landmarks (SEIF paper, Fig. 11 and 12)"
SIZES: Final = (50, 100, 200, 300, 400, 500)
STEPS_PER_LANDMARK: Final = 8
WINDOW: Final = 500
"""Last steps of a run in the paper's world, over which times are taken; at most half the run."""
STRIP_LANDMARKS: Final = 1_000_000
STRIP_FIRST: Final = 1000
SETTINGS: Final = FilterSettings(gate=GATE_OFF)
STRIP: Final = "SEIF, strip"
PROGRESS_EVERY: Final = 10_000
MB: Final = 1e6


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What one filter's step costs at one size of the map; a line of the CSV.

    steps: how many were measured. step_us_*: by the wall clock, also while the machine does something else; cpu_us_max:
    the largest by the clock of this thread's work, NaN where it was not taken.
    bytes: of the filter's numbers (of iSAM2: those in its Bayes tree alone).
    """

    filter: str
    landmarks: int
    steps: int
    step_us_median: float
    step_us_mean: float
    step_us_p99: float
    step_us_max: float
    cpu_us_max: float
    bytes: int


def run(out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]:
    """Raises NumericalError where a filter breaks down."""
    sizes = SIZES[:2] if quick else SIZES
    strip = Strip(10 * STRIP_FIRST if quick else STRIP_LANDMARKS, seed=seed)
    total = len(sizes) + strip.landmarks // PROGRESS_EVERY
    costs = []
    for done, size in enumerate(sizes, 1):
        costs += at_size(size, seed)
        progress(done, total)
    costs += along(strip, lambda step: progress(len(sizes) + step // PROGRESS_EVERY, total))
    progress(total, total)
    write_csv(csv_of(out, NAME), [vars(cost) for cost in costs])
    _draw(png_of(out, NAME), costs)
    return _summary(costs)


@one_thread
def at_size(landmarks: int, seed: int) -> list[Cost]:
    """The costs of all filters in the paper's world."""
    world = paper_world(landmarks, seed, steps=STEPS_PER_LANDMARK * landmarks)
    ekf, seif = drive(Ekf(SETTINGS), world), drive(Seif(SETTINGS), world)
    costs = [
        _cost("EKF", landmarks, _window(ekf.step_us), ekf.filter.bytes_used()),
        _cost("SEIF", landmarks, _window(seif.step_us), seif.filter.bytes_used()),
    ]
    return [*costs, _isam2_cost(world, landmarks)] if isam2.is_installed() else costs


def _isam2_cost(world: World, landmarks: int) -> Cost:
    """With Cholesky, gtsam's default; where that breaks down the whole run again with QR, which takes twice as long."""
    try:
        peer, label = isam2.Isam2(SETTINGS.start_information), "iSAM2"
        step_us = _drive_isam2(peer, world)
    except NumericalError:
        peer, label = isam2.Isam2(SETTINGS.start_information, "QR"), "iSAM2, QR"
        step_us = _drive_isam2(peer, world)
    return _cost(label, landmarks, _window(step_us), peer.bytes_used())


def _drive_isam2(peer: isam2.Isam2, world: World) -> Floats:
    """Time of each step, us, shape (T,)."""
    peer.start(world.log.sightings_at(0))
    step_us = np.empty(world.log.steps)
    for k, reading in enumerate(world.log.readings()):
        begin = time.perf_counter_ns()
        peer.step(reading)
        step_us[k] = (time.perf_counter_ns() - begin) * 1e-3
    return step_us


@one_thread
def along(strip: Strip, tell: Callable[[int], None]) -> list[Cost]:
    """The costs of a SEIF on its way through the strip, at 1, 2 and 5 times each power of ten; tell(step) at times."""
    sizes = _round_numbers(STRIP_FIRST, strip.landmarks)
    seif = Seif(FilterSettings(landmarks_max=strip.landmarks))
    known = len(seif.start(strip.start()).new)
    step_us, cpu_us, since, costs = np.empty(strip.steps), np.empty(strip.steps), STRIP_FIRST // 2, []
    for k, reading in enumerate(strip.readings(), 1):
        begin, cpu_begin = time.perf_counter_ns(), time.thread_time_ns()
        seif.step(reading)
        cpu_us[k - 1] = (time.thread_time_ns() - cpu_begin) * 1e-3
        step_us[k - 1] = (time.perf_counter_ns() - begin) * 1e-3
        if known + k in sizes:
            cpu_us_max = float(np.max(cpu_us[since:k]))
            costs.append(_cost(STRIP, known + k, step_us[since:k], seif.bytes_used(), cpu_us_max))
            since = k
        if k % PROGRESS_EVERY == 0:
            tell(k)
    return costs


def _round_numbers(low: int, high: int) -> set[int]:
    """1, 2 and 5 times powers of ten from low to high, and high."""
    powers = [10**e for e in range(len(str(high)))]
    return {high, *(m * power for power in powers for m in (1, 2, 5) if low <= m * power <= high)}


def _window(step_us: Floats) -> Floats:
    return step_us[-min(WINDOW, len(step_us) // 2) :]


def _cost(label: str, landmarks: int, step_us: Floats, used: int, cpu_us_max: float = math.nan) -> Cost:
    return Cost(
        filter=label,
        landmarks=landmarks,
        steps=len(step_us),
        step_us_median=float(np.median(step_us)),
        step_us_mean=float(np.mean(step_us)),
        step_us_p99=float(np.percentile(step_us, 99)),
        step_us_max=float(np.max(step_us)),
        cpu_us_max=cpu_us_max,
        bytes=used,
    )


def _summary(costs: Sequence[Cost]) -> list[Row]:
    strip = [cost for cost in costs if cost.filter == STRIP]
    rows = []
    for size in sorted({cost.landmarks for cost in costs if cost.filter != STRIP}):
        at = [cost for cost in costs if cost.landmarks == size and cost.filter != STRIP]
        seif_us = next(cost.step_us_median for cost in at if cost.filter == "SEIF")
        for cost in at:
            times = f"{cost.step_us_median:.0f} ({cost.step_us_median / seif_us:.1f} x SEIF); {cost.step_us_mean:.0f}"
            quantity = f"step, us, median; mean; memory, MB, at N = {size}: {cost.filter}"
            rows.append(Row(quantity=quantity, ours=f"{times}; {cost.bytes / MB:.3g}"))
    if not isam2.is_installed():
        rows.append(Row(quantity="iSAM2", ours="not run: gtsam is not installed, pip install 'fleet-seif[bench]'"))
    for cost in strip:
        tail = f"{cost.step_us_p99:.0f}; {cost.step_us_max:.0f} ({cost.cpu_us_max:.0f})"
        quantity = f"step, us, median; p99; largest (by the clock of its work): {STRIP}, N = {cost.landmarks:,}"
        rows.append(Row(quantity=quantity, ours=f"{cost.step_us_median:.1f}; {tail}"))
    first, last = strip[0], strip[-1]
    spread = max(cost.step_us_p99 / cost.step_us_median for cost in strip)
    return [
        *rows,
        Row(
            quantity=f"median step at N = {last.landmarks:,} over that at {first.landmarks:,}",
            ours=f"{last.step_us_median / first.step_us_median:.2f}",
        ),
        Row(quantity="p99 over median, largest of all lines of the strip", ours=f"{spread:.1f}"),
        Row(
            quantity=f"bytes a landmark with its links at N = {last.landmarks:,}",
            ours=f"{last.bytes / last.landmarks:.0f}",
        ),
    ]


def _draw(path: Path, costs: Sequence[Cost]) -> None:
    note = "the paper's world, median of the last steps of 8 N; SEIF also along a strip with six sightings a step"
    figure = drawing.new_figure(13.0, 6.2, TITLE, note)
    grid = figure.add_gridspec(1, 2, left=0.055, right=0.985, bottom=0.1, top=0.82, wspace=0.15)
    step, memory = (figure.add_subplot(grid[i]) for i in range(2))
    styles = {
        "EKF": (drawing.EKF_COLOUR, "o", "-"),
        "iSAM2": (drawing.EXACT_COLOUR, "o", "-"),
        "iSAM2, QR": (drawing.EXACT_COLOUR, "s", "--"),
        "SEIF": (drawing.SEIF_COLOUR, "o", "-"),
        STRIP: (drawing.SKY, ".", "-"),
    }
    for label, (colour, marker, line) in styles.items():
        own = [cost for cost in costs if cost.filter == label]
        if own:
            sizes = [cost.landmarks for cost in own]
            panels = ((step, [cost.step_us_median for cost in own]), (memory, [cost.bytes / MB for cost in own]))
            for axes, values in panels:
                axes.plot(sizes, values, color=colour, marker=marker, ls=line, lw=1.8, ms=5, label=label)
    strip = [cost for cost in costs if cost.filter == STRIP]
    p99 = [cost.step_us_p99 for cost in strip]
    step.plot([cost.landmarks for cost in strip], p99, color=drawing.SKY, lw=1.0, ls=":", label=f"{STRIP}, p99")
    for axes, title in ((step, "time of a step, µs"), (memory, "memory, MB (iSAM2: Bayes tree alone)")):
        axes.set_xscale("log")
        drawing.plain(axes, title, "landmarks on the map, N")
        drawing.log_y(axes)
        drawing.legend(axes)
    drawing.save(figure, path)
