"""From the ledger to a served map."""

from dataclasses import dataclass

import numpy as np

from fleet_seif.config import FusionSettings
from fleet_seif.errors import NumericalError
from fleet_seif.joint import Life, landmark_classes, marginal_covariances, solve
from fleet_seif.messages import JointMap, VehicleState
from fusion.core import FusionCore
from fusion.ledger import Ledger


@dataclass(frozen=True, eq=False, kw_only=True)
class MapInput:
    """A copy of all that a map is made from."""

    fleet: str
    lives: tuple[Life, ...]
    map_digest: bytes
    ledger_digest: bytes
    vehicles: tuple[VehicleState, ...]
    counters: dict[str, int]


def lives_of(ledger: Ledger) -> tuple[Life, ...]:
    """What the placed and healthy lives have contributed, in canonical order."""
    return tuple(
        Life(
            vehicle=stream.vehicle,
            life=stream.life,
            start_pose=stream.hello.start_pose,
            start_pose_cov=stream.hello.start_pose_cov,
            frames=tuple(stream.frames[f].total.delta() for f in sorted(stream.frames)),
            signatures=tuple(stream.signatures),
        )
        for stream in ledger.placed()
        if stream.hello is not None
    )


def map_input(core: FusionCore, now_s: float) -> MapInput:
    """Copy what a map is made from; the caller keeps others off the core meanwhile."""
    return MapInput(
        fleet=core.ledger.fleet,
        lives=lives_of(core.ledger),
        map_digest=core.ledger.map_digest(),
        ledger_digest=core.ledger.ledger_digest(),
        vehicles=core.states(now_s),
        counters=dict(core.counters),
    )


def make_map(taken: MapInput, version: int, settings: FusionSettings, *, final: bool) -> JointMap:
    """Solve. With frames = "single" every map is a canonical one: assembled from nothing, in canonical order."""
    lives = taken.lives
    counters = dict(taken.counters)
    try:
        solution = solve(lives, landmark_classes(lives))
    except NumericalError:
        lives = tuple(life for life in lives if can_be_solved(life))  # one bad vehicle must not stop the map of all
        counters["lives_left_out"] = len(taken.lives) - len(lives)
        solution = solve(lives, landmark_classes(lives))
    classes = solution.classes
    newest = [i for i, (_, _, k) in enumerate(solution.poses) if k < 0]
    with_cov = final or len(classes) <= settings.covariance_landmarks_max
    if with_cov:
        landmark_cov, pose_cov = marginal_covariances(solution)
    return JointMap(
        fleet=taken.fleet,
        version=version,
        canonical=True,
        final=final,
        map_digest=taken.map_digest,
        ledger_digest=taken.ledger_digest,
        landmark_mean=solution.landmark_mean,
        landmark_cov=landmark_cov if with_cov else np.empty((0, 2, 2)),
        cov_version=version if with_cov else -1,
        names=classes,
        signature=solution.signatures,
        poses=tuple(solution.poses[i][0] for i in newest),
        pose_mean=solution.pose_mean[newest],
        pose_cov=pose_cov[newest] if with_cov else np.empty((0, 3, 3)),
        vehicles=taken.vehicles,
        counters=counters,
    )


def can_be_solved(life: Life) -> bool:
    """Whether what a life has contributed is a map on its own."""
    try:
        solve([life], landmark_classes([life]))
    except NumericalError:
        return False
    return True


def empty_map(fleet: str, version: int = -1) -> JointMap:
    """The map before anything is known."""
    return JointMap(
        fleet=fleet, version=version, canonical=True, final=False, map_digest=bytes(32), ledger_digest=bytes(32),
        landmark_mean=np.empty((0, 2)), landmark_cov=np.empty((0, 2, 2)), cov_version=-1, names=(), signature=(),
        poses=(), pose_mean=np.empty((0, 3)), pose_cov=np.empty((0, 3, 3)), vehicles=(),
    )  # fmt: skip
