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
from typing import Final, NamedTuple

import numpy as np

from fleet_seif.alignments import cautious, judged, root
from fleet_seif.consistent import Bools, Candidates
from fleet_seif.errors import NumericalError
from fleet_seif.jit import one_thread
from fleet_seif.joint import Pair, landmark_classes
from fleet_seif.joint_covariance import JointCovariance, halved, squared_distances
from fleet_seif.joint_records import Classes, JointSolution, Life
from fleet_seif.joint_solver import JointSolver
from fleet_seif.left_out import LeftOut, left_out
from fleet_seif.merge_records import Considered, MergeRules, Merges, Reason
from fleet_seif.near import Near, components, density, margins, not_crowded, within
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints

__all__ = ["Considered", "MergeRules", "Merges", "Reason", "merged"]

SEARCHES_MAX: Final = 12
DEFAULT: Final = MergeRules()


@one_thread
def merged(
    lives: Sequence[Life],
    forced: Sequence[Pair] = (),
    forbidden: Sequence[Pair] = (),
    rules: MergeRules = DEFAULT,
) -> Merges:
    """Which landmarks are the same: by signatures, aliases and decisions, and where those are silent by place."""
    lives = sorted(lives, key=lambda life: (life.vehicle, life.life))
    parts = landmark_classes(lives, forced, forbidden)
    search = _Search(lives, parts, forbidden, rules)
    if not search.anything_to_decide:
        return Merges(parts)
    try:
        return search.run()
    except (NumericalError, np.linalg.LinAlgError):
        good = [life for life in lives if _is_solvable(life)]
        if len(good) in (0, len(lives)):
            return Merges(parts)
    try:
        found = _Search(good, landmark_classes(good, forced, forbidden), forbidden, rules).run()
    except (NumericalError, np.linalg.LinAlgError):
        return Merges(parts)
    return Merges(landmark_classes(lives, forced, forbidden, found.pairs), found.pairs, found.considered)


def _is_solvable(life: Life) -> bool:
    try:
        JointSolver().replay([life], landmark_classes([life]))
    except NumericalError:
        return False
    return True


class _Map(NamedTuple):
    """The map of one round. groups: the parts of each landmark. has (n, l): which lives it has names of. component
    (n,): landmarks of one number belong to lives that are related by landmarks in common; others are independent."""

    solution: JointSolution
    covariance: JointCovariance
    groups: list[tuple[int, ...]]
    has: Bools
    density: Floats
    component: Ints


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
        self.dropped: dict[tuple[int, int], tuple[float, Reason]] = {}

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
        solver, last, searches = JointSolver(), self.groups, 0
        solution = solver.replay(self.lives, self._classes())
        while True:  # ends: at most SEARCHES_MAX searches join, and what is taken out stays out
            now = self._map(solution)
            tested = left_out(solution, self.parts, now.covariance)
            if not self._take_out(now, tested):
                near = self._near(now)
                reasons, found = self._proposed(now, near)
                last, searches = self.groups, searches + 1
                if searches > SEARCHES_MAX or not self._join(now, near, found):
                    return self._result(now, tested, near, reasons)
            try:
                solution = solver.update(self.lives, self._classes())
            except NumericalError:
                self._undo(last)
                solution = solver.replay(self.lives, self._classes())

    def _undo(self, last: list[tuple[int, ...]]) -> None:
        """Take back what was joined last, and do not try it again."""
        before = {p: group for group in last for p in group}
        for group in self.groups:
            for i, p in enumerate(group):
                for q in group[i + 1 :]:
                    if q not in before[p]:
                        self._part(p, q)
                        self.dropped[min(p, q), max(p, q)] = (np.inf, Reason.UNSOLVED)
        self.groups = last

    def _classes(self) -> Classes:
        joined = (tuple(sorted(name for p in group for name in self.parts[p])) for group in self.groups)
        return tuple(sorted(joined))

    def _map(self, solution: JointSolution) -> _Map:
        first = {self.parts[p][0]: p for p in range(len(self.parts))}
        group_of = {p: group for group in self.groups for p in group}
        groups = [group_of[first[names[0]]] for names in solution.classes]
        has = np.array([np.any(self.has[list(group)], axis=0) for group in groups])
        component = components(has)[np.argmax(has, axis=1)]
        around = density(solution.landmark_mean, has)
        return _Map(solution, JointCovariance(solution), groups, has, around, component)

    def _take_out(self, now: _Map, tested: LeftOut) -> bool:
        """Take out of their landmarks the parts that fail their test by themselves; of several the worst ones."""
        d2 = tested.d2
        gain = cautious(d2, tested.S, now.density[tested.landmark], self.rules)
        bad = (d2 > self.rules.gate) | (gain < self.rules.pair_gain)
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
                reason = Reason.CONTRADICTED if d2[i] > self.rules.gate else Reason.CROWDED
                self.dropped[min(p, q), max(p, q)] = (float(d2[i]), reason)
            self.groups = sorted([g for g in self.groups if g != now.groups[c]] + [(p,), rest])
        return True

    def _near(self, now: _Map) -> Near:
        """Pairs that may be merged, within gate and margin of each other."""
        rules, mean = self.rules, now.solution.landmark_mean
        reach = float(np.sqrt(rules.gate + rules.margin))
        cov = now.covariance.landmarks()
        ends = within(mean, reach * np.sqrt(np.linalg.eigvalsh(cov)[:, -1]))
        ends = ends[~np.any(now.has[ends[:, 0]] & now.has[ends[:, 1]], axis=1)]
        signed = np.array([bool(np.any(self.signed[list(group)])) for group in now.groups], bool)
        fit = np.array([bool(np.all(self.fit[list(group)])) for group in now.groups], bool)
        ends = ends[~(signed[ends[:, 0]] & signed[ends[:, 1]]) & fit[ends[:, 0]] & fit[ends[:, 1]]]
        apart = [self._are_apart(now.groups[a], now.groups[b]) for a, b in ends.tolist()]
        ends = ends[~np.array(apart, bool)]
        D = mean[ends[:, 0]] - mean[ends[:, 1]]
        S = cov[ends[:, 0]] + cov[ends[:, 1]]
        related = now.component[ends[:, 0]] == now.component[ends[:, 1]]
        near = np.where(related, 0.5, 1.0) * squared_distances(D, S) <= rules.gate + rules.margin  # S is at most twice
        ends, D, S, related = ends[near], D[near], S[near], related[near]
        S[related] = now.covariance.difference_blocks(ends[related])
        d2 = squared_distances(D, S)
        found = Near(ends, D, S, d2).take(d2 <= rules.gate + rules.margin)
        return found.take(not_crowded(found, len(mean)))

    def _are_apart(self, one: tuple[int, ...], other: tuple[int, ...]) -> bool:
        return any(not self.apart[p].isdisjoint(other) for p in one)

    def _proposed(self, now: _Map, near: Near) -> tuple[list[Reason], list[tuple[float, int]]]:
        """What to make of each pair, and the pairs to join with what speaks for each."""
        rules = self.rules
        density = np.maximum(now.density[near.ends[:, 0]], now.density[near.ends[:, 1]])
        gain = cautious(near.d2, near.S, density, rules)
        clear = margins(near, now.has) >= rules.margin
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
            verdicts, support = judged(c, now.solution.landmark_mean, rules)
            for k, verdict, value in zip(some.tolist(), verdicts, support.tolist(), strict=True):
                if verdict is Reason.MERGED:
                    found[k] = max(value, found.get(k, value))
                if verdict is not None and k not in found:
                    reasons[k] = verdict
                elif k in found:
                    reasons[k] = Reason.MERGED
        return reasons, sorted(((value, k) for k, value in found.items()), key=lambda item: (-item[0], item[1]))

    def _searched_together(self, now: _Map, near: Near) -> Iterable[Ints]:
        """Candidates between the same two parts of the fleet, where there are many those that lie together."""
        keys = np.sort(now.component[near.ends], axis=1)
        inside = near.d2 <= self.rules.gate
        place = now.solution.landmark_mean[near.ends].mean(axis=1)
        for key in np.unique(keys[inside], axis=0):
            chosen = np.flatnonzero(inside & np.all(keys == key, axis=1))
            if len(chosen) >= self.rules.set_min:
                for some in halved(place[chosen], self.rules.group_max):
                    yield np.sort(chosen[some])

    def _join(self, now: _Map, near: Near, found: Sequence[tuple[float, int]]) -> bool:
        """Join pairs, what speaks most for itself first, but for those that would give a life two names."""
        group = {i: i for i in range(len(now.groups))}
        has, parts = now.has.copy(), [set(each) for each in now.groups]
        changed = False
        for _, k in found:
            a, b = (root(group, int(end)) for end in near.ends[k])
            if a == b or np.any(has[a] & has[b]) or self._are_apart(tuple(parts[a]), tuple(parts[b])):
                continue
            group[b] = a
            has[a] |= has[b]
            parts[a] |= parts[b]
            changed = True
        self.groups = sorted(tuple(sorted(parts[i])) for i in range(len(parts)) if group[i] == i)
        return changed

    def _result(self, now: _Map, tested: LeftOut, near: Near, reasons: list[Reason]) -> Merges:
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
        for (p, q), (d2, reason) in self.dropped.items():
            considered.append(Considered(self.parts[p][0], self.parts[q][0], d2, reason))
        return Merges(self._classes(), tuple(sorted(pairs)), tuple(sorted(considered, key=lambda e: e[:2])))
