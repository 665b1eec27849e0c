"""How well a filter did: its map against the truth, and what it claims to know against its errors.

1. A candidate is driven through a world; the same candidate and world give the same outcome, but for times.
2. One outcome is one line of a CSV: what was run, then what was measured.

Symbols: x (3,) pose, y (n, 2) landmarks, both in the filter's frame, m and rad; P their joint covariance, pose first.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Generic, TypeVar

import numpy as np
import scipy.linalg

from fleet_seif.config import FilterSettings
from fleet_seif.ekf import Ekf
from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.filters import Filter
from fleet_seif.jit import one_thread
from fleet_seif.records import Floats, Ints, Sightings
from fleet_seif.seif import Seif
from scenarios.experiments.study import Progress
from scenarios.experiments.worlds import World
from scenarios.score import align

GATE_OFF: Final = 1e12
"""A squared innovation that nothing reaches. The paper has no gate, and with its noise a gate would hide divergence."""
ONE_FRAME: Final = FilterSettings(gate=GATE_OFF, frames="single")
"""What all candidates have in common: the paper's filters, in one frame."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A filter to be compared. label: in figures and CSV. dense: the EKF, which needs no more than the gate."""

    label: str
    settings: FilterSettings
    dense: bool = False

    def filter(self, model: int) -> Filter:
        return Ekf(self.settings, model) if self.dense else Seif(self.settings, model)


EKF: Final = Candidate(label="EKF", settings=ONE_FRAME, dense=True)
EIF: Final = Candidate(label="EIF", settings=FilterSettings(gate=GATE_OFF, frames="single", kind="eif"))


F = TypeVar("F", bound=Filter)


def seif(active_max: int, label: str = "", **changes: object) -> Candidate:
    """A SEIF by label "SEIF 6", or the label given; changes: of its other settings."""
    settings = FilterSettings.model_validate({**ONE_FRAME.model_dump(), "active_max": active_max, **changes})
    return Candidate(label=label or f"SEIF {active_max}", settings=settings)


@dataclass(frozen=True, eq=False, kw_only=True)
class Drive(Generic[F]):
    """A filter that has been through a world.

    step_us (T,): time of each step; active (T,): landmarks linked to the pose after it; refused: steps whose sightings
    were left out.
    """

    filter: F
    world: World
    step_us: Floats
    active: Ints
    refused: int

    @property
    def truth(self) -> Floats:
        """True landmarks in the filter's order, (n, 2) m."""
        return self.world.landmarks[self.filter.signatures]


def drive(made: F, world: World) -> Drive[F]:
    """Take a new filter, made for the world's model, through all readings.

    A reading that the filter refuses (a sighting too close to tell anything finite) is given again without sightings.
    """
    made.start(world.log.sightings_at(0))
    step_us, active, refused = np.empty(world.log.steps), np.empty(world.log.steps, np.int64), 0
    for k, reading in enumerate(world.log.readings()):
        begin = time.perf_counter_ns()
        try:
            result = made.step(reading)
        except (ReadingRefused, NumericalError):
            result = made.step(replace(reading, sightings=Sightings.none()))
            refused += 1
        step_us[k] = (time.perf_counter_ns() - begin) * 1e-3
        active[k] = result.active
    return Drive(filter=made, world=world, step_us=step_us, active=active, refused=refused)


def relative_map(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """The landmarks as the vehicle sees them, q = R(theta)' (y - t), and the Jacobian.

    Args:
        x: pose (t, theta), shape (3,). y: landmarks, shape (n, 2).

    Returns:
        q, shape (n, 2), m; J_q_xy, shape (2 n, 3 + 2 n): -R', R' and dq/dtheta = (q_y, -q_x).
    """
    c, s = math.cos(x[2]), math.sin(x[2])
    R_t = np.array([[c, s], [-s, c]])
    q = (y - x[:2]) @ R_t.T
    J = np.zeros((2 * len(y), 3 + 2 * len(y)))
    J[:, :2] = np.tile(-R_t, (len(y), 1))
    J[0::2, 2], J[1::2, 2] = q[:, 1], -q[:, 0]
    J[:, 3:] = np.kron(np.eye(len(y)), R_t)
    return q, J


def nees_per_dof(error: Floats, P: Floats) -> float:
    """d' P^-1 d / k of the error d (any shape, k entries) with covariance P (k, k): 1 on average if P is right.

    Raises NumericalError where P is not positive definite.
    """
    d = error.ravel()
    return float(d @ scipy.linalg.cho_solve((_cholesky(P), True), d)) / len(d)


def log_det(P: Floats) -> float:
    """log det P by Cholesky. Raises NumericalError where P is not positive definite."""
    return 2.0 * float(np.sum(np.log(np.diag(_cholesky(P)))))


def _cholesky(P: Floats) -> Floats:
    try:
        return np.asarray(scipy.linalg.cholesky(P, lower=True))
    except np.linalg.LinAlgError:
        raise NumericalError(f"a covariance of {len(P)} rows is not positive definite") from None


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One filter in one world: which, and how it did. For the EKF and the EIF active_max and soften say nothing.

    landmarks: of the world; seen: those on the map, on which the rest is measured.
    over_bound: part of the steps after which more than active_max landmarks were linked to the pose.
    error_m: see `map_error_m`; aligned_m: the same after the rotation and translation that fit best.
    log_det: of the joint covariance of all landmarks, the pose marginalised out, m^2 each.
    nees_global: of all landmarks jointly, per degree of freedom, in the frame of the start; nees_relative: in the
    vehicle's own coordinates, where an error that moves pose and map together is none.
    """

    world: str
    seed: int
    landmarks: int
    seen: int
    steps: int
    filter: str
    active_max: int
    mean: str
    strength: str
    soften: float
    error_m: float
    aligned_m: float
    log_det: float
    nees_global: float
    nees_relative: float
    over_bound: float
    refused: int
    step_us_median: float
    step_us_p99: float


def outcome(candidate: Candidate, drive: Drive[Filter]) -> Outcome:
    """Raises NumericalError where the filter's covariance is not positive definite."""
    y, settings = drive.filter.landmarks, candidate.settings
    P = drive.filter.covariance_of(range(len(y)))
    q, J = relative_map(drive.filter.pose, y)
    true_q, _ = relative_map(drive.world.poses[-1], drive.truth)
    return Outcome(
        world=drive.world.name,
        seed=drive.world.seed,
        landmarks=len(drive.world.landmarks),
        seen=len(y),
        steps=len(drive.step_us),
        filter=candidate.label,
        active_max=settings.active_max,
        mean=settings.mean,
        strength=settings.strength,
        soften=settings.soften,
        error_m=_mean_distance(y, drive.truth),
        aligned_m=_mean_distance(align(y, drive.truth), drive.truth),
        log_det=log_det(P[3:, 3:]),
        nees_global=nees_per_dof(y - drive.truth, P[3:, 3:]),
        nees_relative=nees_per_dof(q - true_q, J @ P @ J.T),
        over_bound=float(np.mean(drive.active > settings.active_max)),
        refused=drive.refused,
        step_us_median=float(np.median(drive.step_us)),
        step_us_p99=float(np.percentile(drive.step_us, 99)),
    )


def map_error_m(drive: Drive[F]) -> float:
    """The paper's absolute error: mean distance of a landmark from the true one, in the frame of the true start, m."""
    return _mean_distance(drive.filter.landmarks, drive.truth)


def _mean_distance(points: Floats, truth: Floats) -> float:
    return float(np.mean(np.hypot(*(points - truth).T)))


@one_thread
def compare(
    candidates: Sequence[Candidate], worlds: Sequence[Callable[[], World]], progress: Progress
) -> list[Outcome]:
    """Every candidate through every world, which is made when its turn comes; single-threaded: times compare."""
    done, total = 0, len(candidates) * len(worlds)
    outcomes = []
    for make in worlds:
        world = make()
        for candidate in candidates:
            outcomes.append(outcome(candidate, drive(candidate.filter(world.model), world)))
            done += 1
            progress(done, total)
    return outcomes
