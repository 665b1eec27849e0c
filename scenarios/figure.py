"""A run as one picture: the joint map at chosen times, and its uncertainty and error over time.

"meetings" is Fig. 17 of Thrun et al. (IJRR 2004): six maps round the first two meetings. "overview" is one large map.
Same run, same picture; no display and no state of matplotlib's own.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.transforms import Affine2D

from fleet_seif.records import Floats
from scenarios.history import Moment, meetings
from scenarios.recording import Log, Recording
from scenarios.score import rmse, signature_truth

Kind = Literal["meetings", "overview"]

SIZE_IN: Final = (16.0, 9.4)
DPI: Final = 100
EVEN_MOMENTS: Final = 60
"""Moments spread evenly over a run; as many again, closer together, over its first tenth (half) and the meetings."""
FIRST_STEP: Final = 3
AFTER_STEPS: Final = 3
"""A meeting's second panel is so many steps after the first landmark in common, as in the paper."""
WINDOW_STEPS: Final = 8
MEETINGS_MAX: Final = 2
SIGMAS: Final = 3.0
TAIL_STEPS: Final = 40
PATH_POINTS_MAX: Final = 4000
LEGEND_VEHICLES_MAX: Final = 20
FEW_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, SHARED, GREY, FAINT = "#222222", "#111111", "#8a8a8a", "#dddddd"
TINY, SMALL, PLAIN, LARGE = 8.5, 10.0, 11.5, 15.0


@dataclass(frozen=True, kw_only=True)
class FigureTimes:
    """When a figure wants the joint map, in the vehicles' time, s.

    times_s: ascending, for `history.replay`. panels: time and caption of each map, ascending, all in times_s.
    meetings: (vehicle, vehicle, time s) of those first sightings in common that joined groups of vehicles.
    """

    kind: Kind
    times_s: tuple[float, ...]
    panels: tuple[tuple[float, str], ...]
    meetings: tuple[tuple[str, str, float], ...]


@dataclass(frozen=True, eq=False)
class _Scene:
    """What all maps of a figure share. limits: x and y range, m. truths: true landmark by vehicle and signature."""

    recording: Recording
    moments: Sequence[Moment]
    times: FigureTimes
    tracks: Mapping[str, Floats]
    colours: dict[str, Any]
    limits: Floats
    truths: dict[str, dict[int, int]]


def figure_times(kind: Kind, recording: Recording) -> FigureTimes:
    """At which times to replay a run, so that its figure is good and cheap: at most about 120 of them."""
    clock = np.unique(np.concatenate([log.time_s for log in recording.logs.values()]))
    last = len(clock) - 1
    joins = _joins(recording)
    chosen = {min(FIRST_STEP, last)} | set(np.linspace(0, last, EVEN_MOMENTS).astype(int).tolist())
    chosen |= set(np.linspace(0, last / 10, EVEN_MOMENTS // 2).astype(int).tolist())
    captions = {} if kind == "overview" else {min(FIRST_STEP, last): "near the start"}
    for a, b, time_s in joins[:MEETINGS_MAX]:
        met = int(np.searchsorted(clock, time_s))
        chosen |= set(range(max(met - WINDOW_STEPS, 0), min(met + WINDOW_STEPS, last) + 1))
        if kind == "meetings" and met > 0:
            captions[met - 1] = f"just before {a} and {b} meet"
            captions[min(met + AFTER_STEPS, last)] = f"just after {a} and {b} met"
    captions[last] = "the end"
    return FigureTimes(
        kind=kind,
        times_s=tuple(float(clock[i]) for i in sorted(chosen)),
        panels=tuple((float(clock[i]), captions[i]) for i in sorted(captions)),
        meetings=tuple(joins),
    )


def _joins(recording: Recording) -> list[tuple[str, str, float]]:
    """The meetings of vehicles that no earlier meetings connect, earliest first."""
    group = {name: {name} for name in recording.logs}
    joins = []
    for a, b, time_s in meetings(recording):
        if b not in group[a]:
            joins.append((a, b, time_s))
            both = group[a] | group[b]
            group |= dict.fromkeys(both, both)
    return joins


def draw_figure(
    path: Path,
    *,
    title: str,
    recording: Recording,
    times: FigureTimes,
    moments: Sequence[Moment],
    tracks: Mapping[str, Floats],
) -> None:
    """Write the figure as a PNG, 1600 by 940 pixels.

    Args:
        times: as `figure_times` gave them; its kind decides the layout.
        moments: the joint map at those times, as `history.replay` gave them; some or all may be missing.
        tracks: each vehicle's live estimate (T+1, 3), pose k at its log's time k; vehicles may be missing.
    """
    scene = _Scene(
        recording=recording,
        moments=moments,
        times=times,
        tracks=tracks,
        colours=_colours(list(recording.logs)),
        limits=_limits(recording, moments, tracks),
        truths={name: signature_truth(log) for name, log in recording.logs.items()},
    )
    figure = Figure(figsize=SIZE_IN, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.035, 0.972, title, fontsize=LARGE, color=INK, weight="bold", va="center")
    if times.kind == "meetings":
        grid = figure.add_gridspec(2, 3, left=0.035, right=0.68, bottom=0.085, top=0.905, wspace=0.05, hspace=0.13)
        cells = [grid[i // 3, i % 3] for i in range(6)]
        size = 1.0
    else:
        grid = figure.add_gridspec(1, 1, left=0.035, right=0.60, bottom=0.085, top=0.935)
        cells = [grid[0, 0]]
        size = 1.5
    for i, (cell, (time_s, caption)) in enumerate(zip(cells, times.panels)):
        axes = figure.add_subplot(cell)
        _draw_map(axes, scene, time_s, size)
        where = f"step {_step(scene, time_s)}" if times.kind == "meetings" else f"{time_s:.4g} s"
        axes.set_title(f"{where}: {caption}", fontsize=PLAIN, color=INK, pad=6)
        axes.tick_params(labelbottom=i >= len(times.panels) - 3, labelleft=i % 3 == 0)
    _draw_curves(figure, scene, 0.745 if times.kind == "meetings" else 0.675)
    _draw_legend(figure, scene)
    figure.savefig(path, format="png", dpi=DPI, metadata={"Software": None})


def _draw_map(axes: Axes, scene: _Scene, until_s: float, size: float) -> None:
    """The joint map and the vehicles' tracks at one time. size: of the marks, 1 for a small map."""
    truth = scene.recording.landmarks
    crowd = size * min(1.0, math.sqrt(150 / max(len(truth), 1)) + 0.15)
    axes.set_aspect("equal")
    axes.set_xlim(*scene.limits[0])
    axes.set_ylim(*scene.limits[1])
    axes.plot(truth[:, 0], truth[:, 1], "x", color=GREY, ms=4.5 * crowd, mew=0.9, zorder=2)
    for name, log in scene.recording.logs.items():
        colour, count = scene.colours[name], int(np.searchsorted(log.time_s, until_s, side="right"))
        _draw_path(axes, log.truth_pose[:count], color=colour, lw=0.7, alpha=0.35, zorder=1)
        track = scene.tracks.get(name, np.empty((0, 3)))[:count]
        tail = TAIL_STEPS if scene.times.kind == "meetings" else count
        _draw_path(axes, track[max(0, len(track) - tail) :], color=colour, lw=1.3, alpha=0.8, zorder=3)
    moment = _moment_at(scene, until_s)
    if moment is not None:
        _draw_landmarks(axes, scene, moment, crowd)
        _draw_vehicles(axes, scene, moment, size)
    axes.set_facecolor("white")
    _plain(axes)


def _draw_path(axes: Axes, poses: Floats, **style: Any) -> None:
    """A track, broken where it is not known, thinned to PATH_POINTS_MAX."""
    stride = max(1, math.ceil(len(poses) / PATH_POINTS_MAX))
    shown = np.concatenate([poses[::stride], poses[-1:]])
    axes.plot(shown[:, 0], shown[:, 1], solid_joinstyle="round", **style)


def _draw_landmarks(axes: Axes, scene: _Scene, moment: Moment, crowd: float) -> None:
    """Means and ellipses of SIGMAS standard deviations, in the colour of who saw them."""
    colours = [_seen_by(scene, {name.vehicle for name in names}) for names in moment.solution.classes]
    variance, axis = np.linalg.eigh(moment.landmark_cov)
    across = 2 * SIGMAS * np.sqrt(np.maximum(variance, 0.0))
    angle_deg = np.degrees(np.arctan2(axis[:, 1, 1], axis[:, 0, 1]))
    mean = moment.solution.landmark_mean
    for face, style in ((True, {"alpha": 0.14}), (False, {"alpha": 0.9})):
        axes.add_collection(
            EllipseCollection(
                across[:, 1], across[:, 0], angle_deg, units="xy", offsets=mean, offset_transform=axes.transData,
                facecolors=colours if face else "none", edgecolors="none" if face else colours,
                linewidths=1.0, zorder=4, **style,
            )
        )  # fmt: skip
    axes.scatter(mean[:, 0], mean[:, 1], s=7.0 * crowd**2, c=colours, linewidths=0, zorder=5)


def _draw_vehicles(axes: Axes, scene: _Scene, moment: Moment, size: float) -> None:
    """A triangle at each vehicle's newest pose in the joint map, pointing ahead."""
    poses = moment.solution.pose_mean
    newest = {vehicle: poses[i] for i, (vehicle, _, k) in enumerate(moment.solution.poses) if k < 0}
    for vehicle, (x, y, theta) in newest.items():
        ahead = Affine2D().scale(0.75, 1.25).rotate(theta - math.pi / 2)
        marker = MarkerStyle("^", transform=ahead)
        axes.plot(
            [x], [y], linestyle="none", marker=marker, ms=10.0 * math.sqrt(size), mfc=scene.colours[vehicle],
            mec="white", mew=1.0, zorder=7,
        )  # fmt: skip


def _draw_curves(figure: Figure, scene: _Scene, left: float) -> None:
    """Summed uncertainty, and the error beside what the map claims of it."""
    grid = figure.add_gridspec(2, 1, left=left, right=0.985, bottom=0.085, top=0.79, hspace=0.22)
    above, below = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    steps = scene.times.kind == "meetings"
    at = [_step(scene, m.time_s) if steps else m.time_s for m in scene.moments]
    above.plot(at, [m.uncertainty_m2 for m in scene.moments], color=INK, lw=1.6)
    above.set_title("uncertainty: all landmarks' variances summed, m²", fontsize=PLAIN, color=INK, loc="left")
    claimed = [math.sqrt(m.uncertainty_m2 / len(m.landmark_cov)) for m in scene.moments]
    below.plot(at, claimed, color=GREY, lw=1.4, ls=(0, (4, 2)), label="claimed (root of the mean variance)")
    errors = [(t, error) for t, m in zip(at, scene.moments) if (error := _landmark_error(scene, m)) is not None]
    if errors:
        below.plot(*zip(*errors), color=INK, lw=1.6, label="true (RMS distance to the truth)")
    below.set_title("error of a landmark, m", fontsize=PLAIN, color=INK, loc="left")
    below.set_xlabel("step" if steps else "time, s", fontsize=PLAIN, color=INK)
    for axes in (above, below):
        axes.set_yscale("log")
        axes.margins(x=0.0, y=0.12)
        axes.grid(True, which="major", color=FAINT, lw=0.7)
        _plain(axes)
        _mark_meetings(axes, scene, named=axes is above)
    below.legend(fontsize=SMALL, frameon=True, framealpha=0.9, edgecolor="none", loc="upper right", labelcolor=INK)


def _mark_meetings(axes: Axes, scene: _Scene, named: bool) -> None:
    steps = scene.times.kind == "meetings"
    for i, (a, b, time_s) in enumerate(scene.times.meetings):
        x = _step(scene, time_s) if steps else time_s
        axes.axvline(x, color=GREY, lw=1.0 if steps else 0.7, ls=":", zorder=1)
        if steps and named:
            text = f" {a} and {b} meet, step {x}"
            axes.text(
                x, 0.96 - 0.075 * i, text, transform=axes.get_xaxis_transform(), fontsize=SMALL, color=INK, va="top"
            )


def _draw_legend(figure: Figure, scene: _Scene) -> None:
    left = 0.745 if scene.times.kind == "meetings" else 0.675

    def line(label: str, **style: Any) -> Line2D:
        return Line2D([], [], label=label, **style)

    marks = [
        line("true landmark", marker="x", color=GREY, ls="none", ms=6),
        line(f"landmark, {SIGMAS:.0f}σ ellipse", marker="o", ls="none", ms=11, mfc="#eeeeee", mec=INK),
        line("seen by one vehicle: its colour", marker="o", ls="none", ms=6, color=FEW_COLOURS[0]),
        line("seen by several: black", marker="o", ls="none", ms=6, color=SHARED),
        line("true track", color=GREY, lw=0.8),
        line("live estimate", color=GREY, lw=2.0),
    ]
    figure.legend(
        handles=marks, loc="upper left", bbox_to_anchor=(left - 0.008, 0.95), ncols=2, fontsize=SMALL, frameon=False,
        labelcolor=INK, borderaxespad=0.0, columnspacing=1.2, handletextpad=0.5,
    )  # fmt: skip


def _plain(axes: Axes) -> None:
    axes.tick_params(labelsize=SMALL, colors=INK, length=3, width=0.7)
    for spine in axes.spines.values():
        spine.set_color(GREY)
        spine.set_linewidth(0.8)


def _moment_at(scene: _Scene, time_s: float) -> Moment | None:
    """The newest moment that is not later."""
    return next((m for m in reversed(scene.moments) if m.time_s <= time_s), None)


def _step(scene: _Scene, time_s: float) -> int:
    """Index of the pose at a time, in the longest log."""
    longest: Log = max(scene.recording.logs.values(), key=lambda log: log.steps)
    return int(np.searchsorted(longest.time_s, time_s))


def _seen_by(scene: _Scene, vehicles: set[str]) -> Any:
    return scene.colours.get(next(iter(vehicles)), SHARED) if len(vehicles) == 1 else SHARED


def _colours(vehicles: Sequence[str]) -> dict[str, Any]:
    """A colour for each vehicle."""
    count = len(vehicles)
    if count <= len(FEW_COLOURS):
        return dict(zip(vehicles, FEW_COLOURS))
    spread = mpl.colormaps["turbo"](np.linspace(0.04, 0.96, count))
    return {name: tuple(colour) for name, colour in zip(vehicles, spread)}


def _landmark_error(scene: _Scene, moment: Moment) -> float | None:
    """Root mean square distance of the landmarks from the true ones of their signature, m; None without truth."""
    truth = np.array(
        [
            max(scene.truths.get(name.vehicle, {}).get(signature, -1) for name in names)
            for names, signature in zip(moment.solution.classes, moment.solution.signatures, strict=True)
        ],
        np.int64,
    )
    known = truth >= 0
    return rmse(moment.solution.landmark_mean[known] - scene.recording.landmarks[truth[known]])


def _limits(recording: Recording, moments: Sequence[Moment], tracks: Mapping[str, Floats]) -> Floats:
    """A square that holds the truth, (2, 2) m; without truth, what has been estimated."""
    points = [recording.landmarks, *(log.truth_pose[:, :2] for log in recording.logs.values())]
    if not any(np.isfinite(p).all(axis=1).any() for p in points):
        points = [m.solution.landmark_mean for m in moments[-1:]] + [track[:, :2] for track in tracks.values()]
    found = np.concatenate([*points, np.empty((0, 2))])
    found = found[np.isfinite(found).all(axis=1)]
    low, high = (found.min(axis=0), found.max(axis=0)) if len(found) else (np.zeros(2), np.ones(2))
    half = 0.53 * max(float(np.max(high - low)), 1e-3)
    centre = (low + high) / 2
    return np.column_stack([centre - half, centre + half])
