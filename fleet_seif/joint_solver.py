"""Solving the joint map: as frames arrive (the canonical replay), and warm, from where it was.

1. `replay` forgets what it knew. Frames are taken in round by round, frame r of every life in round r, and a few
   iterations follow each round; so a long loop is closed from an estimate that is as good as it was when it was driven.
   Late rounds take several frames of each life at once: 1 + r // ROUNDS_SINGLE.
2. `replay` is a function of the lives and classes alone, in the order given. One thread, no clock.
3. `update` goes on from the last solution: frames that are the same objects about the same landmarks keep what is known
   of them, others are placed by them. Where that fails it replays.
4. `solve_from` goes on from an estimate that is given, and is a function of its arguments alone.
5. In large maps `update` improves only what has changed, all else held, until a share of the frames has come or been
   corrected since all were solved, or a frame does not fit what is held (MATHS.md 13 has what that costs).
6. Where every vehicle has one frame and a given start pose the system is linear: one round, no robust weights.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from fleet_seif.errors import NumericalError
from fleet_seif.jit import one_thread
from fleet_seif.joint_assembly import Evaluation
from fleet_seif.joint_estimate import Estimate
from fleet_seif.joint_records import Classes, JointSolution, Life, System
from fleet_seif.joint_registry import Change, Records, Registry
from fleet_seif.messages import LandmarkName
from fleet_seif.records import Floats, Ints

ITERATIONS_MAX: Final = 400
"""Frames that contradict each other strongly make the last steps shrink slowly."""
WARM_ITERATIONS_MAX: Final = 100
WARM_ENOUGH: Final = 1e-6
"""An update is over when a step is shorter than this, in sigmas squared over all variables."""
NEAR_FRAMES_LEAST: Final = 256
"""Maps of fewer frames are solved as a whole."""
PENDING_SHARE: Final = 1.0 / 48.0
"""All is solved when more than this share of the frames has come or been corrected since, each life's newest apart."""
DISAGREEMENT: Final = 2.0
"""All is solved when a frame's chi-square stays above this many times where its robust weight begins, all else held."""
ROUND_ITERATIONS: Final = 8
ROUND_ENOUGH: Final = 1e-2
"""A round is over when a step is shorter than this, in sigmas squared over all variables."""
ROUNDS_SINGLE: Final = 64


class JointSolver:
    """See the rules above. One thread at a time may use it."""

    def __init__(self) -> None:
        self._records = Records()
        self._estimate: Estimate | None = None
        self._changed: set[int] = set()

    @one_thread
    def replay(self, lives: Sequence[Life], classes: Classes) -> JointSolution:
        """The joint map of these lives, in canonical order (by vehicle, then life), from nothing.

        Raises NumericalError where the system is not positive definite or does not settle.
        """
        self._estimate = None
        if not any(life.frames for life in lives):
            raise NumericalError("nothing to solve: no vehicle has contributed anything yet")
        registry = Registry(self._records)
        added = registry.register(lives, classes).added
        estimate = Estimate(registry)
        estimate.grow()
        numbers = np.array([max(key[2], 0) for f in added if (key := registry.keys[f]) is not None])
        for last in _round_ends(int(numbers.max()), single=not registry.robust):
            now = np.flatnonzero(numbers <= last)[len(estimate.active) :]
            estimate.take([added[i] for i in now.tolist()])
            estimate.settle(ROUND_ITERATIONS, ROUND_ENOUGH)
        settled, at = estimate.settle(ITERATIONS_MAX)
        if not settled:
            raise NumericalError(f"the joint map did not settle in {ITERATIONS_MAX} iterations, cost {at.cost:.3g}")
        self._estimate = estimate
        return _solution(estimate, at, lives, classes)

    @one_thread
    def update(self, lives: Sequence[Life], classes: Classes) -> JointSolution:
        """The joint map of these lives, in canonical order, from where the last call left it.

        Raises NumericalError where the system is not positive definite or does not settle.
        """
        estimate = self._estimate
        if estimate is not None and any(life.frames for life in lives):
            self._estimate = None
            try:
                change = estimate.registry.register(lives, classes)
                if 2 * len(change.added) <= len(estimate.active):
                    estimate.follow(change)
                    at = self._settled_near(estimate, change, lives) or self._settled(estimate)
                    if at is not None:
                        self._estimate = estimate
                        return _solution(estimate, at, lives, classes)
            except NumericalError:  # replayed below, which raises it again if it is not for the start
                pass
        return self.replay(lives, classes)

    @one_thread
    def solve_from(
        self, life: Life, classes: Classes, landmarks: Floats, poses: Floats, enough: float = WARM_ENOUGH
    ) -> JointSolution:
        """The map of one life, whose start pose is given, from an estimate on. Where that fails it replays.

        Raises NumericalError where the system is not positive definite or does not settle.

        Args:
            landmarks (n, 2): by number, m; NaN unknown. poses (k, 3): where frames 1 .. k start.
            enough: as WARM_ENOUGH.
        """
        registry = Registry(self._records)
        added = registry.register([life], classes).added
        estimate = Estimate(registry)
        estimate.grow()
        numbers = np.array([names[0].number for names in classes], np.int64)
        known = np.flatnonzero(numbers < len(landmarks))
        known = known[np.isfinite(landmarks[numbers[known], 0])]
        at = np.pad(landmarks[numbers[known]], ((0, 0), (0, 1)))
        starts = [registry.pose(life.vehicle, life.life, k) for k in range(1, len(poses) + 1)]
        variables = np.concatenate([registry.class_variables[known], starts]).astype(np.int64)
        estimate.begin_at(variables, np.vstack([at, poses]))
        try:
            estimate.take(added)
            settled = self._settled(estimate, enough)
        except NumericalError:
            settled = None
        if settled is None:
            return self.replay([life], classes)
        self._estimate = estimate
        return _solution(estimate, settled, [life], classes)

    @one_thread
    def joint_covariance(self, solution: JointSolution, landmarks: Ints, poses: Ints) -> Floats:
        """Exact joint covariance of some rows of the last solution: poses, then landmarks, shape (n, n).

        Linearised where its frames were last, robust weights included.

        Args:
            landmarks (k,): positions in its `classes`. poses (p,): in its `poses`. Each once.
        """
        estimate, variable, count = self._estimate, solution.system.variable, len(solution.classes)
        if estimate is None or solution.system.at is not estimate.last:
            raise ValueError("joint_covariance is of the last solution only: solve again")
        return estimate.covariance(np.concatenate([variable[count + poses], variable[landmarks]]))

    def _settled(self, estimate: Estimate, enough: float = WARM_ENOUGH) -> Evaluation | None:
        """All of it."""
        self._changed.clear()
        settled, at = estimate.settle(WARM_ITERATIONS_MAX, enough)
        return at if settled else None

    def _settled_near(self, estimate: Estimate, change: Change, lives: Sequence[Life]) -> Evaluation | None:
        """Rule 5; None where all has to be solved."""
        changed, keys = sorted([*change.added, *change.altered]), estimate.registry.keys
        newest = {(life.vehicle, life.life, len(life.frames) - 1) for life in lives}
        self._changed.update(changed)
        pending, count = sum(keys[f] not in newest for f in self._changed), len(estimate.active)
        if change.removed or count < NEAR_FRAMES_LEAST or pending > PENDING_SHARE * count:
            return None
        return estimate.settle_near(changed, DISAGREEMENT)


def _round_ends(last: int, *, single: bool) -> list[int]:
    """The last frame of each round."""
    if single:
        return [last]
    ends, r = [], 0
    while r <= last:
        r += 1 + r // ROUNDS_SINGLE
        ends.append(r - 1)
    return ends


def _rows(registry: Registry, lives: Sequence[Life]) -> tuple[Ints, list[tuple[str, int, int]]]:
    """The joint variable of each landmark and pose in the order of a solution's rows, and the poses."""
    variables, poses = [], []
    for life in lives:
        count = len(life.frames)
        for k in range(count + 1):
            if k > 0 or np.any(life.start_pose_cov):
                variables.append(registry.pose(life.vehicle, life.life, k))
                poses.append((life.vehicle, life.life, k if k < count else -1))
    return np.concatenate([registry.class_variables, np.array(variables, np.int64)]), poses


def _solution(estimate: Estimate, at: Evaluation, lives: Sequence[Life], classes: Classes) -> JointSolution:
    registry = estimate.registry
    variables, poses = _rows(registry, lives)
    idle = np.count_nonzero(estimate.tree.touches[variables] == 0)
    if idle:
        raise NumericalError(f"{idle} landmarks or poses are in no frame: the joint map has no solution")
    signatures = {(life.vehicle, life.life): life.signatures for life in lives}

    def signature(name: LandmarkName) -> int:
        return signatures[name.vehicle, name.life][name.number]

    count = len(classes)
    numbers = {key: f for f, key in enumerate(registry.keys) if key is not None and key[2] >= 0}
    keys = tuple((life.vehicle, life.life, f) for life in lives for f in range(len(life.frames)))
    chosen = np.array([numbers[key] for key in keys], np.int64)
    return JointSolution(
        mean=np.concatenate([estimate.X[variables[:count], :2].ravel(), estimate.X[variables[count:]].ravel()]),
        classes=classes,
        signatures=tuple(max(signature(name) for name in names) for names in classes),
        poses=tuple(poses),
        frames=keys,
        weight=at.weight[chosen],
        chi_square=at.chi_square[chosen],
        dof=(registry.frames.end_row - registry.frames.first_row)[chosen],
        system=System(
            frames=registry.frames,
            keys=tuple(registry.keys),
            pieces=tuple(estimate.tree.pieces.values()),
            at=at,
            variable=variables,
            size=estimate.tree.size,
        ),
    )
