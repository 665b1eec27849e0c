"""Alignments of two maps: sets of pairs that agree, their rivals, and patterns that repeat."""

import numpy as np
import scipy.spatial

from fleet_seif.consistent import Candidates, Found, agreeing, gains, grown, largest_clique
from fleet_seif.joint_covariance import diagonal_blocks, squared_distances
from fleet_seif.merge_records import MergeRules, Reason
from fleet_seif.records import Floats, Ints


def cautious(d2: Floats, S: Floats, density: Floats, rules: MergeRules) -> Floats:
    """The gain of pairs as if all covariances were larger: those of real vehicles are too small."""
    return gains(d2 / rules.inflation, S * rules.inflation, density)


def root(group: dict[int, int], i: int) -> int:
    while group[i] != i:
        i = group[i]
    return i


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
        rows = _rows(members)
        S, d = c.S[np.ix_(rows, rows)], c.D[members].ravel()
        gain = -0.5 * (np.linalg.slogdet(S)[1] + d @ np.linalg.solve(S, d))
        found.append(Found(members, float(gain - np.log(2.0 * np.pi * c.density[members]).sum())))
    return found


def _independent(c: Candidates, members: Ints) -> Ints:
    """Without those that follow from others: of a = b, b = c and a = c the last."""
    group = {int(end): int(end) for end in c.ends[members].ravel()}
    kept = []
    for k in members.tolist():
        a, b = (root(group, int(end)) for end in c.ends[k])
        if a != b:
            group[b] = a
            kept.append(k)
    return np.array(kept, np.int64)


def _is_rival(best: Found, other: Found, c: Candidates, rules: MergeRules) -> bool:
    """Whether another set is another alignment, nearly as large: most of its pairs cannot be true with the best one."""
    if other is best or other.gain <= 0.0:
        return False
    if len(other.members) < max(rules.set_min - 1, rules.rival_share * len(best.members)):
        return False
    beside = np.setdiff1d(other.members, best.members)
    against = beside[_given(c, beside, best.members) > rules.gate]
    return 2 * len(against) > len(other.members) and not set(c.ends[against].ravel().tolist()).isdisjoint(
        c.ends[best.members].ravel().tolist()
    )


def _rows(members: Ints) -> Ints:
    return np.asarray((2 * members[:, None] + np.arange(2)).ravel())


def _given(c: Candidates, chosen: Ints, members: Ints) -> Floats:
    """The squared distance of each chosen pair, given that all members are true."""
    i, j = _rows(chosen), _rows(members)
    pull = np.linalg.solve(c.S[np.ix_(j, j)], np.column_stack([c.S[np.ix_(j, i)], c.D[members].ravel()]))
    S = diagonal_blocks(c.S[np.ix_(i, i)] - c.S[np.ix_(i, j)] @ pull[:, :-1])
    d = c.D[chosen] - (c.S[np.ix_(i, j)] @ pull[:, -1]).reshape(-1, 2)
    return squared_distances(d, S + 1e-12 * np.eye(2))


def _given_the_others(c: Candidates, members: Ints) -> tuple[Floats, Floats]:
    """For each member of a set, d2 (k,) and S (k, 2, 2) given that all others are true.

    With M = S^-1 of the whole set and w = M d: S_k = M_kk^-1, d_k = S_k w_k.
    """
    rows = _rows(members)
    M = np.linalg.inv(c.S[np.ix_(rows, rows)])
    S = np.linalg.inv(diagonal_blocks((M + M.T) / 2))
    w = (M @ c.D[members].ravel()).reshape(-1, 2)
    return np.asarray(np.einsum("ki,kij,kj->k", w, S, w)), np.asarray(S)


def _repeats_within(pattern: Floats, cloud: Floats, S: Floats, repeat: float, reach: float, tolerance: float) -> bool:
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


def judged(c: Candidates, mean: Floats, rules: MergeRules) -> tuple[list[Reason | None], Floats]:
    """The verdict on each candidate of a group by the sets that agree, and the gain of each given its set."""
    verdicts: list[Reason | None] = [None] * len(c.D)
    support = np.zeros(len(c.D))
    place = mean[c.ends].mean(axis=1)
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
        elif _repeats(c, members, mean, rules):
            verdict = Reason.REPEATS
        else:
            d2, S = _given_the_others(c, members)
            own = cautious(d2, S, c.density[members], rules)
            for k, value, distance in zip(members.tolist(), own.tolist(), d2.tolist(), strict=True):
                fine = value >= rules.pair_gain and distance <= rules.gate
                verdicts[k] = Reason.MERGED if fine else Reason.CROWDED
                support[k] = value
            continue
        for k in members.tolist():
            verdicts[k] = verdict
    return verdicts, support


def _repeats(c: Candidates, members: Ints, mean: Floats, rules: MergeRules) -> bool:
    """Whether one of the two maps holds the pattern of a set again, so near that place does not tell them apart."""
    own = diagonal_blocks(c.S)[members]
    S = own[int(np.argmin(np.linalg.det(own)))]
    reach = float(np.sqrt(rules.repeat * np.linalg.eigvalsh(S)[-1]))
    _, given = _given_the_others(c, members)
    tolerance = float(np.sqrt(rules.gate * np.median(np.linalg.eigvalsh(given)[:, -1])))
    for side in (0, 1):
        ends = c.ends[members, side]
        lives = np.any(c.has[ends], axis=0)
        cloud = mean[np.any(c.has & lives, axis=1)]
        if _repeats_within(mean[ends], cloud, S, rules.repeat, reach, tolerance):
            return True
    return False
