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
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator
from matplotlib.transforms import Affine2D

from fleet_seif.records import Floats
from scenarios.association import Truths
from scenarios.figure_marks import DASHED, draw_kept_apart, draw_own_map, draw_seen_by, legend_of, seen_by_several
from scenarios.history import Moment, meetings
from scenarios.palette import FAINT, FEW_COLOURS, GREY, INK, LARGE, PLAIN, SMALL
from scenarios.recording import Log, Recording
from scenarios.score import align, landmark_truths, rmse
from vehicles.drive import DriveResult

Kind = Literal["meetings", "overview"]

SIZE_IN: Final = (16.0, 9.0)
DPI: Final = 100
EVEN_MOMENTS: Final = 60
"""Moments spread evenly over a run; half as many again over its first tenth, where most is learned."""
FIRST_STEP: Final = 3
AFTER_STEPS: Final = 3
"""A meeting's second panel is so many steps after the first landmark in common, as in the paper."""
WINDOW_STEPS: Final = 8
"""Every step so close to a meeting is a moment."""
MEETINGS_MAX: Final = 2
TAIL_STEPS: Final = 40
"""So much of the live estimate is shown in a small map, where all of it would hide the rest."""
SIGMAS: Final = 3.0
CROWDED_STEPS: Final = 3000
"""Tracks of more steps in all are drawn thinner."""
PATH_POINTS_MAX: Final = 4000
LEGEND_VEHICLES_MAX: Final = 20
SHARED, ALIGNED = "#111111", "#a8780a"
STRIPS_Y: Final = {1: (0.028,), 2: (0.047, 0.018), 3: (0.062, 0.037, 0.012)}
"""Heights of the legend's strips, by how many there are."""
STRIP_CHARACTERS: Final = 225
"""What fits into a strip of the legend, with HANDLE_CHARACTERS for each mark; longer ones are written smaller."""
HANDLE_CHARACTERS: Final = 8


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
    """What all parts of a figure share."""

    recording: Recording
    moments: Sequence[Moment]
    times: FigureTimes
    drives: Mapping[str, DriveResult]
    colours: dict[str, Any]
    truths: Truths


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
        if kind == "meetings" and met > 0:
            chosen |= set(range(max(met - WINDOW_STEPS, 0), min(met + WINDOW_STEPS, last) + 1))
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
    drives: Mapping[str, DriveResult],
    truths: Truths,
) -> None:
    """Write the figure as a PNG of SIZE_IN by DPI pixels.

    Args:
        times: as `figure_times` gave them; its kind decides the layout.
        moments: the joint map at those times, as `history.replay` gave them; some or all may be missing.
        drives: what each vehicle had to say, pose k at its log's time k; vehicles may be missing.
        truths: which true landmark each vehicle's landmarks are.
    """
    scene = _Scene(recording, moments, times, drives, _colours(list(recording.logs)), truths)
    figure = Figure(figsize=SIZE_IN, dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    figure.text(0.04, 0.968, title, fontsize=LARGE, color=INK, weight="bold", va="center")
    if times.kind == "meetings":
        _draw_panels(figure, scene)
        _draw_curves(figure, scene, left=0.75)
    else:
        _draw_overview(figure, scene)
        _draw_curves(figure, scene, left=0.62)
    _draw_legend(figure, scene)
    figure.savefig(path, format="png", dpi=DPI, metadata={"Software": None})


def _draw_panels(figure: Figure, scene: _Scene) -> None:
    grid = figure.add_gridspec(2, 3, left=0.04, right=0.705, bottom=0.12, top=0.915, wspace=0.04, hspace=0.11)
    limits = _limits(scene, 1.0)
    for i, (time_s, caption) in enumerate(scene.times.panels):
        axes = figure.add_subplot(grid[i // 3, i % 3])
        _draw_map(axes, scene, time_s, limits, size=1.0)
        axes.set_title(f"step {_step(scene, time_s)}: {caption}", fontsize=PLAIN, color=INK, pad=5)
        axes.tick_params(labelbottom=i >= len(scene.times.panels) - 3, labelleft=i % 3 == 0)
        axes.set_xlabel("x, m" if i >= len(scene.times.panels) - 3 else "", fontsize=SMALL, color=INK, labelpad=2)
        axes.set_ylabel("y, m" if i % 3 == 0 else "", fontsize=SMALL, color=INK, labelpad=2)


def _draw_overview(figure: Figure, scene: _Scene) -> None:
    width, height = 0.53, 0.795
    axes = figure.add_axes((0.04, 0.12, width, height))
    ratio = width / height * SIZE_IN[0] / SIZE_IN[1]
    _draw_map(axes, scene, scene.times.panels[-1][0], _limits(scene, ratio), size=1.5)
    axes.set_xlabel("x, m", fontsize=SMALL, color=INK, labelpad=2)
    axes.set_ylabel("y, m", fontsize=SMALL, color=INK, labelpad=2)


def _draw_map(axes: Axes, scene: _Scene, until_s: float, limits: Floats, size: float) -> None:
    """The joint map and the vehicles' tracks at one time. limits: x and y range, m. size: of the marks."""
    truth, logs = scene.recording.landmarks, scene.recording.logs
    crowd = size * min(1.0, math.sqrt(150 / max(len(truth), 1)) + 0.15)
    width = 1.3 if sum(log.steps for log in logs.values()) * size < CROWDED_STEPS else 0.7
    axes.set_aspect("equal")
    axes.set_xlim(*limits[0])
    axes.set_ylim(*limits[1])
    axes.plot(truth[:, 0], truth[:, 1], "x", color=GREY, ms=4.5 * crowd, mew=0.9, zorder=4)
    moment = _moment_at(scene, until_s)
    for name, log in logs.items():
        colour, count = scene.colours[name], int(np.searchsorted(log.time_s, until_s, side="right"))
        _draw_path(axes, log.truth_pose[:count], color=colour, lw=0.6 * width, alpha=0.4, zorder=1)
        track = scene.drives[name].pose[:count] if name in scene.drives else np.empty((0, 3))
        tail = track[-TAIL_STEPS:] if scene.times.kind == "meetings" else track
        is_fused = moment is None or name not in moment.doubtful
        _draw_path(axes, tail, color=colour, lw=width, alpha=0.75, zorder=3, ls="-" if is_fused else DASHED)
        if not is_fused and len(track):
            _draw_vehicle(axes, track[-1], size, mfc="white", mec=colour)
            if until_s >= scene.times.times_s[-1]:  # how its own map was before, nobody has kept
                draw_own_map(axes, scene.drives[name].landmarks, colour, size)
    if moment is not None:
        _draw_landmarks(axes, scene, moment, crowd)
        landmarks = moment.solution.landmark_mean, moment.solution.classes
        draw_kept_apart(axes, *landmarks, moment.merges.refused, math.sqrt(size))
        _draw_vehicles(axes, scene, moment, size)
    _plain(axes)


def _draw_path(axes: Axes, poses: Floats, **style: Any) -> None:
    """A track, broken where it is not known, thinned to PATH_POINTS_MAX."""
    stride = max(1, math.ceil(len(poses) / PATH_POINTS_MAX))
    shown = np.concatenate([poses[::stride], poses[-1:]])
    axes.plot(shown[:, 0], shown[:, 1], solid_joinstyle="round", **style)


def _draw_landmarks(axes: Axes, scene: _Scene, moment: Moment, crowd: float) -> None:
    """Means and ellipses of SIGMAS standard deviations, in the colours of who saw them."""
    vehicles = [sorted({name.vehicle for name in names}) for names in moment.solution.classes]
    colours = [scene.colours.get(each[0], SHARED) if len(each) == 1 else SHARED for each in vehicles]
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
    draw_seen_by(axes, mean, vehicles, scene.colours, 7.0 * crowd**2)


def _draw_vehicles(axes: Axes, scene: _Scene, moment: Moment, size: float) -> None:
    """A triangle at each vehicle's newest pose in the joint map, pointing ahead."""
    poses = moment.solution.pose_mean
    newest = {vehicle: poses[i] for i, (vehicle, _, k) in enumerate(moment.solution.poses) if k < 0}
    for vehicle, pose in newest.items():
        _draw_vehicle(axes, pose, size, mfc=scene.colours[vehicle], mec="white")


def _draw_vehicle(axes: Axes, pose: Floats, size: float, **style: Any) -> None:
    x, y, theta = pose
    marker = MarkerStyle("^", transform=Affine2D().scale(0.75, 1.25).rotate(theta - math.pi / 2))
    axes.plot([x], [y], linestyle="none", marker=marker, ms=10.0 * math.sqrt(size), mew=1.0, zorder=7, **style)


def _draw_curves(figure: Figure, scene: _Scene, left: float) -> None:
    """Summed uncertainty, and the error beside what the map claims of it."""
    grid = figure.add_gridspec(2, 1, left=left, right=0.985, bottom=0.12, top=0.915, hspace=0.19)
    above, below = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    steps = scene.times.kind == "meetings"
    at = [_step(scene, m.time_s) if steps else m.time_s for m in scene.moments]
    above.plot(at, [m.uncertainty_m2 for m in scene.moments], color=INK, lw=1.6)
    above.set_title("variance, sum over all landmarks, m²", fontsize=PLAIN, color=INK, loc="left")
    claimed = [math.sqrt(m.uncertainty_m2 / len(m.landmark_cov)) for m in scene.moments]
    below.plot(at, claimed, color=GREY, lw=1.5, ls=(0, (4, 1.5)), label="claimed (root of mean variance)")
    errors = np.array([_landmark_errors(scene, m) for m in scene.moments]).reshape(-1, 2)
    if np.isfinite(errors).any():
        below.plot(at, errors[:, 0], color=INK, lw=1.6, label="true (RMS distance to truth)")
        below.plot(at, errors[:, 1], color=ALIGNED, lw=1.3, label="true, map moved to fit best")
    below.set_title("error of a landmark, m", fontsize=PLAIN, color=INK, loc="left")
    below.set_xlabel("step" if steps else "time, s", fontsize=SMALL, color=INK, labelpad=2)
    for axes in (above, below):
        axes.set_yscale("log")
        axes.margins(x=0.0, y=0.1)
        low, high = axes.get_ylim()
        subs = (1.0, 2.0, 5.0) if high < 2000 * low else (1.0,)
        axes.yaxis.set_major_locator(LogLocator(subs=subs))
        axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.grid(True, color=FAINT, lw=0.7)
        _plain(axes)
    _mark_meetings(above, below, scene)
    below.legend(fontsize=SMALL, framealpha=0.9, edgecolor="none", loc="best", labelcolor=INK)


def _mark_meetings(above: Axes, below: Axes, scene: _Scene) -> None:
    """A line at each meeting; in an overview, where there may be many, at the one that joined the last vehicle."""
    met = scene.times.meetings
    marks: list[tuple[float, str]]
    if scene.times.kind == "meetings":
        marks = [(_step(scene, t), f"{a} and {b} meet, step {_step(scene, t)}") for a, b, t in met]
    else:
        whole = len(met) == len(scene.recording.logs) - 1
        marks = [(t, f"all vehicles connected, {t:.3g} s") for _, _, t in met[-1:] if whole]
    for i, (x, text) in enumerate(marks):
        for axes in (above, below):
            axes.axvline(x, color=GREY, lw=1.0, ls=":", zorder=1)
        above.annotate(
            text, (x, 0.97), xycoords=("data", "axes fraction"), xytext=(5, -15 * i), textcoords="offset points",
            fontsize=SMALL, color=INK, va="top",
        )  # fmt: skip


def _draw_legend(figure: Figure, scene: _Scene) -> None:
    """Strips along the foot of the figure: the marks, the vehicles, and what was not merged or not fused."""
    tail = f", last {TAIL_STEPS} steps" if scene.times.kind == "meetings" else ""
    marks = [
        Line2D([], [], label="true landmark", marker="x", color=GREY, ls="none", ms=6),
        Line2D([], [], label=f"estimate with {SIGMAS:.0f}σ ellipse", marker="o", ls="none", ms=10, mfc=FAINT, mec=GREY),
        seen_by_several(list(scene.colours.values())),
        Line2D([], [], label="true track", color=GREY, lw=0.7),
        Line2D([], [], label=f"live estimate{tail}", color=GREY, lw=2.0),
    ]
    vehicles = [
        Line2D([], [], label=name, marker="^", color=colour, ms=8, lw=2.0, mec="white")
        for name, colour in list(scene.colours.items())[:LEGEND_VEHICLES_MAX]
    ]
    few = len(vehicles) <= len(FEW_COLOURS)
    shown = [m for time_s, _ in scene.times.panels if (m := _moment_at(scene, time_s)) is not None]
    apart = legend_of([m.merges.refused for m in shown], sorted(frozenset().union(*(m.doubtful for m in shown))))
    strips = [strip for strip in ([marks + vehicles] if few else [marks, vehicles]) + [apart] if strip]
    for handles, y in zip(strips, STRIPS_Y[len(strips)], strict=True):
        length = sum(len(str(handle.get_label())) + HANDLE_CHARACTERS for handle in handles)
        figure.legend(
            handles=handles, loc="center", bbox_to_anchor=(0.5, y), ncols=len(handles), frameon=False, labelcolor=INK,
            fontsize=SMALL * min(1.0, STRIP_CHARACTERS / length), borderaxespad=0.0, handletextpad=0.5,
            columnspacing=1.6 if few else 1.0, handlelength=1.8,
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


def _colours(vehicles: Sequence[str]) -> dict[str, Any]:
    """A colour for each vehicle; of many, neighbours in fleet order (and so often in the world) are unlike."""
    if len(vehicles) <= len(FEW_COLOURS):
        return dict(zip(vehicles, FEW_COLOURS))
    golden = (math.sqrt(5) - 1) / 2
    spread = 0.85 * mpl.colormaps["turbo"](0.03 + 0.94 * (golden * np.arange(len(vehicles)) % 1.0))
    return {name: tuple(colour[:3]) for name, colour in zip(vehicles, spread)}


def _landmark_errors(scene: _Scene, moment: Moment) -> tuple[float, float]:
    """RMS distance of the landmarks from the true ones that they are, m, as they are and after alignment.

    NaN for what cannot be told: without truth, and for an alignment of fewer than three landmarks.
    """
    truth = landmark_truths(moment.solution, scene.truths)
    known = truth >= 0
    mean, target = moment.solution.landmark_mean[known], scene.recording.landmarks[truth[known]]
    error = rmse(mean - target)
    aligned = rmse(align(mean, target) - target) if len(mean) > 2 else None
    return (math.nan if error is None else error, math.nan if aligned is None else aligned)


def _limits(scene: _Scene, ratio: float) -> Floats:
    """x and y range, (2, 2) m, `ratio` times as wide as high, that hold the truth; without it, what was estimated."""
    recording = scene.recording
    points = [recording.landmarks, *(log.truth_pose[:, :2] for log in recording.logs.values())]
    if not any(np.isfinite(p).all(axis=1).any() for p in points):
        points = [m.solution.landmark_mean for m in scene.moments[-1:]] + [d.pose[:, :2] for d in scene.drives.values()]
    found = np.concatenate([*points, np.empty((0, 2))])
    found = found[np.isfinite(found).all(axis=1)]
    low, high = (found.min(axis=0), found.max(axis=0)) if len(found) else (np.zeros(2), np.ones(2))
    width, height = high - low
    half = 0.53 * max(height, width / ratio, 1e-3) * np.array([ratio, 1.0])
    centre = (low + high) / 2
    return np.column_stack([centre - half, centre + half])
