"""Scores a finished run against the truth. What has no truth is None."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import gammaincinv

from fleet_seif.joint import JointSolution, landmark_chi_square
from fleet_seif.records import Floats, Ints
from scenarios.association import Truths, assigned_truth
from scenarios.recording import Log, Recording
from vehicles.drive import DriveResult

BAND: Final = 0.95
"""Share of runs whose NEES lies in the band that is shown with it, where errors are what a map says they are."""


def chi_square_band(dof: int) -> tuple[float, float]:
    """Between which a mean of squared normalised errors per degree of freedom lies with probability BAND."""
    low, high = (2.0 * float(gammaincinv(dof / 2, p)) / dof for p in ((1 - BAND) / 2, (1 + BAND) / 2))
    return low, high


def rmse(error: Floats) -> float | None:
    """Root mean square of the rows' lengths, m; None without rows."""
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) if len(error) else None


def align(points: Floats, truth: Floats) -> Floats:
    """The points after the rotation and translation that bring them nearest to the truth (least squares), (n, 2)."""
    if len(points) < 2:
        return truth.copy()
    p, q = points - points.mean(axis=0), truth - truth.mean(axis=0)
    U, _, V = np.linalg.svd(p.T @ q)
    D = np.diag([1.0, np.sign(np.linalg.det(U @ V))])
    moved: Floats = p @ U @ D @ V + truth.mean(axis=0)
    return moved


@dataclass(frozen=True, eq=False, kw_only=True)
class MapScore:
    """The joint map against the truth; see the README for the fields of report.json that have the same names."""

    landmark_truth: Ints
    landmark_rmse_m: float | None
    landmark_rmse_aligned_m: float | None
    nees_per_dof: float | None
    nees_per_landmark: float | None
    truth_landmarks: int
    fused_landmarks: int
    matched_landmarks: int
    merges: int
    wrong_merges: int
    missed_merges: int


def score_map(solution: JointSolution, landmark_cov: Floats, recording: Recording, truths: Truths) -> MapScore:
    """Errors, consistency and merges of a joint map. landmark_cov (n, 2, 2), m^2. truths: as `assigned_truth`."""
    member_truth = _member_truth(solution, truths)
    landmark_truth = np.array([majority(values) for values in member_truth], np.int64)
    matched = landmark_truth >= 0
    truth = recording.landmarks[landmark_truth[matched]]
    mean, cov = solution.landmark_mean[matched], landmark_cov[matched]
    error = mean - truth
    nees = np.array([d @ np.linalg.solve(P, d) / 2 for d, P in zip(error, cov, strict=True)])
    merges, wrong, missed = _merges(solution, member_truth)
    seen = {t for log in recording.logs.values() for t in np.unique(log.sighting_truth).tolist() if t >= 0}
    some = bool(np.any(matched))
    return MapScore(
        landmark_truth=landmark_truth,
        landmark_rmse_m=rmse(error),
        landmark_rmse_aligned_m=rmse(align(mean, truth) - truth) if some else None,
        nees_per_dof=landmark_chi_square(solution, error, matched) / (2 * len(error)) if some else None,
        nees_per_landmark=float(nees.mean()) if some else None,
        truth_landmarks=len(seen),
        fused_landmarks=len(solution.classes),
        matched_landmarks=len(set(landmark_truth[matched].tolist())),
        merges=merges,
        wrong_merges=wrong,
        missed_merges=missed,
    )


def landmark_truths(solution: JointSolution, truths: Truths) -> Ints:
    """Which true landmark each landmark of a joint map is by most of its vehicles' sightings, -1 unknown, (n,)."""
    return np.array([majority(values) for values in _member_truth(solution, truths)], np.int64)


def _member_truth(solution: JointSolution, truths: Truths) -> list[list[int]]:
    return [[truths[name.vehicle].get(name.number, -1) for name in names] for names in solution.classes]


def majority(values: list[int]) -> int:
    """The most frequent of the values that are not negative, of equals the least; -1 where there is none."""
    known = [value for value in values if value >= 0]
    return max(sorted(set(known)), key=known.count) if known else -1


def _merges(solution: JointSolution, member_truth: list[list[int]]) -> tuple[int, int, int]:
    """Over pairs of different vehicles in a class: merged, merged wrongly, not merged though one in truth.

    Of two that are both no true landmark it cannot be told whether they are the same.
    """
    members = []
    for c, (names, truths) in enumerate(zip(solution.classes, member_truth, strict=True)):
        for vehicle in sorted({name.vehicle for name in names}):  # who has two names for it has merged them itself
            own = [truth for name, truth in zip(names, truths, strict=True) if name.vehicle == vehicle]
            members.append((c, vehicle, majority(own)))
    merges = wrong = 0
    for c in range(len(solution.classes)):
        group = [m for m in members if m[0] == c] if len(solution.classes[c]) > 1 else []
        pairs = [(a, b) for i, a in enumerate(group) for b in group[i + 1 :] if a[1] != b[1]]
        merges += len(pairs)
        wrong += sum(a[2] != b[2] for a, b in pairs)
    by_truth: dict[int, list[tuple[int, str, int]]] = {}
    for member in members:
        if member[2] >= 0:
            by_truth.setdefault(member[2], []).append(member)
    missed = sum(
        a[0] != b[0] and a[1] != b[1]
        for group in by_truth.values()
        for i, a in enumerate(group)
        for b in group[i + 1 :]
    )
    return merges, wrong, missed


def score_vehicle(result: DriveResult, log: Log, landmarks: Floats) -> Mapping[str, float | None]:
    """A vehicle's own live map and pose against the truth."""
    truths = assigned_truth(log, result.assigned)
    truth = np.array([truths.get(number, -1) for number in range(len(result.landmarks))], np.int64)
    known = (truth >= 0) & np.isfinite(result.landmarks).all(axis=1)
    with_truth = np.all(np.isfinite(log.truth_pose), axis=1)
    with_truth &= np.all(np.isfinite(result.pose), axis=1)  # steps of a process that was killed are not known
    pose_error = result.pose[with_truth, :2] - log.truth_pose[with_truth, :2]
    return {
        "landmark_rmse_m": rmse(result.landmarks[known] - landmarks[truth[known]]),
        "pose_rmse_m": rmse(pose_error),
    }
