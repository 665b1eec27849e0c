"""A vehicle's own map of its closed frames, and what of it lies around where the next one begins.

Solved anew when a frame closes, from where it was: a function of the vehicle's own readings alone, to the bit, whenever
its state was stored and taken up again. It serves association; nothing of it is published.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from fleet_seif.delta_wire import pack_delta, read_delta
from fleet_seif.errors import NumericalError
from fleet_seif.information import FrameDelta
from fleet_seif.jit import one_thread
from fleet_seif.joint import JointSolution, JointSolver, Life, landmark_classes
from fleet_seif.local_map import LocalMap, seen_from
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints

TRAVEL_LEAST: Final = 0.25
"""Share of the reach of its sightings that a vehicle may always travel within a frame."""


class OwnMap:
    """See above. Frames are numbered from 0 on. aliases: pairs of landmarks that are one, the lesser number first.
    misfit: chi-square per degree of freedom of all frames, when `around` was called last."""

    def __init__(self) -> None:
        self.frames: list[FrameDelta] = []
        self.aliases: list[tuple[int, int]] = []
        self.misfit = 0.0
        self._solver = JointSolver()
        self._solution: JointSolution | None = None
        self._landmarks, self._poses = np.empty((0, 2)), np.empty((0, 3))

    def put(self, frame: int, total: FrameDelta) -> None:
        """What a frame says, for the first time or anew."""
        if frame == len(self.frames):
            self.frames.append(total)
        self.frames[frame] = total

    @one_thread
    def around(self, most: int, reach_m: float) -> tuple[LocalMap, float]:
        """The landmarks around the end of the last frame, as seen from there, and how far they are all there are.

        At most so many, as `nearest` has it. Raises NumericalError where the frames cannot be solved.
        """
        last = max((int(delta.variables[-1]) for delta in self.frames if len(delta.variables)), default=0)
        life = Life(
            vehicle="", life=0, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)), frames=tuple(self.frames),
            signatures=(UNKNOWN_SIGNATURE,) * last, aliases=tuple(sorted(self.aliases)),
        )  # fmt: skip
        self._solution = None
        self._solution = solution = self._solve(life, last)
        self.misfit = float(solution.chi_square.sum() / max(int(solution.dof.sum()), 1))
        newest = [k for _, _, k in solution.poses].index(-1)
        pose, landmarks = solution.pose_mean[newest], solution.landmark_mean
        chosen, travel_max_m = nearest(landmarks, pose, most, reach_m)
        P = self._solver.joint_covariance(solution, chosen, np.array([newest]))
        numbers = np.array([names[0].number for names in solution.classes], np.int64)
        return seen_from(pose, landmarks[chosen], P, numbers[chosen]), travel_max_m

    def around_start(self, frame: int, most: int) -> LocalMap:
        """The landmarks around the start of a frame, at most so many, by the solution of the last `around`.

        Raises NumericalError where there is none.
        """
        solution = self._solution
        if solution is None:
            raise NumericalError("no own map: its frames could not be solved")
        at = [i for i, (_, _, k) in enumerate(solution.poses) if k == frame]
        start = solution.pose_mean[at[0]] if at else np.zeros(3)
        away = np.hypot(*(solution.landmark_mean - start[:2]).T)
        chosen = np.sort(np.argsort(away, kind="stable")[:most])
        P = self._solver.joint_covariance(solution, chosen, np.array(at, np.int64))
        if not at:  # the first frame's start is given
            whole = np.zeros((len(P) + 3, len(P) + 3))
            whole[3:, 3:] = P
            P = whole
        numbers = np.array([names[0].number for names in solution.classes], np.int64)
        return seen_from(start, solution.landmark_mean[chosen], P, numbers[chosen])

    def _solve(self, life: Life, count: int) -> JointSolution:
        solution = self._solver.solve_from(life, landmark_classes([life]), self._landmarks, self._poses)
        self._landmarks, self._poses = np.full((count, 2), np.nan), solution.pose_mean
        self._landmarks[[names[0].number for names in solution.classes]] = solution.landmark_mean
        return solution

    def state(self) -> tuple[Any, ...]:
        """Plain values for msgpack; `restore` takes them back."""
        frames = [pack_delta(delta) for delta in self.frames]
        return frames, list(self.aliases), self._landmarks.tobytes(), self._poses.tobytes()

    def restore(self, state: tuple[Any, ...]) -> None:
        """Go on where `state` was taken, to the bit."""
        frames, aliases, landmarks, poses = state
        self.frames = [read_delta(data) for data in frames]
        self.aliases = [(a, b) for a, b in aliases]
        self._landmarks, self._poses = np.frombuffer(landmarks).reshape(-1, 2), np.frombuffer(poses).reshape(-1, 3)


def nearest(landmarks: Floats, pose: Floats, most: int, reach_m: float) -> tuple[Ints, float]:
    """At most so many landmarks, those nearest to the pose, and how far from there they are all there are, m.

    Args:
        landmarks (n, 2), pose (3,): m and rad.
        reach_m: of the vehicle's sightings, which must find what they may be of.
    """
    away = np.hypot(*(landmarks - pose[:2]).T)
    order = np.argsort(away, kind="stable")
    travel_max_m = np.inf
    if len(order) > most:
        travel_max_m = max(float(away[order[most]]) - reach_m, TRAVEL_LEAST * reach_m)
    return np.sort(order[:most]), travel_max_m


def first_names(aliases: Sequence[tuple[int, int]], count: int) -> Ints:
    """The least number of all that are one landmark, for each number, shape (count,)."""
    first = np.arange(count)
    for a, b in aliases:
        one, other = sorted((int(first[a]), int(first[b])))
        first[first == other] = one
    return first
