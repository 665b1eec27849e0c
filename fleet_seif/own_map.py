"""A vehicle's own map of its closed frames, and what of it lies around where the next one begins.

Solved anew when a frame closes, from where it was: a function of the vehicle's own readings alone, to the bit, whenever
its state was stored and taken up again. Of large maps only a window is solved (own_window). It serves association;
nothing of it is published.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from fleet_seif.delta_wire import pack_delta, read_delta
from fleet_seif.errors import NumericalError
from fleet_seif.information import POSE, FrameDelta
from fleet_seif.jit import one_thread
from fleet_seif.joint import JointSolution, JointSolver, Life, landmark_classes
from fleet_seif.joint_solver import WARM_ENOUGH
from fleet_seif.local_map import LocalMap, seen_from
from fleet_seif.own_window import ENOUGH, WHOLE_FRAMES, View, carried, chain, nearby, starts, view
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints

TRAVEL_LEAST: Final = 0.25
"""Share of the reach of its sightings that a vehicle may always travel within a frame."""


class OwnMap:
    """See above. Frames are numbered from 0 on. aliases: pairs of landmarks that are one, the lesser number first.
    _fit (n, 3): of each frame when `around` solved it last, chi-square, degrees of freedom and robust weight."""

    def __init__(self) -> None:
        self.frames: list[FrameDelta] = []
        self.aliases: list[tuple[int, int]] = []
        self._solver = JointSolver()
        self._solution: JointSolution | None = None
        self._first = np.empty(0, np.int64)
        self._numbers = np.empty(0, np.int64)
        self._start = np.zeros(3)
        self._views: list[View | None] = []
        self._landmarks, self._poses = np.empty((0, 2)), np.empty((0, 3))
        self._fit = np.empty((0, 3))
        self._changed: set[int] = set()

    @property
    def misfit(self) -> float:
        """Chi-square per degree of freedom of all frames, each when `around` solved it last."""
        return float(self._fit[:, 0].sum() / max(int(self._fit[:, 1].sum()), 1))

    def put(self, frame: int, total: FrameDelta) -> None:
        """What a frame says, for the first time or anew."""
        if frame == len(self.frames):
            self.frames.append(total)
            self._views.append(None)
        self.frames[frame], self._views[frame] = total, None
        self._changed.add(frame)

    def join(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Landmarks that are one from now on."""
        for pair in pairs:
            one, other = min(pair), max(pair)
            if (one, other) not in self.aliases:
                self.aliases.append((one, other))

    @property
    def count(self) -> int:
        """How many landmarks there are."""
        numbers = [delta.variables[delta.variables != POSE] - 1 for delta in self.frames]
        present = np.unique(np.concatenate([np.empty(0, np.int64), *numbers]))
        return len(np.unique(self._first_names()[present]))

    def _first_names(self) -> Ints:
        """See `first_names`: of all landmarks that are in a frame or a pair."""
        numbers = [int(delta.variables[-1]) for delta in self.frames if len(delta.variables)]
        return first_names(self.aliases, max([0, *numbers, *(other + 1 for _, other in self.aliases)]))

    def until(self, frame: int, aliases: int) -> "OwnMap":
        """The map of the frames before this one alone, with the first so many pairs; a small one is solved anew."""
        earlier = OwnMap()
        earlier.frames, earlier.aliases = self.frames[:frame], self.aliases[:aliases]
        earlier._views, earlier._fit = self._views[:frame], self._fit[:frame]
        earlier._changed = {number for number in self._changed if number < frame}
        if frame > WHOLE_FRAMES:
            earlier._poses = self._poses[:frame]
        return earlier

    @one_thread
    def around(self, most: int, reach_m: float) -> tuple[LocalMap, float]:
        """The landmarks around the end of the last frame, as seen from there, and how far they are all there are.

        At most so many, as `nearest` has it. Raises NumericalError where the frames cannot be solved.
        """
        self._solution, self._first = None, self._first_names()
        if len(self.frames) <= WHOLE_FRAMES:
            self._solution = solution = self._solve(self.frames, np.arange(len(self.frames)), np.zeros(3), WARM_ENOUGH)
            self._poses = solution.pose_mean
        else:
            self._solution = solution = self._solve_window(most)
        newest = [k for _, _, k in solution.poses].index(-1)
        pose, landmarks = solution.pose_mean[newest], solution.landmark_mean
        chosen, travel_max_m = nearest(landmarks, pose, most, reach_m)
        P = self._solver.joint_covariance(solution, chosen, np.array([newest]))
        return seen_from(pose, landmarks[chosen], P, self._keys(solution)[chosen]), travel_max_m

    def around_start(self, frame: int, most: int) -> LocalMap:
        """The landmarks around the start of a frame, at most so many, by the solution of the last `around`.

        Raises NumericalError where there is none, or the frame has no part in it.
        """
        solution, at = self._solution, np.flatnonzero(self._numbers == frame)
        if solution is None or not len(at):
            raise NumericalError("no own map: its frames could not be solved")
        poses = [i for i, (_, _, k) in enumerate(solution.poses) if k == at[0]]
        start = solution.pose_mean[poses[0]] if poses else self._start
        chosen, _ = nearest(solution.landmark_mean, start, most, 0.0)
        P = self._solver.joint_covariance(solution, chosen, np.array(poses, np.int64))
        if not poses:  # the first frame's start is given
            whole = np.zeros((len(P) + 3, len(P) + 3))
            whole[3:, 3:] = P
            P = whole
        return seen_from(start, solution.landmark_mean[chosen], P, self._keys(solution)[chosen])

    def _keys(self, solution: JointSolution) -> Ints:
        return self._first[[names[0].number for names in solution.classes]]

    def _solve_window(self, most: int) -> JointSolution:
        views = [each or view(delta) for each, delta in zip(self._views, self.frames, strict=True)]
        self._views[:] = views
        at = starts(self._poses, views)
        chosen = nearby(views, at, self._first, most, self._changed)
        deltas, numbers = chain(self.frames, views, self._fit[:, 2], chosen)
        solution = self._solve(deltas, numbers, at[numbers[0]], ENOUGH)
        ends = np.append(numbers[1:], len(views))
        self._poses = carried(at, np.append(numbers[0], ends), np.vstack([at[numbers[0]], solution.pose_mean]))[1:]
        return solution

    def _solve(self, deltas: Sequence[FrameDelta], numbers: Ints, start: Floats, enough: float) -> JointSolution:
        """These frames, the first of which starts at `start`; numbers: the frame that each is, or begins with."""
        names, aliases = dict[int, int](), []
        for number in np.unique(np.concatenate([delta.variables[1:] - 1 for delta in deltas])).tolist():
            name = names.setdefault(int(self._first[number]), number)
            if name != number:
                aliases.append((name, number))
        life = Life(
            vehicle="", life=0, start_pose=start, start_pose_cov=np.zeros((3, 3)), frames=tuple(deltas),
            signatures=(UNKNOWN_SIGNATURE,) * len(self._first), aliases=tuple(aliases),
        )  # fmt: skip
        ends = np.append(numbers[1:], len(self.frames))
        poses = self._poses[ends[ends <= len(self._poses)] - 1]
        solution = self._solver.solve_from(life, landmark_classes([life]), self._landmarks, poses, enough)
        self._numbers, self._start = numbers, start
        self._landmarks = np.full((len(self._first), 2), np.nan)
        self._landmarks[[names[0].number for names in solution.classes]] = solution.landmark_mean
        self._fit = np.concatenate([self._fit, np.zeros((len(self.frames) - len(self._fit), 3))])
        whole = np.array([delta is self.frames[k] for delta, k in zip(deltas, numbers.tolist(), strict=True)])
        self._fit[numbers[whole]] = np.column_stack([solution.chi_square, solution.dof, solution.weight])[whole]
        self._changed.clear()
        return solution

    def state(self) -> tuple[Any, ...]:
        """Plain values for msgpack; `restore` takes them back."""
        frames = [pack_delta(delta) for delta in self.frames]
        arrays = (self._landmarks.tobytes(), self._poses.tobytes(), self._fit.tobytes())
        return frames, list(self.aliases), sorted(self._changed), *arrays

    def restore(self, state: tuple[Any, ...]) -> None:
        """Go on where `state` was taken, to the bit."""
        frames, aliases, changed, landmarks, poses, fit = state
        self.frames = [read_delta(data) for data in frames]
        self.aliases = [(a, b) for a, b in aliases]
        self._views, self._changed = [None] * len(frames), set(changed)
        self._landmarks, self._poses = np.frombuffer(landmarks).reshape(-1, 2), np.frombuffer(poses).reshape(-1, 3)
        self._fit = np.frombuffer(fit).reshape(-1, 3)


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
    first, lesser = np.arange(count), dict[int, int]()

    def least(number: int) -> int:
        while number in lesser:
            number = lesser[number]
        return number

    for pair in aliases:
        one, other = sorted(map(least, pair))
        if one != other:
            lesser[other] = one
    for number in lesser:
        first[number] = least(number)
    return first
