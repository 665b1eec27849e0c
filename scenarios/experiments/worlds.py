"""The worlds of the experiments: one vehicle, one frame (`frames = "single"`) that starts at its true first pose.

The paper's world has N landmarks in a square of side sqrt(N / 50) m, at least 0.05 m apart, a sensor that
reaches from 0.06 m to 0.2 m, and 20 N steps. Routes are those of `scenarios.routes` for coverage. Signatures
are the numbers of the true landmarks.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fleet_seif.geometry import act_all, between, inverse
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats
from scenarios.recording import Log
from scenarios.world import NoiseSettings, WorldSettings, simulate

STEPS_PER_LANDMARK: Final = 20
VEHICLE: Final = "v1"
PAPER_NOISE: Final = NoiseSettings()
"""Variances 1e-4 m^2, 1e-2 rad^2, 0.002 m^2, 0.003 rad^2, as in three_air_vehicles."""
MILD_NOISE: Final = NoiseSettings(forward_std_m=0.005, turn_std_rad=0.03, range_std_m=0.01, bearing_std_rad=0.02)
"""As in three_air_vehicles_mild: headings stay known so well that linearisation hardly matters."""
PAPER_WORLD, MILD_WORLD, COMPASS = "the paper's noise", "mild noise", "compass"
"""Names of worlds; the last is linear."""
COMPASS_STREAM: Final = 3
"""Random numbers of the compass world; `scenarios.world` and `scenarios.detection` use the others up to 9."""


@dataclass(frozen=True, eq=False, kw_only=True)
class World:
    """What one vehicle reads, and the truth in its frame.

    name: of the noise or the model; seed: it was made from; model: of fleet_seif.models; log: the readings;
    landmarks (N, 2), m; poses (T+1, 3), m and rad, from (0, 0, 0).
    """

    name: str
    seed: int
    model: int
    log: Log
    landmarks: Floats
    poses: Floats


def paper_world(landmarks: int, seed: int, *, mild: bool = False, steps: int | None = None) -> World:
    """The paper's world, with its own noise or a mild one; 20 steps a landmark where `steps` is not given."""
    settings = WorldSettings(
        landmarks=landmarks, steps=STEPS_PER_LANDMARK * landmarks if steps is None else steps, routes="coverage"
    )
    recording = simulate(settings, MILD_NOISE if mild else PAPER_NOISE, [VEHICLE], seed)
    log = recording.logs[VEHICLE]
    return World(
        name=MILD_WORLD if mild else PAPER_WORLD,
        seed=seed,
        model=RANGE_BEARING,
        log=log,
        landmarks=act_all(inverse(log.start_pose), recording.landmarks),
        poses=np.array([between(log.start_pose, pose) for pose in log.truth_pose]),
    )


def compass_world(landmarks: int, seed: int, start_information: float, *, steps: int | None = None) -> World:
    """The same landmarks, route and sighted pairs, read with a compass: linear and Gaussian, so a filter can be exact.

    u = x' - x + noise, z = y - x + noise, all along the axes of the frame; the paper's forward and turn noise, and its
    range noise in both directions. The first pose is drawn from what filters assume of it, N(0, I / start_information),
    so that the errors of an exact filter have its covariance.
    """
    noise, flat = PAPER_NOISE, paper_world(landmarks, seed, steps=steps)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(COMPASS_STREAM,)))
    poses = flat.poses + rng.standard_normal(3) / math.sqrt(start_information)
    odometry, odometry_std = np.diff(poses, axis=0), np.array([noise.forward_std_m] * 2 + [noise.turn_std_rad])
    seen = flat.landmarks[flat.log.sighting_truth] - poses[flat.log.sighting_step, :2]
    log = replace(
        flat.log,
        odometry=odometry + odometry_std * rng.standard_normal(odometry.shape),
        odometry_cov=np.tile(np.diag(odometry_std**2), (len(odometry), 1, 1)),
        sighting_z=seen + noise.range_std_m * rng.standard_normal(seen.shape),
        sighting_cov=np.tile(noise.range_std_m**2 * np.eye(2), (len(seen), 1, 1)),
    )
    return World(name=COMPASS, seed=seed, model=COMPASS_XY, log=log, landmarks=flat.landmarks, poses=poses)
