"""What filters claim to know against their errors: SEIF, soft sparsification, ESEIF, EKF (SEIF paper, Fig. 15, 16).

Sparsification drops links, and with them the knowledge that errors of landmarks belong together: the map then claims
to be better known than it is. Three kinds of worlds, N = 50, no gate: the paper's noise, mild noise, and the linear
world of a compass, in which the EKF is exact and every deviation from NEES 1 is the sparsification's.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from fleet_seif.records import Floats
from scenarios.experiments import drawing
from scenarios.experiments.association import likelihood_errors
from scenarios.experiments.measures import EIF, EKF, Candidate, Outcome, compare, seif
from scenarios.experiments.study import Progress, Row, csv_of, png_of, write_csv
from scenarios.experiments.worlds import COMPASS, compass_world, paper_world
from scenarios.palette import GREY, INK
from scenarios.score import BAND, chi_square_band

NAME: Final = "confidence"
TITLE: Final = "What a filter claims to know, against its errors (SEIF paper, Fig. 15, 16)"
LANDMARKS: Final = 50
WORLDS: Final = 20
LINEAR_WORLDS: Final = 100
LIKELIHOOD_WORLDS: Final = 3
PAPER_LIKELIHOOD_ERROR: Final = 3.4e-4
ACTIVE: Final = (4, 6, 8, 10, 15, 20, 30)
SOFT_ACTIVE: Final = 6
RHO: Final = (0.05, 0.1, 0.2, 0.4, 0.7)
Value = Callable[[Outcome], float]


def soft(rho: float) -> Candidate:
    """Soft sparsification towards SOFT_ACTIVE landmarks; rho = 1 is that SEIF."""
    return seif(SOFT_ACTIVE, f"SEIF {SOFT_ACTIVE} rho {rho:g}", soften=rho)


def eseif(theta_x: int) -> Candidate:
    return seif(theta_x, f"ESEIF {theta_x}", kind="eseif")


LINEAR: Final = (EKF, EIF, eseif(10), eseif(6), soft(0.1), seif(20), seif(10), seif(6), seif(4))


def run(out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]:
    """Raises NumericalError where a filter breaks down."""
    active, rhos = ((6, 10), (0.1,)) if quick else (ACTIVE, RHO)
    steps, count, linear_count = (100, 2, 4) if quick else (None, WORLDS, LINEAR_WORLDS)
    seeds = range(seed, seed + count)
    compared = [EKF, EIF, *(seif(n) for n in active), *(eseif(n) for n in active), *(soft(rho) for rho in rhos)]
    worlds = [partial(paper_world, LANDMARKS, each, mild=mild, steps=steps) for mild in (False, True) for each in seeds]
    linear = [
        partial(compass_world, LANDMARKS, seed + i, EKF.settings.start_information, steps=steps)
        for i in range(linear_count)
    ]
    total, first = len(worlds) * len(compared) + len(linear) * len(LINEAR), len(worlds) * len(compared)
    outcomes = compare(compared, worlds, lambda done, _: progress(done, total))
    outcomes += compare(LINEAR, linear, lambda done, _: progress(first + done, total))
    write_csv(csv_of(out, NAME), [vars(each) for each in outcomes])
    _draw(png_of(out, NAME), outcomes, active, rhos)
    rows = _nonlinear_rows(outcomes) + _linear_rows(outcomes)
    return rows + _likelihood_rows(seeds[:LIKELIHOOD_WORLDS], steps)


def _values(outcomes: Sequence[Outcome], world: str, label: str, value: Value) -> Floats:
    return np.array([value(each) for each in outcomes if each.world == world and each.filter == label])


def _log_det(each: Outcome) -> float:
    return each.log_det


def _nees_global(each: Outcome) -> float:
    return each.nees_global


def _nees_relative(each: Outcome) -> float:
    return each.nees_relative


VALUES: Final[tuple[Value, ...]] = (_log_det, _nees_global, _nees_relative)
SUMMARY: Final = (
    *(each.label for each in (EKF, EIF, seif(4), seif(6), seif(10), seif(20))),
    *(each.label for each in (soft(0.1), soft(0.4), eseif(6), eseif(10), eseif(20))),
)
"""Rows of the summary; the CSV has all."""


def _nonlinear_rows(outcomes: Sequence[Outcome]) -> list[Row]:
    """Medians, and of the NEES also the median ratio to the EKF's in the same world."""
    rows = []
    for world in dict.fromkeys(each.world for each in outcomes if each.world != COMPASS):
        for label in SUMMARY:
            values = [_values(outcomes, world, label, value) for value in VALUES]
            if len(values[0]):
                ekf = [_values(outcomes, world, EKF.label, value) for value in VALUES]
                medians = [np.median(each) for each in values]
                ratios = [np.median(mine / other) for mine, other in zip(values[1:], ekf[1:], strict=True)]
                rows.append(
                    Row(
                        quantity=f"{world}, medians: log det P; NEES per dof global, relative (over EKF's): {label}",
                        ours=f"{medians[0]:.0f}; {medians[1]:.2f}, {medians[2]:.2f} ({ratios[0]:.2f}, {ratios[1]:.2f})",
                    )
                )
    over = max(each.over_bound for each in outcomes if each.filter.startswith("ESEIF"))
    return [*rows, Row(quantity="steps on which ESEIF had to exceed its bound, worst world", ours=f"{over:.1%}")]


def _linear_rows(outcomes: Sequence[Outcome]) -> list[Row]:
    rows = []
    for each in LINEAR:
        nees = _values(outcomes, COMPASS, each.label, _nees_global)
        low, high = chi_square_band(_linear_dof(outcomes))
        inside = "inside" if low <= nees.mean() <= high else "outside"
        rows.append(
            Row(
                quantity=f"compass, {len(nees)} runs: NEES per dof, mean: {each.label}",
                ours=f"{nees.mean():.3f}, {inside} the {BAND:.0%} band {low:.3f} to {high:.3f}",
            )
        )
    return rows


def _linear_dof(outcomes: Sequence[Outcome]) -> int:
    """Degrees of freedom of all compass runs together."""
    return sum(2 * each.seen for each in outcomes if each.world == COMPASS and each.filter == EKF.label)


def _likelihood_rows(seeds: Sequence[int], steps: int | None) -> list[Row]:
    rows = []
    for theta_x in (6, 10):
        worlds = [paper_world(LANDMARKS, each, steps=steps) for each in seeds]
        errors = np.concatenate([likelihood_errors(seif(theta_x).settings, world) for world in worlds])
        rows.append(
            Row(
                quantity=f"likelihood of a sighting from the Markov blanket, relative error: SEIF {theta_x}",
                paper=f"{PAPER_LIKELIHOOD_ERROR:.1e}",
                ours=f"{errors.mean():.1e} (median {np.median(errors):.1e}, {len(errors)} sightings)",
            )
        )
    return rows


def _draw(path: Path, outcomes: Sequence[Outcome], active: Sequence[int], rhos: Sequence[float]) -> None:
    nonlinear = list(dict.fromkeys(each.world for each in outcomes if each.world != COMPASS))
    count = len(_values(outcomes, nonlinear[0], EKF.label, _log_det))
    note = f"N = {LANDMARKS}, no gate; medians and quartiles of {count} worlds; NEES above 1 is overconfident"
    figure = drawing.new_figure(16.0, 14.0, TITLE, note)
    grid = figure.add_gridspec(3, 3, left=0.045, right=0.985, bottom=0.045, top=0.91, wspace=0.16, hspace=0.27)
    titles = ("log det of the landmarks' covariance", "NEES per dof, global", "NEES per dof, relative to the vehicle")
    for row, world in enumerate(nonlinear):
        for column, value in enumerate(VALUES):
            axes = figure.add_subplot(grid[row, column])
            _draw_active(axes, outcomes, world, active, value)
            drawing.plain(axes, f"{titles[column]}; {world}", "active landmarks after a step, at most")
            if value is not _log_det:
                drawing.log_y(axes)
            drawing.legend(axes, "upper right")
    _draw_soft(figure.add_subplot(grid[2, 0]), figure.add_subplot(grid[2, 1]), outcomes, nonlinear, rhos)
    place = grid[2, 2].get_position(figure)
    shift = 0.035  # room for the names of filters
    _draw_linear(figure.add_axes((place.x0 + shift, place.y0, place.width - shift, place.height)), outcomes)
    drawing.save(figure, path)


def _draw_active(axes: Axes, outcomes: Sequence[Outcome], world: str, active: Sequence[int], value: Value) -> None:
    drawing.level(axes, _values(outcomes, world, EKF.label, value), drawing.EKF_COLOUR, "EKF", drawing.median)
    for kind, colour in (("SEIF", drawing.SEIF_COLOUR), ("ESEIF", drawing.ESEIF_COLOUR)):
        runs = [_values(outcomes, world, f"{kind} {theta_x}", value) for theta_x in active]
        drawing.band(axes, range(len(active)), runs, colour, kind, drawing.median)
    drawing.number_x(axes, active)


def _draw_soft(
    log_det: Axes, nees: Axes, outcomes: Sequence[Outcome], worlds: Sequence[str], rhos: Sequence[float]
) -> None:
    """Against the EKF in the same world: the difference of log det P, the ratio of the NEES."""
    labels = [*(soft(rho).label for rho in rhos), seif(SOFT_ACTIVE).label]
    for world, colour in zip(worlds, (drawing.ORANGE, drawing.PINK), strict=True):
        ekf = _values(outcomes, world, EKF.label, _log_det)
        runs = [_values(outcomes, world, label, _log_det) - ekf for label in labels]
        drawing.band(log_det, range(len(labels)), runs, colour, world, drawing.median)
        ekf = _values(outcomes, world, EKF.label, _nees_global)
        runs = [_values(outcomes, world, label, _nees_global) / ekf for label in labels]
        drawing.band(nees, range(len(labels)), runs, colour, world, drawing.median)
    titles = ("log det P minus the EKF's", "NEES, global, over the EKF's")
    for axes, level, title in zip((log_det, nees), (0.0, 1.0), titles, strict=True):
        axes.axhline(level, color=INK, lw=1.5, label="EKF")
        name = f"soft sparsification: {title}"
        drawing.plain(axes, name, f"rho, towards {SOFT_ACTIVE} active landmarks; 1 is hard sparsification")
        drawing.number_x(axes, [*rhos, 1.0])
    drawing.log_y(nees)
    drawing.legend(log_det, "lower left")
    drawing.legend(nees, "upper left")


def _draw_linear(axes: Axes, outcomes: Sequence[Outcome]) -> None:
    """Every run as a dot, the mean of all as a diamond against the band that a consistent filter keeps to."""
    low, high = chi_square_band(_linear_dof(outcomes))
    axes.axvspan(low, high, color=drawing.GREEN, alpha=0.25, lw=0, label=f"{BAND:.0%} band of the mean")
    axes.axvline(1.0, color=GREY, lw=0.8)
    colours = {"E": drawing.ESEIF_COLOUR, "S": drawing.SEIF_COLOUR}
    for place, each in enumerate(LINEAR):
        values = _values(outcomes, COMPASS, each.label, _nees_global)
        colour = drawing.EKF_COLOUR if each in (EKF, EIF) else colours[each.label[0]]
        axes.scatter(values, place + drawing.spread(len(values), 0.5), s=9, color=colour, alpha=0.35, linewidths=0)
        axes.plot([values.mean()], [place], "D", ms=7, mfc="white", mec=colour, mew=1.8, zorder=5)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(LINEAR)), [each.label for each in LINEAR])
    axes.invert_yaxis()
    runs = len(_values(outcomes, COMPASS, EKF.label, _nees_global))
    drawing.plain(axes, f"linear world, {runs} runs, means as diamonds", "NEES per dof, global")
    drawing.legend(axes, "upper right")
