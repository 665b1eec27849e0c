"""From the ledger to a served map."""

import contextlib
import dataclasses
from dataclasses import dataclass

import numpy as np

from fleet_seif.config import FusionSettings
from fleet_seif.errors import NumericalError
from fleet_seif.joint import Life, marginal_covariances, solve
from fleet_seif.messages import JointMap, LandmarkName, VehicleState
from fusion.core import FusionCore

LEFT_OUT = "lives_left_out"
Classes = tuple[tuple[LandmarkName, ...], ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class MapInput:
    """A copy of all that a map is made from: what has been checked, and (None: the same) all that has been folded."""

    fleet: str
    node: str
    checked: tuple[Life, ...]
    classes: Classes
    live: tuple[Life, ...] | None
    live_classes: Classes
    map_digest: bytes
    ledger_digest: bytes
    vehicles: tuple[VehicleState, ...]
    counters: dict[str, int]


def map_input(core: FusionCore, now_s: float) -> MapInput:
    """Copy what a map is made from; the caller keeps others off the core meanwhile."""
    ledger = core.ledger
    checked, live = ledger.lives(), ledger.lives(live=True)
    same = all(a.frames == b.frames for a, b in zip(checked, live, strict=True))  # the very same arrays
    return MapInput(
        fleet=ledger.fleet,
        node=core.node,
        checked=checked,
        classes=ledger.classes(checked),
        live=None if same else live,
        live_classes=() if same else ledger.classes(live),
        map_digest=ledger.map_digest(),
        ledger_digest=ledger.ledger_digest(),
        vehicles=core.states(now_s),
        counters=dict(core.counters),
    )


def make_map(taken: MapInput, version: int, settings: FusionSettings, *, final: bool) -> JointMap:
    """Solve: everything folded if that is positive definite, what has been checked otherwise and at the end."""
    canonical = taken.live is None or final
    if taken.live is not None and not final:
        try:
            return _solved(taken, taken.live, taken.live_classes, version, settings, final=False, canonical=False)
        except NumericalError:
            canonical = True
    try:
        return _solved(taken, taken.checked, taken.classes, version, settings, final=final, canonical=canonical)
    except NumericalError:
        # each positive definite, and yet too lopsided or contradictory to be solved: nobody takes the map from all
        good = _that_can_be_solved(taken.checked, taken.classes)
        taken = dataclasses.replace(taken, counters={**taken.counters, LEFT_OUT: len(taken.checked) - len(good)})
        kept = _classes_of(good, taken.classes)
        return _solved(taken, good, kept, version, settings, final=final, canonical=canonical)


def _that_can_be_solved(lives: tuple[Life, ...], classes: Classes) -> tuple[Life, ...]:
    """In canonical order, every life with which those before it can still be solved."""
    kept: tuple[Life, ...] = ()
    for life in lives:
        with contextlib.suppress(NumericalError):
            solve((*kept, life), _classes_of((*kept, life), classes))
            kept = (*kept, life)
    return kept


def _classes_of(lives: tuple[Life, ...], classes: Classes) -> Classes:
    """The classes without the names of other lives."""
    names = {(life.vehicle, life.life) for life in lives}
    groups = (tuple(name for name in group if name[:2] in names) for group in classes)
    return tuple(sorted(group for group in groups if group))


def _solved(
    taken: MapInput, lives: tuple[Life, ...], classes: Classes, version: int, settings: FusionSettings,
    *, final: bool, canonical: bool,
) -> JointMap:  # fmt: skip
    if not lives:  # nothing yet, but who has been heard and what has been counted
        return dataclasses.replace(
            empty_map(taken.fleet, taken.node, version), canonical=canonical, final=final, map_digest=taken.map_digest,
            ledger_digest=taken.ledger_digest, vehicles=taken.vehicles, counters=taken.counters,
        )  # fmt: skip
    solution = solve(lives, classes)
    poses = solution.poses
    newest = {vehicle: i for i, (vehicle, _, k) in enumerate(poses) if k < 0}  # of several lives, the last
    rows = list(newest.values())
    with_cov = final or len(classes) <= settings.covariance_landmarks_max
    if with_cov:
        landmark_cov, pose_cov = marginal_covariances(solution)
    return JointMap(
        fleet=taken.fleet,
        node=taken.node,
        version=version,
        canonical=canonical,
        final=final,
        map_digest=taken.map_digest,
        ledger_digest=taken.ledger_digest,
        landmark_mean=solution.landmark_mean,
        landmark_cov=landmark_cov if with_cov else np.empty((0, 2, 2)),
        cov_version=version if with_cov else -1,
        names=classes,
        signature=solution.signatures,
        poses=tuple(newest),
        pose_mean=solution.pose_mean[rows],
        pose_cov=pose_cov[rows] if with_cov else np.empty((0, 3, 3)),
        vehicles=taken.vehicles,
        counters=taken.counters,
    )


def empty_map(fleet: str, node: str, version: int = -1) -> JointMap:
    """The map before anything is known."""
    return JointMap(
        fleet=fleet, node=node, version=version, canonical=True, final=False,
        map_digest=bytes(32), ledger_digest=bytes(32),
        landmark_mean=np.empty((0, 2)), landmark_cov=np.empty((0, 2, 2)), cov_version=-1, names=(), signature=(),
        poses=(), pose_mean=np.empty((0, 3)), pose_cov=np.empty((0, 3, 3)), vehicles=(),
    )  # fmt: skip
