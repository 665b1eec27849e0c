"""The estimate of a joint system and how it is improved: Gauss-Newton on the tree of frames, damped where needed.

1. The gradient is always that of the present state. The factor may be a little old: a frame is linearised anew when it
   has moved by more than a tolerance, so far from what is new nothing is redone. Where the estimate settles, the
   gradient is zero, whatever the factor's age: staleness costs iterations, not accuracy. Where steps shrink slowly the
   tolerance shrinks.
2. A step beyond which the cost rises again is shortened to where its slope, taken as a straight line between both ends,
   is zero. Frames that contradict the others by metres (a barcode misread several times) bend the cost more than
   Gauss-Newton knows; where damping would hold back the whole map for them, this does not.
3. A step that still raises the cost is not taken: first all frames are linearised anew, then the step is damped
   (Levenberg): the diagonal grows by a share that is tenfold after each failure and a tenth after each success.
4. Whole turns of headings are chosen where `settle` begins and stay: were they chosen at each step, the cost would
   jump where a frame is half a turn off, and no step would bring it down.
5. Frames that are taken in are placed from where their first pose is and what they saw; what is known stays.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from fleet_seif.errors import NumericalError
from fleet_seif.joint_assembly import Evaluation, evaluate_into, moved_frames, place_into, remember_into, turns_into
from fleet_seif.joint_frames import Frames, Placed
from fleet_seif.joint_registry import Change, Registry
from fleet_seif.joint_tree import Piece, Tree
from fleet_seif.records import Floats, Ints

SETTLED: Final = 1e-13
"""An estimate has settled where a step is shorter than this, in sigmas squared over all variables."""
ROUNDING: Final = 1e-10
"""Where a step is shorter than this per variable, in sigmas squared, and steps no longer shrink, rounding is all that
is left."""
TOLERANCE_FIRST: Final = 3e-2
TOLERANCE_LEAST: Final = 1e-6
"""How far a frame may move before it is linearised anew: its heading in rad, what it sees relative to its size, its
weight relative."""
SLOW: Final = 0.3
"""A step (in sigmas squared) above this share of the one before is slow: the tolerance becomes a tenth."""
OVERSHOT: Final = 0.5
"""A step is too long where the cost's slope at its end is this share of that at its beginning, and points back."""
SLACK: Final = 1e-9
"""What the cost may grow by, relative: rounding."""
DAMPING_FIRST: Final = 1e-4
DAMPING_FACTOR: Final = 10.0
DAMPING_MAX: Final = 1e9


class Estimate:
    """See the rules above. X (v, 3): the state by joint variable."""

    def __init__(self, registry: Registry) -> None:
        self.registry = registry
        self.tree = Tree()
        self.X = np.zeros((0, 3))
        self.damping = 0.0
        self._known = np.zeros(0, np.int64)
        self._pieces: dict[int, list[int]] = {}
        self._heading = np.zeros(0)
        self._z = np.zeros(0)
        self._weight = np.zeros(0)
        self._rows = np.zeros(1, np.int64)

    @property
    def frames(self) -> Frames:
        return self.registry.frames

    @property
    def active(self) -> Ints:
        """Numbers of the frames that take part, ascending."""
        return np.array(sorted(self._pieces), np.int64)

    def grow(self) -> None:
        """Make room for what the registry knows by now."""
        more = len(self.registry.sizes) - len(self.X)
        if more:
            self.X = np.concatenate([self.X, np.zeros((more, 3))])
            self._known = np.concatenate([self._known, np.zeros(more, np.int64)])
            self.tree.know(self.registry.sizes[-more:])
        if self._rows is self.frames.first_row:
            return
        z, old, new = np.full(len(self.frames.mean), np.nan), self._rows, self.frames.first_row
        keep = np.zeros(len(new) - 1, bool)
        keep[list(self._pieces)] = True
        for f in np.flatnonzero(keep).tolist():
            if old[f + 1] - old[f] == new[f + 1] - new[f]:
                z[new[f] : new[f + 1]] = self._z[old[f] : old[f + 1]]
        more = len(new) - 1 - len(self._heading)
        self._heading = np.concatenate([self._heading, np.full(more, np.nan)])
        self._weight = np.concatenate([self._weight, np.full(more, np.nan)])
        self._z, self._rows = z, new

    def follow(self, change: Change) -> None:
        """Drop what is gone, take in what is new and what differs."""
        self.drop(change.removed)
        self.grow()
        self._weight[change.altered] = np.nan
        if change.altered:
            place_into(self.X, self._known, self.frames, np.array(change.altered, np.int64))
        for f in change.altered:
            pieces, old = self._cut(f), self._pieces[f]
            if len(pieces) == len(old) == 1:
                self.tree.replace(old[0], pieces[0])
            else:
                self.drop([f])
                self._add([f])
        self.take(change.added)

    def take(self, frames: Sequence[int]) -> None:
        """Let frames take part, placed one after the other."""
        if frames:
            place_into(self.X, self._known, self.frames, np.array(frames, np.int64))
            self._add(frames)

    def _add(self, frames: Sequence[int]) -> None:
        pieces = [self._cut(f) for f in frames]
        numbers = iter(self.tree.add([piece for each in pieces for piece in each]))
        for f, each in zip(frames, pieces, strict=True):
            self._pieces[f] = [next(numbers) for _ in each]
            self._weight[f] = np.nan

    def drop(self, frames: Sequence[int]) -> None:
        """Let frames no longer take part."""
        for f in frames:
            self.tree.remove(self._pieces.pop(f))

    def _cut(self, f: int) -> list[Piece]:
        placed: Placed = self.registry.placed[f]
        record, start = placed.record, [placed.start] if placed.start >= 0 else []
        found = []
        for first, last in record.pieces.tolist():
            variable = placed.variable
            if len(record.pieces) > 1:
                variable = variable[np.unique(np.concatenate([record.rows[first:last], record.cols[first:last]]))]
            variables = np.unique(np.concatenate([start, variable]).astype(np.int64))
            x, y, _ = self.X[variables].mean(axis=0).tolist()
            found.append(Piece(f, first, last, variables, (x, y)))
        return found

    def _turns(self, active: Ints) -> Floats:
        turns = np.zeros((len(self.frames.start), 2))
        turns_into(turns, self.frames, active, self.X)
        return turns

    def _evaluate(self, X: Floats, active: Ints, turns: Floats) -> Evaluation:
        """Cost and gradient of the frames that take part, at X."""
        g, z = np.zeros_like(X), np.zeros(len(self.frames.mean))
        chi_square, weight = np.zeros(len(self.frames.start)), np.ones(len(self.frames.start))
        cost = evaluate_into(g, z, chi_square, weight, self.frames, active, X, turns)
        return Evaluation(X, cost, g, z, chi_square, weight)

    def settle(self, iterations: int, enough: float = SETTLED) -> tuple[bool, Evaluation]:
        """Improve the estimate until a step is shorter than `enough`. Returns whether it was, and the evaluation there.

        Raises NumericalError where the joint information matrix is not positive definite.
        """
        active = self.active
        turns = self._turns(active)
        now, last, tolerance = self._evaluate(self.X, active, turns), np.inf, TOLERANCE_FIRST
        for _ in range(iterations):
            step = self._step(now, active, tolerance)
            length = float(np.vdot(now.g, step))
            if not np.isfinite(length):
                raise NumericalError("the joint map has no finite solution: information of frames is too lopsided")
            then = self._evaluate(self.X + step, active, turns)
            back = -float(np.vdot(then.g, step))
            if back > OVERSHOT * length:
                then = self._evaluate(self.X + length / (length + back) * step, active, turns)
                tolerance = TOLERANCE_LEAST
            short = length * (1.0 + self.damping) ** 2 <= enough
            short |= length <= ROUNDING * len(self.X) and length > 0.9 * last and not self.damping
            if then.cost <= now.cost * (1.0 + SLACK) + SLACK or short:
                self.X, now = then.X, then
                if short:
                    return True, now
                self.damping = self.damping / DAMPING_FACTOR if self.damping > DAMPING_FIRST else 0.0
                if length > SLOW * last:
                    tolerance = max(tolerance / 10.0, TOLERANCE_LEAST)
                last = length
            elif tolerance > TOLERANCE_LEAST:
                tolerance = TOLERANCE_LEAST
            else:
                self.damping = max(DAMPING_FIRST, self.damping * DAMPING_FACTOR)
                if self.damping > DAMPING_MAX:
                    break
        return False, now

    def _step(self, now: Evaluation, active: Ints, tolerance: float) -> Floats:
        moved = moved_frames(
            self.frames, active, self.X, now.z, now.weight, self._heading, self._z, self._weight, tolerance
        )
        self.tree.relinearise([piece for f in moved.tolist() for piece in self._pieces[f]])
        remember_into(self._heading, self._z, self._weight, self.frames, moved, self.X, now.z, now.weight)
        self.tree.factor(self.frames, now, self.damping)
        return self.tree.solve(now.g)
