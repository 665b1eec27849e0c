"""Which landmarks of different vehicles are one, where no signature says so: MATHS.md section 20.

1. Merges are a pure function of lives and decisions: computed from nothing, never stored. Where nothing is left to be
   decided (every landmark carries a signature, or there is one life) it costs nothing and changes nothing.
2. A round solves the map with the merges so far, tests each of them with itself removed, and takes out those that fail;
   where all pass, it looks for more. Rounds end where nothing changes.
3. Candidates lie within the gate of each other, by the joint covariance of their difference.
4. Candidates are merged as a set, of which each agrees with all others; or one by one, where nothing else comes near.
5. Whatever has a rival stays apart, and so does a pattern that repeats within the uncertainty of its place: ambiguity
   is said, not decided.
6. No landmark has two names of one life, but for what aliases, signatures and operators say.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal, NamedTuple

import numpy as np
import scipy.sparse.csgraph
import scipy.spatial

from fleet_seif.consistent import Bools, Candidates, Found, agreeing, gains, grown, largest_clique
from fleet_seif.errors import NumericalError
from fleet_seif.jit import one_thread
from fleet_seif.joint import Pair, landmark_classes
from fleet_seif.joint_covariance import JointCovariance, diagonal_blocks, halved, squared_distances
from fleet_seif.joint_records import Classes, JointSolution, Life
from fleet_seif.joint_solver import JointSolver
from fleet_seif.left_out import LeftOut, left_out
from fleet_seif.messages import LandmarkName
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints

ROUNDS_MAX: Final = 12
NEIGHBOURS: Final = 8
"""Landmarks of one life that a density is measured over."""
CROWD_MAX: Final = 16
"""Candidates of one landmark that are looked at, the nearest first."""


@dataclass(frozen=True, kw_only=True)
class MergeRules:
    """When landmarks are merged. All nodes of a fleet must use the same.

    gate: squared distance (chi-square, 2 degrees of freedom) beyond which a pair is none. margin: by how much the
    squared distance to any other landmark must be larger. set_min: pairs that must agree. set_gain, pair_gain: least
    gain (see fleet_seif.consistent) of a set, and of a pair given all others. rival_share: share of a set's pairs from
    which on another alignment makes it ambiguous. repeat: squared distance within which a pattern must not repeat.
    group_max: candidates that are searched together. by: how sets are found.
    """

    gate: float = 13.8
    margin: float = 6.0
    set_min: int = 4
    set_gain: float = 8.0
    pair_gain: float = 3.0
    rival_share: float = 0.5
    repeat: float = 36.0
    group_max: int = 128
    by: Literal["joint", "clique"] = "joint"


class Reason(StrEnum):
    """What became of a pair, and why."""

    MERGED = "merged"
    AMBIGUOUS = "another landmark, or another alignment, fits as well"
    REPEATS = "the pattern repeats within the uncertainty of its place"
    FEW = "too few others agree"
    CROWDED = "landmarks lie too close for how uncertain they are"
    CONTRADICTED = "given all other merges they are not one"
    UNSOLVED = "with them the map has no solution"


class Considered(NamedTuple):
    """A pair of landmarks, by first names, that was or might have been merged; its squared distance given the rest."""

    a: LandmarkName
    b: LandmarkName
    d2: float
    reason: Reason


@dataclass(frozen=True)
class Merges:
    """classes: the landmarks. pairs: what was joined beyond signatures, aliases and decisions. considered: all pairs
    that came near each other, merged or not."""

    classes: Classes
    pairs: tuple[Pair, ...] = ()
    considered: tuple[Considered, ...] = ()

    @property
    def refused(self) -> tuple[Considered, ...]:
        """Pairs that lie within the gate of each other and were not merged."""
        return tuple(each for each in self.considered if each.reason is not Reason.MERGED)


@one_thread
def merged(
    lives: Sequence[Life],
    forced: Sequence[Pair] = (),
    forbidden: Sequence[Pair] = (),
    rules: MergeRules = MergeRules(),
) -> Merges:
    """Which landmarks are the same: by signatures, aliases and decisions, and where those are silent by place."""
    lives = sorted(lives, key=lambda life: (life.vehicle, life.life))
    parts = landmark_classes(lives, forced, forbidden)
    search = _Search(lives, parts, forbidden, rules)
    if not search.anything_to_decide:
        return Merges(parts)
    try:
        return search.run()
    except NumericalError:
        good = [life for life in lives if _is_solvable(life)]
        if len(good) in (0, len(lives)):
            return Merges(parts)
    try:
        found = merged(good, forced, forbidden, rules)
    except NumericalError:
        return Merges(parts)
    return Merges(landmark_classes(lives, forced, forbidden, found.pairs), found.pairs, found.considered)


def _is_solvable(life: Life) -> bool:
    try:
        JointSolver().replay([life], landmark_classes([life]))
    except NumericalError:
        return False
    return True


class _Map(NamedTuple):
    """The map of one round. groups: the parts of each landmark. has (n, l): which lives it has names of."""

    solution: JointSolution
    covariance: JointCovariance
    groups: list[tuple[int, ...]]
    has: Bools
    density: Floats


class _Near(NamedTuple):
    """Pairs of landmarks (m, 2) that come near each other, with differences, covariances and squared distances."""

    ends: Ints
    D: Floats
    S: Floats
    d2: Floats

    def take(self, chosen: Ints | Bools) -> "_Near":
        return _Near(*(each[chosen] for each in self))


class _Search:
    """The rounds of `merged`. Parts are the classes that are given; what is found joins them to groups."""

    def __init__(self, lives: Sequence[Life], parts: Classes, forbidden: Sequence[Pair], rules: MergeRules) -> None:
        self.lives, self.parts, self.rules = lives, parts, rules
        number = {(life.vehicle, life.life): i for i, life in enumerate(lives)}
        known = {(life.vehicle, life.life): life.signatures for life in lives}
        part_of = {name: p for p, names in enumerate(parts) for name in names}
        self.has = np.zeros((len(parts), len(lives)), bool)
        for p, names in enumerate(parts):
            self.has[p, [number[name.vehicle, name.life] for name in names]] = True
        self.signed = np.array(
            [any(known[n.vehicle, n.life][n.number] != UNKNOWN_SIGNATURE for n in names) for names in parts], bool
        )
        fit = np.array([life.consistent for life in lives], bool)
        self.fit = ~np.any(self.has & ~fit, axis=1)
        self.apart: list[set[int]] = [set() for _ in parts]
        for a, b in forbidden:
            if a in part_of and b in part_of:
                self._part(part_of[a], part_of[b])
        self.groups: list[tuple[int, ...]] = [(p,) for p in range(len(parts))]
        self.dropped: dict[tuple[int, int], Reason] = {}

    @property
    def anything_to_decide(self) -> bool:
        """Whether there are landmarks of two lives of which one carries no signature."""
        free = self.fit & ~self.signed
        lives = np.any(self.has[self.fit], axis=0)
        return bool(np.any(free)) and int(lives.sum()) > 1

    def _part(self, p: int, q: int) -> None:
        self.apart[p].add(q)
        self.apart[q].add(p)

    def run(self) -> Merges:
        """Raises NumericalError where the map has no solution even without merges."""
        solver, last = JointSolver(), self.groups
        solution = solver.replay(self.lives, self._classes())
        for rounds in range(2 * ROUNDS_MAX):
            if rounds:
                try:
                    solution = solver.update(self.lives, self._classes())
                except NumericalError:
                    self._undo(last)
                    solution = solver.replay(self.lives, self._classes())
            now = self._map(solution)
            tested = left_out(solution, self.parts, now.covariance)
            if self._take_out(now, tested):
                continue
            near = self._near(now)
            reasons, found = self._proposed(now, near)
            last = self.groups
            if rounds >= ROUNDS_MAX or not self._join(now, near, found):
                break
        return self._result(now, tested, near, reasons)

    def _undo(self, last: list[tuple[int, ...]]) -> None:
        """Take back what was joined last, and do not try it again."""
        before = {p: group for group in last for p in group}
        for group in self.groups:
            for i, p in enumerate(group):
                for q in group[i + 1 :]:
                    if q not in before[p]:
                        self._part(p, q)
                        self.dropped[min(p, q), max(p, q)] = Reason.UNSOLVED
        self.groups = last

    def _classes(self) -> Classes:
        joined = (tuple(sorted(name for p in group for name in self.parts[p])) for group in self.groups)
        return tuple(sorted(joined))

    def _map(self, solution: JointSolution) -> _Map:
        first = {self.parts[p][0]: p for p in range(len(self.parts))}
        group_of = {p: group for group in self.groups for p in group}
        groups = [group_of[first[names[0]]] for names in solution.classes]
        has = np.array([np.any(self.has[list(group)], axis=0) for group in groups])
        return _Map(solution, JointCovariance(solution), groups, has, _density(solution.landmark_mean, has))

    def _take_out(self, now: _Map, tested: LeftOut) -> bool:
        """Take out of their landmarks the parts that fail their test by themselves; of several the worst ones."""
        automatic = self._automatic(now)
        d2 = np.where(automatic[tested.landmark], tested.d2, 0.0)
        gain = gains(d2, tested.S, now.density[tested.landmark])
        bad = (d2 > self.rules.gate) | (automatic[tested.landmark] & (gain < self.rules.pair_gain))
        if not np.any(bad):
            return False
        worst = bad & ((d2 >= 0.5 * d2[bad].max()) | (d2 <= self.rules.gate))
        done: set[int] = set()
        for i in np.flatnonzero(worst)[np.argsort(-d2[worst], kind="stable")].tolist():
            c, p = int(tested.landmark[i]), int(tested.part[i])
            if c in done:
                continue
            done.add(c)
            rest = tuple(q for q in now.groups[c] if q != p)
            for q in rest:
                self._part(p, q)
                self.dropped[min(p, q), max(p, q)] = (
                    Reason.CONTRADICTED if d2[i] > self.rules.gate else Reason.CROWDED
                )
            self.groups = sorted([g for g in self.groups if g != now.groups[c]] + [(p,), rest])
        return True

    def _automatic(self, now: _Map) -> Bools:
        """Which landmarks are made of several parts."""
        return np.array([len(group) > 1 for group in now.groups], bool)

    def _near(self, now: _Map) -> _Near:
        """Pairs that may be merged, within gate and margin of each other."""
        rules, mean = self.rules, now.solution.landmark_mean
        reach = float(np.sqrt(rules.gate + rules.margin))
        sigma = np.sqrt(np.linalg.eigvalsh(now.covariance.landmarks())[:, -1])
        ends = _within(mean, reach * sigma)
        ends = ends[~np.any(now.has[ends[:, 0]] & now.has[ends[:, 1]], axis=1)]
        signed = np.array([bool(np.any(self.signed[list(group)])) for group in now.groups], bool)
        fit = np.array([bool(np.all(self.fit[list(group)])) for group in now.groups], bool)
        ends = ends[~(signed[ends[:, 0]] & signed[ends[:, 1]]) & fit[ends[:, 0]] & fit[ends[:, 1]]]
        apart = [self._are_apart(now.groups[a], now.groups[b]) for a, b in ends.tolist()]
        ends = ends[~np.array(apart, bool)]
        D = mean[ends[:, 0]] - mean[ends[:, 1]]
        S = now.covariance.difference_blocks(ends)
        d2 = squared_distances(D, S)
        near = _Near(ends, D, S, d2).take(d2 <= rules.gate + rules.margin)
        return near.take(_not_crowded(near, len(mean)))

    def _are_apart(self, one: tuple[int, ...], other: tuple[int, ...]) -> bool:
        return any(not self.apart[p].isdisjoint(other) for p in one)

    def _proposed(self, now: _Map, near: _Near) -> tuple[list[Reason], list[tuple[float, int]]]:
        """What to make of each pair, and the pairs to join with what speaks for each."""
        rules = self.rules
        density = np.maximum(now.density[near.ends[:, 0]], now.density[near.ends[:, 1]])
        gain = gains(near.d2, near.S, density)
        clear = _margins(near, now.has) >= rules.margin
        reasons = [Reason.FEW] * len(near.d2)
        found: dict[int, float] = {}
        for k in np.flatnonzero(near.d2 <= rules.gate).tolist():
            if not clear[k]:
                reasons[k] = Reason.AMBIGUOUS
            elif gain[k] >= rules.pair_gain:
                reasons[k], found[k] = Reason.MERGED, float(gain[k])
        for some in self._searched_together(now, near):
            c = Candidates(near.D[some], now.covariance.differences(near.ends[some]), near.ends[some], now.has,
                           density[some])  # fmt: skip
            verdicts, support = self._sets(c, now)
            for k, verdict, value in zip(some.tolist(), verdicts, support.tolist(), strict=True):
                if verdict is Reason.MERGED:
                    found[k] = max(value, found.get(k, value))
                if verdict is not None and k not in found:
                    reasons[k] = verdict
                elif k in found:
                    reasons[k] = Reason.MERGED
        return reasons, sorted(((value, k) for k, value in found.items()), key=lambda item: (-item[0], item[1]))

    def _searched_together(self, now: _Map, near: _Near) -> Iterable[Ints]:
        """Candidates between the same two parts of the fleet, where there are many those that lie together."""
        component = _components(now.has)
        of = component[np.argmax(now.has, axis=1)]
        keys = np.sort(of[near.ends], axis=1)
        inside = near.d2 <= self.rules.gate
        place = now.solution.landmark_mean[near.ends].mean(axis=1)
        for key in np.unique(keys[inside], axis=0):
            chosen = np.flatnonzero(inside & np.all(keys == key, axis=1))
            if len(chosen) >= self.rules.set_min:
                for some in halved(place[chosen], self.rules.group_max):
                    yield np.sort(chosen[some])

    def _sets(self, c: Candidates, now: _Map) -> tuple[list[Reason | None], Floats]:
        """The verdict on each candidate of a group by the sets that agree, and the gain of each given its set."""
        rules = self.rules
        verdicts: list[Reason | None] = [None] * len(c.D)
        support = np.zeros(len(c.D))
        place = now.solution.landmark_mean[c.ends].mean(axis=1)
        found = _hypotheses(c, place, rules)
        taken: set[int] = set()
        for best in found:
            if len(best.members) < rules.set_min or best.gain < rules.set_gain:
                break
            members = best.members
            if taken & set(c.ends[members].ravel().tolist()):
                continue
            taken |= set(c.ends[members].ravel().tolist())
            if any(_is_rival(best, other, c, rules) for other in found):
                verdict = Reason.AMBIGUOUS
            elif self._repeats(c, members, now):
                verdict = Reason.REPEATS
            else:
                d2, S = _given_the_others(c, members)
                own = gains(d2, S, c.density[members])
                for k, value, distance in zip(members.tolist(), own.tolist(), d2.tolist(), strict=True):
                    fine = value >= rules.pair_gain and distance <= rules.gate
                    verdicts[k] = Reason.MERGED if fine else Reason.CROWDED
                    support[k] = value
                continue
            for k in members.tolist():
                verdicts[k] = verdict
        return verdicts, support

    def _repeats(self, c: Candidates, members: Ints, now: _Map) -> bool:
        """Whether one of the two maps holds the pattern of a set again, so near that place does not tell them apart."""
        own = diagonal_blocks(c.S)[members]
        S = own[int(np.argmin(np.linalg.det(own)))]
        reach = float(np.sqrt(self.rules.repeat * np.linalg.eigvalsh(S)[-1]))
        _, given = _given_the_others(c, members)
        tolerance = float(np.sqrt(self.rules.gate * np.median(np.linalg.eigvalsh(given)[:, -1])))
        mean = now.solution.landmark_mean
        for side in (0, 1):
            ends = c.ends[members, side]
            lives = np.any(now.has[ends], axis=0)
            cloud = mean[np.any(now.has & lives, axis=1)]
            if _repeats_within(mean[ends], cloud, S, self.rules.repeat, reach, tolerance):
                return True
        return False

    def _join(self, now: _Map, near: _Near, found: Sequence[tuple[float, int]]) -> bool:
        """Join pairs, what speaks most for itself first, but for those that would give a life two names."""
        group = {i: i for i in range(len(now.groups))}
        has, parts = now.has.copy(), [set(each) for each in now.groups]
        changed = False
        for _, k in found:
            a, b = (_root(group, int(end)) for end in near.ends[k])
            if a == b or np.any(has[a] & has[b]) or self._are_apart(tuple(parts[a]), tuple(parts[b])):
                continue
            group[b] = a
            has[a] |= has[b]
            parts[a] |= parts[b]
            changed = True
        self.groups = sorted(tuple(sorted(parts[i])) for i in range(len(parts)) if group[i] == i)
        return changed

    def _result(self, now: _Map, tested: LeftOut, near: _Near, reasons: list[Reason]) -> Merges:
        pairs = [(self.parts[group[0]][0], self.parts[p][0]) for group in self.groups for p in group[1:]]
        considered = []
        for c, p, d2 in zip(tested.landmark.tolist(), tested.part.tolist(), tested.d2.tolist(), strict=True):
            group = now.groups[c]
            if p != group[0]:
                considered.append(Considered(self.parts[group[0]][0], self.parts[p][0], d2, Reason.MERGED))
        for (a, b), d2, reason in zip(near.ends.tolist(), near.d2.tolist(), reasons, strict=True):
            if d2 <= self.rules.gate:
                one, other = sorted((now.solution.classes[a][0], now.solution.classes[b][0]))
                kept = Reason.AMBIGUOUS if reason is Reason.MERGED else reason
                considered.append(Considered(one, other, d2, kept))
        for (p, q), reason in self.dropped.items():
            considered.append(Considered(self.parts[p][0], self.parts[q][0], float("nan"), reason))
        return Merges(self._classes(), tuple(sorted(pairs)), tuple(sorted(considered, key=lambda e: e[:2])))


def _root(group: dict[int, int], i: int) -> int:
    while group[i] != i:
        i = group[i]
    return i


def _density(mean: Floats, has: Bools) -> Floats:
    """How dense the landmarks of one life lie around each landmark, per m^2; of several lives the densest."""
    density = np.zeros(len(mean))
    for life in range(has.shape[1]):
        own = np.flatnonzero(has[:, life])
        k = min(NEIGHBOURS, len(own) - 1)
        if k < 1:
            density[own] = np.inf  # nothing is known: nothing is merged by it
            continue
        radius = scipy.spatial.KDTree(mean[own]).query(mean[own], [k + 1])[0][:, 0]
        density[own] = np.maximum(density[own], k / (np.pi * np.maximum(radius, 1e-12) ** 2))
    return density


def _within(mean: Floats, reach: Floats) -> Ints:
    """Pairs (m, 2), a < b, ascending, that may be nearer than reach_a + reach_b."""
    near = scipy.spatial.KDTree(mean).query_ball_point(mean, 2.0 * reach)
    a = np.repeat(np.arange(len(mean)), [len(each) for each in near])
    b = np.concatenate([np.array(each, np.int64) for each in near])
    ends = np.sort(np.stack([a, b], axis=1)[a != b], axis=1)
    ends = np.unique(ends, axis=0).reshape(-1, 2)
    apart = np.linalg.norm(mean[ends[:, 0]] - mean[ends[:, 1]], axis=1)
    return ends[apart <= reach[ends[:, 0]] + reach[ends[:, 1]]]


def _incident(ends: Ints, n: int) -> list[list[int]]:
    """The pairs of each landmark."""
    found: list[list[int]] = [[] for _ in range(n)]
    for k, (a, b) in enumerate(ends.tolist()):
        found[a].append(k)
        found[b].append(k)
    return found


def _not_crowded(near: _Near, n: int) -> Bools:
    """Which pairs are among the nearest CROWD_MAX of both of their landmarks."""
    kept = np.ones(len(near.d2), bool)
    for pairs in _incident(near.ends, n):
        if len(pairs) > CROWD_MAX:
            order = np.array(pairs)[np.argsort(near.d2[pairs], kind="stable")]
            kept[order[CROWD_MAX:]] = False
    return kept


def _margins(near: _Near, has: Bools) -> Floats:
    """By how much the squared distance of the nearest rival of each pair is larger: one that cannot be true with it."""
    margin = np.full(len(near.d2), np.inf)
    for x, pairs in enumerate(_incident(near.ends, len(has))):
        other = near.ends[pairs].sum(axis=1) - x
        for i, k in enumerate(pairs):
            for j, r in enumerate(pairs):
                if i != j and np.any(has[other[i]] & has[other[j]]):
                    margin[k] = min(margin[k], near.d2[r] - near.d2[k])
    return margin


def _components(has: Bools) -> Ints:
    """Which lives have landmarks in common, directly or through others: a number for each life."""
    shared = (has.T.astype(np.int64) @ has.astype(np.int64)) > 0
    return np.asarray(scipy.sparse.csgraph.connected_components(shared, directed=False)[1])


def _hypotheses(c: Candidates, place: Floats, rules: MergeRules) -> list[Found]:
    """Consistent sets, the one with the largest gain first."""
    found = _by_cliques(c, place, rules) if rules.by == "clique" else _by_growing(c, rules)
    return sorted(found, key=lambda each: -each.gain)


def _by_growing(c: Candidates, rules: MergeRules) -> list[Found]:
    own = diagonal_blocks(c.S)
    first = gains(squared_distances(c.D, own), own, c.density)
    covered = np.zeros(len(c.D), bool)
    found = []
    for seed in np.argsort(-first, kind="stable").tolist():
        if not covered[seed]:
            each = grown(c, seed, rules.gate)
            if len(each.members) >= rules.set_min - 1:
                covered[each.members] = True
                found.append(each)
    return found


def _by_cliques(c: Candidates, place: Floats, rules: MergeRules) -> list[Found]:
    fits = agreeing(c, place, rules.gate)
    left = np.arange(len(c.D))
    found = []
    while len(left):
        members = left[largest_clique(fits[np.ix_(left, left)])]
        if len(members) < rules.set_min - 1:
            break
        left = np.setdiff1d(left, members)
        members = _independent(c, members)
        rows = (2 * members[:, None] + np.arange(2)).ravel()
        S, d = c.S[np.ix_(rows, rows)], c.D[members].ravel()
        gain = -0.5 * (np.linalg.slogdet(S)[1] + d @ np.linalg.solve(S, d))
        found.append(Found(members, float(gain - np.log(2.0 * np.pi * c.density[members]).sum())))
    return found


def _independent(c: Candidates, members: Ints) -> Ints:
    """Without those that follow from others: of a = b, b = c and a = c the last."""
    group = {int(end): int(end) for end in c.ends[members].ravel()}
    kept = []
    for k in members.tolist():
        a, b = (_root(group, int(end)) for end in c.ends[k])
        if a != b:
            group[b] = a
            kept.append(k)
    return np.array(kept, np.int64)


def _is_rival(best: Found, other: Found, c: Candidates, rules: MergeRules) -> bool:
    """Whether another set is another alignment, nearly as large, that cannot be true together with the best one."""
    shared = len(np.intersect1d(best.members, other.members))
    if other is best or other.gain <= 0.0 or shared > 0.5 * len(other.members):
        return False
    if len(other.members) < max(rules.set_min - 1, rules.rival_share * len(best.members)):
        return False
    for k in best.members.tolist():
        for r in other.members.tolist():
            for i in (0, 1):
                for j in (0, 1):
                    rivals = np.any(c.has[c.ends[k, 1 - i]] & c.has[c.ends[r, 1 - j]])
                    if k != r and c.ends[k, i] == c.ends[r, j] and rivals:
                        return True
    return False


def _given_the_others(c: Candidates, members: Ints) -> tuple[Floats, Floats]:
    """For each member of a set, d2 (k,) and S (k, 2, 2) given that all others are true.

    With M = S^-1 of the whole set and w = M d: S_k = M_kk^-1, d_k = S_k w_k.
    """
    rows = (2 * members[:, None] + np.arange(2)).ravel()
    M = np.linalg.inv(c.S[np.ix_(rows, rows)])
    S = np.linalg.inv(diagonal_blocks((M + M.T) / 2))
    w = (M @ c.D[members].ravel()).reshape(-1, 2)
    return np.einsum("ki,kij,kj->k", w, S, w), S


def _repeats_within(
    pattern: Floats, cloud: Floats, S: Floats, repeat: float, reach: float, tolerance: float
) -> bool:
    """Whether at least half of a pattern lies in the cloud again, shifted by t with t' S^-1 t <= repeat."""
    tree = scipy.spatial.KDTree(cloud)
    for anchor in pattern[: len(pattern) // 2 + 1]:
        t = cloud[tree.query_ball_point(anchor, reach)] - anchor
        t = t[(np.linalg.norm(t, axis=1) > 1e-9)]
        t = t[squared_distances(t, np.broadcast_to(S, (len(t), 2, 2))) <= repeat]
        if not len(t):
            continue
        apart, _ = tree.query(pattern[None] + t[:, None], distance_upper_bound=tolerance)
        if np.any(np.sum(np.isfinite(apart), axis=1) >= 0.5 * len(pattern)):
            return True
    return False
