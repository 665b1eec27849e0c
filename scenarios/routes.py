"""Where the vehicles fly: routes steered on the truth by a planner that knows the landmarks.

1. A step moves straight ahead, then turns by at most `turn_max_rad`.
2. A pose is safe in a pen when its circle of tightest turns, to the left or to the right, lies in the pen. Staying on
   that circle keeps a safe pose safe, so a vehicle that starts safe never leaves its pen; a pen may only grow.
3. A vehicle flies towards one landmark until it sights it, then towards the least recently sighted of those it wants.
   In a narrow pen it may circle without getting there, so every goal has a deadline, after which it is given up.
4. Vehicles whose pens are more than twice the sensor's range apart cannot share a landmark. That is what keeps the
   vehicles of `meetings` strangers until the steps at which they are meant to meet.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_seif.geometry import wrap
from fleet_seif.records import Floats, Ints

Mask = NDArray[np.bool_]

NEVER = int(np.iinfo(np.int64).max)
TURNS = 17
"""Turns tried, evenly spaced, when the wished one is not safe."""
WALL_M = 1e-9
"""Kept clear of the square's walls, so that rounding cannot take a vehicle outside."""


class Pose(NamedTuple):
    """x m, y m, heading rad (not wrapped)."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True, kw_only=True)
class Craft:
    """How a vehicle flies, and the ranges between which it sights a landmark (all around)."""

    step_m: float
    turn_max_rad: float
    range_min_m: float
    range_max_m: float

    @property
    def radius_m(self) -> float:
        """Of the circle through the poses of a vehicle that always turns by `turn_max_rad`: chords of `step_m`."""
        return self.step_m / (2.0 * math.sin(self.turn_max_rad / 2.0))

    def sights(self, x: float, y: float, landmarks: Floats) -> Mask:
        """Which landmarks (m, 2) are sighted from (x, y)."""
        distance = np.hypot(landmarks[:, 0] - x, landmarks[:, 1] - y)
        return (distance >= self.range_min_m) & (distance <= self.range_max_m)


@dataclass(frozen=True, kw_only=True)
class Area:
    """A rectangle along the axes, m: a vehicle's pen, or the part of the square it looks after."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float

    def shrunk(self, by_m: float) -> "Area":
        """With every wall moved inwards; outwards if negative."""
        return Area(x_min=self.x_min + by_m, x_max=self.x_max - by_m, y_min=self.y_min + by_m, y_max=self.y_max - by_m)

    def distance(self, points: Floats) -> Floats:
        """From each point (m, 2) to the area, 0 inside, shape (m,)."""
        dx = np.maximum(np.maximum(self.x_min - points[:, 0], points[:, 0] - self.x_max), 0.0)
        dy = np.maximum(np.maximum(self.y_min - points[:, 1], points[:, 1] - self.y_max), 0.0)
        return np.hypot(dx, dy)

    def margin(self, x: float, y: float) -> float:
        """From (x, y) to the nearest wall; negative outside."""
        return min(x - self.x_min, self.x_max - x, y - self.y_min, self.y_max - y)


def to_centre(heading: float, side: int, craft: Craft) -> tuple[float, float]:
    """From a pose to the centre of its circle of tightest turns, on its left (side 1) or right (-1).

    The step ahead is a chord that subtends `turn_max_rad`, so it makes an angle of pi/2 - turn_max/2 with the radius.
    """
    angle = heading + side * (math.pi - craft.turn_max_rad) / 2.0
    return craft.radius_m * math.cos(angle), craft.radius_m * math.sin(angle)


def clearance(pose: Pose, pen: Area, craft: Craft) -> float:
    """From the better one of the pose's two circles of tightest turns to the pen's nearest wall; 0 or more is safe."""
    centres = [to_centre(pose.heading, side, craft) for side in (-1, 1)]
    return max(pen.margin(pose.x + dx, pose.y + dy) for dx, dy in centres) - craft.radius_m


def draw_start(area: Area, pen: Area, craft: Craft, rng: np.random.Generator) -> Pose:
    """A safe pose in the pen, on a circle whose centre lies in `area` (or as close to it as the pen allows)."""
    radius = craft.radius_m
    x = float(np.clip(rng.uniform(area.x_min, area.x_max), pen.x_min + radius, pen.x_max - radius))
    y = float(np.clip(rng.uniform(area.y_min, area.y_max), pen.y_min + radius, pen.y_max - radius))
    heading = float(rng.uniform(-math.pi, math.pi))
    dx, dy = to_centre(heading, int(rng.choice([-1, 1])), craft)
    return Pose(x - dx, y - dy, heading)


def fly_step(pose: Pose, goal: tuple[float, float] | None, pen: Area, craft: Craft) -> Pose:
    """One step ahead, then the safe turn that comes closest to facing the goal.

    Without a goal, or too close to it to sight it, the wish is to fly straight on.
    """
    x = pose.x + craft.step_m * math.cos(pose.heading)
    y = pose.y + craft.step_m * math.sin(pose.heading)
    wish = 0.0
    if goal is not None and math.hypot(goal[0] - x, goal[1] - y) >= craft.range_min_m:
        off = float(wrap(math.atan2(goal[1] - y, goal[0] - x) - pose.heading))
        wish = min(max(off, -craft.turn_max_rad), craft.turn_max_rad)
    wished = Pose(x, y, pose.heading + wish)
    if clearance(wished, pen, craft) >= 0.0:
        return wished
    turns = np.linspace(-craft.turn_max_rad, craft.turn_max_rad, TURNS).tolist()
    poses = [Pose(x, y, pose.heading + turn) for turn in sorted(turns, key=lambda turn: abs(turn - wish))]
    # Staying on the circle is safe but for rounding: hence the roomiest pose, should none be safe to the last bit.
    return next(
        (p for p in poses if clearance(p, pen, craft) >= 0.0), max(poses, key=lambda p: clearance(p, pen, craft))
    )


class Walker:
    """One vehicle on its way: its poses so far, and what it sighted from them.

    poses: pose k is where step k ended. first_seen (m,): step of the first sighting of a landmark, NEVER if none.
    """

    def __init__(self, craft: Craft, landmarks: Floats, start: Pose) -> None:
        self.craft = craft
        self.landmarks = landmarks
        self.poses = [start]
        self.first_seen: Ints = np.full(len(landmarks), NEVER, np.int64)
        # When each landmark was last sighted or given up as a goal, -1 never.
        self._tended: Ints = np.full(len(landmarks), -1, np.int64)
        self._goal: int | None = None
        self._deadline = 0
        self._look()

    @property
    def step(self) -> int:
        return len(self.poses) - 1

    def fly(self, pen: Area, wanted: Mask, until: int) -> None:
        """Visit the wanted landmarks, the least recently sighted and then the nearest first, until step `until`."""
        self._goal = None
        while self.step < until:
            if self._goal is None and wanted.any():
                self._choose_goal(wanted)
            goal = None if self._goal is None else self.landmarks[self._goal].tolist()
            self.poses.append(fly_step(self.poses[-1], goal, pen, self.craft))
            self._look()

    def _look(self) -> None:
        pose = self.poses[-1]
        seen = self.craft.sights(pose.x, pose.y, self.landmarks)
        self._tended[seen] = self.step
        np.minimum(self.first_seen, self.step, out=self.first_seen, where=seen)
        if self._goal is not None and (seen[self._goal] or self.step >= self._deadline):
            self._tended[self._goal] = self.step
            self._goal = None

    def _choose_goal(self, wanted: Mask) -> None:
        """The deadline leaves time for one full turn and twice the way."""
        oldest = np.flatnonzero(wanted & (self._tended == self._tended[wanted].min()))
        pose = self.poses[-1]
        distance = np.hypot(self.landmarks[oldest, 0] - pose.x, self.landmarks[oldest, 1] - pose.y)
        nearest = int(np.argmin(distance))
        path_m = 2.0 * math.pi * self.craft.radius_m + 2.0 * float(distance[nearest])
        self._goal = int(oldest[nearest])
        self._deadline = self.step + math.ceil(path_m / self.craft.step_m)


def first_shared_step(first_seen_a: Ints, first_seen_b: Ints) -> int:
    """The first step by which two vehicles have sighted a landmark in common, NEVER if they have not."""
    return int(np.maximum(first_seen_a, first_seen_b).min())


def as_routes(walkers: Iterable[Walker]) -> Floats:
    """Shape (vehicles, steps + 1, 3)."""
    return np.array([walker.poses for walker in walkers])


# Coverage: every vehicle for itself.


def grid(side_m: float, count: int) -> list[Area]:
    """The square cut into `count` parts of the same size: rows, and every row into columns."""
    rows = np.array_split(np.arange(count), round(math.sqrt(count)))
    parts, y_min = [], 0.0
    for row in rows:
        y_max = y_min + side_m * len(row) / count
        width = side_m / len(row)
        parts += [Area(x_min=c * width, x_max=(c + 1) * width, y_min=y_min, y_max=y_max) for c in range(len(row))]
        y_min = y_max
    return parts


def roam(walker: Walker, part: Area, square: Area, until: int) -> None:
    """Keep visiting the landmarks of one's part, and of its neighbours as far in as the sensor reaches."""
    walker.fly(square, part.distance(walker.landmarks) <= walker.craft.range_max_m, until)


def coverage_routes(
    craft: Craft, landmarks: Floats, side_m: float, steps: int, count: int, rng: np.random.Generator
) -> Floats:
    """Routes (count, steps + 1, 3): each vehicle tours its own part of the square and the neighbours' margins."""
    square = Area(x_min=0.0, x_max=side_m, y_min=0.0, y_max=side_m).shrunk(WALL_M)
    walkers = []
    for part in grid(side_m, count):
        walkers.append(Walker(craft, landmarks, draw_start(part, square, craft, rng)))
        roam(walkers[-1], part, square, steps)
    return as_routes(walkers)
