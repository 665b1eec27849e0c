"""Small worlds for tests: a vehicle that drives circles among landmarks, and the messages it publishes."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.information import FrameDelta, FrameTotal
from fleet_seif.messages import Epoch
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats, Reading, Sightings
from fleet_seif.store import Store
from tests import reference
from vehicles.core import Identity, VehicleCore

ODOMETRY_STD = np.array([0.005, 0.002, 0.005])
SIGHTING_STD = np.array([0.01, 0.02])
FLEET = "test"
VEHICLES = ("ann", "bob", "cem")


@dataclass(frozen=True, eq=False)
class Drive:
    """What a vehicle reads, and the truth. start_pose is in the world, truth (T+1, 3) too."""

    start_pose: Floats
    start: Sightings
    readings: tuple[Reading, ...]
    truth: Floats


def signature_of(landmark: int) -> int:
    """Signatures are not numbers: a mix-up of both shows."""
    return 9000 - 7 * landmark


def landmark_of(signature: int) -> int:
    return (9000 - signature) // 7


def square(count: int, side_m: float, seed: int) -> Floats:
    """Landmarks in a square around the origin."""
    return np.random.default_rng(seed).uniform(-side_m / 2, side_m / 2, (count, 2))


def drive(
    landmarks: Floats,
    *,
    steps: int,
    seed: int,
    model: int = RANGE_BEARING,
    start_pose: tuple[float, float, float] = (0.0, -1.0, 0.0),
    range_m: float = 1.5,
    most: int = 5,
) -> Drive:
    """Circles of radius 1 m to the left in steps of 0.1 m; at most `most` landmarks are seen from a pose, in turn."""
    rng = np.random.default_rng(seed)
    pose = np.array(start_pose)
    truth = [pose]
    readings = []
    start = _look(model, pose, landmarks, range_m, most, 0, rng)
    for k in range(1, steps + 1):
        u = np.array([0.1, 0.0, 0.1])
        if model == COMPASS_XY:
            u = np.append(reference.rotation(0.1 * k) @ u[:2], 0.1)
        pose = reference.moved(model, pose, u)
        truth.append(pose)
        readings.append(
            Reading(
                time_s=0.1 * k,
                odometry=u + ODOMETRY_STD * rng.standard_normal(3),
                odometry_cov=np.diag(ODOMETRY_STD**2),
                sightings=_look(model, pose, landmarks, range_m, most, k, rng),
            )
        )
    return Drive(np.array(start_pose), start, tuple(readings), np.array(truth))


def _look(
    model: int, pose: Floats, landmarks: Floats, range_m: float, most: int, turn: int, rng: np.random.Generator
) -> Sightings:
    distance = np.hypot(*(landmarks - pose[:2]).T)
    near = np.flatnonzero((distance > 0.1) & (distance < range_m))
    near = np.sort(np.roll(near, -turn)[:most])
    z = np.array([reference.expected(model, pose, landmarks[i]) for i in near]).reshape(-1, 2)
    z = z + SIGHTING_STD * rng.standard_normal(z.shape)
    cov = np.tile(np.diag(SIGHTING_STD**2), (len(z), 1, 1))
    return Sightings(z=z, cov=cov, signature=np.array([signature_of(i) for i in near.tolist()], np.int64))


def sighting(z: tuple[float, float], signature: int, std: tuple[float, float] = (0.01, 0.02)) -> Sightings:
    """A single sighting."""
    return Sightings(z=np.array([z]), cov=np.diag(np.square(std))[None], signature=np.array([signature]))


def reading(time_s: float, sightings: Sightings, u: tuple[float, float, float] = (0.1, 0.0, 0.1)) -> Reading:
    return Reading(time_s=time_s, odometry=np.array(u), odometry_cov=np.diag(ODOMETRY_STD**2), sightings=sightings)


def core_of(
    vehicle: str,
    start_pose: Floats,
    fleet: str = FLEET,
    model: int = RANGE_BEARING,
    frames: Literal["single", "adaptive"] = "adaptive",
) -> VehicleCore:
    identity = Identity(
        fleet=fleet, vehicle=vehicle, epoch=Epoch(1, 77), start_pose=start_pose, start_pose_cov=np.zeros((3, 3))
    )
    return VehicleCore(identity, FilterSettings(active_max=4, frames=frames), PublishSettings(window=10_000), model)


def commit(core: VehicleCore, store: Store | None = None) -> None:
    """What a vehicle does before it puts anything."""
    changes, mark = core.take_changes()
    if store is not None:
        store.commit(changes)
    core.note_commit(mark)


def put(core: VehicleCore, store: Store | None = None) -> list[bytes]:
    """Everything that a vehicle has to put now."""
    commit(core, store)
    return core.release()


@cache
def streams(steps: int = 12) -> dict[str, tuple[bytes, ...]]:
    """What three vehicles publish that drive among the same landmarks: hello, one message a step, the end."""
    landmarks = square(15, 5.0, 3)
    published = {}
    for i, vehicle in enumerate(VEHICLES):
        heading = 2.0 * math.pi * i / len(VEHICLES)
        log = drive(landmarks, steps=steps, seed=10 + i, start_pose=(math.sin(heading), -math.cos(heading), heading))
        core = core_of(vehicle, log.start_pose)
        core.start(0.0, log.start)
        for each in log.readings:
            core.step(each)
        core.end()
        published[vehicle] = tuple(put(core))
    return published


def sum_deltas(deltas: list[FrameDelta]) -> FrameDelta:
    """One delta with the effect of all."""
    total = FrameTotal()
    for delta in deltas:
        total.add(delta)
    return total.delta()
