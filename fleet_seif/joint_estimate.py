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
6. `settle_near` improves only what single frames are about, all else held. What it leaves to be done elsewhere stays in
   the gradient, for the next `settle`.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from fleet_seif.errors import NumericalError
from fleet_seif.joint_assembly import (
    Evaluation,
    evaluate_into,
    held_step,
    moved_frames,
    place_into,
    remember_into,
    turns_into,
)
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
NEAR_ITERATIONS: Final = 4
NEAR_ENOUGH: Final = 1e-4
"""A frame has settled where a step is shorter than this, in sigmas squared, all else held."""


class Estimate:
    """See the rules above. X (v, 3): the state by joint variable. last: the evaluation where it settled last."""

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
        self._spans = np.empty((0, 2), np.int64)
        self._generation = 0
        self.last: Evaluation | None = None

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
        more = len(self.frames.start) - len(self._heading)
        self._heading = np.concatenate([self._heading, np.full(more, np.nan)])
        self._weight = np.concatenate([self._weight, np.full(more, np.nan)])
        self._make_room_for_views()

    def begin_at(self, variables: Ints, X: Floats) -> None:
        """Where these variables are at first, shape (v, 3): frames that are taken in do not place them."""
        self.X[variables], self._known[variables] = X, 1

    def _make_room_for_views(self) -> None:
        """Rows of frames stay where they are until the table of frames gives them other places."""
        rows, moved = len(self.frames.mean), self.registry.table.generation != self._generation
        if moved or rows > len(self._z):
            old, self._z = self._z, np.full(2 * rows, np.nan)
            if not moved:
                self._z[: len(old)] = old
            for f in self._pieces if moved else ():
                first, end = self._spans[f]
                if end - first == self.frames.end_row[f] - self.frames.first_row[f]:
                    self._z[self.frames.first_row[f] : self.frames.end_row[f]] = old[first:end]
        self._spans = np.column_stack([self.frames.first_row, self.frames.end_row])
        self._generation = self.registry.table.generation

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
                    self.last = now
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

    def covariance(self, variables: Ints) -> Floats:
        """Joint block of H^-1 of these variables, frames linearised where they were last; see Tree.covariance.

        Raises NumericalError where the joint information matrix is not positive definite.
        """
        assert self.last is not None
        self.tree.factor(self.frames, self.last)
        return self.tree.covariance(variables)

    def settle_near(self, changed: Sequence[int], disagreement: float) -> Evaluation | None:
        """Improve what each of these frames is about, one after the other, all else held.

        Returns the evaluation of the frames nearby, others as they were; None where that is not enough: a frame's
        chi-square stays above `disagreement` times where robust weights begin, so what is elsewhere has to give way.
        """
        now = self._remembered()
        if now is None:
            return None
        for f in changed:
            held = self._settle_one(f, now)
            if held.chi_square[f] > disagreement * self.frames.limit[f]:
                return None
            now = held
        self.last = now
        return now

    def _remembered(self) -> Evaluation | None:
        """The last evaluation, with room for the frames and variables that have come since; None before the first."""
        last = self.last
        if last is None:
            return None
        chi_square, weight = np.zeros(len(self.frames.start)), np.ones(len(self.frames.start))
        chi_square[: len(last.chi_square)], weight[: len(last.weight)] = last.chi_square, last.weight
        return last._replace(chi_square=chi_square, weight=weight)

    def _settle_one(self, f: int, now: Evaluation) -> Evaluation:
        pieces, chosen = self._touching(f)
        turns = self._turns(chosen)
        variables = np.unique(np.concatenate([self.tree.pieces[n].variables for n in self._pieces[f]]))
        then = self._evaluate_near(now, self.X, chosen, turns)
        for _ in range(NEAR_ITERATIONS):
            now = then
            step = held_step(self.frames, pieces, now, variables, self.tree.size)
            length = float(np.vdot(now.g[variables], step))
            X = self.X.copy()
            X[variables] += step
            then = self._evaluate_near(now, X, chosen, turns)
            if not then.cost <= now.cost * (1.0 + SLACK) + SLACK:
                return now
            self.X = X
            if length <= NEAR_ENOUGH:
                return then
        return then

    def _touching(self, f: int) -> tuple[Ints, Ints]:
        """Pieces (p, 3) of all frames that touch what frame f is about, and the numbers of those frames, ascending."""
        pieces = self.tree.touching(self._pieces[f])
        return pieces, np.unique(pieces[:, 0])

    def _evaluate_near(self, last: Evaluation, X: Floats, chosen: Ints, turns: Floats) -> Evaluation:
        """Cost, gradient and view of the chosen frames at X; chi-square and weight of the others as they were."""
        g, z, chi_square, weight = (
            np.zeros_like(X), np.empty(len(self.frames.mean)), last.chi_square.copy(), last.weight.copy()
        )  # fmt: skip
        cost = evaluate_into(g, z, chi_square, weight, self.frames, chosen, X, turns)
        return Evaluation(X, cost, g, z, chi_square, weight)

    def _step(self, now: Evaluation, active: Ints, tolerance: float) -> Floats:
        moved = moved_frames(
            self.frames, active, self.X, now.z, now.weight, self._heading, self._z, self._weight, tolerance
        )
        self.tree.relinearise([piece for f in moved.tolist() for piece in self._pieces[f]])
        remember_into(self._heading, self._z, self._weight, self.frames, moved, self.X, now.z, now.weight)
        self.tree.factor(self.frames, now, self.damping)
        return self.tree.solve(now.g)
