"""The map of an EKF beside that of a SEIF, with correlation and normalised information matrices (Fig. 1, 7).

What the paper rests on: all landmarks of a map are correlated, but once normalised almost all of the information matrix
is close to zero. A SEIF makes those entries exactly zero.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import PowerNorm

from fleet_seif.ekf import Ekf
from fleet_seif.jit import one_thread
from fleet_seif.records import Floats, Ints
from fleet_seif.seif import Seif
from scenarios.experiments import drawing
from scenarios.experiments.measures import EKF, Drive, F, drive, map_error_m, seif
from scenarios.experiments.study import Cell, Progress, Row, csv_of, png_of, write_csv
from scenarios.experiments.worlds import World, paper_world
from scenarios.palette import GREY, INK, SMALL

NAME: Final = "correlation"
TITLE: Final = "Correlation is dense, information is nearly sparse: EKF and SEIF (SEIF paper, Fig. 1, 7)"
LANDMARKS: Final = 50
SEIF: Final = seif(6)
SIGMAS: Final = 3.0
SMALL_INFORMATION: Final = 0.01
"""A normalised entry below it says next to nothing."""
LINK_SHOWN: Final = 0.01
"""Weaker links are not drawn into the map."""
CONTRAST: Final = 0.5
"""Entries are shown with this power, so that small ones can be told from zero."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate:
    """Where a filter ended.

    P, H: covariance and information of pose and landmarks, (3 + 2 n, 3 + 2 n), pose first; landmarks, truth (n, 2), m.
    """

    label: str
    pose: Floats
    landmarks: Floats
    truth: Floats
    P: Floats
    H: Floats
    error_m: float


@one_thread
def run(out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]:
    """Raises NumericalError where a filter breaks down."""
    world = paper_world(LANDMARKS, seed, steps=200 if quick else None)
    ekf = drive(Ekf(EKF.settings, world.model), world)
    progress(1, 2)
    sparse = drive(Seif(SEIF.settings, world.model), world)
    progress(2, 2)
    P = ekf.filter.covariance_of(range(len(ekf.truth)))
    estimates = [_estimate("EKF", ekf, np.asarray(np.linalg.inv(P), np.float64))]
    estimates.append(_estimate(SEIF.label, sparse, sparse.filter.information()[0].toarray()))
    _draw(png_of(out, NAME), estimates, world)
    write_csv(csv_of(out, NAME), [pair for each in estimates for pair in _pairs(each)])
    return [row for each in estimates for row in _rows(each)]


def _estimate(label: str, done: Drive[F], H: Floats) -> Estimate:
    return Estimate(
        label=label,
        pose=done.filter.pose,
        landmarks=done.filter.landmarks,
        truth=done.truth,
        P=done.filter.covariance_of(range(len(done.truth))),
        H=H,
        error_m=map_error_m(done),
    )


def normalised(A: Floats) -> Floats:
    """|A_ij| / sqrt(A_ii A_jj): of a covariance the size of correlations, of an information that of partial ones."""
    scale = 1.0 / np.sqrt(np.diag(A))
    sizes: Floats = np.abs(A) * scale[:, None] * scale
    return sizes


def strengths(A: Floats) -> Floats:
    """The largest normalised entry of each block between two landmarks, (n, n), of a matrix over pose and landmarks."""
    n = (len(A) - 3) // 2
    blocks: Floats = normalised(A)[3:, 3:].reshape(n, 2, n, 2).max(axis=(1, 3))
    return blocks


def along_the_map(points: Floats) -> Ints:
    """An order of points (n, 2) in which neighbours stay close: by rows of about sqrt(n), every other row backwards."""
    n = len(points)
    rows = np.array_split(np.argsort(points[:, 1], kind="stable"), max(1, round(math.sqrt(n) / 1.4)))
    sorted_rows = [
        row[np.argsort(points[row, 0], kind="stable")][:: 1 if k % 2 == 0 else -1] for k, row in enumerate(rows)
    ]
    return np.concatenate(sorted_rows)


def _off_diagonal(A: Floats) -> Floats:
    return A[np.triu_indices(len(A), 1)]


def _pairs(estimate: Estimate) -> list[dict[str, Cell]]:
    """Every pair of landmarks of an estimate, by number."""
    correlation, information = strengths(estimate.P), strengths(estimate.H)
    distance = np.hypot(*(estimate.truth[:, None] - estimate.truth).transpose(2, 0, 1))
    return [
        {
            "filter": estimate.label,
            "landmark": i,
            "other": j,
            "distance_m": float(distance[i, j]),
            "correlation": float(correlation[i, j]),
            "normalised_information": float(information[i, j]),
        }
        for i in range(len(distance))
        for j in range(i + 1, len(distance))
    ]


def _rows(estimate: Estimate) -> list[Row]:
    correlation, information = _off_diagonal(strengths(estimate.P)), _off_diagonal(strengths(estimate.H))
    small, zero = np.mean(information < SMALL_INFORMATION), np.mean(information == 0.0)
    who = f"{estimate.label}, N = {len(estimate.truth)}"
    return [
        Row(quantity=f"landmark error, m: {who}", ours=f"{estimate.error_m:.3f}"),
        Row(
            quantity=f"correlation of two landmarks, median over all pairs: {who}", ours=f"{np.median(correlation):.2f}"
        ),
        Row(quantity=f"pairs with normalised information below {SMALL_INFORMATION}: {who}", ours=f"{small:.0%}"),
        Row(quantity=f"pairs with information exactly zero: {who}", ours=f"{zero:.0%}"),
    ]


def _draw(path: Path, estimates: Sequence[Estimate], world: World) -> None:
    note = f"N = {LANDMARKS}, {world.log.steps} steps, the paper's noise; matrices: neighbours stand close together"
    figure = drawing.new_figure(15.6, 11.3, TITLE, note)
    grid = figure.add_gridspec(
        2, 4, left=0.035, right=0.95, bottom=0.06, top=0.89, wspace=0.14, hspace=0.13, width_ratios=(1, 1, 1, 0.03)
    )
    limits = _limits([estimates[0].truth, world.poses[:, :2], *(each.landmarks for each in estimates)])
    for row, each in enumerate(estimates):
        axes = figure.add_subplot(grid[row, 0])
        _draw_map(axes, each, world)
        axes.set_xlim(*limits[0])
        axes.set_ylim(*limits[1])
        if row == 1:
            axes.legend(
                loc="upper left", bbox_to_anchor=(-0.02, -0.06), ncols=2, frameon=False, fontsize=SMALL,
                labelcolor=INK, columnspacing=1.0, handletextpad=0.5,
            )  # fmt: skip
        order = along_the_map(each.truth)
        entries = (3 + 2 * order[:, None] + np.arange(2)).ravel()
        for column, (A, name) in enumerate(((each.P, "correlation"), (each.H, "normalised information"))):
            axes = figure.add_subplot(grid[row, 1 + column])
            shown = normalised(A)[np.ix_(entries, entries)]
            image = axes.imshow(shown, cmap="Blues", norm=PowerNorm(CONTRAST, 0.0, 1.0), interpolation="nearest")
            drawing.plain(axes, f"{each.label}: {name}")
            axes.set_xticks([])
            axes.set_yticks([])
        bar = figure.colorbar(image, cax=figure.add_subplot(grid[row, 3]), ticks=(0.0, 0.01, 0.1, 0.3, 0.6, 1.0))
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=SMALL, colors=INK, length=3)
    drawing.save(figure, path)


def _limits(points: Sequence[Floats]) -> Floats:
    """x and y range of a square that holds the points, (2, 2) m."""
    every = np.concatenate(points)
    low, high = every.min(axis=0), every.max(axis=0)
    centre, half = (low + high) / 2, 0.53 * float(np.max(high - low))
    return np.column_stack([centre - half, centre + half])


def _draw_map(axes: Axes, estimate: Estimate, world: World) -> None:
    axes.set_aspect("equal")
    _draw_links(axes, estimate)
    axes.plot(*world.poses[:, :2].T, color=GREY, lw=0.4, alpha=0.4, zorder=1, label="true track")
    axes.plot(*estimate.truth.T, "x", color=GREY, ms=5, mew=1.0, zorder=4, label="true landmark")
    n = len(estimate.landmarks)
    blocks = estimate.P[3:, 3:].reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
    variance, axis = np.linalg.eigh(blocks)
    across, angle_deg = 2 * SIGMAS * np.sqrt(variance), np.degrees(np.arctan2(axis[:, 1, 1], axis[:, 0, 1]))
    for face, style in ((True, {"alpha": 0.13}), (False, {"alpha": 0.8})):
        axes.add_collection(
            EllipseCollection(
                across[:, 1], across[:, 0], angle_deg, units="xy", offsets=estimate.landmarks,
                offset_transform=axes.transData, facecolors=drawing.BLUE if face else "none",
                edgecolors="none" if face else drawing.BLUE, linewidths=0.9, zorder=3, **style,
            )
        )  # fmt: skip
    label = f"estimate with {SIGMAS:.0f}σ ellipse"
    axes.plot(*estimate.landmarks.T, ".", color=drawing.BLUE, ms=4, zorder=5, label=label)
    axes.plot([], [], color=drawing.VERMILION, lw=1.0, label=f"link above {LINK_SHOWN:g}")
    drawing.plain(axes, f"{estimate.label}: map, m, and links")


def _draw_links(axes: Axes, estimate: Estimate) -> None:
    """Lines between landmarks that share information, the stronger the darker."""
    strength = strengths(estimate.H)
    first, second = np.nonzero(np.triu(strength, 1) > LINK_SHOWN)
    lines = np.stack([estimate.landmarks[first], estimate.landmarks[second]], axis=1)
    shade = np.clip(1.3 * strength[first, second] ** CONTRAST, 0.0, 1.0)
    axes.add_collection(LineCollection(list(lines), colors=drawing.VERMILION, alpha=shade, linewidths=1.0, zorder=2))
