"""Scores what a finished run left in its folder, and sets the batch over the same readings beside it."""

import json
import time
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.sparse
from rich.console import Group
from rich.table import Table
from rich.text import Text

from fleet_seif.errors import RunError
from fleet_seif.joint import marginal_covariances, solve
from fleet_seif.records import Floats, Ints
from scenarios import output
from scenarios.batch import BatchSolution, landmark_chi_square, solve_batch
from scenarios.experiments.confidence import BAND, chi_square_band
from scenarios.recording import Log, Recording
from scenarios.report import FinishedRun
from scenarios.score import align, rmse, score_map, signature_truth

FIT_MAX: Final = 1.5
"""Chi-square per degree of freedom of a batch above which its readings are not what they declare to be."""
SAME_TIME_S: Final = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class MapEstimate:
    """Landmarks mean (n, 2) m with the row truth (n,) of each in the truth, -1 unknown; H: information, they first."""

    mean: Floats
    truth: Ints
    H: scipy.sparse.csr_array


@dataclass(frozen=True, kw_only=True)
class MapErrors:
    """A map against the truth; None where no landmark has one.

    landmarks: how many were compared. nees_low, nees_high: between which NEES per degree of freedom lies in BAND of
    all runs, where errors are what the map says they are.
    """

    landmarks: int
    rmse_m: float | None
    rmse_aligned_m: float | None
    nees_per_dof: float | None
    nees_low: float | None
    nees_high: float | None


@dataclass(frozen=True, kw_only=True)
class PoseErrors:
    """Positions along a path against the truth, m: as they are, and after the best rotation and translation of them."""

    rmse_m: float | None
    rmse_aligned_m: float | None


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Our fused map and the batch's over the same landmarks."""

    ours: MapErrors
    batch: MapErrors

    @property
    def ratio(self) -> float | None:
        """Of the absolute errors."""
        return ratio_of(self.ours.rmse_m, self.batch.rmse_m)

    @property
    def ratio_aligned(self) -> float | None:
        return ratio_of(self.ours.rmse_aligned_m, self.batch.rmse_aligned_m)


@dataclass(frozen=True, eq=False, kw_only=True)
class StoredRun:
    """A finished run as its folder holds it. tracks: live poses by vehicle (T+1, 3), NaN where unknown."""

    report: dict[str, Any]
    recording: Recording
    map: MapEstimate
    tracks: dict[str, Floats]


def ratio_of(ours: float | None, batch: float | None) -> float | None:
    return ours / batch if ours is not None and batch else None


def map_errors(estimate: MapEstimate, landmarks: Floats, only: Iterable[int] | None = None) -> MapErrors:
    """Errors of the landmarks whose truth is known, or of those among `only`. landmarks: the true ones (m, 2)."""
    chosen = estimate.truth >= 0
    if only is not None:
        chosen &= np.isin(estimate.truth, list(only))
    mean, truth = estimate.mean[chosen], landmarks[estimate.truth[chosen]]
    count = len(mean)
    if not count:
        return MapErrors(
            landmarks=0, rmse_m=None, rmse_aligned_m=None, nees_per_dof=None, nees_low=None, nees_high=None
        )
    rows = np.flatnonzero(np.repeat(chosen, 2))
    low, high = chi_square_band(2 * count)
    return MapErrors(
        landmarks=count,
        rmse_m=rmse(mean - truth),
        rmse_aligned_m=rmse(align(mean, truth) - truth),
        nees_per_dof=landmark_chi_square(estimate.H, rows, (mean - truth).ravel()) / (2 * count),
        nees_low=low,
        nees_high=high,
    )


def pose_errors(poses: Floats, truth: Floats) -> PoseErrors:
    """Of poses (T+1, 3) where both they and the truth are known."""
    known = np.isfinite(poses).all(axis=1) & np.isfinite(truth).all(axis=1)
    at, there = poses[known, :2], truth[known, :2]
    return PoseErrors(rmse_m=rmse(at - there), rmse_aligned_m=rmse(align(at, there) - there) if len(at) else None)


def fused_map(run: FinishedRun) -> MapEstimate:
    """The canonical map of a run."""
    lives = run.ledger.lives()
    solution = solve(lives, run.ledger.classes(lives))
    score = score_map(solution, marginal_covariances(solution)[0], run.recording)
    return MapEstimate(mean=solution.landmark_mean, truth=score.landmark_truth, H=solution.H)


def batch_map(solution: BatchSolution, recording: Recording) -> MapEstimate:
    """A batch's map, each landmark with the truth that most vehicles' signatures stand for."""
    truths: dict[int, list[int]] = {}
    for log in recording.logs.values():
        for signature, truth in signature_truth(log).items():
            truths.setdefault(signature, []).append(truth)
    majority = [max(sorted(set(known)), key=known.count) for known in map(truths.__getitem__, solution.signatures)]
    return MapEstimate(mean=solution.landmark_mean, truth=np.array(majority, np.int64), H=solution.H)


def compare(ours: MapEstimate, batch: MapEstimate, landmarks: Floats) -> Comparison:
    """Over the landmarks that both hold."""
    common = set(ours.truth.tolist()) & set(batch.truth.tolist())
    return Comparison(ours=map_errors(ours, landmarks, common), batch=map_errors(batch, landmarks, common))


def ratio_to_batch(run: FinishedRun, batch: BatchSolution | None = None, *, robust: bool = False) -> Comparison:
    """A run in memory beside the batch over its readings, which may be given. Raises as `solve_batch`."""
    solution = solve_batch(run.recording, robust=robust) if batch is None else batch
    return compare(fused_map(run), batch_map(solution, run.recording), run.recording.landmarks)


def read_run(folder: Path) -> StoredRun:
    """What `fleet-seif run SCENARIO --out DIR` left. Raises RunError where it is not whole."""
    if not (folder / "report.json").is_file():
        raise RunError(
            f"{folder} holds no finished run: it has no report.json; remedy: fleet-seif run SCENARIO --out {folder}"
        )
    try:
        report = json.loads((folder / "report.json").read_text())
        if report["format"] != output.FORMAT:
            raise RunError(f"{folder} is of format {report['format']!r}, this version reads {output.FORMAT}")
        truth = _arrays(folder / "truth.npz")
        logs = {name: _log(folder, name, truth[f"pose_{name}"]) for name in report["vehicles"]}
        joint = _arrays(folder / "map.npz")
        H = scipy.sparse.csr_array((joint["H_data"], joint["H_indices"], joint["H_indptr"]))
        return StoredRun(
            report=report,
            recording=Recording(landmarks=truth["landmarks"], logs=logs, skipped=report["sightings_left_out"]),
            map=MapEstimate(mean=joint["landmark_mean"], truth=joint["landmark_truth"], H=H),
            tracks={name: _track(folder / "trajectory" / f"{name}.tum", log.time_s) for name, log in logs.items()},
        )
    except KeyError as error:
        raise RunError(f"{folder} holds no finished run: {error} is missing in one of its files") from None
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise RunError(f"{folder} holds no finished run: one of its files is broken: {error}") from None


def _arrays(path: Path) -> dict[str, Any]:
    with path.open("rb") as raw, np.load(raw) as file:  # numpy leaves a broken file open
        return {name: file[name] for name in file.files}


def _log(folder: Path, vehicle: str, truth_pose: Floats) -> Log:
    """The inverse of `output.write_readings`."""
    fields = _arrays(folder / "readings" / f"{vehicle}.npz")
    z = np.column_stack([fields.pop("sighting_range_m"), fields.pop("sighting_bearing_rad")])
    return Log(vehicle=vehicle, truth_pose=truth_pose, sighting_z=z, **fields)


def _track(path: Path, time_s: Floats) -> Floats:
    """Poses (T+1, 3) from a TUM file at these times, NaN where it has none."""
    rows = np.array([line.split() for line in path.read_text().splitlines()], float).reshape(-1, 8)
    poses = np.full((len(time_s), 3), np.nan)
    at = np.clip(np.searchsorted(time_s, rows[:, 0] - SAME_TIME_S), 0, len(time_s) - 1)
    same = np.abs(time_s[at] - rows[:, 0]) <= SAME_TIME_S
    poses[at[same]] = np.column_stack([rows[:, 1:3], 2.0 * np.arctan2(rows[:, 6], rows[:, 7])])[same]
    return poses


def score_run(run: StoredRun) -> dict[str, Any]:
    """Errors of a run against the truth, for JSON; units are in the names.

    own_map_rmse_m: of the map that the vehicle made alone. pose_*: of its live poses, that is of what it knew then.
    """
    vehicles = {
        name: {
            **_pose_fields(run.tracks[name], log),
            "own_map_rmse_m": run.report["vehicles"][name]["landmark_rmse_m"],
            "bytes_per_step_mean": run.report["vehicles"][name]["bytes_per_step_mean"],
        }
        for name, log in run.recording.logs.items()
    }
    steps = sum(log.steps for log in run.recording.logs.values())
    bytes_put = sum(row["bytes_per_step_mean"] * run.recording.logs[name].steps for name, row in vehicles.items())
    return {
        "format": output.FORMAT,
        "scenario": run.report["scenario"],
        "seed": run.report["seed"],
        "map": asdict(map_errors(run.map, run.recording.landmarks)),
        "vehicles": vehicles,
        "bytes_per_step_mean": bytes_put / max(steps, 1),
    }


def score_with_batch(run: StoredRun, *, robust: bool = False) -> dict[str, Any]:
    """The same, with the batch over the run's readings and our errors over its errors. Raises as `solve_batch`."""
    begin = time.monotonic()
    solution = solve_batch(run.recording, robust=robust)
    found = compare(run.map, batch_map(solution, run.recording), run.recording.landmarks)
    scored = score_run(run)
    poses = {name: _pose_fields(solution.poses[name], log) for name, log in run.recording.logs.items()}
    scored["batch"] = {
        "robust": robust,
        "map": asdict(found.batch),
        "vehicles": poses,
        "chi_square_per_dof": solution.chi_square / max(solution.degrees_of_freedom, 1),
        "iterations": solution.iterations,
        "sightings_left_out": solution.left_out,
        "wall_s": time.monotonic() - begin,
    }
    scored["ratio"] = {
        "landmarks": found.ours.landmarks,
        "map_rmse": found.ratio,
        "map_rmse_aligned": found.ratio_aligned,
        "vehicles": {
            name: {
                field.removesuffix("_m"): ratio_of(scored["vehicles"][name][field], value)
                for field, value in row.items()
            }
            for name, row in poses.items()
        },
    }
    return scored


def _pose_fields(poses: Floats, log: Log) -> dict[str, float | None]:
    return {f"pose_{name}": value for name, value in asdict(pose_errors(poses, log.truth_pose)).items()}


def score_table(scored: Mapping[str, Any]) -> Group:
    """Scores as tables for the terminal: the maps in rows, then the vehicles."""
    batch, ratio = scored.get("batch"), scored.get("ratio")
    maps = Table(title=f"{scored['scenario']}, seed {scored['seed']}", box=None, padding=(0, 1))
    for head in ("map", "landmarks", "error m", "aligned m", "NEES per dof", f"{BAND:.0%} band"):
        maps.add_column(head, justify="left" if head == "map" else "right")
    maps.add_row("fused", *_map_cells(scored["map"]))
    if batch is not None and ratio is not None:
        maps.add_row("batch, robust" if batch["robust"] else "batch", *_map_cells(batch["map"]))
        maps.add_row("ratio", str(ratio["landmarks"]), *(_cell(ratio[f"map_rmse{x}"], 3) for x in ("", "_aligned")))
    names = ("own map m", "pose m", "aligned m", "bytes a step")
    heads = names if batch is None else (*names, "batch pose m", "aligned m", "ratio", "aligned")
    table = Table(box=None, padding=(0, 1))
    for head in ("vehicle", *heads):
        table.add_column(head, justify="left" if head == "vehicle" else "right")
    for name, row in scored["vehicles"].items():
        cells = [_cell(row[field], 4) for field in ("own_map_rmse_m", "pose_rmse_m", "pose_rmse_aligned_m")]
        cells.append(_cell(row["bytes_per_step_mean"], 0))
        if batch is not None and ratio is not None:
            cells += [_cell(value, 4) for value in batch["vehicles"][name].values()]
            cells += [_cell(value, 3) for value in ratio["vehicles"][name].values()]
        table.add_row(name, *cells)
    return Group(maps, Text(""), table, Text(_remarks(scored)))


def _remarks(scored: Mapping[str, Any]) -> str:
    batch = scored.get("batch")
    lines = [f"poses are live estimates; {scored['bytes_per_step_mean']:.0f} bytes a step and vehicle"]
    if batch is not None:
        fit = batch["chi_square_per_dof"]
        lines = [
            "our poses are live estimates, the batch's know the whole run; "
            f"{scored['bytes_per_step_mean']:.0f} bytes a step and vehicle",
            f"batch: chi-square per dof {fit:.3f}, {batch['iterations']} iterations, {batch['wall_s']:.1f} s",
        ]
        if fit > FIT_MAX and not batch["robust"]:
            lines.append("the batch does not fit: readings with outliers need --robust")
    return "\n".join(lines)


def _map_cells(errors: Mapping[str, Any]) -> tuple[str, ...]:
    band = f"{_cell(errors['nees_low'], 2)} to {_cell(errors['nees_high'], 2)}"
    numbers = (_cell(errors[field], digits) for field, digits in (("rmse_m", 5), ("rmse_aligned_m", 5)))
    return (str(errors["landmarks"]), *numbers, _cell(errors["nees_per_dof"], 2), band)


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
