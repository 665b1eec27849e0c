"""Marks of a figure for what was merged, what was kept apart, and what was not fused at all."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.path import Path

from fleet_seif.joint_records import Classes
from fleet_seif.merge_records import Considered, Reason
from fleet_seif.records import Floats
from scenarios.palette import INK

APART: Final = "#B00020"
DASHED: Final = (0, (4, 1.5))
SECTORS_MAX: Final = 6
"""A landmark that more vehicles have seen is one dark dot: sectors would be too thin to tell their colours."""
NAMES_MAX: Final = 4
"""So many vehicles are named in the legend, the others counted."""
MARKER_OF: Final[Mapping[Reason, str]] = {
    Reason.AMBIGUOUS: "D",
    Reason.REPEATS: "s",
    Reason.FEW: "p",
    Reason.CROWDED: "h",
    Reason.CONTRADICTED: "X",
    Reason.UNSOLVED: "P",
}


def draw_seen_by(
    axes: Axes, mean: Floats, vehicles: Sequence[Sequence[str]], colours: Mapping[str, Any], area: float
) -> None:
    """Dots at landmarks: in the colour of the vehicle that saw it, or cut like a cake in those of all that did.

    Args:
        mean: landmarks, shape (n, 2), m.
        vehicles: who saw each of them, ascending.
        area: of a dot, points^2; where several saw it larger.
    """
    for count in sorted({len(each) for each in vehicles}):
        rows = [i for i, each in enumerate(vehicles) if len(each) == count]
        x, y = mean[rows].T
        if count > 1:
            axes.scatter(x, y, s=4.4 * area, c=INK, linewidths=0, zorder=5)
        for k in range(count if count <= SECTORS_MAX else 0):
            faces = [colours.get(vehicles[i][k], INK) for i in rows]
            sector = Path.wedge(90 + 360 * k / count, 90 + 360 * (k + 1) / count) if count > 1 else "o"
            axes.scatter(x, y, s=area * (3.6 if count > 1 else 1.0), c=faces, marker=sector, linewidths=0, zorder=5)


def draw_kept_apart(axes: Axes, mean: Floats, classes: Classes, refused: Sequence[Considered], size: float) -> None:
    """A thin line between the two landmarks of each pair, and round its middle the mark of the reason.

    Args:
        mean: landmarks, shape (n, 2), m. classes: the names of each.
    """
    landmark = {name: i for i, names in enumerate(classes) for name in names}
    for each in refused:
        ends = mean[[landmark[each.a], landmark[each.b]]]
        axes.plot(ends[:, 0], ends[:, 1], color=APART, lw=1.0, zorder=6)
        axes.plot(*ends.mean(axis=0), ms=9.0 * size, **_apart_style(each.reason), zorder=6)


def draw_own_map(axes: Axes, landmarks: Floats, colour: Any, size: float) -> None:
    """The landmarks of a vehicle that is not fused, (n, 2) m, hollow."""
    axes.scatter(landmarks[:, 0], landmarks[:, 1], s=16.0 * size**2, facecolors="none", edgecolors=[colour],
                 linewidths=0.9, zorder=3)  # fmt: skip


def legend_of(refused: Sequence[Sequence[Considered]], doubtful: Sequence[str]) -> list[Line2D]:
    """What the marks of refused pairs mean, how many there are of each at the end, and which vehicles are not fused.

    Args:
        refused: the pairs of each map that is drawn, that of the end last.
    """
    drawn = {each.reason for pairs in refused for each in pairs}
    counts = Counter(each.reason for pairs in refused[-1:] for each in pairs)
    handles = [
        Line2D([], [], label=f"{reason} ({counts[reason]})", ms=8, **_apart_style(reason))
        for reason in MARKER_OF
        if reason in drawn
    ]
    if handles:
        handles.insert(0, Line2D([], [], label="kept apart (at the end):", ls="none"))
    if doubtful:
        more = f" and {len(doubtful) - NAMES_MAX} more" if len(doubtful) > NAMES_MAX else ""
        names = ", ".join(itertools.islice(doubtful, NAMES_MAX))
        text = f"doubtful: not fused ({names}{more}): live track, own map"
        handles.append(Line2D([], [], label=text, color=INK, lw=1.3, ls=DASHED, marker="o", mfc="none", ms=5))
    return handles


def seen_by_several(colours: Sequence[Any]) -> Line2D:
    """The legend's dot of two colours."""
    one, other = (*colours[:2], INK, INK)[:2]
    return Line2D([], [], label="seen by several vehicles", ls="none", marker="o", ms=7, fillstyle="left", mfc=one,
                  markerfacecoloralt=other, mec="none")  # fmt: skip


def _apart_style(reason: Reason) -> dict[str, Any]:
    return {"marker": MARKER_OF[reason], "color": APART, "mfc": "none", "mew": 0.9, "ls": "none"}
