"""How figures of experiments look: that of `scenarios.figure`, without any state of matplotlib's own."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator

from fleet_seif.records import Floats
from scenarios.figure import DPI
from scenarios.palette import FAINT, FEW_COLOURS, GREY, INK, LARGE, PLAIN, SMALL

BLUE, VERMILION, GREEN, PINK, ORANGE, SKY = FEW_COLOURS
EKF_COLOUR, SEIF_COLOUR, ESEIF_COLOUR, EXACT_COLOUR = INK, BLUE, GREEN, VERMILION
GOLDEN: Final = (math.sqrt(5.0) - 1.0) / 2.0
QUARTILES: Final = (25.0, 75.0)


def new_figure(width_in: float, height_in: float, title: str, note: str) -> Figure:
    """A white figure with a title and, under it, a line that says what is shown."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.02, 1 - 0.30 / height_in, title, fontsize=LARGE, color=INK, weight="bold", va="center")
    figure.text(0.02, 1 - 0.62 / height_in, note, fontsize=PLAIN, color=GREY, va="center")
    return figure


def save(figure: Figure, path: Path) -> None:
    figure.savefig(path, format="png", dpi=DPI, metadata={"Software": None})


def plain(axes: Axes, title: str, x_label: str = "") -> None:
    axes.set_title(title, fontsize=PLAIN, color=INK, loc="left", pad=7)
    axes.set_xlabel(x_label, fontsize=SMALL, color=INK, labelpad=3)
    axes.tick_params(labelsize=SMALL, colors=INK, length=3, width=0.7)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(GREY)
        spine.set_linewidth(0.8)


def log_y(axes: Axes) -> None:
    """A logarithmic axis with plain numbers, and faint lines at them."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    fine, middle, coarse = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0), (1.0, 2.0, 5.0), (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=fine if high < 6 * low else middle if high < 200 * low else coarse))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.grid(True, axis="y", color=FAINT, lw=0.7)


def number_x(axes: Axes, values: Sequence[float]) -> None:
    """Evenly spaced places 0, 1, ... labelled with these values."""
    axes.set_xticks(range(len(values)), [f"{value:g}" for value in values])
    axes.set_xlim(-0.5, len(values) - 0.5)


Middle = Callable[[Floats], float]


def mean(runs: Floats) -> float:
    return float(np.mean(runs))


def median(runs: Floats) -> float:
    return float(np.median(runs))


def band(axes: Axes, x: Sequence[float], runs: Sequence[Floats], colour: str, label: str, middle: Middle) -> None:
    """The mean or median of the runs at each x as a line, their quartiles as a band."""
    low, high = np.array([np.percentile(each, QUARTILES) for each in runs]).T
    axes.fill_between(x, low, high, color=colour, alpha=0.13, lw=0)
    line(axes, x, runs, colour, label, middle)


def line(axes: Axes, x: Sequence[float], runs: Sequence[Floats], colour: str, label: str, middle: Middle) -> None:
    axes.plot(x, [middle(each) for each in runs], color=colour, lw=1.8, marker="o", ms=4, label=label)


def level(axes: Axes, runs: Floats, colour: str, label: str, middle: Middle) -> None:
    """The mean or median of runs that do not depend on x as a line across, their quartiles as a band."""
    axes.axhspan(*np.percentile(runs, QUARTILES), color=colour, alpha=0.08, lw=0)
    axes.axhline(middle(runs), color=colour, lw=1.5, label=label)


def printed(axes: Axes, x: Sequence[float], y: Sequence[float], label: str, marker: str = "D") -> None:
    """What the paper prints."""
    axes.plot(x, y, ls="none", marker=marker, ms=8, mfc="white", mec=VERMILION, mew=1.6, label=label, zorder=6)


def spread(count: int, width: float) -> Floats:
    """Sideways shifts that keep dots apart, in a fixed pattern, (count,)."""
    shifts: Floats = (GOLDEN * np.arange(count, dtype=np.float64) % 1.0 - 0.5) * width
    return shifts


def dots(axes: Axes, x: float, values: Floats, colour: str, width: float) -> None:
    """Every value as a dot, and the median as a bar."""
    axes.scatter(x + spread(len(values), width), values, s=16, color=colour, alpha=0.45, linewidths=0, zorder=3)
    axes.plot([x - width / 2, x + width / 2], [median(values)] * 2, color=colour, lw=2.6, zorder=4)


Place = Literal["best", "upper left", "upper right", "lower left", "lower right"]


def legend(axes: Axes, place: Place = "best") -> None:
    axes.legend(fontsize=SMALL, framealpha=0.6, edgecolor="none", loc=place, labelcolor=INK)
