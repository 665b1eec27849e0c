"""What a vehicle takes its sightings for, step by step, where nothing tells it (DESIGN D5, MATHS.md 19).

1. Sightings are compared with the landmarks of a local map (fleet_seif.local_map), which they then improve.
2. A sighting that fits nothing and is near nothing begins a provisional landmark. Once it has been sighted often enough
   it is accepted and gets a number; its earlier sightings belong to it from then on. Else it is forgotten.
3. A landmark that has not been sighted for a while is dormant: where the vehicle is relative to it is not well known,
   and one wrong pair would move all that follows. Pairs with dormant landmarks count once `wake_together` of them fit in
   one step, or one has fitted in two steps soon after each other; until then they move nothing.
4. Keys: the number of an accepted landmark; below NONE, a provisional one; NONE: not told, or nobody's.
5. `decide` changes nothing; `take` does, once the filter has taken the step too.
6. A function of this vehicle's own readings and settings alone.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_seif.association import associate, limits
from fleet_seif.association_guards import Verdict
from fleet_seif.config import AssociationSettings
from fleet_seif.errors import ReadingRefused
from fleet_seif.local_map import LocalMap, begun_at, expected, in_reach, kept, moved, nothing_known, sighted, with_new
from fleet_seif.models import COMPASS_XY, innovation
from fleet_seif.records import Floats, Ints

NONE: Final = -1
REACH_SIGMAS: Final = 4.0
"""How far beyond what was measured a landmark may be, in standard deviations, to be compared at all."""


@dataclass(frozen=True)
class Provisional:
    """A landmark that has not been accepted. born: the step of its first sighting."""

    born: int
    sightings: int


@dataclass(frozen=True)
class Waking:
    """A dormant landmark that a sighting fitted. key: of that sighting, until the landmark is awake. step: of it."""

    key: int
    step: int


@dataclass(frozen=True, eq=False)
class Decision:
    """What the sightings of one step are taken for.

    keys (s,). accepted: keys below NONE that have numbers from now on. innovation: squared normalised innovation of
    the sightings of landmarks known before, chi-square of `dof` degrees of freedom.
    """

    keys: Ints
    accepted: dict[int, int]
    innovation: float
    dof: int
    local: LocalMap
    provisional: dict[int, Provisional]
    waking: dict[int, Waking]
    next: int


class Associator:
    """See the rules above. travel_max_m: how far from the frame's start the local map is whole."""

    def __init__(self, settings: AssociationSettings, model: int) -> None:
        self.settings = settings
        self.model = model
        self.local = nothing_known()
        self.travel_max_m = np.inf
        self.reach_m = 0.0
        self._provisional: dict[int, Provisional] = {}
        self._waking: dict[int, Waking] = {}
        self._last: dict[int, int] = {}
        self._next = NONE - 1
        self._birth_gate = limits(settings, 0).birth_gate

    def decide(self, step: int, motion: tuple[Floats, Floats] | None, z: Floats, Z: Floats, known: int) -> Decision:
        """Raises ReadingRefused where a sighting is none, NumericalError where the local map cannot be.

        Args:
            motion: odometry and its covariance. z (s, 2), Z (s, 2, 2). known: landmarks that have a number.
        """
        _check(z, Z)
        local = self.local if motion is None else moved(self.model, self.local, *motion)
        near = in_reach(local.mean, local.P, _reach(self.model, z, Z), REACH_SIGMAS)
        h, C = expected(self.model, local.mean, local.P, near)
        found = associate(z, Z, h, C, self.settings, model=self.model)
        candidates = local.keys[near]
        dormant = np.array([self._is_dormant(key, step) for key in candidates.tolist()], bool)
        keys, waking, accepted, key = self._paired(step, found.assignment, candidates, dormant)
        paired = np.flatnonzero(
            (found.assignment >= 0) & (keys != NONE) & ~np.isin(keys, [w.key for w in waking.values()])
        )
        local, squared = sighted(self.model, local, near[found.assignment[paired]], z[paired], Z[paired])
        provisional = dict(self._provisional)
        for i in np.flatnonzero(found.verdict == Verdict.NEW).tolist():
            if self._is_near(z[i], Z[i], h, C, np.flatnonzero(dormant)):
                continue
            local = with_new(self.model, local, key, z[i], Z[i])
            keys[i], provisional[key] = key, Provisional(step, 0)
            key -= 1
        for each in keys[keys < NONE].tolist():
            if each in provisional:
                provisional[each] = Provisional(provisional[each].born, provisional[each].sightings + 1)
        made = Decision(keys, accepted, squared, 2 * len(paired), local, provisional, waking, key)
        return self._settled(step, known, made)

    def _is_dormant(self, key: int, step: int) -> bool:
        return key >= 0 and step - self._last.get(key, step) > self.settings.awake_steps

    def _is_near(self, z: Floats, Z: Floats, h: Floats, C: Floats, which: Ints) -> bool:
        """Whether a sighting is within the birth gate of one of these candidates, taken or not."""
        return any(
            pair_squared(self.model, z, Z, h[j], C[2 * j : 2 * j + 2, 2 * j : 2 * j + 2]) <= self._birth_gate
            for j in which.tolist()
        )

    def _paired(
        self, step: int, assignment: Ints, candidates: Ints, dormant: NDArray[np.bool_]
    ) -> tuple[Ints, dict[int, Waking], dict[int, int], int]:
        """Keys of sightings that are paired (rule 3), dormant landmarks that are waking, and those that have."""
        settings, key = self.settings, self._next
        keys, accepted = np.full(len(assignment), NONE), dict[int, int]()
        waking = {n: each for n, each in self._waking.items() if step - each.step <= settings.wake_steps}
        paired = np.flatnonzero(assignment >= 0)
        together = np.count_nonzero(dormant[assignment[paired]]) >= settings.wake_together
        for i in paired.tolist():
            number = int(candidates[assignment[i]])
            if not dormant[assignment[i]]:
                keys[i] = number
            elif together or number in waking:
                keys[i] = number
                if number in waking:
                    accepted[waking.pop(number).key] = number
            else:
                keys[i], waking[number] = key, Waking(key, step)
                key -= 1
        return keys, waking, accepted, key

    def _settled(self, step: int, known: int, made: Decision) -> Decision:
        """Provisional landmarks that are accepted now, and those that are forgotten."""
        settings, accepted, gone = self.settings, made.accepted, set[int]()
        for key in made.keys[made.keys < NONE].tolist():  # in the order of sightings: that of numbers
            if key in made.provisional and made.provisional[key].sightings >= settings.confirm_sightings:
                accepted[key] = known + sum(number >= known for number in accepted.values())
        for key, each in made.provisional.items():
            if key not in accepted and step - each.born >= settings.confirm_steps - 1:
                gone.add(key)
        for key in (*accepted, *gone):
            made.provisional.pop(key, None)
        local = made.local
        if accepted or gone:
            names = np.array([accepted.get(key, key) for key in local.keys.tolist()], np.int64)
            local = LocalMap(local.mean, local.P, names)
            local = kept(local, np.flatnonzero(~np.isin(names, list(gone)))) if gone else local
        keys = np.array([accepted.get(key, key) for key in made.keys.tolist()], np.int64)
        return replace(made, keys=keys, local=local)

    def take(self, step: int, decision: Decision, z: Floats) -> None:
        """The step has been taken."""
        self.local, self._next = decision.local, decision.next
        self._provisional, self._waking = decision.provisional, decision.waking
        self._last.update((key, step) for key in decision.keys.tolist() if key >= 0)
        if len(z):
            self.reach_m = max(self.reach_m, float(_distances(self.model, z).max()))

    def has_left(self, pose: Floats) -> bool:
        """Whether this pose in the frame is so far from its start that the local map may lack what is sighted."""
        return bool(np.hypot(pose[0], pose[1]) >= self.travel_max_m)

    def begin(self, near: LocalMap, travel_max_m: float) -> None:
        """A frame begins where the vehicle is: with these landmarks, as seen from there, and the provisional ones."""
        carried = np.flatnonzero(self.local.keys < NONE)
        self.local, self.travel_max_m = beside(near, begun_at(kept(self.local, carried))), travel_max_m

    def state(self) -> dict[str, Any]:
        """Plain values for msgpack; `restore` takes them back."""
        local = self.local
        return {
            "mean": local.mean.tobytes(), "P": local.P.tobytes(), "keys": local.keys.tobytes(), "next": self._next,
            "travel": self.travel_max_m, "reach": self.reach_m,
            "last": list(self._last.items()), "waking": [(n, each.key, each.step) for n, each in self._waking.items()],
            "provisional": [(key, each.born, each.sightings) for key, each in self._provisional.items()],
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken, to the bit."""
        mean = np.frombuffer(state["mean"])
        P = np.frombuffer(state["P"]).reshape(len(mean), len(mean))
        self.local = LocalMap(mean, P, np.frombuffer(state["keys"], np.int64))
        self.travel_max_m, self.reach_m, self._next = state["travel"], state["reach"], state["next"]
        self._last, self._waking = dict(state["last"]), {n: Waking(key, step) for n, key, step in state["waking"]}
        self._provisional = {key: Provisional(born, sightings) for key, born, sightings in state["provisional"]}


def pair_squared(model: int, z: Floats, Z: Floats, h: Floats, C: Floats) -> float:
    """r' (C + Z)^-1 r of one pair."""
    r = innovation(model, z, h)
    return float(r @ np.linalg.solve(C + Z, r))


def beside(a: LocalMap, b: LocalMap) -> LocalMap:
    """Landmarks of two maps with the same pose, which is certain; nothing links them."""
    n, m = len(a.mean), len(b.mean) - 3
    P = np.zeros((n + m, n + m))
    P[:n, :n], P[n:, n:] = a.P, b.P[3:, 3:]
    return LocalMap(np.concatenate([a.mean, b.mean[3:]]), P, np.concatenate([a.keys, b.keys]))


def _distances(model: int, z: Floats) -> Floats:
    return np.asarray(np.hypot(z[:, 0], z[:, 1]) if model == COMPASS_XY else z[:, 0])


def _reach(model: int, z: Floats, Z: Floats) -> float:
    """How far away the sightings may be at most, m."""
    if not len(z):
        return 0.0
    return float(np.max(_distances(model, z) + REACH_SIGMAS * np.sqrt(Z[:, 0, 0] + (Z[:, 1, 1] if model else 0.0))))


def _check(z: Floats, Z: Floats) -> None:
    det = Z[:, 0, 0] * Z[:, 1, 1] - Z[:, 0, 1] * Z[:, 1, 0]
    if np.all(np.isfinite(z)) and np.all(Z[:, 0, 0] > 0.0) and np.all(det > 0.0) and np.all(np.isfinite(det)):
        return
    raise ReadingRefused(
        "reading refused: a sighting is not finite, or its covariance not positive definite: it cannot be told what it"
        " is of; leave it out"
    )
