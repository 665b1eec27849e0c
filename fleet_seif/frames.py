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
7. Where nothing tells which landmark a sighting is of (identities = "associated"), an Associator decides, against what
   the closed frames say about where the open one starts and what lies around it (own_map). Where too many landmarks may
   be another one, the frames do not fit each other, or what should be in view is not seen, the vehicle has probably
   taken some for their neighbours: it is doubtful until a frame closes after which none of this is nearly so. Or until
   it finds a way back: what the sightings of the last frames are of is told anew (way_back), and where that looks right
   these frames are corrected.
8. With frames = "single" what lies around the pose comes from the one filter itself, every frame_steps_max steps
   (surroundings), and only the sighting that has a landmark accepted, and later ones, enter the filter: earlier ones
   would have to be worked into poses that are gone. Landmarks begun twice become aliases, and the filter holds them
   together (seif_join).
"""

import contextlib
import dataclasses
import logging
from typing import Any

import numpy as np

from fleet_seif.associator import Associator, Decision
from fleet_seif.closed_frames import Closed, join
from fleet_seif.config import FilterSettings
from fleet_seif.delta_wire import pack_delta, read_delta
from fleet_seif.errors import NumericalError
from fleet_seif.filters import Names, StepResult, checked_reading
from fleet_seif.frame_log import NONE, FrameLog
from fleet_seif.geometry import act_all, between, compose
from fleet_seif.information import FrameDelta, FrameTotal
from fleet_seif.joint import JointSolution, JointSolver, Life, landmark_classes, landmark_names
from fleet_seif.messages import FramePart, FrameStatus
from fleet_seif.models import RANGE_BEARING
from fleet_seif.own_map import OwnMap, first_names
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints, Reading, Sightings
from fleet_seif.seif import Seif, Taken
from fleet_seif.surroundings import around_pose
from fleet_seif.way_back import ToldAnew, told_anew

log = logging.getLogger(__name__)
AGAIN_FRAMES = 4
"""A frame is looked at again when so many more have closed."""
KEPT_FRAMES = 16
"""Closed frames whose readings are kept, while the vehicle is sound; where it is doubtful, those since, too."""
KEPT_FRAMES_MAX = 48
"""Closed frames whose readings are kept at most: a doubt that has lasted for 32 is looked into for the last time."""
SOUND_SHARE = 0.55
"""Share of the limits of doubt up to which a doubtful vehicle is sound again, and what was told anew is taken."""
BACK_COUNT = 1.1
"""How many times the landmarks of before there may be then."""
CROWDED_MAX = 0.15
"""Share of the landmarks around that may be crowded (own_duplicates) where a way back is taken; where there are more in
a single frame, the vehicle is doubtful."""
CORRECTIONS_EACH = 16
"""Frames that are corrected with one step, on the way back from doubt."""
FRAME_LANDMARKS_MAX = 4096
"""Landmarks of one frame of several, for which its filter reserves space."""


def _told(seen: Sightings, decision: Decision | None) -> Sightings:
    """The sightings that the filter takes, by the numbers of their landmarks."""
    if decision is None:
        return seen
    told = decision.keys >= 0
    return Sightings(z=np.asarray(seen.z)[told], cov=np.asarray(seen.cov)[told], signature=decision.keys[told])


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
        self._has_names = not self._single or settings.identities == "associated"
        self._frame_settings = settings
        if not self._single:
            most = min(settings.landmarks_max, FRAME_LANDMARKS_MAX)
            self._frame_settings = settings.model_copy(update={"landmarks_max": most})
        self._kept: list[Closed] = []
        self._closed: list[Closed] = []
        self._looked_at: list[Closed] = []
        self._late: list[FramePart] = []
        self._associator = Associator(settings.association, model) if settings.identities == "associated" else None
        self._own_map = OwnMap()
        self._doubtful_since: int | None = None
        self._to_correct: dict[int, tuple[FrameDelta, Floats]] = {}
        self._begun: list[tuple[int, int]] = []
        self._new_aliases: list[tuple[int, int, bool]] = []
        self._assigned: list[Ints] = []
        self._open()

    def _open(self) -> None:
        """Begin a frame; it is published with its first step."""
        self.filter = Seif(self._frame_settings, self.model, self._names if self._has_names else None)
        self._log = FrameLog()
        self._opened = False

    @property
    def doubtful(self) -> bool:
        """Whether this vehicle's map did not look right when the last frame closed (rule 7), or still is corrected."""
        return self._doubtful_since is not None or bool(self._to_correct)

    @property
    def signatures(self) -> list[int]:
        """Signatures of the life's landmarks by number."""
        if self._associator is not None:
            return [UNKNOWN_SIGNATURE] * len(self._names.signatures)
        return self.filter.signatures if self._single else self._names.signatures

    @property
    def assigned(self) -> Ints:
        """Which landmark each sighting taken so far is of, by number, -1 none, shape (s,)."""
        keys = np.concatenate([*self._assigned, np.empty(0, np.int64)]).astype(np.int64)
        if self._associator is not None:
            first = first_names(self._own_map.aliases, len(self._names.signatures))
            return np.array([first[key] if key >= 0 else NONE for key in keys.tolist()], np.int64)
        numbers = {signature: number for number, signature in enumerate(self.signatures)}
        return np.array([numbers[key] for key in keys.tolist()], np.int64)

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
            landmarks = self.filter.landmarks
            landmarks[first_names(self._own_map.aliases, len(landmarks)) != np.arange(len(landmarks))] = np.nan
            return landmarks
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
            signatures=tuple(self.signatures), aliases=tuple(sorted(self._own_map.aliases)),
        )  # fmt: skip

    def solve_own(self, life: Life) -> JointSolution | None:
        """The joint solution of `own_life`; None where there is none."""
        try:
            return self._solver.update(
                [life],
                tuple((name,) for name in landmark_names(life))
                if self._associator is None
                else landmark_classes([life]),
            )
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
        decision = self._decide(None, sightings)
        result = self.filter.start(_told(sightings, decision))
        return self._take(False, result, sightings, decision)

    def step(self, reading: Reading) -> tuple[StepResult, tuple[FramePart, ...]]:
        """One reading. Raises what Seif.step raises; nothing has changed then."""
        decision = self._decide((reading.odometry, reading.odometry_cov), reading.sightings)
        result = self.filter.step(dataclasses.replace(reading, sightings=_told(reading.sightings, decision)))
        self.steps += 1
        return self._take(True, result, reading.sightings, decision)

    def _decide(self, motion: tuple[Floats, Floats] | None, seen: Sightings) -> Decision | None:
        if self._associator is None:
            return None
        u, cov = motion or (np.zeros(3), np.eye(3))
        u, cov, z, Z, _ = checked_reading(u, cov, dataclasses.replace(seen, signature=np.full(len(seen.z), NONE)))
        known = len(self._names.signatures)
        return self._associator.decide(self.steps + (motion is not None), motion and (u, cov), z, Z, known)

    def _take(
        self, moves: bool, result: StepResult, seen: Sightings, decision: Decision | None
    ) -> tuple[StepResult, tuple[FramePart, ...]]:
        frame, status = self.frame, FrameStatus.CONTINUED if self._opened else FrameStatus.OPENED
        self._opened = True
        taken = self.filter.taken
        if decision is not None:
            result, taken = self._take_decision(decision, result, seen)
        self._assigned.append(taken[4])
        if self._single:
            if self._is_round_over():
                result = dataclasses.replace(result, delta=self._look_around_pose(result.delta))
            return result, (FramePart(frame=frame, status=status, delta=result.delta),)
        self._log.add(moves, taken, self.filter.pose)
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
            parts += self._corrected(self._closed.pop(0))
        late, self._late = self._late, []
        return result, (*parts, *late, *self._corrections())

    def _take_decision(self, decision: Decision, result: StepResult, seen: Sightings) -> tuple[StepResult, Taken]:
        """What sightings were taken for holds from now on: the step as published, and as it is kept."""
        assert self._associator is not None
        z, Z = np.array(seen.z, float), np.array(seen.cov, float)
        self._associator.take(decision, z)
        for key, number in decision.accepted.items():
            self._log.accept(key, number)
            for closed in (*self._looked_at, *self._closed):  # with one sighting of it, it has nothing to test that by
                closed.log.accept(key, number, least=2)
        new = (UNKNOWN_SIGNATURE,) * len(result.new)
        result = dataclasses.replace(
            result, new=new, innovation=decision.innovation, sightings=decision.dof // 2,
        )  # fmt: skip
        u, cov, *_ = self.filter.taken
        return result, (u, cov, z, Z, decision.keys)

    def _is_over(self) -> bool:
        settings, readings = self.settings, self._log
        return (
            len(readings.motions) >= settings.frame_steps_max
            or len(self.filter.called) >= settings.frame_landmarks_max
            or readings.heading_variance >= settings.frame_heading_std_max_rad**2
            or (self._associator is not None and self._associator.has_left(self.filter.pose))
        )

    def _close(self) -> Floats:
        """End the open frame where it is now, so that the next step begins another; its last pose."""
        end_pose = self.filter.pose
        live = self.filter
        self._kept.append(
            Closed(
                frame=self.frame,
                due=self.steps + self.settings.close_lag_steps,
                log=self._log,
                landmarks=live.landmarks,
                signatures=np.array(live.signatures, np.int64),
                numbers=live.called,
                first_step=self.steps - len(self._log.motions),
                aliases=len(self._own_map.aliases),
            )
        )
        self._closed.append(self._kept[-1])
        self.totals.append(FrameTotal())
        self.totals[-1].add(live.published())
        self.ends.append(end_pose)
        if self._associator is not None:
            self._look_around(self._kept[-1], self._associator)
        self._forget()
        self._open()
        return end_pose

    def _look_around(self, closed: Closed, associator: Associator) -> None:
        """What lies around the end of a frame that closes, for the next."""
        before, own = set(self._own_map.aliases), self._own_map
        known, total = len(self._names.signatures), self.totals[closed.frame].delta()
        duplicates, _ = join(closed, associator, own, self.settings, self.model, known, total)
        try:
            near = own.around(self.settings.association.local_landmarks_max, associator.reach_m)
        except NumericalError as error:
            log.warning("own_map_not_solved frame=%d reason=%s", closed.frame, error)
            near = associator.around()
        associator.begin(*near)
        share = 1.0 if self._doubtful_since is None else SOUND_SHARE
        if not self._looks_wrong(duplicates.unclear, own, associator, share):
            self._doubtful_since = None
        else:
            if self._doubtful_since is None:
                self._doubtful_since = closed.frame
            self._find_way_back(closed.frame, self._doubtful_since, associator)
        self._note_aliases(before)
        while self._looked_at and self._looked_at[0].frame + AGAIN_FRAMES <= closed.frame:
            self._late += self._looked_at_again(self._looked_at.pop(0))

    def _looks_wrong(self, unclear: float, own: OwnMap, associator: Associator, share: float) -> bool:
        """Whether that much is unclear, fits so badly, or is not seen. share: of the limits."""
        limits = self.settings.association
        return (
            unclear > share * limits.unclear_max
            or own.misfit > share * limits.misfit_max
            or associator.unseen > share * limits.unseen_max
        )

    def _looks_right(self, found: ToldAnew) -> bool:
        """Whether what was told anew is sound by more than a hair, and the older map has been found again: else there
        are many more landmarks than before, or they lie where hardly two can."""
        if self._looks_wrong(found.unclear, found.own_map, found.associator, SOUND_SHARE):
            return False
        return found.own_map.count <= BACK_COUNT * self._own_map.count and found.associator.crowded() <= CROWDED_MAX

    def _find_way_back(self, frame: int, since: int, associator: Associator) -> None:
        """Tell the last frames anew, from the further back the longer the doubt lasts; take it where it looks right."""
        doubtful = frame - since + 1
        if doubtful & (doubtful - 1):  # 1, 2, 4, 8 frames, ...
            return
        first = max(since - min(2 * doubtful, KEPT_FRAMES), 0)
        again = [closed for closed in self._kept if closed.frame >= first]
        if again[0].frame > first:
            return
        known = len(self._names.signatures)
        found = told_anew(again, self._own_map, associator, self.settings, self.model, known)
        if found is not None and self._looks_right(found):
            log.info("way_back frame=%d doubtful_since=%d told_anew_from=%d", frame, since, first)
            self._take_back(again, found)

    def _take_back(self, before: list[Closed], found: ToldAnew) -> None:
        """What was told anew holds from now on; its corrections are to be published."""
        news = dict(zip(map(id, before), found.frames, strict=True))
        for old, new in zip(before, found.frames, strict=True):
            for i, ((step, names, z, Z), (_, told, _, _)) in enumerate(
                zip(old.log.sightings, new.log.sightings, strict=True)
            ):
                names[:] = told  # the array that `assigned` has, too
                new.log.sightings[i] = step, names, z, Z
        self._kept, self._closed, self._looked_at = (
            [news.get(id(closed), closed) for closed in frames]
            for frames in (self._kept, self._closed, self._looked_at)
        )
        count = len(self._names.signatures)
        self._names.add(list(range(count, found.known)))
        self._begun += [(number, UNKNOWN_SIGNATURE) for number in range(count, found.known)]
        self._own_map, self._associator, self._doubtful_since = found.own_map, found.associator, None
        self._to_correct |= {closed.frame: each for closed, each in zip(found.frames, found.solved, strict=True)}

    def _forget(self) -> None:
        """Readings that are not needed any more."""
        needed, first = {id(closed) for closed in (*self._closed, *self._looked_at)}, self.frame
        if self._associator is not None:
            sound = self.frame if self._doubtful_since is None else self._doubtful_since
            first = max(sound - KEPT_FRAMES, self.frame - KEPT_FRAMES_MAX)
        self._kept = [closed for closed in self._kept if closed.frame >= first or id(closed) in needed]

    def _corrections(self) -> list[FramePart]:
        """Some of what was told anew."""
        parts = []
        for frame in sorted(self._to_correct)[:CORRECTIONS_EACH]:
            parts += self._replaced(frame, *self._to_correct[frame])
        return parts

    def _note_aliases(self, before: set[tuple[int, int]]) -> None:
        """Pairs of landmarks that are one since then, or not any more."""
        now = set(self._own_map.aliases)
        self._new_aliases += [(a, b, True) for a, b in sorted(now - before)]
        self._new_aliases += [(a, b, False) for a, b in sorted(before - now)]

    def take_begun(self) -> tuple[tuple[int, int], ...]:
        """Landmarks, and their signatures, that came to be on the way back from doubt, after those of the last step."""
        taken, self._begun = tuple(self._begun), []
        return taken

    def _is_round_over(self) -> bool:
        """Whether what lies around a vehicle of a single frame is to be looked at anew."""
        associator, every = self._associator, self.settings.frame_steps_max
        return associator is not None and (self.steps % every == 0 or associator.has_left(associator.local.pose))

    def _look_around_pose(self, step: FrameDelta) -> FrameDelta:
        """Rule 8, after a step with this delta; what is published instead of it."""
        associator, limits = self._associator, self.settings.association
        assert associator is not None
        duplicates, before = associator.duplicates(), set(self._own_map.aliases)
        self._own_map.join(duplicates.pairs)
        self._note_aliases(before)
        first = np.unique(first_names(self._own_map.aliases, len(self._names.signatures)))
        try:
            step = self.filter.join(duplicates.pairs, step)
            near = around_pose(self.filter, first, limits.local_landmarks_max, associator.reach_m)
        except NumericalError as error:
            log.warning("not_looked_around step=%d reason=%s", self.steps, error)
            near = associator.around()
        associator.begin(*near)
        doubtful = duplicates.unclear > limits.unclear_max or associator.crowded() > CROWDED_MAX
        self._doubtful_since = self.frame if doubtful else None
        return step

    def take_aliases(self) -> tuple[tuple[int, int, bool], ...]:
        """Pairs of landmarks that have become one, or are not any more, since the last call: to be published."""
        taken, self._new_aliases = tuple(self._new_aliases), []
        return taken

    def _corrected(self, closed: Closed) -> list[FramePart]:
        """The correction of a frame, which is looked at again later where sightings are associated."""
        if self._associator is not None:
            self._looked_at.append(closed)
        return self._correction(closed)

    def _looked_at_again(self, closed: Closed) -> list[FramePart]:
        """Correct a frame once more, if what has been mapped since tells what some of its sightings are of."""
        try:
            local = self._own_map.around_start(closed.frame, self.settings.association.local_landmarks_max)
        except NumericalError:
            return []
        found = closed.log.recovered(self.model, closed.poses, local) if len(closed.poses) else False
        return self._correction(closed) if found else []

    def _correction(self, closed: Closed) -> list[FramePart]:
        """What the batch over a closed frame changes, to be published; nothing where it fails, or nothing moved."""
        solved = closed.solved(self.settings, self.model)
        return [] if solved is None else self._replaced(closed.frame, *solved)

    def _replaced(self, frame: int, whole: FrameDelta, end_pose: Floats) -> list[FramePart]:
        """The correction after which a frame says this, and ends there."""
        self._to_correct.pop(frame, None)
        total, change = self.totals[frame], FrameTotal()
        try:
            change.add(whole)
            change.subtract(total.delta())
        except NumericalError:
            return []
        delta = change.delta()
        total.add(delta)
        self.ends[frame] = end_pose
        if self._associator is not None:
            self._own_map.put(frame, whole)
        return [FramePart(frame=frame, status=FrameStatus.CORRECTED, delta=delta, end_pose=end_pose)]

    def end(self) -> tuple[FramePart, ...]:
        """Close the open frame and correct all that is outstanding."""
        parts: list[FramePart] = []
        if self._opened:
            frame, last = self.frame, FrameDelta.nothing()
            if self._single and self._associator is not None:
                last = self._look_around_pose(last)
            end_pose = self.filter.pose if self._single else self._close()
            parts.append(FramePart(frame=frame, status=FrameStatus.ENDED, delta=last, end_pose=end_pose))
        elif self._associator is not None and self.ends:  # the last solution is no part of the state
            with contextlib.suppress(NumericalError):
                self._own_map.around(self.settings.association.local_landmarks_max, self._associator.reach_m)
        for closed in self._closed:
            parts += self._corrected(closed)
        for closed in self._looked_at:
            parts += self._looked_at_again(closed)
        parts += self._late
        while self._to_correct:
            parts += self._corrections()
        self._kept, self._closed, self._looked_at, self._late = [], [], [], []
        self._localised = self.steps - self.settings.localise_steps
        return tuple(parts)

    def state(self) -> dict[str, Any]:
        """All that it knows, as plain values for msgpack; `restore` takes it back."""
        assigned = np.concatenate([*self._assigned, np.empty(0, np.int64)]).astype(np.int64)
        state = {
            "filter": self.filter.state(), "steps": self.steps, "opened": self._opened, "assigned": assigned.tobytes(),
            "associator": self._associator and self._associator.state(),
        }  # fmt: skip
        if self._associator is not None:
            state |= {"doubtful_since": self._doubtful_since, "own": self._own_map.state()}
        if self._has_names:
            state["signatures"] = list(self._names.signatures)
        if self._single:
            return state
        return {
            **state, "log": self._log.state(),
            "kept": [each.state() for each in self._kept],
            "closed": [each.frame for each in self._closed],
            "looked_at": [each.frame for each in self._looked_at],
            "totals": [pack_delta(total.delta()) for total in self.totals],
            "to_correct": [
                (frame, pack_delta(whole), end.tobytes()) for frame, (whole, end) in self._to_correct.items()
            ],
            "ends": np.array(self.ends).tobytes(),
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken, to the bit. Raises ValueError where it is not the state of a filter."""
        if self._has_names:
            self._names.add(list(state["signatures"]))
        self.filter.restore(state["filter"])
        self.steps, self._opened = state["steps"], state["opened"]
        self._assigned = [np.frombuffer(state["assigned"], np.int64).copy()]
        if self._associator is not None:
            self._associator.restore(state["associator"])
            self._doubtful_since = state["doubtful_since"]
            self._own_map.restore(state["own"])
        if self._single:
            return
        self._localised = self.steps - self.settings.localise_steps
        self._log = FrameLog.restored(state["log"])
        self._kept = [Closed.restored(each) for each in state["kept"]]
        by_frame = {closed.frame: closed for closed in self._kept}
        self._closed = [by_frame[frame] for frame in state["closed"]]
        self._looked_at = [by_frame[frame] for frame in state["looked_at"]]
        self._share_keys()
        self.totals = [FrameTotal() for _ in state["totals"]]
        for total, data in zip(self.totals, state["totals"], strict=True):
            total.add(read_delta(data))
        self._to_correct = {
            frame: (read_delta(whole), np.frombuffer(end).copy()) for frame, whole, end in state["to_correct"]
        }
        self.ends = list(np.frombuffer(state["ends"]).reshape(-1, 3).copy())

    def _share_keys(self) -> None:
        """What sightings are taken for is kept once: by the logs of frames and by `assigned`."""
        if self._associator is None:
            return
        (keys,), logs = self._assigned, [closed.log for closed in self._kept]
        logs.append(self._log)
        at = len(keys) - sum(len(names) for each in logs for _, names, _, _ in each.sightings)
        for each in logs:
            for i, (step, names, z, Z) in enumerate(each.sightings):
                each.sightings[i] = step, keys[at : at + len(names)], z, Z
                at += len(names)

    def published(self) -> tuple[FrameDelta, ...]:
        """The sum of all that has been published, frame by frame."""
        closed = tuple(total.delta() for total in self.totals)
        return (*closed, self.filter.published()) if self._opened else closed
