"""What a finished run has left in its folder, read back: the inverse of `output`."""

import contextlib
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from fleet_seif.errors import RunError
from fleet_seif.records import Floats, Ints
from scenarios import output
from scenarios.recording import Log, Recording
from vehicles.drive import NOT_KNOWN

SAME_TIME_S: Final = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class MapEstimate:
    """Landmarks mean (n, 2) m with the row truth (n,) of each in the truth, -1 unknown; H: information, they first."""

    mean: Floats
    truth: Ints
    H: scipy.sparse.csr_array


@dataclass(frozen=True, eq=False, kw_only=True)
class StoredRun:
    """A finished run as its folder holds it.

    assigned: by vehicle (S,), see `DriveResult`. tracks: live poses by vehicle (T+1, 3), NaN where unknown.
    joint_poses: of the joint map by vehicle, the same.
    """

    report: dict[str, Any]
    recording: Recording
    assigned: dict[str, Ints]
    map: MapEstimate
    tracks: dict[str, Floats]
    joint_poses: dict[str, Floats]


def read_run(folder: Path) -> StoredRun:
    """What `fleet-seif run SCENARIO --out DIR` left. Raises RunError where it is not whole."""
    path = folder / "report.json"
    if not path.is_file():
        raise RunError(
            f"{folder} holds no finished run: it has no report.json; remedy: fleet-seif run SCENARIO --out {folder}"
        )
    with _whole(path):
        report = json.loads(path.read_text())
        if report["format"] != output.FORMAT:
            raise RunError(f"{path} is of format {report['format']!r}, this version reads {output.FORMAT}")
        names = [name for name in report["vehicles"] if _scores_of(report, name)]
        kept = {key: report[key] for key in ("scenario", "seed", "sightings_left_out", "vehicles")}
    with _whole(folder / "truth.npz") as path:
        truth = _arrays(path)
        landmarks, poses = truth["landmarks"], {name: truth[f"pose_{name}"] for name in names}
    read = {name: _readings(folder, name, poses[name]) for name in names}
    logs = {name: log for name, (log, _) in read.items()}
    with _whole(folder / "map.npz") as path:
        joint = _arrays(path)
        H = scipy.sparse.csr_array((joint["H_data"], joint["H_indices"], joint["H_indptr"]))
        estimate = MapEstimate(mean=joint["landmark_mean"], truth=joint["landmark_truth"], H=H)
        joint_poses = _joint_poses(joint, H, logs)
    return StoredRun(
        report=kept,
        recording=Recording(landmarks=landmarks, logs=logs, skipped=kept["sightings_left_out"]),
        assigned={name: assigned for name, (_, assigned) in read.items()},
        map=estimate,
        tracks={name: _track(folder / "trajectory" / f"{name}.tum", log.time_s) for name, log in logs.items()},
        joint_poses=joint_poses,
    )


@contextlib.contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """Says of a file that it is not what a run has left, whatever comes of reading it."""
    remedy = "remedy: run the scenario again"
    try:
        yield path
    except KeyError as error:
        raise RunError(f"{path} is not whole: {error} is missing; {remedy}") from None
    except (OSError, ValueError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise RunError(f"{path} is not whole: {error}; {remedy}") from None


def _scores_of(report: Mapping[str, Any], vehicle: str) -> tuple[Any, ...]:
    """What `score_run` takes from the report of a vehicle. Raises KeyError."""
    row = report["vehicles"][vehicle]
    return row["landmark_rmse_m"], float(row["bytes_per_step_mean"])


def _arrays(path: Path) -> dict[str, Any]:
    with path.open("rb") as raw, np.load(raw) as file:  # numpy leaves a broken file open
        return {name: file[name] for name in file.files}


def _readings(folder: Path, vehicle: str, truth_pose: Floats) -> tuple[Log, Ints]:
    """The inverse of `output.write_readings`. Versions before landmark association wrote no assignments."""
    with _whole(folder / "readings" / f"{vehicle}.npz") as path:
        fields = _arrays(path)
        z = np.column_stack([fields.pop("sighting_range_m"), fields.pop("sighting_bearing_rad")])
        assigned = fields.pop("sighting_assigned", np.full(len(z), NOT_KNOWN))
        return Log(vehicle=vehicle, truth_pose=truth_pose, sighting_z=z, **fields), assigned


def _joint_poses(joint: Mapping[str, Any], H: scipy.sparse.csr_array, logs: Mapping[str, Log]) -> dict[str, Floats]:
    """Poses of the joint map by vehicle and step (T+1, 3), NaN where it holds none, or none whose time is known.

    Their rows of H mean = b: `variables` names them, `pose_time_s` says when each was.
    """
    first = 2 * len(joint["landmark_mean"])
    mean = scipy.sparse.linalg.spsolve(H.tocsc(), joint["b"])[first:].reshape(-1, 3)
    found = {name: np.full((log.steps + 1, 3), np.nan) for name, log in logs.items()}
    for row, time_s, pose in zip(joint["variables"][first::3].tolist(), joint["pose_time_s"], mean, strict=True):
        vehicle = row.split("/")[1]  # pose/<vehicle>/x, frame/<vehicle>/<life>/<f>/x
        steps, _ = _steps_at(logs[vehicle].time_s, np.array([time_s]))
        found[vehicle][steps] = pose
    return found


def _steps_at(time_s: Floats, sought_s: Floats) -> tuple[Ints, Ints]:
    """Which steps of a vehicle were at these times, and which of the times those are; others are left out."""
    at = np.clip(np.searchsorted(time_s, sought_s - SAME_TIME_S), 0, len(time_s) - 1)
    same = np.flatnonzero(np.abs(time_s[at] - sought_s) <= SAME_TIME_S)
    return at[same], same


def _track(path: Path, time_s: Floats) -> Floats:
    """Poses (T+1, 3) from a TUM file at these times, NaN where it has none."""
    with _whole(path):
        rows = np.array([line.split() for line in path.read_text().splitlines()], float).reshape(-1, 8)
    poses = np.full((len(time_s), 3), np.nan)
    steps, chosen = _steps_at(time_s, rows[:, 0])
    poses[steps] = np.column_stack([rows[:, 1:3], 2.0 * np.arctan2(rows[:, 6], rows[:, 7])])[chosen]
    return poses
