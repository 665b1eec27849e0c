"""How many active landmarks a SEIF needs: time and error against theta_x (Fig. 14 of the SEIF paper).

N = 50, the paper's noise, no gate. Each SEIF drives with the amortised and with the exact mean; 4, 6 and 10 active
landmarks also with the other two rules for choosing which link is cut. All filters read the same worlds.
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
from scenarios.experiments.measures import EKF, Candidate, Outcome, compare, seif
from scenarios.experiments.study import NOT_PRINTED, Progress, Row, csv_of, png_of, write_csv
from scenarios.experiments.worlds import paper_world
from scenarios.palette import INK

NAME: Final = "sparsity"
TITLE: Final = "Time and error against the number of active landmarks (SEIF paper, Fig. 14)"
LANDMARKS: Final = 50
WORLDS: Final = 20
ACTIVE: Final = (4, 5, 6, 7, 8, 10, 12, 16, 20)
RULES_AT: Final = (4, 6, 10)
PAPER_EKF_M: Final = 0.053
PAPER_M: Final = {10: 0.058, 6: 0.080, 4: 0.341}
PAPER_EXACT_M: Final = {4: 0.070}
PAPER_RATIO: Final = {10: 1.11, 6: 1.52, 4: 6.4}
DIVERGED_M: Final = 0.2
"""An EKF with a larger error has diverged: a landmark whose place it knows so badly is out of the sensor's reach."""
RULE_NAMES: Final = {"raw": "raw strength", "kl": "KL cost"}
RULE_STYLES: Final = ((0.26, "raw", drawing.PINK), (0.52, "kl", drawing.GREEN))


def candidates(active: Sequence[int], rules_at: Sequence[int]) -> list[Candidate]:
    """The EKF, then SEIFs by label "SEIF 6", "SEIF 6 exact", "SEIF 6 raw", "SEIF 6 kl"."""
    made = [EKF]
    for theta_x in active:
        made += [seif(theta_x), seif(theta_x, f"SEIF {theta_x} exact", mean="exact")]
        if theta_x in rules_at:
            made += [seif(theta_x, f"SEIF {theta_x} {rule}", strength=rule) for rule in RULE_NAMES]
    return made


def run(out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]:
    """Raises NumericalError where a filter breaks down."""
    active, rules_at = ((4, 6, 10), (6,)) if quick else (ACTIVE, RULES_AT)
    seeds = range(seed, seed + (2 if quick else WORLDS))
    worlds = [partial(paper_world, LANDMARKS, each, steps=100 if quick else None) for each in seeds]
    outcomes = compare(candidates(active, rules_at), worlds, progress)
    write_csv(csv_of(out, NAME), [vars(each) for each in outcomes])
    _draw(png_of(out, NAME), outcomes, active, rules_at)
    return _summary(outcomes, rules_at)


def _errors(outcomes: Sequence[Outcome], label: str) -> Floats:
    return np.array([each.error_m for each in outcomes if each.filter == label])


def _aligned(outcomes: Sequence[Outcome], label: str) -> Floats:
    return np.array([each.aligned_m for each in outcomes if each.filter == label])


def _times(outcomes: Sequence[Outcome], label: str) -> Floats:
    return np.array([each.step_us_median for each in outcomes if each.filter == label])


def _ratios(outcomes: Sequence[Outcome], label: str) -> Floats:
    """Error over that of the EKF in the same world, (worlds,)."""
    ratios: Floats = _errors(outcomes, label) / _errors(outcomes, EKF.label)
    return ratios


def _summary(outcomes: Sequence[Outcome], rules_at: Sequence[int]) -> list[Row]:
    rows = [_mean_row(outcomes, "EKF", "EKF", f"{PAPER_EKF_M:.3f}")]
    shown = sorted(PAPER_M, reverse=True)
    for theta_x in shown:
        label, who = f"SEIF {theta_x}", f"SEIF, {theta_x} active"
        exact = f"{PAPER_EXACT_M[theta_x]:.3f}" if theta_x in PAPER_EXACT_M else NOT_PRINTED
        rows.append(_mean_row(outcomes, label, who, f"{PAPER_M[theta_x]:.3f}"))
        rows.append(_mean_row(outcomes, f"{label} exact", f"{who}, exact mean", exact))
    for theta_x in shown:
        label, who = f"SEIF {theta_x}", f"{theta_x} active"
        rows.append(_ratio_row(outcomes, label, who, f"({PAPER_RATIO[theta_x]:g})"))
        rows.append(_ratio_row(outcomes, f"{label} exact", f"{who}, exact mean", NOT_PRINTED))
        for rule in RULE_NAMES if theta_x in rules_at else ():
            name = f"{who}, links cut by {RULE_NAMES[rule]}"
            rows.append(_ratio_row(outcomes, f"{label} {rule}", name, NOT_PRINTED))
    for label in (EKF.label, "SEIF 6", "SEIF 6 exact"):
        times = f"{median(_times(outcomes, label)):.0f}"
        rows.append(Row(quantity=f"time of a step, us, median: {label}", ours=times))
    diverged = [each.seed for each in outcomes if each.filter == EKF.label and each.error_m > DIVERGED_M]
    return [
        *rows,
        Row(
            quantity=f"worlds in which the EKF itself diverges (error above {DIVERGED_M} m); kept in all numbers",
            ours=", ".join(f"seed {each}" for each in diverged) or "none",
        ),
        Row(
            quantity="gate; steps whose sightings a filter refused, of all",
            ours=f"off; {sum(each.refused for each in outcomes)}",
        ),
    ]


def _mean_row(outcomes: Sequence[Outcome], label: str, who: str, paper: str) -> Row:
    errors, aligned = _errors(outcomes, label), _aligned(outcomes, label)
    return Row(
        quantity=f"landmark error, m, mean of {len(errors)} worlds (median; mean, map moved to fit best): {who}",
        paper=paper,
        ours=f"{mean(errors):.3f} ({median(errors):.3f}; {mean(aligned):.4f})",
    )


def _ratio_row(outcomes: Sequence[Outcome], label: str, who: str, paper: str) -> Row:
    errors, aligned = (values(outcomes, label) / values(outcomes, EKF.label) for values in (_errors, _aligned))
    of_means = mean(_errors(outcomes, label)) / mean(_errors(outcomes, EKF.label))
    return Row(
        quantity=f"error over the EKF's in the same world, median (ratio of means; median, moved to fit best): {who}",
        paper=paper,
        ours=f"{median(errors):.2f} ({of_means:.2f}; {median(aligned):.2f})",
    )


def _draw(path: Path, outcomes: Sequence[Outcome], active: Sequence[int], rules_at: Sequence[int]) -> None:
    worlds = len(_errors(outcomes, EKF.label))
    note = f"N = {LANDMARKS}, {worlds} worlds with the paper's noise, no gate; bands are quartiles over the worlds"
    figure = drawing.new_figure(15.0, 10.5, TITLE, note)
    grid = figure.add_gridspec(2, 2, left=0.05, right=0.985, bottom=0.06, top=0.885, wspace=0.11, hspace=0.24)
    error, aligned, ratio, time = (figure.add_subplot(grid[i]) for i in range(4))
    _draw_curves(error, outcomes, active, _errors, mean)
    _draw_curves(aligned, outcomes, active, _aligned, mean)
    _draw_curves(time, outcomes, active, _times, median)
    _draw_ratios(ratio, outcomes, active, rules_at)
    error.axhline(PAPER_EKF_M, color=drawing.VERMILION, lw=1.2, ls=":", label="the paper: EKF")
    at = [active.index(theta_x) for theta_x in PAPER_M]
    drawing.printed(error, at, list(PAPER_M.values()), "the paper: SEIF, amortised mean")
    at = [active.index(theta_x) for theta_x in PAPER_EXACT_M]
    drawing.printed(error, at, list(PAPER_EXACT_M.values()), "the paper: SEIF, exact mean", "s")
    for axes, title in (
        (error, "error of a landmark in the frame of the start, m, mean"),
        (aligned, "the same after moving the map to fit best, m, mean"),
        (ratio, "error over the EKF's in the same world; bars are medians"),
        (time, "time of a step, µs, median"),
    ):
        drawing.plain(axes, title, "active landmarks after a step, at most")
        drawing.number_x(axes, active)
        drawing.legend(axes)
    for axes in (error, aligned, ratio, time):
        drawing.log_y(axes)
    drawing.save(figure, path)


def _draw_curves(
    axes: Axes,
    outcomes: Sequence[Outcome],
    active: Sequence[int],
    values: Callable[[Sequence[Outcome], str], Floats],
    middle: drawing.Middle,
) -> None:
    drawing.level(axes, values(outcomes, EKF.label), drawing.EKF_COLOUR, "EKF", middle)
    places = range(len(active))
    exact = [values(outcomes, f"SEIF {theta_x} exact") for theta_x in active]
    drawing.line(axes, places, exact, drawing.ORANGE, "SEIF, exact mean", middle)
    amortised = [values(outcomes, f"SEIF {theta_x}") for theta_x in active]
    drawing.band(axes, places, amortised, drawing.SEIF_COLOUR, "SEIF, amortised mean", middle)


def _draw_ratios(axes: Axes, outcomes: Sequence[Outcome], active: Sequence[int], rules_at: Sequence[int]) -> None:
    axes.axhline(1.0, color=INK, lw=1.0)
    for place, theta_x in enumerate(active):
        drawing.dots(axes, place, _ratios(outcomes, f"SEIF {theta_x}"), drawing.SEIF_COLOUR, 0.22)
        for shift, rule, colour in RULE_STYLES if theta_x in rules_at else ():
            drawing.dots(axes, place + shift, _ratios(outcomes, f"SEIF {theta_x} {rule}"), colour, 0.22)
    axes.plot([], [], "o", color=drawing.SEIF_COLOUR, ms=5, label="links cut by normalised strength")
    for _, rule, colour in RULE_STYLES:
        axes.plot([], [], "o", color=colour, ms=5, label=f"by {RULE_NAMES[rule]}")
    at = [active.index(theta_x) for theta_x in PAPER_RATIO]
    drawing.printed(axes, at, list(PAPER_RATIO.values()), "the paper: ratio of means")
