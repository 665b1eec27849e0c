"""What a vehicle takes its sightings for, step by step, where nothing tells it (DESIGN D5, MATHS.md 19).

1. Sightings are compared with the landmarks of a local map (fleet_seif.local_map), which they then improve.
2. A sighting that fits nothing and is near nothing begins a provisional landmark. Once it has been sighted often enough
   it is accepted and gets a number; its earlier sightings belong to it from then on. Else it is forgotten.
3. A landmark that has not been sighted in this frame, and whose place the vehicle does not know well enough to tell it
   from its neighbours, is doubtful: one wrong pair would move all that follows. It is not compared with sightings. What
   is there begins anew. When the frame closes, landmarks that were begun twice are found by the pattern of all of them
   (own_duplicates); they become aliases.
4. Keys: the number of an accepted landmark; below NONE, a provisional one; NONE: not told, or nobody's.
5. `decide` changes nothing; `take` does, once the filter has taken the step too.
6. A function of this vehicle's own readings and settings alone.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from fleet_seif.association import associate
from fleet_seif.association_guards import Verdict
from fleet_seif.config import AssociationSettings
from fleet_seif.errors import ReadingRefused
from fleet_seif.frame_log import NONE
from fleet_seif.jit import one_thread
from fleet_seif.local_map import (
    LocalMap,
    begun_at,
    expected,
    from_pose_stds,
    in_reach,
    in_view,
    kept,
    moved,
    nothing_known,
    sighted,
    with_new,
)
from fleet_seif.models import COMPASS_XY
from fleet_seif.own_duplicates import Duplicates, crowded, own_duplicates, spacing_m
from fleet_seif.records import Bools, Floats, Ints
from fleet_seif.seif import FAULTS
from fleet_seif.seif_step import check_reading
from fleet_seif.unseen import Unseen

DOUBTFUL_SIGMAS: Final = 3.0
"""A landmark is told from its neighbour where so many standard deviations reach at most half way to it."""
LIFETIMES: Final = 10
"""A provisional landmark out of reach is kept for so many times `confirm_steps`."""
IN_VIEW_SHARE: Final = 0.8
"""Share of the largest distance, and bearing, of all sightings up to which a landmark should be in view."""
REACH_SIGMAS: Final = 4.0
"""How far beyond what was measured a landmark may be, in standard deviations, to be compared at all."""
NOBODY: Final[Counter[int]] = Counter()


@dataclass(frozen=True)
class Provisional:
    """A landmark that has not been accepted. born: the step of its first sighting. chances: steps, from that one on, in
    which it was within reach."""

    born: int
    sightings: int
    chances: int


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
        self._next = NONE - 1
        self._together: dict[int, Counter[int]] = {}
        self._apart: dict[int, float] = {}
        self._bearing = 0.0
        self._unseen = Unseen()

    def anew(self) -> "Associator":
        """One that has met what this one has, and knows of no provisional landmark."""
        other = Associator(self.settings, self.model)
        other.reach_m, other._bearing, other._next = self.reach_m, self._bearing, self._next
        other._together = {key: met.copy() for key, met in self._together.items()}
        return other

    def decide(self, step: int, motion: tuple[Floats, Floats] | None, z: Floats, Z: Floats, known: int) -> Decision:
        """Raises ReadingRefused where a number or a covariance is none, NumericalError where the local map cannot be.

        Args:
            motion: odometry and its covariance. z (s, 2), Z (s, 2, 2). known: landmarks that have a number.
        """
        _check(self.model, motion, z, Z)
        local = self.local if motion is None else moved(self.model, self.local, *motion)
        near = in_reach(local.mean, local.P, _reach(self.model, z, Z), REACH_SIGMAS)
        near = near[~self._are_doubtful(local, near)]
        found = associate(z, Z, *expected(self.model, local.mean, local.P, near), self.settings, model=self.model)
        paired = np.flatnonzero(found.assignment >= 0)
        which = near[found.assignment[paired]]
        keys = np.full(len(z), NONE)
        keys[paired] = local.keys[which]
        local, squared = sighted(self.model, local, which, z[paired], Z[paired])
        provisional, key = dict(self._provisional), self._next
        for i in np.flatnonzero(found.verdict == Verdict.NEW).tolist():
            local = with_new(self.model, local, key, z[i], Z[i])
            keys[i], provisional[key] = key, Provisional(step, 0, 0)
            key -= 1
        seen, within = set(keys.tolist()), set[int]()
        if provisional:
            within = set(local.keys[in_reach(local.mean, local.P, self.reach_m, 0.0)].tolist())
        for each, known_of in provisional.items():
            sighted_now = each in seen
            provisional[each] = Provisional(
                known_of.born, known_of.sightings + sighted_now, known_of.chances + (sighted_now or each in within)
            )
        return self._settled(step, known, Decision(keys, {}, squared, 2 * len(paired), local, provisional, key))

    def _are_doubtful(self, local: LocalMap, which: Ints) -> Bools:
        """Rule 3, of landmarks at these positions: a mask."""
        apart = np.array([self._apart.get(key, np.inf) for key in local.keys[which].tolist()])
        return np.asarray(2.0 * DOUBTFUL_SIGMAS * from_pose_stds(local.P, which) > apart)

    def _settled(self, step: int, known: int, made: Decision) -> Decision:
        """Provisional landmarks that are accepted now, and those that are forgotten."""
        settings, accepted, gone = self.settings, made.accepted, set[int]()
        for key in made.keys[made.keys < NONE].tolist():  # in the order of sightings: that of numbers
            if made.provisional[key].sightings >= settings.confirm_sightings:
                accepted[key] = known + len(accepted)
        for key, each in made.provisional.items():
            old = step - each.born >= LIFETIMES * settings.confirm_steps
            if key not in accepted and (old or each.chances >= settings.confirm_steps):
                gone.add(key)
        for key in (*accepted, *gone):
            del made.provisional[key]
        local = made.local
        if accepted or gone:
            local = LocalMap(local.mean, local.P, _renamed(local.keys, accepted))
            local = kept(local, np.flatnonzero(~np.isin(local.keys, list(gone)))) if gone else local
        return replace(made, keys=_renamed(made.keys, accepted), local=local)

    def take(self, decision: Decision, z: Floats) -> None:
        """The step has been taken."""
        self.local, self._provisional, self._next = decision.local, decision.provisional, decision.next
        seen = sorted(key for key in decision.keys.tolist() if key >= 0)
        self._expect(seen)
        for i, key in enumerate(seen):
            self._together.setdefault(key, Counter()).update(seen[i + 1 :])
            self._apart.pop(key, None)
        if len(z):
            self.reach_m = max(self.reach_m, float(_distances(self.model, z).max()))
            self._bearing = max(self._bearing, float(np.abs(z[:, 1]).max()))

    def _expect(self, seen: Sequence[int]) -> None:
        """Count what should be in view after this step, and what was sighted."""
        local = self.local
        inside = in_view(self.model, local.mean, IN_VIEW_SHARE * self.reach_m, IN_VIEW_SHARE * self._bearing)
        inside = inside[~self._are_doubtful(local, inside)]
        self._unseen.add((key for key in local.keys[inside].tolist() if key >= 0), seen)

    @property
    def unseen(self) -> float:
        """Share of the landmarks that should have been in view in the last frames, but were not sighted in them."""
        return self._unseen.share

    def has_left(self, pose: Floats) -> bool:
        """Whether this pose in the frame is so far from its start that the local map may lack what is sighted."""
        return bool(np.hypot(pose[0], pose[1]) >= self.travel_max_m)

    def around(self) -> tuple[LocalMap, float]:
        """What to `begin` with where nothing else tells what lies around: the accepted landmarks, as they are."""
        return begun_at(kept(self.local, np.flatnonzero(self.local.keys >= 0))), self.travel_max_m

    @one_thread
    def duplicates(self) -> Duplicates:
        """Landmarks that have been begun twice (rule 3): pairs of keys."""
        return own_duplicates(self.local, self._met_now())

    def _met_now(self) -> Ints:
        """See `_met`: of all accepted landmarks."""
        return self._met(self.local.keys[self.local.keys >= 0])

    def _met(self, keys: Ints) -> Ints:
        """From how many poses each two of these landmarks have been sighted, shape (k, k)."""
        met, at = np.zeros((len(keys), len(keys)), np.int64), {key: i for i, key in enumerate(keys.tolist())}
        for a, i in at.items():
            for b, count in self._together.get(a, NOBODY).items():
                if b in at:
                    met[i, at[b]] = met[at[b], i] = count
        return met

    def crowded(self) -> float:
        """Share of landmarks that lie where hardly two can (own_duplicates)."""
        return crowded(self.local, self._met_now())

    @one_thread
    def begin(self, near: LocalMap, travel_max_m: float, barred: Iterable[int] = ()) -> None:
        """A frame begins here: with these landmarks, as seen from its start, and the provisional ones.

        barred: those that are not compared with sightings, however well their places are known.
        """
        self._unseen.close()
        carried = np.flatnonzero(self.local.keys < NONE)
        spacing = spacing_m(near.landmarks, self._met(near.keys)).tolist()
        self._apart = dict(zip(near.keys.tolist(), spacing, strict=True)) | dict.fromkeys(barred, 0.0)
        self.local, self.travel_max_m = beside(near, begun_at(kept(self.local, carried))), travel_max_m

    def state(self) -> dict[str, Any]:
        """Plain values for msgpack; `restore` takes them back."""
        local = self.local
        return {
            "mean": local.mean.tobytes(), "P": local.P.tobytes(), "keys": local.keys.tobytes(), "next": self._next,
            "travel": self.travel_max_m, "reach": self.reach_m, "apart": list(self._apart.items()),
            "together": [(key, list(others.items())) for key, others in self._together.items()],
            "bearing": self._bearing, "unseen": self._unseen.state(),
            "provisional": [(key, each.born, each.sightings, each.chances) for key, each in self._provisional.items()],
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken, to the bit."""
        mean = np.frombuffer(state["mean"]).copy()  # for arrays that are read only kernels would be compiled anew
        P = np.frombuffer(state["P"]).reshape(len(mean), len(mean)).copy()
        self.local = LocalMap(mean, P, np.frombuffer(state["keys"], np.int64).copy())
        self.travel_max_m, self.reach_m, self._next = state["travel"], state["reach"], state["next"]
        self._apart = dict(state["apart"])
        self._together = {key: Counter(dict(others)) for key, others in state["together"]}
        self._bearing = state["bearing"]
        self._unseen.restore(state["unseen"])
        self._provisional = {key: Provisional(*rest) for key, *rest in state["provisional"]}


def _renamed(keys: Ints, names: dict[int, int]) -> Ints:
    """Keys by the names that some have from now on."""
    return np.array([names.get(key, key) for key in keys.tolist()], np.int64) if names else keys


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


def _check(model: int, motion: tuple[Floats, Floats] | None, z: Floats, Z: Floats) -> None:
    """What the filter refuses is refused here already, and for sightings that it is not told, too."""
    u, cov = motion or (np.zeros(3), np.eye(3))
    code = check_reading(model, u, cov, z, Z)
    if code in FAULTS:
        raise ReadingRefused(f"reading refused: {FAULTS[code]}; u={u.tolist()} z={z.tolist()}")
