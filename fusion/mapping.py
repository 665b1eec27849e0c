"""From the ledger to a served map."""

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fleet_seif.errors import NumericalError
from fleet_seif.joint import JointSolution, JointSolver, Life, landmark_classes, marginal_covariances, solve
from fleet_seif.joint_records import Classes
from fleet_seif.merging import Merges
from fleet_seif.messages import JointMap, VehicleState
from fleet_seif.records import Floats
from fusion.core import FusionCore
from fusion.events import Decisions
from fusion.ledger import digest_of
from fusion.merges import Merger

LEFT_OUT = "lives_left_out"
WEIGHTED_DOWN = "frames_weighted_down"
CANDIDATES = "merge_candidates"
REFUSED = "merges_refused"
OF_MAPS = (LEFT_OUT, WEIGHTED_DOWN, CANDIDATES, REFUSED)
"""Counters that a map adds to those of its node."""
COVARIANCE_PAUSE = 4.0
"""Time between two computations of covariances, in the time that one takes."""
MERGE_PAUSE = 4.0
"""Time between two searches for merges, in the time that one takes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MapInput:
    """A copy of all that a map is made from: what has been checked, and (None: the same) all that has been folded."""

    fleet: str
    node: str
    checked: tuple[Life, ...]
    live: tuple[Life, ...] | None
    decisions: Decisions
    ledger_digest: bytes
    vehicles: tuple[VehicleState, ...]
    counters: dict[str, int]


@dataclass(frozen=True, eq=False)
class Covariances:
    """Those of landmarks (n, 2, 2), m^2, and newest poses (v, 3, 3), with what they belong to. due_s: when anew."""

    version: int = -1
    classes: Classes = ()
    poses: tuple[str, ...] = ()
    landmark_cov: Floats = field(default_factory=lambda: np.empty((0, 2, 2)))
    pose_cov: Floats = field(default_factory=lambda: np.empty((0, 3, 3)))
    due_s: float = -math.inf


def map_input(core: FusionCore, now_s: float) -> MapInput:
    """Copy what a map is made from; the caller keeps others off the core meanwhile."""
    ledger = core.ledger
    checked, live = ledger.lives(), ledger.lives(live=True)
    same = all(a.frames == b.frames for a, b in zip(checked, live, strict=True))  # the very same arrays
    return MapInput(
        fleet=ledger.fleet,
        node=core.node,
        checked=checked,
        live=None if same else live,
        decisions=ledger.decisions,
        ledger_digest=ledger.ledger_digest(),
        vehicles=core.states(now_s),
        counters=dict(core.counters),
    )


class MapMaker:
    """Makes the maps of a node, one after the other.

    1. A map goes on from the one before (fleet_seif.joint_solver). A final one, a first one, and one that is asked for
       as a `replay` is solved from nothing; if it rests on checked prefixes it is canonical.
    2. Covariances have a cadence of their own, a fifth of the time: `with_covariances` adds them to a map that has been
       served already. Maps in between carry the last ones as long as they have the same landmarks, with the version
       they belong to. The first map and a final one have their own.
    3. So have merges: `look_for_merges` finds those of all that has been folded, from nothing. Maps in between keep the
       last ones, with what is new unmerged; a canonical map has its own.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._solver = JointSolver()
        self._covariances = Covariances()
        self._merger = Merger()
        self._merges = Merges(())
        self._merges_due_s = -math.inf
        self._taken: MapInput | None = None
        self._is_first = True
        self._solution: JointSolution | None = None
        self.replay_s = 0.0
        """How long the last solution from nothing took."""

    def make(self, taken: MapInput, version: int, *, final: bool, replay: bool = False) -> JointMap:
        """Solve: everything folded if that is positive definite, what has been checked otherwise and at the end.

        Raises NumericalError where nothing can be solved.
        """
        self._taken = taken
        canonical = taken.live is None or final
        if taken.live is not None and not final:
            try:
                classes = self._with_merges(taken.live, taken.decisions)
                return self._solved(taken, taken.live, classes, version, final=False, canonical=False)
            except NumericalError:
                canonical = replay = True
        canonical = canonical and (replay or final or self._is_first)
        if canonical:
            self._merges = self._merger.of(taken.checked, taken.decisions)
        classes = self._with_merges(taken.checked, taken.decisions)
        try:
            return self._solved(taken, taken.checked, classes, version, final=final, canonical=canonical)
        except NumericalError:
            # each positive definite, and yet too lopsided or contradictory to be solved: nobody takes the map from all
            good = _that_can_be_solved(taken.checked, classes)
            taken = dataclasses.replace(taken, counters={**taken.counters, LEFT_OUT: len(taken.checked) - len(good)})
            return self._solved(taken, good, _classes_of(good, classes), version, final=final, canonical=canonical)

    @property
    def merges(self) -> Merges:
        """Those that the last map was made with."""
        return self._merges

    def _with_merges(self, lives: tuple[Life, ...], decisions: Decisions) -> Classes:
        """The classes of lives with the merges that were found last: all of them, where they were found for these."""
        return landmark_classes(lives, decisions.forced, decisions.forbidden, self._merges.pairs)

    def look_for_merges(self) -> bool:
        """Find the merges of what the last map was made from, where that is due; whether they differ from the last."""
        taken = self._taken
        if taken is None or self._clock() < self._merges_due_s:
            return False
        lives, before = taken.checked if taken.live is None else taken.live, self._merges.pairs
        if self._merger.knows(lives, taken.decisions):
            return False
        begin = self._clock()
        self._merges = self._merger.of(lives, taken.decisions)
        now_s = self._clock()
        self._merges_due_s = now_s + MERGE_PAUSE * (now_s - begin)
        return self._merges.pairs != before

    def _solved(
        self, taken: MapInput, lives: tuple[Life, ...], classes: Classes, version: int, *, final: bool, canonical: bool
    ) -> JointMap:
        self._solution = None
        map_digest = digest_of(taken.checked, self._with_merges(taken.checked, taken.decisions))
        if not lives:  # nothing yet, but who has been heard and what has been counted
            return dataclasses.replace(
                empty_map(taken.fleet, taken.node, version), canonical=canonical, final=final,
                map_digest=map_digest, ledger_digest=taken.ledger_digest, vehicles=taken.vehicles,
                counters=taken.counters,
            )  # fmt: skip
        begin = self._clock()
        solution = self._solver.replay(lives, classes) if canonical else self._solver.update(lives, classes)
        if canonical:
            self.replay_s = self._clock() - begin
        newest = _newest(solution)
        rows = list(newest.values())
        covariances = self._covariances
        counted = {
            WEIGHTED_DOWN: len(solution.doubtful),
            CANDIDATES: len(self._merges.considered),
            REFUSED: len(self._merges.refused),
        }
        if (covariances.classes, covariances.poses) != (classes, tuple(newest)):
            covariances = Covariances()
        made = JointMap(
            fleet=taken.fleet,
            node=taken.node,
            version=version,
            canonical=canonical,
            final=final,
            map_digest=map_digest,
            ledger_digest=taken.ledger_digest,
            landmark_mean=solution.landmark_mean,
            landmark_cov=covariances.landmark_cov,
            cov_version=covariances.version,
            names=classes,
            signature=solution.signatures,
            poses=tuple(newest),
            pose_mean=solution.pose_mean[rows],
            pose_cov=covariances.pose_cov,
            vehicles=taken.vehicles,
            counters={**taken.counters, **{name: n for name, n in counted.items() if n}},
        )
        self._solution, is_first, self._is_first = solution, self._is_first, False
        return self.with_covariances(made, version) if final or is_first else made

    @property
    def are_covariances_due(self) -> bool:
        return self._solution is not None and self._clock() >= self._covariances.due_s

    def with_covariances(self, newest: JointMap, version: int) -> JointMap:
        """The map that was made last, as this version, with covariances of its own."""
        solution, begin = self._solution, self._clock()
        assert solution is not None
        landmarks, poses = marginal_covariances(solution)
        poses = poses[list(_newest(solution).values())]
        spent = self._clock() - begin
        due_s = self._clock() + COVARIANCE_PAUSE * spent
        self._covariances = Covariances(version, newest.names, newest.poses, landmarks, poses, due_s)
        return dataclasses.replace(newest, version=version, landmark_cov=landmarks, pose_cov=poses, cov_version=version)


def make_map(taken: MapInput, version: int, *, final: bool) -> JointMap:
    """One map, from nothing. Raises NumericalError where nothing can be solved."""
    return MapMaker().make(taken, version, final=final)


def _newest(solution: JointSolution) -> dict[str, int]:
    """The row of each vehicle's newest pose; of several lives, the last one's."""
    return {vehicle: i for i, (vehicle, _, k) in enumerate(solution.poses) if k < 0}


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


def empty_map(fleet: str, node: str, version: int = -1) -> JointMap:
    """The map before anything is known."""
    return JointMap(
        fleet=fleet, node=node, version=version, canonical=True, final=False,
        map_digest=bytes(32), ledger_digest=bytes(32),
        landmark_mean=np.empty((0, 2)), landmark_cov=np.empty((0, 2, 2)), cov_version=-1, names=(), signature=(),
        poses=(), pose_mean=np.empty((0, 3)), pose_cov=np.empty((0, 3, 3)), vehicles=(),
    )  # fmt: skip
