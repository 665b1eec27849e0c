"""What a run leaves in its folder; the README documents it as FORMAT below."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from fleet_seif.errors import RunError, WireError
from fleet_seif.joint import JointSolution
from fleet_seif.records import Floats, Ints
from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.store import Put, StoreError
from fusion import records
from fusion.core import FusionCore
from fusion.ledger import Ledger
from scenarios.recording import Log, Recording
from vehicles.drive import DriveResult

FORMAT: Final = 1
PARTS: Final = {
    "": ("report.json", "map.npz", "map.json", "truth.npz", "figure.png"),
    "readings": ("*.npz",),
    "trajectory": ("*.tum",),
    "process": ("*.npz", "*.json", "*.ledger*", "*.outbox*"),
}


def prepare_folder(folder: Path) -> None:
    """Make the folder and its parts, without what an earlier run left there. Raises RunError where that cannot be."""
    try:
        for part, kinds in PARTS.items():
            (folder / part).mkdir(parents=True, exist_ok=True)
            for old in (path for kind in kinds for path in (folder / part).glob(kind)):
                old.unlink()
    except OSError as error:
        raise RunError(f"cannot write to {folder}: {error.strerror or error}; give another --out DIR") from None


def write_readings(folder: Path, log: Log, assigned: Ints) -> None:
    """readings/<vehicle>.npz: exactly what the filter was fed, and beside it what it took each sighting for."""
    np.savez_compressed(
        folder / "readings" / f"{log.vehicle}.npz",
        time_s=log.time_s,
        odometry=log.odometry,
        odometry_cov=log.odometry_cov,
        sighting_step=log.sighting_step,
        sighting_range_m=log.sighting_z[:, 0],
        sighting_bearing_rad=log.sighting_z[:, 1],
        sighting_cov=log.sighting_cov,
        sighting_signature=log.sighting_signature,
        sighting_truth=log.sighting_truth,
        sighting_assigned=assigned,
        start_pose=log.start_pose,
        start_pose_cov=log.start_pose_cov,
    )


def _save(path: Path, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]  # the stub confuses names with allow_pickle


def write_truth(folder: Path, recording: Recording) -> None:
    """truth.npz: landmarks, and each vehicle's true poses (NaN where unknown)."""
    poses = {f"pose_{name}": log.truth_pose for name, log in recording.logs.items()}
    _save(folder / "truth.npz", {"landmarks": recording.landmarks, **poses})


def write_trajectory(path: Path, time_s: Floats, poses: Floats) -> None:
    """TUM format, one pose a line: time x y z qx qy qz qw. Poses that are not finite are left out."""
    known = np.all(np.isfinite(poses), axis=1)
    x, y, theta = poses[known].T
    zero = np.zeros(len(x))
    table = np.column_stack([time_s[known], x, y, zero, zero, zero, np.sin(theta / 2), np.cos(theta / 2)])
    np.savetxt(path, table, fmt="%.9f")


def write_map(
    folder: Path, solution: JointSolution, landmark_cov: Floats, landmark_truth: Ints, pose_time_s: Floats
) -> None:
    """map.npz and map.json: the canonical map with its joint system. pose_time_s (p,): of `solution.poses`."""
    newest = [i for i, (_, _, k) in enumerate(solution.poses) if k < 0]
    vehicles = [solution.poses[i][0] for i in newest]
    H = solution.H.tocsr()
    H.sort_indices()
    np.savez_compressed(
        folder / "map.npz",
        landmark_mean=solution.landmark_mean,
        landmark_cov=landmark_cov,
        landmark_truth=landmark_truth,
        vehicles=np.array(vehicles, dtype=np.str_),
        pose_mean=solution.pose_mean[newest],
        pose_time_s=pose_time_s,
        H_data=H.data,
        H_indices=H.indices,
        H_indptr=H.indptr,
        b=solution.b,
        variables=np.array(solution.variables(), dtype=np.str_),
    )
    landmarks = [
        {
            "mean_m": mean.tolist(),
            "cov_m2": cov.tolist(),
            "truth": int(truth),
            "signature": signature,
            "seen_by": [f"{name.vehicle}/{name.life}/{name.number}" for name in names],
        }
        for mean, cov, truth, signature, names in zip(
            solution.landmark_mean, landmark_cov, landmark_truth, solution.signatures, solution.classes, strict=True
        )
    ]
    poses = {vehicle: solution.pose_mean[i].tolist() for vehicle, i in zip(vehicles, newest, strict=True)}
    write_json(folder / "map.json", {"format": FORMAT, "landmarks": landmarks, "poses": poses})


def write_json(path: Path, value: Mapping[str, object]) -> None:
    """JSON for people and programs, two spaces deep."""
    path.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n")


def stream_facts(core: FusionCore, now_s: float) -> dict[str, dict[str, Any]]:
    """Per vehicle what a report says of its messages, over all its epochs."""
    facts: dict[str, dict[str, Any]] = {}
    for state in core.states(now_s):
        counts = {
            "epochs": 1,
            "deltas_folded": state.cut + 1,
            "duplicates": state.duplicates,
            "gaps_repaired": state.gaps_repaired,
            "parked": state.parked,
            "messages_refused": state.refused,
        }
        before = facts.setdefault(state.name, {**dict.fromkeys(counts, 0), "quarantine": ""})
        for name, count in counts.items():
            before[name] += count
        before["quarantine"] = before["quarantine"] or state.fault
    return facts


def write_ledger(path: Path, ledger: Ledger) -> None:
    """A store as a fusion node would have left it."""
    store = SqliteStore.open(path, records.KIND, records.SCHEMA)
    try:
        store.commit([Put(records.IDENTITY, f"{ledger.fleet}/fusion".encode()), *ledger.contents()])
    finally:
        store.close()


def read_ledger(path: Path, fleet: str) -> Ledger:
    """The ledger of a store, folded anew; others may be writing it. Raises StoreError."""
    store = SqliteStore.open(path, records.KIND, records.SCHEMA, read_only=True)
    ledger = Ledger(fleet)
    try:
        ledger.restore(store.load())
    except WireError as error:
        raise StoreError(f"{path} holds what no fusion node of fleet {fleet!r} put there: {error}") from None
    finally:
        store.close()
    return ledger


def write_drive(path: Path, result: DriveResult) -> None:
    """What a vehicle process hands to the launcher."""
    _save(path, {name: np.asarray(value) for name, value in vars(result).items()})


def read_drive(path: Path) -> DriveResult:
    """The same, read back."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    return DriveResult(
        pose=arrays["pose"],
        landmarks=arrays["landmarks"],
        signatures=arrays["signatures"],
        assigned=arrays["assigned"],
        filter_s=arrays["filter_s"],
        publish_s=arrays["publish_s"],
        bytes_put=int(arrays["bytes_put"]),
        messages=int(arrays["messages"]),
        readings_refused=int(arrays["readings_refused"]),
        sightings_refused=int(arrays["sightings_refused"]),
        steps_beyond_active_max=int(arrays["steps_beyond_active_max"]),
    )
