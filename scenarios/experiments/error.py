"""The error of the map against the number of landmarks N, EKF and SEIF (Fig. 13 of the SEIF paper).

The square grows with N and the drive is 20 N steps, so every landmark is seen as often in a large map as in a small.
What grows is the way from a landmark back to itself, and with it the error of the heading: with the paper's noise the
EKF itself diverges from N = 300 on. Mild noise and a SEIF with the exact mean show what is sparsification's, what is
linearisation's, and what is due to a mean that lags behind after a long loop.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes

from fleet_seif.records import Floats
from scenarios.experiments import drawing
from scenarios.experiments.drawing import mean, median
from scenarios.experiments.measures import EKF, Outcome, compare, seif
from scenarios.experiments.study import NOT_PRINTED, Progress, Row, csv_of, png_of, write_csv
from scenarios.experiments.worlds import PAPER_WORLD, paper_world

NAME: Final = "error"
TITLE: Final = "Error of the map against the number of landmarks (SEIF paper, Fig. 13)"
SIZES: Final = (50, 100, 200, 300, 400, 500)
QUICK_SIZES: Final = (12, 18)
WORLDS: Final = 5
PAPER_M: Final = {"EKF": 0.053, "SEIF 6": 0.080, "SEIF 10": 0.058}
PAPER_SIZE: Final = 50
"""Where the paper prints numbers; larger N are a curve."""
EXACT: Final = seif(10, "SEIF 10 exact", mean="exact")
EXACT_SIZE_MAX: Final = 200
"""The exact mean takes a solution over the whole map a step: beyond it most of the time would go there."""
SEIFS: Final = (seif(6), seif(10))
COLOURS: Final = {
    EKF.label: drawing.EKF_COLOUR,
    "SEIF 6": drawing.SEIF_COLOUR,
    "SEIF 10": drawing.SKY,
    EXACT.label: drawing.ORANGE,
}


def run(out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]:
    """Raises NumericalError where a filter breaks down."""
    sizes = QUICK_SIZES if quick else SIZES
    seeds = range(seed, seed + (1 if quick else WORLDS))
    worlds = [(size, mild, each) for size in sizes for mild in (False, True) for each in seeds]
    total, done = sum(size for size, _, _ in worlds), 0
    outcomes: list[Outcome] = []
    for size, mild, each in worlds:
        candidates = (EKF, *SEIFS, EXACT) if size <= EXACT_SIZE_MAX else (EKF, *SEIFS)
        outcomes += compare(candidates, [partial(paper_world, size, each, mild=mild)], lambda done, total: None)
        done += size
        progress(done, total)
    write_csv(csv_of(out, NAME), [vars(each) for each in outcomes])
    names = list(dict.fromkeys(each.world for each in outcomes))
    _draw(png_of(out, NAME), outcomes, names, sizes)
    return [
        _row([each for each in outcomes if each.world == world and each.landmarks == size], label)
        for world in names
        for size in sizes
        for label in COLOURS
        if label != EXACT.label or size <= EXACT_SIZE_MAX
    ]


def _row(here: Sequence[Outcome], label: str) -> Row:
    """A line about the worlds of one kind and size."""
    world, size, errors = here[0].world, here[0].landmarks, _errors(here, label)
    printed = size == PAPER_SIZE and world == PAPER_WORLD and label in PAPER_M
    return Row(
        quantity=f"{world}, N = {size}: landmark error, m, mean of {len(errors)} worlds (median; median, moved to fit "
        f"best): {label}",
        paper=f"{PAPER_M[label]:.3f}" if printed else NOT_PRINTED,
        ours=f"{mean(errors):.3f} ({median(errors):.3f}; {median(_aligned(here, label)):.4f})",
    )


def _errors(outcomes: Sequence[Outcome], label: str) -> Floats:
    return np.array([each.error_m for each in outcomes if each.filter == label])


def _aligned(outcomes: Sequence[Outcome], label: str) -> Floats:
    return np.array([each.aligned_m for each in outcomes if each.filter == label])


def _draw(path: Path, outcomes: Sequence[Outcome], names: Sequence[str], sizes: Sequence[int]) -> None:
    worlds = len(_errors(outcomes, EKF.label)) // (len(names) * len(sizes))
    note = f"{worlds} worlds for each size and noise, 20 N steps, no gate; dots are worlds, lines their medians"
    figure = drawing.new_figure(15.0, 10.5, TITLE, note)
    grid = figure.add_gridspec(2, 2, left=0.05, right=0.985, bottom=0.055, top=0.885, wspace=0.11, hspace=0.25)
    for row, world in enumerate(names):
        here = [[each for each in outcomes if each.world == world and each.landmarks == size] for size in sizes]
        for column, (values, title) in enumerate(
            ((_errors, "error of a landmark in the frame of the start, m"), (_aligned, "map moved to fit best, m"))
        ):
            axes = figure.add_subplot(grid[row, column])
            _draw_curves(axes, here, values)
            drawing.plain(axes, f"{world}: {title}", "landmarks N")
            drawing.number_x(axes, sizes)
            if column == 0 and world == PAPER_WORLD and PAPER_SIZE in sizes:
                at = [float(sizes.index(PAPER_SIZE))] * len(PAPER_M)
                drawing.printed(axes, at, list(PAPER_M.values()), f"the paper, N = {PAPER_SIZE}")
            drawing.log_y(axes)
            drawing.legend(axes, "lower right" if row == 0 else "upper left")
    drawing.save(figure, path)


def _draw_curves(
    axes: Axes, here: Sequence[Sequence[Outcome]], values: Callable[[Sequence[Outcome], str], Floats]
) -> None:
    """One line a filter over the sizes; here: the outcomes of each size."""
    for k, (label, colour) in enumerate(COLOURS.items()):
        runs = [runs for each in here if len(runs := values(each, label))]
        for place, each in enumerate(runs):
            axes.scatter([place + 0.1 * (k - 1.5)] * len(each), each, s=16, color=colour, alpha=0.45, linewidths=0)
        drawing.line(axes, range(len(runs)), runs, colour, label, median)
