"""How long the joint map takes to refresh, on made-up frames: python -m tests.refresh [--only 1000 10000 flat].

Vehicles drive one lawnmower path over a square again and again, each from a place of its own; its sweeps turn by a
quarter. Frames are 25 steps long. Times are medians of wall clock; `lives` and `classes` are made beforehand.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np

from fleet_seif import joint
from fleet_seif.frame_deltas import quantised
from fleet_seif.information import FrameDelta
from fleet_seif.jit import one_thread
from fleet_seif.joint import JointSolution, JointSolver, Life
from fleet_seif.records import Floats
from tests import reference

T = TypeVar("T")
FRAME_STEPS = 25
LOOKS = 5
"""From so many poses of a frame landmarks are seen."""
RANGE_M = 1.2
LANE_M = 2.0
ODOMETRY_STD = np.array([0.01, 0.01, 0.004])
"""Per step, m and rad."""
SIGHTING_STD_M = 0.05
SPACING_M = 0.15
"""Between steps: a frame sees 11 landmarks."""
WIDE_M = 0.36
"""The same where 3 vehicles see 2,000 landmarks in 1,000 steps each: a frame sees 20."""
FLAT_FRAMES = 14
"""So many new frames of each vehicle are timed: more than twice as many as the largest map lets wait."""


@dataclass
class Drive:
    """A vehicle's frames so far; which landmark each of its numbers is."""

    vehicle: str
    start: Floats
    frames: list[FrameDelta]
    shown: list[int]

    def life(self, frames: int | None = None) -> Life:
        return Life(
            vehicle=self.vehicle, life=0, start_pose=self.start, start_pose_cov=np.zeros((3, 3)),
            frames=tuple(self.frames[:frames]), signatures=tuple(self.shown),
        )  # fmt: skip


def sweep(side: float) -> Floats:
    """Corners of lanes from (0, 0) to (0, side); turned clockwise by a quarter it goes on where it ended."""
    lanes = 2 * round(side / LANE_M / 2)
    y = (np.arange(lanes) + 0.5) * side / lanes
    x = np.where(np.arange(2 * lanes) % 4 % 3 == 0, 0.0, side)
    return np.column_stack([x, np.repeat(y, 2)])


def path(side: float, length: float, spacing: float) -> Floats:
    """Poses (n, 3) every `spacing` along sweeps after sweeps."""
    corners, middle = sweep(side), side / 2
    found, done, k = [], 0.0, 0
    while done < length:
        c, s = np.cos(k * np.pi / 2), -np.sin(k * np.pi / 2)
        found.append((corners - middle) @ np.array([[c, s], [-s, c]]) + middle)
        done += float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
        k += 1
    all_corners = np.concatenate(found)
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(all_corners, axis=0), axis=1))])
    where = np.arange(0.0, length, spacing)
    points = np.column_stack([np.interp(where, at, all_corners[:, axis]) for axis in range(2)])
    ahead = np.column_stack([np.interp(where + spacing, at, all_corners[:, axis]) for axis in range(2)]) - points
    return np.column_stack([points, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))])


def frame_information(poses: Floats, landmarks: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, list[int]]:
    """H and z of a frame along these poses (k, 3), odometry between them; and the landmarks seen, ascending."""
    away = np.linalg.norm(landmarks[:, None] - poses[None, 1:, :2], axis=2)
    seen = np.flatnonzero((away < RANGE_M).any(axis=1))
    k, n = len(poses) - 1, 3 * (len(poses) - 1) + 2 * len(seen)
    H, step = np.zeros((n, n)), np.diag(1.0 / (ODOMETRY_STD**2 * FRAME_STEPS / k))
    for i in range(k):
        d = poses[i + 1, :2] - poses[i, :2]
        R = reference.rotation(poses[i, 2])
        J = np.zeros((3, n))
        if i:
            J[:2, 3 * i - 3 : 3 * i - 1], J[:2, 3 * i - 1] = -R.T, R.T @ [d[1], -d[0]]
            J[2, 3 * i - 1] = -1.0
        J[:2, 3 * i : 3 * i + 2], J[2, 3 * i + 2] = R.T, 1.0
        H += J.T @ step @ J
        R = reference.rotation(poses[i + 1, 2])
        for j in np.flatnonzero(away[seen, i] < RANGE_M).tolist():
            d = landmarks[seen[j]] - poses[i + 1, :2]
            J, at = np.zeros((2, n)), 3 * k + 2 * j
            J[:, 3 * i : 3 * i + 2], J[:, 3 * i + 2], J[:, at : at + 2] = -R.T, R.T @ [d[1], -d[0]], R.T
            H += J.T @ J / SIGHTING_STD_M**2
    inner = 3 * (k - 1)
    H = H[inner:, inner:] - H[inner:, :inner] @ np.linalg.solve(H[:inner, :inner], H[:inner, inner:])
    turn = np.eye(n - inner)  # into the frame's own coordinates
    R = reference.rotation(poses[0, 2])
    turn[:2, :2] = R
    for j in range(len(seen)):
        turn[3 + 2 * j : 5 + 2 * j, 3 + 2 * j : 5 + 2 * j] = R
    H = turn.T @ H @ turn
    z = reference.frame_view(poses[0], poses[-1], landmarks[seen])
    return (H + H.T) / 2, z + np.linalg.solve(np.linalg.cholesky(H).T, rng.normal(size=len(z))), seen.tolist()


def fleet(landmarks: int, vehicles: int, frames: int, spacing: float, seed: int = 0) -> list[Drive]:
    """Drives of `frames` frames each through one landmark a square metre."""
    rng = np.random.default_rng(seed)
    side = float(np.sqrt(landmarks))
    world = rng.uniform(0.0, side, (landmarks, 2))
    steps = frames * FRAME_STEPS
    one_sweep = float(np.linalg.norm(np.diff(sweep(side), axis=0), axis=1).sum())
    track = path(side, one_sweep + (steps + 1) * spacing, spacing)
    drives = []
    for v in range(vehicles):
        first = round(v / vehicles * one_sweep / spacing)
        own = track[first : first + steps + 1]
        drive = Drive(f"v{v}", own[0].copy(), [], [])
        number: dict[int, int] = {}
        for f in range(frames):
            poses = own[f * FRAME_STEPS : (f + 1) * FRAME_STEPS + 1 : FRAME_STEPS // LOOKS]
            H, z, seen = frame_information(poses, world, rng)
            for j in seen:
                if j not in number:
                    number[j] = len(drive.shown)
                    drive.shown.append(j)
            order = np.argsort([number[j] for j in seen])
            rows = np.concatenate([np.arange(3), (3 + 2 * order[:, None] + np.arange(2)).ravel()])
            variables = np.array([0, *(1 + number[seen[i]] for i in order)], np.int64)
            H = H[np.ix_(rows, rows)]
            drive.frames.append(quantised(variables, H, H @ z[rows], z[rows]))
        drives.append(drive)
    return drives


def timed(call: Callable[[], T]) -> tuple[T, float]:
    begin = time.perf_counter()
    result = call()
    return result, time.perf_counter() - begin


def report(text: str) -> None:
    print(text, flush=True)


def arrivals(drives: Sequence[Drive], first: int, last: int) -> list[list[Life]]:
    """Lives after each frame that arrives, one vehicle's after the other's, from `first` frames each to `last`."""
    counts = [first] * len(drives)
    found = [[drive.life(first) for drive in drives]]
    for f in range(first, last):
        for v in range(len(drives)):
            counts[v] = f + 1
            found.append([drive.life(count) for drive, count in zip(drives, counts, strict=True)])
    return found


def altered(life: Life) -> Life:
    """The life whose last frame has gone on a little: what it says differs by a thousandth."""
    last = life.frames[-1]
    return dataclasses.replace(life, frames=(*life.frames[:-1], dataclasses.replace(last, b=last.b + last.b // 1000)))


def refreshing(drives: Sequence[Drive], first: int, last: int) -> Iterator[tuple[float, float, JointSolution]]:
    """After the cold solution (its seconds twice), for each new frame: milliseconds of a refresh with it, and of one in
    which an open frame has gone on; what was found."""
    lives = arrivals(drives, first, last)
    classes = [joint.landmark_classes(each) for each in lives]
    solver = JointSolver()
    solution, cold = timed(partial(solver.replay, lives[0], classes[0]))
    yield cold, cold, solution
    for each, names in zip(lives[1:], classes[1:], strict=True):
        solution, new_frame = timed(partial(solver.update, each, names))
        _, open_frame = timed(partial(solver.update, [altered(each[0]), *each[1:]], names))
        yield 1e3 * new_frame, 1e3 * open_frame, solution


def tell(found: Sequence[tuple[float, float, JointSolution]]) -> float:
    """Print what `refreshing` has found; the mean of new frames."""
    (cold, _, _), *rest = found
    new, altered = [row[0] for row in rest], [row[1] for row in rest]
    solution = found[-1][2]
    report(
        f"{len(solution.classes):6d} landmarks, {len(solution.frames):5d} frames: replay {cold:6.2f} s; new frame: "
        f"median {statistics.median(new):6.1f} ms, mean {statistics.mean(new):6.1f} ms, worst {max(new):6.1f} ms; "
        f"open frame altered: median {statistics.median(altered):6.1f} ms"
    )
    return statistics.mean(new)


@one_thread
def refreshes(drives: Sequence[Drive], first: int, last: int) -> None:
    """Times of new frames, and of all covariances."""
    found = list(refreshing(drives, first, last))
    tell(found)
    report(f"{'':30s} covariances of all {timed(partial(joint.marginal_covariances, found[-1][2]))[1]:6.2f} s")


@one_thread
def flat(drives: Sequence[Drive], counts: Sequence[int]) -> None:
    """Times at several lengths of a run, one refresh of each after the other, so that all have the same machine."""
    runs = list(zip(*(refreshing(drives, count - FLAT_FRAMES, count) for count in counts), strict=True))
    means = [tell(found) for found in zip(*runs, strict=True)]
    report(f"mean refresh at the end / at the tenth: {means[-1] / means[0]:.2f}")
    lives, last = [drive.life() for drive in drives], runs[-1][-1][2]
    whole = joint.solve(lives, joint.landmark_classes(lives))
    variance = np.diagonal(joint.marginal_covariances(whole)[0], axis1=1, axis2=2)
    off = np.abs(last.landmark_mean - whole.landmark_mean) / np.sqrt(variance)
    report(f"last map against the canonical one: {np.sqrt(np.mean(off**2)):.3f} sigma rms, {off.max():.3f} at most")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=["1000", "10000", "flat"], default=["1000", "10000", "flat"])
    chosen = parser.parse_args().only
    refreshes(fleet(100, 2, 6, SPACING_M), 4, 6)  # compiles
    if "1000" in chosen:
        refreshes(fleet(1000, 3, 100, SPACING_M), 85, 100)
    if "10000" in chosen:
        refreshes(fleet(10_000, 5, 600, SPACING_M), 596, 600)
    if "flat" in chosen:
        flat(fleet(2000, 3, 400, WIDE_M), (40, 80, 200, 400))


if __name__ == "__main__":
    main()
