"""The simulated world of Thrun et al. (IJRR 2004), section 5.4: air vehicles over a square of point landmarks.

A step moves a vehicle straight ahead and then turns it. Its odometry is that increment with normal noise; from every
pose it sights each landmark between two ranges, all around, as range and bearing with normal noise. Streams of random
numbers are kept apart (landmarks, routes, each vehicle's noise), so that a change of one leaves the others alone.

What vehicles are shown beside the landmarks, and what they are not shown, is in `detection`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fleet_seif.config import NotNegative, Positive, Settings
from fleet_seif.geometry import wrap
from fleet_seif.records import Floats, Ints
from scenarios.meetings import meeting_routes
from scenarios.recording import Log, Recording
from scenarios.routes import WALL_M, Craft, coverage_routes

LANDMARKS_PER_M2 = 50.0
"""Of the paper's world; fixes the side of a square whose side is not given."""
DARTS_MAX = 2000
"""Places tried for one landmark before the square counts as full."""
RANGE_FLOOR_M = 1e-3
"""A noisy range at or below it is drawn again: no sensor reports a landmark behind itself."""


STREAM_LANDMARKS, STREAM_ROUTES, STREAM_NOISE, STREAM_TWINS = 0, 1, 2, 4
"""First part of the keys of random streams; 3 is the compass world's, from 5 on they are those of `detection`."""


class WorldSettings(Settings):
    """The square, its landmarks, and how the vehicles fly over it.

    side_m: None for the paper's density of landmarks. min_distance_m: between any two landmarks.
    layout: "random", or "grid" for rows and columns at one distance, which look the same from everywhere.
    close_pairs: so many of the landmarks stand within close_pair_m of another one, whatever min_distance_m says.
    step_s: the vehicle's own time from pose to pose. turn_max_rad: most that the heading changes in a step.
    range_min_m, range_max_m: a landmark in between is sighted.
    routes: "meetings" for three vehicles that first share landmarks at set steps, "coverage" for any number.
    """

    landmarks: Annotated[int, Field(ge=1, le=100_000)] = 50
    side_m: Positive | None = None
    min_distance_m: NotNegative = 0.05
    layout: Literal["random", "grid"] = "random"
    close_pairs: Annotated[int, Field(ge=0)] = 0
    close_pair_m: Positive = 0.02
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 500
    step_m: Positive = 0.05
    step_s: Positive = 0.1
    range_min_m: Annotated[float, Field(ge=RANGE_FLOOR_M, allow_inf_nan=False)] = 0.06
    range_max_m: Positive = 0.2
    turn_max_rad: Annotated[float, Field(gt=0, le=math.pi / 2)] = 0.6
    routes: Literal["meetings", "coverage"] = "meetings"

    @property
    def square_side_m(self) -> float:
        return math.sqrt(self.landmarks / LANDMARKS_PER_M2) if self.side_m is None else self.side_m

    @property
    def craft(self) -> Craft:
        return Craft(
            step_m=self.step_m,
            turn_max_rad=self.turn_max_rad,
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
        )

    @model_validator(mode="after")
    def _landmarks_can_be_placed(self) -> Self:
        if 2 * self.close_pairs > self.landmarks:
            raise ValueError(f"{self.landmarks} landmarks have at most {self.landmarks // 2} close_pairs")
        if self.layout == "grid":
            rows = math.isqrt(self.landmarks)
            if rows**2 != self.landmarks:
                raise ValueError(f"a grid has {rows**2} or {(rows + 1) ** 2} landmarks, not {self.landmarks}")
            if self.close_pairs:
                raise ValueError('a grid has no close_pairs; remedy: layout = "random"')
        return self

    @model_validator(mode="after")
    def _vehicles_can_turn_and_see(self) -> Self:
        if self.range_min_m >= self.range_max_m:
            raise ValueError(f"range_min_m {self.range_min_m} must be below range_max_m {self.range_max_m}")
        circle_m = 2.0 * self.craft.radius_m
        # Else a vehicle could circle for ever round a landmark that it cannot see.
        if circle_m > self.range_max_m:
            raise ValueError(
                f"the tightest circle is {circle_m:.3f} m across, wider than range_max_m {self.range_max_m}; "
                "remedy: a smaller step_m or a larger turn_max_rad"
            )
        side_m = self.square_side_m
        if circle_m + 2.0 * WALL_M >= side_m:
            raise ValueError(
                f"the tightest circle is {circle_m:.3f} m across and does not fit a side of {side_m:.3f} m; "
                "remedy: a larger side_m, a smaller step_m or a larger turn_max_rad"
            )
        return self


class NoiseSettings(Settings):
    """Standard deviations of the noise, per step and per sighting.

    sideways_std_m: the paper's vehicle does not slip; this floor keeps the covariance positive definite.
    """

    forward_std_m: Positive = 0.01
    sideways_std_m: Positive = 1e-4
    turn_std_rad: Positive = 0.1
    range_std_m: Positive = math.sqrt(0.002)
    bearing_std_rad: Positive = math.sqrt(0.003)


def stream(seed: int, *key: int) -> np.random.Generator:
    """The random numbers of one purpose, apart from those of all others."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def place_landmarks(world: WorldSettings, seed: int) -> Floats:
    """Landmarks (m, 2) of the layout; the second ones of close pairs are the last. Raises ValueError: no room."""
    side_m, count, alone = world.square_side_m, world.landmarks, world.landmarks - world.close_pairs
    if world.layout == "grid":
        rows = math.isqrt(count)
        if side_m / rows < world.min_distance_m:
            raise _no_room(world, count)
        at = (np.arange(rows) + 0.5) * (side_m / rows)
        return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    placed = np.empty((count, 2))
    rng = stream(seed, STREAM_LANDMARKS)
    for i in range(alone):
        placed[i] = _dart(world, i, placed[:i], lambda: rng.uniform(0.0, side_m, 2))
    twins = stream(seed, STREAM_TWINS)
    for i, first in zip(range(alone, count), twins.permutation(alone).tolist(), strict=False):
        others = np.delete(placed[:i], first, axis=0)
        placed[i] = _dart(world, i, others, lambda first=first: placed[first] + _in_disc(world.close_pair_m, twins))  # type: ignore[misc]
    return placed


def _dart(world: WorldSettings, number: int, others: Floats, draw: Callable[[], Floats]) -> Floats:
    """A place for a landmark, drawn again while it is too close to the others, or not in the square."""
    for _ in range(DARTS_MAX):
        dart = draw()
        inside = dart.min() >= 0.0 and dart.max() <= world.square_side_m
        if inside and np.all(np.sum((others - dart) ** 2, axis=1) >= world.min_distance_m**2):
            return dart
    raise _no_room(world, number + 1)


def _no_room(world: WorldSettings, number: int) -> ValueError:
    return ValueError(
        f"no room for landmark {number} of {world.landmarks}, {world.min_distance_m} m from the others, "
        f"in a square of side {world.square_side_m:.3f} m; remedy: fewer landmarks, a larger side_m or a "
        "smaller min_distance_m"
    )


def _in_disc(radius_m: float, rng: np.random.Generator) -> Floats:
    """Uniform, shape (2,)."""
    distance, angle = radius_m * math.sqrt(rng.uniform()), rng.uniform(-math.pi, math.pi)
    return np.array([distance * math.cos(angle), distance * math.sin(angle)])


def plan_routes(world: WorldSettings, landmarks: Floats, count: int, rng: np.random.Generator) -> Floats:
    """True poses (count, T+1, 3) of as many vehicles, headings not wrapped."""
    if world.routes == "coverage":
        return coverage_routes(world.craft, landmarks, world.square_side_m, world.steps, count, rng)
    if count != 3:
        raise ValueError(f"meetings are for 3 vehicles, got {count}; remedy: coverage routes")
    return meeting_routes(world.craft, landmarks, world.square_side_m, world.steps, rng)


def noisy_odometry(truth: Floats, world: WorldSettings, stds: Floats, rng: np.random.Generator) -> Floats:
    """Increments (T, 3) from pose to pose of truth (T+1, 3), each (step_m, 0, turn) plus noise of stds (3,)."""
    increments = np.zeros((len(truth) - 1, 3))
    increments[:, 0] = world.step_m
    increments[:, 2] = np.diff(truth[:, 2])
    return increments + stds * rng.standard_normal(increments.shape)


def sighted_pairs(truth: Floats, landmarks: Floats, craft: Craft) -> tuple[Ints, Ints]:
    """Step and landmark of every sighting, each (S,), ordered by step, then landmark."""
    seen = [np.flatnonzero(craft.sights(x, y, landmarks)) for x, y, _ in truth.tolist()]
    steps = np.repeat(np.arange(len(truth)), [len(indices) for indices in seen])
    return steps, np.concatenate(seen)


def noisy_sightings(poses: Floats, landmarks: Floats, noise: NoiseSettings, rng: np.random.Generator) -> Floats:
    """Range m and bearing rad, shape (S, 2), of landmark i (S, 2) from pose i (S, 3)."""
    offset = landmarks - poses[:, :2]
    true_range = np.hypot(offset[:, 0], offset[:, 1])
    range_m = rng.normal(true_range, noise.range_std_m)
    # True ranges are above the floor, so at least every other draw is: this ends.
    while np.any(behind := range_m <= RANGE_FLOOR_M):
        range_m[behind] = rng.normal(true_range[behind], noise.range_std_m)
    bearing = np.arctan2(offset[:, 1], offset[:, 0]) - poses[:, 2]
    bearing += noise.bearing_std_rad * rng.standard_normal(len(bearing))
    return np.column_stack([range_m, [wrap(angle) for angle in bearing.tolist()]])


def record(
    vehicle: str,
    truth: Floats,
    landmarks: Floats,
    world: WorldSettings,
    noise: NoiseSettings,
    rng: np.random.Generator,
) -> Log:
    """What a vehicle reads along its true poses (T+1, 3)."""
    odometry_std = np.array([noise.forward_std_m, noise.sideways_std_m, noise.turn_std_rad])
    sighting_std = np.array([noise.range_std_m, noise.bearing_std_rad])
    step, landmark = sighted_pairs(truth, landmarks, world.craft)
    return Log(
        vehicle=vehicle,
        time_s=world.step_s * np.arange(len(truth), dtype=np.float64),
        odometry=noisy_odometry(truth, world, odometry_std, rng),
        odometry_cov=np.tile(np.diag(odometry_std**2), (len(truth) - 1, 1, 1)),
        sighting_step=step,
        sighting_z=noisy_sightings(truth[step], landmarks[landmark], noise, rng),
        sighting_cov=np.tile(np.diag(sighting_std**2), (len(step), 1, 1)),
        sighting_signature=landmark,
        sighting_truth=landmark.copy(),
        start_pose=truth[0].copy(),
        start_pose_cov=np.zeros((3, 3)),
        truth_pose=truth,
    )


def simulate(world: WorldSettings, noise: NoiseSettings, vehicles: Sequence[str], seed: int) -> Recording:
    """One run of the named vehicles, the same for the same arguments.

    Raises ValueError for names that are missing or not unique, and when the landmarks or the routes do not fit.
    """
    if not vehicles or len(set(vehicles)) != len(vehicles):
        raise ValueError(f"vehicles need unique names, at least one; got {list(vehicles)}")
    landmarks = place_landmarks(world, seed)
    routes = plan_routes(world, landmarks, len(vehicles), stream(seed, STREAM_ROUTES))
    logs = {
        vehicle: record(vehicle, routes[i], landmarks, world, noise, stream(seed, STREAM_NOISE, i))
        for i, vehicle in enumerate(vehicles)
    }
    return Recording(landmarks=landmarks, logs=logs, skipped={})
