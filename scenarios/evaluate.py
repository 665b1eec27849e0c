"""Scores what a finished run left in its folder, and sets the batch over the same readings beside it.

Poses are compared twice. A live pose knows what its vehicle knew then; the batch's pose of that step knows all readings
of all vehicles, so their ratio says what waiting for the end would have brought. What compares like with like is the
trajectory: those poses that the final joint map holds (frame starts that are not given, and the newest of each
vehicle), against the batch's of the same steps.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from fleet_seif.joint import marginal_chi_square, solve
from fleet_seif.records import Floats
from fusion.merges import merges_of
from scenarios import output
from scenarios.association import associate, fleet_association, majority_truth
from scenarios.batch import BatchSolution, solve_batch
from scenarios.recording import Recording
from scenarios.report import FinishedRun
from scenarios.score import BAND, align, chi_square_band, landmark_truths, majority, rmse
from scenarios.stored_run import MapEstimate, StoredRun
from scenarios.table import association_words

FIT_MAX: Final = 1.5
"""Chi-square per degree of freedom of a batch above which its readings are not what they declare to be."""


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
    """Positions against the truth, m: as they are, and after the best rotation and translation of all together.

    poses: how many were compared; None where none was.
    """

    poses: int
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
        nees_per_dof=marginal_chi_square(estimate.H, rows, mean - truth) / (2 * count),
        nees_low=low,
        nees_high=high,
    )


def pose_errors(poses: Sequence[Floats], truth: Sequence[Floats]) -> PoseErrors:
    """Of paths (T+1, 3), one for each vehicle, where both they and the truth are known."""
    error = [np.empty((0, 4))]
    for path, real in zip(poses, truth, strict=True):
        both = np.column_stack([path[:, :2], real[:, :2]])
        error.append(both[np.isfinite(path).all(axis=1) & np.isfinite(real).all(axis=1)])
    at, there = np.hsplit(np.concatenate(error), 2)
    aligned = rmse(align(at, there) - there) if len(at) else None
    return PoseErrors(poses=len(at), rmse_m=rmse(at - there), rmse_aligned_m=aligned)


def fused_map(run: FinishedRun) -> MapEstimate:
    """The canonical map of a run."""
    solution = solve(run.ledger.lives(), merges_of(run.ledger).classes)
    truth = landmark_truths(solution, run.truths)
    return MapEstimate(mean=solution.landmark_mean, truth=truth, H=solution.H)


def batch_map(solution: BatchSolution, recording: Recording) -> MapEstimate:
    """A batch's map, each landmark with the truth that most vehicles' signatures stand for."""
    truths: dict[int, list[int]] = {}
    for log in recording.identified().logs.values():
        for signature, truth in majority_truth(log.sighting_signature, log.sighting_truth).items():
            truths.setdefault(signature, []).append(truth)
    majorities = np.array([majority(truths[signature]) for signature in solution.signatures.tolist()], np.int64)
    return MapEstimate(mean=solution.landmark_mean, truth=majorities, H=solution.H)


def compare(ours: MapEstimate, batch: MapEstimate, landmarks: Floats) -> Comparison:
    """Over the landmarks that both hold."""
    common = set(ours.truth.tolist()) & set(batch.truth.tolist())
    return Comparison(ours=map_errors(ours, landmarks, common), batch=map_errors(batch, landmarks, common))


def ratio_to_batch(run: FinishedRun, batch: BatchSolution | None = None, *, robust: bool = False) -> Comparison:
    """A run in memory beside the batch over its readings, which may be given. Raises as `solve_batch`."""
    solution = solve_batch(run.recording, robust=robust) if batch is None else batch
    return compare(fused_map(run), batch_map(solution, run.recording), run.recording.landmarks)


def score_run(run: StoredRun) -> dict[str, Any]:
    """Errors of a run against the truth, for JSON; units are in the names.

    trajectory: the poses of the joint map. own_map_rmse_m: of the map that the vehicle made alone. live_*: of its live
    poses. joint_*: of its poses in the joint map.
    """
    logs = run.recording.logs
    vehicles = {
        name: {
            **associate(log, run.assigned[name]).fields(),
            "own_map_rmse_m": run.report["vehicles"][name]["landmark_rmse_m"],
            **_fields("live_", pose_errors([run.tracks[name]], [log.truth_pose])),
            **_fields("joint_", pose_errors([run.joint_poses[name]], [log.truth_pose])),
            "bytes_per_step_mean": run.report["vehicles"][name]["bytes_per_step_mean"],
        }
        for name, log in logs.items()
    }
    steps = sum(log.steps for log in logs.values())
    bytes_put = sum(row["bytes_per_step_mean"] * logs[name].steps for name, row in vehicles.items())
    return {
        "format": output.FORMAT,
        "scenario": run.report["scenario"],
        "seed": run.report["seed"],
        "map": asdict(map_errors(run.map, run.recording.landmarks)),
        "trajectory": asdict(_trajectory(run, run.joint_poses)),
        "vehicles": vehicles,
        **fleet_association(run.recording, run.assigned).fields(),
        "bytes_per_step_mean": bytes_put / max(steps, 1),
    }


def score_with_batch(
    run: StoredRun, *, robust: bool = False, progress: Callable[[str, int, int], None] = lambda stage, done, total: None
) -> dict[str, Any]:
    """The same, with the batch over the run's readings and our errors over its errors. Raises as `solve_batch`.

    Of the batch, live_* is of its poses at all steps, joint_* and trajectory at those steps that the joint map holds.
    """
    begin = time.monotonic()
    solution = solve_batch(run.recording, robust=robust, progress=progress)
    wall_s = time.monotonic() - begin
    found = compare(run.map, batch_map(solution, run.recording), run.recording.landmarks)
    held = {name: np.where(np.isfinite(run.joint_poses[name]), poses, np.nan) for name, poses in solution.poses.items()}
    scored, trajectory = score_run(run), _trajectory(run, held)
    vehicles = {
        name: {
            **_fields("live_", pose_errors([solution.poses[name]], [log.truth_pose])),
            **_fields("joint_", pose_errors([held[name]], [log.truth_pose])),
        }
        for name, log in run.recording.logs.items()
    }
    scored["batch"] = {
        "robust": robust,
        "map": asdict(found.batch),
        "trajectory": asdict(trajectory),
        "vehicles": vehicles,
        "chi_square_per_dof": solution.chi_square / max(solution.degrees_of_freedom, 1),
        "iterations": solution.iterations,
        "sightings_left_out": solution.left_out,
        "wall_s": wall_s,
    }
    scored["ratio"] = {
        "landmarks": found.ours.landmarks,
        "map_rmse": found.ratio,
        "map_rmse_aligned": found.ratio_aligned,
        "trajectory_rmse": ratio_of(scored["trajectory"]["rmse_m"], trajectory.rmse_m),
        "trajectory_rmse_aligned": ratio_of(scored["trajectory"]["rmse_aligned_m"], trajectory.rmse_aligned_m),
        "vehicles": {
            name: {
                field.removesuffix("_m"): ratio_of(scored["vehicles"][name][field], value)
                for field, value in row.items()
            }
            for name, row in vehicles.items()
        },
    }
    return scored


def _trajectory(run: StoredRun, poses: Mapping[str, Floats]) -> PoseErrors:
    """All vehicles' poses together."""
    logs = run.recording.logs
    return pose_errors([poses[name] for name in logs], [log.truth_pose for log in logs.values()])


def _fields(prefix: str, errors: PoseErrors) -> dict[str, float | None]:
    return {f"{prefix}rmse_m": errors.rmse_m, f"{prefix}rmse_aligned_m": errors.rmse_aligned_m}


def score_table(scored: Mapping[str, Any]) -> Group:
    """Scores as tables for the terminal, 80 columns: landmarks and poses of the fleet, then its vehicles."""
    batch, ratio = scored.get("batch"), scored.get("ratio")
    fleet = Table(title=f"{scored['scenario']}, seed {scored['seed']}", box=None, padding=(0, 1))
    for head in ("", "number", "error m", "aligned m", "NEES per dof", f"{BAND:.0%} band"):
        fleet.add_column(head, justify="right" if head else "left")
    for what, of in (("landmarks", "map"), ("poses", "trajectory")):
        fleet.add_row(f"{what}, fused", *_cells(scored[of]))
        if batch is not None and ratio is not None:
            fleet.add_row(f"{what}, {'robust ' if batch['robust'] else ''}batch", *_cells(batch[of]))
            fleet.add_row("ratio", "", *(_cell(ratio[f"{of}_rmse{x}"], 3) for x in ("", "_aligned")))
    names = ("own map", "live pose", "aligned", "joint pose", "bytes")
    table = Table(title="each vehicle: errors in m, bytes a step", box=None, padding=(0, 1))
    for head in ("vehicle", *(names if batch is None else (*names, "batch pose", "ratio"))):
        table.add_column(head, justify="left" if head == "vehicle" else "right")
    for name, row in scored["vehicles"].items():
        fields = ("own_map_rmse_m", "live_rmse_m", "live_rmse_aligned_m", "joint_rmse_m")
        cells = [*(_cell(row[field], 4) for field in fields), _cell(row["bytes_per_step_mean"], 0)]
        if batch is not None and ratio is not None:
            cells.append(_cell(batch["vehicles"][name]["joint_rmse_m"], 4))
            cells.append(_cell(ratio["vehicles"][name]["joint_rmse"], 3))
        table.add_row(name, *cells)
    return Group(fleet, Text(""), table, Text(_remarks(scored)))


def _remarks(scored: Mapping[str, Any]) -> str:
    batch = scored.get("batch")
    lines = [
        association_words(scored),
        f"{scored['bytes_per_step_mean']:.0f} bytes a step and vehicle; live poses are what a vehicle knew then,",
        "joint poses are the frame starts and newest poses of the fused map"
        + ("" if batch is None else ", the batch's"),
    ]
    if batch is None:
        return "\n".join(lines)
    fit = batch["chi_square_per_dof"]
    lines[-1] += " are of the same steps"
    lines.append(f"batch: chi-square per dof {fit:.3f}, {batch['iterations']} iterations, {batch['wall_s']:.1f} s")
    if fit > FIT_MAX and not batch["robust"]:
        lines.append("the batch does not fit: readings with outliers need --robust")
    return "\n".join(lines)


def _cells(errors: Mapping[str, Any]) -> tuple[str, ...]:
    """A row of the first table: of landmarks, or of poses, which have no NEES."""
    row = [_cell(errors[field], 5) for field in ("rmse_m", "rmse_aligned_m")]
    if "poses" in errors:
        return (str(errors["poses"]), *row)
    band = f"{_cell(errors['nees_low'], 2)} to {_cell(errors['nees_high'], 2)}"
    return (str(errors["landmarks"]), *row, _cell(errors["nees_per_dof"], 2), band)


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
