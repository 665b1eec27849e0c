"""Which frames and variables a joint system has, from call to call: numbers stay, so that what is known can be kept.

1. A frame is known by (vehicle, life, number), a pose by (vehicle, life, the frame it starts), a landmark by the first
   name of its class. A frame that comes again as the very same arrays, about the same variables, is unchanged.
2. Numbers of frames that are gone are given again, those of variables are not.
3. A life without frames whose start pose is uncertain has a frame -1 without content, which carries the prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from fleet_seif.errors import NumericalError
from fleet_seif.information import POSE, FrameDelta
from fleet_seif.joint_frames import NO_FRAME, FrameRecord, Frames, FrameTable, Placed, prepared
from fleet_seif.joint_records import Classes, Life
from fleet_seif.messages import LandmarkName
from fleet_seif.records import Floats, Ints

K = TypeVar("K")
FrameKey = tuple[str, int, int]
NOWHERE = Placed(NO_FRAME, np.empty(0, np.int64), -1, np.zeros(3), np.zeros((3, 3)))
EMPTY = FrameDelta.nothing()


class Records:
    """Frames in floating point, made once for each delta: one that comes again as the same object is known."""

    def __init__(self) -> None:
        self._kept: dict[FrameKey, tuple[FrameDelta, FrameRecord]] = {}

    def of(self, key: FrameKey, delta: FrameDelta) -> FrameRecord:
        """Raises NumericalError where the frame cannot take part in a map."""
        kept = self._kept.get(key)
        if kept is not None and kept[0] is delta:
            return kept[1]
        try:
            record = NO_FRAME if delta is EMPTY else prepared(delta)
        except NumericalError as error:
            raise NumericalError(f"frame {key[2]} of {key[0]}: {error}") from None
        self._kept[key] = delta, record
        return record

    def forget_all_but(self, keys: set[FrameKey]) -> None:
        for key in self._kept.keys() - keys:
            del self._kept[key]


@dataclass(frozen=True, eq=False)
class Change:
    """What differs from the last call, by frame number; added in canonical order (frame, vehicle, life)."""

    added: list[int]
    altered: list[int]
    removed: list[int]


@dataclass(frozen=True, eq=False)
class _Start:
    """Where a life starts. variable: -1 where the pose is given."""

    variable: int
    given: Floats
    cov: Floats

    def same_as(self, other: "_Start | None") -> bool:
        return (
            other is not None
            and self.variable == other.variable
            and np.array_equal(self.given, other.given)
            and np.array_equal(self.cov, other.cov)
        )


class Registry:
    """See the rules above. sizes: rows of each variable. keys: of each frame number, None where it is free.
    class_variables: the variable of each class that was registered last."""

    def __init__(self, records: Records) -> None:
        self.records = records
        self.table = FrameTable()
        self.frames: Frames = self.table.frames(robust=True)
        self.keys: list[FrameKey | None] = []
        self.sizes: list[int] = []
        self.class_variables = np.empty(0, np.int64)
        self.robust = True
        self._index: dict[FrameKey, int] = {}
        self._landmarks: dict[LandmarkName, int] = {}
        self._poses: dict[FrameKey, int] = {}
        self._tables: dict[tuple[str, int], Ints] = {}
        self._starts: dict[tuple[str, int], _Start] = {}

    def register(self, lives: Sequence[Life], classes: Classes) -> Change:
        """Take in what there is now. Raises NumericalError, with no frame changed, where one cannot take part."""
        tables, starts = self._tables_of(lives, classes), {(x.vehicle, x.life): self._start_of(x) for x in lives}
        fresh: dict[FrameKey, Placed] = {}
        present: set[FrameKey] = set()
        for life in lives:
            name = life.vehicle, life.life
            old, new = self._tables.get(name), tables[name]
            same_names = old is not None and len(old) <= len(new) and _agree(old, new[: len(old)])
            same_start = starts[name].same_as(self._starts.get(name))
            bare = not life.frames and starts[name].variable >= 0
            for f, delta in enumerate((EMPTY,) if bare else life.frames, start=-1 if bare else 0):
                key = (*name, f)
                present.add(key)
                number = self._index.get(key, -1)
                record = self.records.of(key, delta)
                known = number >= 0 and self.placed[number].record is record
                if not (known and same_names and (same_start or f > 0)):
                    placed = self._placed(key, delta, record, new, starts[name])
                    if not (known and (same_start or f > 0) and np.array_equal(placed.variable, self._of(number))):
                        fresh[key] = placed
        removed = [number for key, number in self._index.items() if key not in present]
        if removed:
            self.records.forget_all_but(present)
        self._tables, self._starts = tables, starts
        robust = any(len(life.frames) > 1 or starts[life.vehicle, life.life].variable >= 0 for life in lives)
        return self._commit(fresh, removed, robust)

    @property
    def placed(self) -> list[Placed]:
        """Frames by number, NOWHERE where it is free."""
        return self.table.placed

    def _of(self, number: int) -> Ints:
        return self.placed[number].variable

    def _commit(self, fresh: dict[FrameKey, Placed], removed: list[int], robust: bool) -> Change:
        for number in removed:
            key = self.keys[number]
            assert key is not None
            del self._index[key]
            self.keys[number] = None
        free = [number for number, key in enumerate(self.keys) if key is None][::-1] if fresh else []
        added, altered, ordered = [], [], sorted(fresh.items(), key=lambda item: (item[0][2], item[0]))
        for key, _ in ordered:
            number = self._index.get(key, -1)
            if number >= 0:
                altered.append(number)
            else:
                number = free.pop() if free else len(self.keys)
                if number == len(self.keys):
                    self.keys.append(None)
                added.append(number)
                self._index[key] = number
            self.keys[number] = key
        if fresh or removed or robust != self.robust:
            self.table.put(removed, [NOWHERE] * len(removed))
            self.table.put([self._index[key] for key, _ in ordered], [placed for _, placed in ordered])
            self.frames, self.robust = self.table.frames(robust=robust), robust
        return Change(added, altered, removed)

    def _placed(self, key: FrameKey, delta: FrameDelta, record: FrameRecord, table: Ints, start: _Start) -> Placed:
        """A frame with its joint variables. Raises ValueError where a landmark is in no class."""
        vehicle, life, f = key
        first, given, prior = self.pose(vehicle, life, f) if f > 0 else start.variable, np.zeros(3), np.zeros((3, 3))
        if f <= 0:
            given = start.given
            if first >= 0:
                prior = np.asarray(np.linalg.inv(start.cov))
        landmarks = table[delta.variables[delta.variables != POSE] - 1]
        if np.any(landmarks < 0):
            raise ValueError(f"frame {f} of {vehicle} has a landmark that is in no class: classes are of other lives")
        end = [self.pose(vehicle, life, f + 1)] if f >= 0 else []
        variable = np.concatenate([np.array(end, np.int64), landmarks])
        return Placed(record, variable, first, given, (prior + prior.T) / 2)

    def pose(self, vehicle: str, life: int, f: int) -> int:
        """The variable of the pose where a frame of a life starts."""
        return self._variable(self._poses, (vehicle, life, f), 3)

    def _variable(self, numbers: dict[K, int], key: K, size: int) -> int:
        number = numbers.get(key)
        if number is None:
            number = numbers[key] = len(self.sizes)
            self.sizes.append(size)
        return number

    def _start_of(self, life: Life) -> _Start:
        given = np.array(life.start_pose, np.float64)
        cov = np.array(life.start_pose_cov, np.float64)
        return _Start(self.pose(life.vehicle, life.life, 0) if np.any(cov) else -1, given, cov)

    def _tables_of(self, lives: Sequence[Life], classes: Classes) -> dict[tuple[str, int], Ints]:
        """For each life the variable of each landmark by number, -1 where it is in no class."""
        tables = {(life.vehicle, life.life): [-1] * len(life.signatures) for life in lives}
        variables = [self._variable(self._landmarks, names[0], 2) for names in classes]
        self.class_variables = np.array(variables, np.int64)
        for names, variable in zip(classes, variables, strict=True):
            for vehicle, life, number in names:
                tables[vehicle, life][number] = variable
        return {name: np.array(table, np.int64) for name, table in tables.items()}


def _agree(old: Ints, new: Ints) -> bool:
    """Whether all that were in a class are in the same one."""
    return bool(np.all((old == new) | (old < 0)))
