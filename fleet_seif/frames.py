"""A vehicle's filter cut into frames (DESIGN D5): each is a filter of its own, and is made anew when it closes.

1. Frame f+1 starts at the last pose of frame f. What is sighted there belongs to the frame that closes.
2. Landmarks are numbered over the whole life; within a frame the filter has its own numbers.
3. A frame closes when its linearisation may soon be wrong (FilterSettings.frames). A batch over the readings of that
   frame alone then replaces its posterior: the difference to what was published is a correction, published with the
   message of the step `close_lag_steps` later, or with the end. Where the batch fails the filter's posterior stays.
4. What is published is a function of this vehicle's own readings and settings, never of timing or of the joint map.
5. Where frames start, and the map, is the joint solution of this vehicle's own frames, the open one included: whoever
   owns the filter calls `localise` after a step. Between two solutions the open frame's filter goes on from there.
6. With frames = "single" there is one, which closes at the end and is never corrected.
"""

import logging
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fleet_seif.config import FilterSettings
from fleet_seif.delta_wire import pack_delta, read_delta
from fleet_seif.errors import NumericalError
from fleet_seif.filters import Names, StepResult
from fleet_seif.frame_batch import FrameReadings, FrameSolution, solve_frame
from fleet_seif.frame_deltas import quantised
from fleet_seif.geometry import act_all, between, compose
from fleet_seif.information import FrameDelta, FrameTotal
from fleet_seif.joint import JointSolution, JointSolver, Life, landmark_names
from fleet_seif.messages import FramePart, FrameStatus
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats, Ints, Reading, Sightings
from fleet_seif.seif import Seif, Taken

log = logging.getLogger(__name__)
FRAME_LANDMARKS_MAX = 4096
"""Landmarks of one frame of several, for which its filter reserves space."""


@dataclass
class FrameLog:
    """The readings of one frame, and the live estimate after each: what its batch is made from.

    motions: odometry, its covariance, and the pose after it. sightings: the number of motions before, signatures, z and
    their covariances.
    """

    motions: list[tuple[Floats, Floats, Floats]] = field(default_factory=list)
    sightings: list[tuple[int, Ints, Floats, Floats]] = field(default_factory=list)
    heading_variance: float = 0.0

    def add(self, moves: bool, taken: Taken, pose: Floats) -> None:
        """One step: the motion (none before any), and what was seen. The arrays are kept."""
        u, cov, z, Z, signature = taken
        if moves:
            self.motions.append((u, cov, pose))
            self.heading_variance += float(cov[2, 2])
        if len(signature):
            self.sightings.append((len(self.motions), signature, z, Z))

    def state(self) -> tuple[Any, ...]:
        """Plain values for msgpack; `restored` takes them back."""
        seen = [
            (step, names.astype(np.int64).tobytes(), z.tobytes(), Z.tobytes()) for step, names, z, Z in self.sightings
        ]
        motions = [tuple(array.tobytes() for array in motion) for motion in self.motions]
        return motions, seen, self.heading_variance

    @staticmethod
    def restored(state: tuple[Any, ...]) -> "FrameLog":
        motions, seen, heading_variance = state
        return FrameLog(
            motions=[
                (np.frombuffer(u), np.frombuffer(cov).reshape(3, 3), np.frombuffer(pose)) for u, cov, pose in motions
            ],
            sightings=[
                (
                    step, np.frombuffer(names, np.int64), np.frombuffer(z).reshape(-1, 2),
                    np.frombuffer(Z).reshape(-1, 2, 2),
                )
                for step, names, z, Z in seen
            ],
            heading_variance=heading_variance,
        )  # fmt: skip

    def solved(self, model: int, signatures: Ints, landmarks: Floats, huber: float | None) -> FrameSolution:
        """The batch over these readings, from the live estimates on; signatures of its landmarks (n,), m (n, 2).

        huber: see FilterSettings.frame_huber.

        Raises NumericalError.
        """
        steps = [np.full(len(names), step) for step, names, _, _ in self.sightings]
        none, order = Sightings.none(), np.argsort(signatures)
        seen = np.concatenate([*(names for _, names, _, _ in self.sightings), none.signature]).astype(np.int64)
        readings = FrameReadings(
            model=model,
            odometry=np.array([u for u, _, _ in self.motions]).reshape(-1, 3),
            odometry_cov=np.array([cov for _, cov, _ in self.motions]).reshape(-1, 3, 3),
            step=np.concatenate([*steps, none.signature]).astype(np.int64),
            landmark=order[np.searchsorted(signatures, seen, sorter=order)],
            z=np.concatenate([*(z for _, _, z, _ in self.sightings), none.z]),
            cov=np.concatenate([*(Z for _, _, _, Z in self.sightings), none.cov]),
        )
        poses = np.array([pose for _, _, pose in self.motions]).reshape(-1, 3)
        return solve_frame(readings, poses, landmarks, bound=math.inf if huber is None else huber**2)


@dataclass
class Closed:
    """A frame that has ended and is to be corrected at step `due`.

    landmarks (n, 2): as estimated last; signatures, numbers (n,): theirs, and how they are called in the life.
    """

    frame: int
    due: int
    log: FrameLog
    landmarks: Floats
    signatures: Ints
    numbers: Ints


class FramedFilter:
    """See the rules above."""

    def __init__(self, settings: FilterSettings, model: int = RANGE_BEARING) -> None:
        self.settings = settings
        self.model = model
        self.steps = 0
        self.totals: list[FrameTotal] = []
        self.ends: list[Floats] = []
        self._solver = JointSolver()
        self._origin = 0, np.zeros(3)
        self._map = np.empty((0, 2))
        self._localised, self._asked = 0, (0, np.zeros(3))
        self._names = Names()
        self._single = settings.frames == "single"
        self._frame_settings = settings
        if not self._single:
            most = min(settings.landmarks_max, FRAME_LANDMARKS_MAX)
            self._frame_settings = settings.model_copy(update={"landmarks_max": most})
        self._closed: list[Closed] = []
        self._open()

    def _open(self) -> None:
        """Begin a frame; it is published with its first step."""
        self.filter = Seif(self._frame_settings, self.model, None if self._single else self._names)
        self._log = FrameLog()
        self._opened = False

    @property
    def signatures(self) -> list[int]:
        """Signatures of the life's landmarks by number."""
        return self.filter.signatures if self._single else self._names.signatures

    @property
    def pose(self) -> Floats:
        """Live pose in the coordinates of frame 0, (x m, y m, theta rad), shape (3,)."""
        return compose(self._open_pose, self.filter.pose)

    @property
    def _open_pose(self) -> Floats:
        """Where the open frame starts, such that the pose of the last solution is what it was found to be."""
        frame, pose = self._origin
        for end in self.ends[frame:]:
            pose = compose(pose, end)
        return pose

    @property
    def landmarks(self) -> Floats:
        """Live landmarks in the coordinates of frame 0, m, shape (n, 2), by number; NaN for one that is none."""
        if self._single:
            return self.filter.landmarks
        found = np.full((len(self.signatures), 2), np.nan)
        found[: len(self._map)] = self._map
        own = self.filter.called
        new = np.isnan(found[own, 0])
        found[own[new]] = act_all(self._open_pose, self.filter.landmarks[new])
        return found

    @property
    def is_localisation_due(self) -> bool:
        """Whether enough has happened since the last `own_life`."""
        return self.frame > 0 and self.steps >= self._localised + self.settings.localise_steps and not self._single

    def localise(self) -> None:
        """Solve this vehicle's own frames, if that is due. Where another thread solves, in three parts: `own_life`,
        `solve_own` (which needs nothing else), `take_solution`."""
        if self.is_localisation_due:
            self.take_solution(self.solve_own(self.own_life()))

    def own_life(self) -> Life:
        """What this vehicle has published, in the coordinates of frame 0."""
        self._localised, self._asked = self.steps, (self.frame, self.filter.pose)
        return Life(
            vehicle="", life=0, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)), frames=self.published(),
            signatures=tuple(self.signatures),
        )  # fmt: skip

    def solve_own(self, life: Life) -> JointSolution | None:
        """The joint solution of `own_life`; None where there is none."""
        try:
            return self._solver.update([life], tuple((name,) for name in landmark_names(life)))
        except NumericalError as error:
            log.warning("not_localised reason=%s", error)
            return None

    def take_solution(self, solution: JointSolution | None) -> None:
        """Take what `solve_own` found."""
        if solution is None:
            return
        frame, pose = self._asked
        newest = solution.pose_mean[[k for _, _, k in solution.poses].index(-1)]
        self._origin = frame, compose(newest, between(pose, np.zeros(3)))
        self._map = np.full((len(self.signatures), 2), np.nan)
        self._map[[names[0].number for names in solution.classes]] = solution.landmark_mean

    @property
    def frame(self) -> int:
        """Number of the frame that the next step belongs to."""
        return len(self.ends)

    def start(self, sightings: Sightings) -> tuple[StepResult, tuple[FramePart, ...]]:
        """What is seen before any motion: the first part of frame 0. Parts are what to publish."""
        return self._take(False, self.filter.start(sightings))

    def step(self, reading: Reading) -> tuple[StepResult, tuple[FramePart, ...]]:
        """One reading. Raises what Seif.step raises; nothing has changed then."""
        result = self.filter.step(reading)
        self.steps += 1
        return self._take(True, result)

    def _take(self, moves: bool, result: StepResult) -> tuple[StepResult, tuple[FramePart, ...]]:
        frame, status = self.frame, FrameStatus.CONTINUED if self._opened else FrameStatus.OPENED
        self._opened = True
        if self._single:
            return result, (FramePart(frame=frame, status=status, delta=result.delta),)
        self._log.add(moves, self.filter.taken, self.filter.pose)
        if not self._is_over():
            parts = [FramePart(frame=frame, status=status, delta=result.delta)]
        elif status is FrameStatus.CONTINUED:
            parts = [FramePart(frame=frame, status=FrameStatus.ENDED, delta=result.delta, end_pose=self._close())]
        else:
            nothing = FrameDelta.nothing()
            parts = [
                FramePart(frame=frame, status=status, delta=result.delta),
                FramePart(frame=frame, status=FrameStatus.ENDED, delta=nothing, end_pose=self._close()),
            ]
        while self._closed and self._closed[0].due <= self.steps:
            parts += self._correction(self._closed.pop(0))
        return result, tuple(parts)

    def _is_over(self) -> bool:
        settings, readings = self.settings, self._log
        return (
            len(readings.motions) >= settings.frame_steps_max
            or len(self.filter.called) >= settings.frame_landmarks_max
            or readings.heading_variance >= settings.frame_heading_std_max_rad**2
        )

    def _close(self) -> Floats:
        """End the open frame where it is now, so that the next step begins another; its last pose."""
        end_pose = self.filter.pose
        due = self.steps + self.settings.close_lag_steps
        live = self.filter
        signatures = np.array(live.signatures, np.int64)
        self._closed.append(Closed(self.frame, due, self._log, live.landmarks, signatures, live.called))
        self.totals.append(FrameTotal())
        self.totals[-1].add(live.published())
        self.ends.append(end_pose)
        self._open()
        return end_pose

    def _correction(self, closed: Closed) -> list[FramePart]:
        """What the batch over a closed frame changes, to be published; nothing where it fails, or nothing moved."""
        if not closed.log.motions:
            return []
        total = self.totals[closed.frame]
        try:
            batch = closed.log.solved(self.model, closed.signatures, closed.landmarks, self.settings.frame_huber)
            order = np.argsort(closed.numbers)
            order = order[batch.seen[order]]
            rows = np.concatenate([np.arange(3), (3 + 2 * order[:, None] + np.arange(2)).ravel()])
            variables = np.concatenate([[0], 1 + closed.numbers[order]]).astype(np.int64)
            H, b, mean = batch.H[np.ix_(rows, rows)], batch.b[rows], batch.mean[rows]
            change = FrameTotal()
            change.add(quantised(variables, H, b, mean))
            change.subtract(total.delta())
        except NumericalError:
            return []
        delta = change.delta()
        total.add(delta)
        self.ends[closed.frame] = batch.mean[:3]
        return [
            FramePart(frame=closed.frame, status=FrameStatus.CORRECTED, delta=delta, end_pose=self.ends[closed.frame])
        ]

    def end(self) -> tuple[FramePart, ...]:
        """Close the open frame and correct all that is outstanding."""
        parts: list[FramePart] = []
        if self._opened:
            frame, nothing = self.frame, FrameDelta.nothing()
            end_pose = self.filter.pose if self._single else self._close()
            parts.append(FramePart(frame=frame, status=FrameStatus.ENDED, delta=nothing, end_pose=end_pose))
        for closed in self._closed:
            parts += self._correction(closed)
        self._closed.clear()
        self._localised = self.steps - self.settings.localise_steps
        return tuple(parts)

    def state(self) -> dict[str, Any]:
        """All that it knows, as plain values for msgpack; `restore` takes it back."""
        state = {"filter": self.filter.state(), "steps": self.steps, "opened": self._opened}
        if self._single:
            return state
        closed = [
            (
                each.frame, each.due, each.log.state(), each.landmarks.tobytes(), each.signatures.tobytes(),
                each.numbers.tobytes(),
            )
            for each in self._closed
        ]  # fmt: skip
        return {
            **state, "signatures": self.signatures, "log": self._log.state(), "closed": closed,
            "totals": [pack_delta(total.delta()) for total in self.totals], "ends": np.array(self.ends).tobytes(),
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken, to the bit. Raises ValueError where it is not the state of a filter."""
        if not self._single:
            self._names.add(list(state["signatures"]))
        self.filter.restore(state["filter"])
        self.steps, self._opened = state["steps"], state["opened"]
        if self._single:
            return
        self._localised = self.steps - self.settings.localise_steps
        self._log = FrameLog.restored(state["log"])
        self._closed = [
            Closed(
                frame, due, FrameLog.restored(log), np.frombuffer(landmarks).reshape(-1, 2),
                np.frombuffer(signatures, np.int64), np.frombuffer(numbers, np.int64),
            )
            for frame, due, log, landmarks, signatures, numbers in state["closed"]
        ]  # fmt: skip
        self.totals = [FrameTotal() for _ in state["totals"]]
        for total, data in zip(self.totals, state["totals"], strict=True):
            total.add(read_delta(data))
        self.ends = list(np.frombuffer(state["ends"]).reshape(-1, 3))

    def published(self) -> tuple[FrameDelta, ...]:
        """The sum of all that has been published, frame by frame."""
        closed = tuple(total.delta() for total in self.totals)
        return (*closed, self.filter.published()) if self._opened else closed
