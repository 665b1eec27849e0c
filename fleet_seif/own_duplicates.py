"""Landmarks that a vehicle has begun twice, found by where they are (MATHS.md 19).

Two landmarks that were never sighted together may be one. Their difference is an error with a known covariance, and so
are those of all such pairs, jointly. The search for sets of pairs that agree is that between vehicles
(fleet_seif.alignments): a pattern of landmarks says more than each of them. A pair by itself counts where its place is
so well known that it cannot be taken for a neighbour: that is the nearest which was sighted together with it, or the
second nearest of all, since where many have been begun twice the nearest is the landmark itself.
"""

from typing import Final, NamedTuple

import numpy as np
import scipy.spatial

from fleet_seif.alignments import judged
from fleet_seif.consistent import Candidates
from fleet_seif.joint_covariance import squared_distances
from fleet_seif.local_map import LocalMap
from fleet_seif.merge_records import MergeRules, Reason
from fleet_seif.records import Floats, Ints

RULES: Final = MergeRules(set_min=3, inflation=1.0, repeat=0.0)
ALONE_GATE: Final = 25.0
"""Squared distance up to which a pair by itself is one landmark: five standard deviations, since two of a kind that
were never sighted together are rare, and pairs that are nearer have been joined before."""
PAIRS_MAX: Final = 128
"""Pairs that are looked at, the nearest first."""
TOGETHER_LEAST: Final = 2
"""Poses from which two landmarks must have been sighted to be two: once may be clutter."""
ALONE_SIGMAS: Final = 3.0
"""A pair by itself counts where its distance and so many standard deviations reach at most half way to the next one."""


def nearest_m(places: Floats, k: int) -> Floats:
    """How far the k-th nearest other place is, m, shape (n,); infinite where there are not so many."""
    return np.asarray(scipy.spatial.KDTree(places).query(places, [k + 1])[0])[:, 0] if len(places) else np.empty(0)


class Duplicates(NamedTuple):
    """pairs: keys that are one landmark. unclear: share of landmarks that may be another one, and could not be told."""

    pairs: list[tuple[int, int]]
    unclear: float


def spacing_m(places: Floats, met: Ints) -> Floats:
    """How far each landmark is at most from its nearest neighbour, m, shape (n,).

    Only landmarks that were sighted together count: others may be one. And nobody counts as lonelier than the median:
    the neighbour may not have been sighted yet.

    Args:
        places (n, 2). met (n, n): from how many poses each two were sighted.
    """
    away = np.linalg.norm(places[:, None] - places[None], axis=2)
    nearest = np.where(met > 0, away, np.inf).min(axis=1, initial=np.inf)
    usual = np.median(nearest[np.isfinite(nearest)]) if np.any(met) else np.inf
    return np.asarray(np.minimum(nearest, usual))


def own_duplicates(local: LocalMap, met: Ints, rules: MergeRules = RULES) -> Duplicates:
    """Landmarks of a map that are one.

    Args:
        met (k, k): from how many poses each two of its k accepted landmarks, in their order, were sighted.
    """
    accepted = np.flatnonzero(local.keys >= 0)
    mean, keys = local.landmarks[accepted], local.keys[accepted]
    ends = np.stack(np.triu_indices(len(keys), 1), axis=1)
    rows = 3 + 2 * accepted
    S = _differences(local.P, rows[ends])
    d2 = squared_distances(mean[ends[:, 0]] - mean[ends[:, 1]], S)
    near = np.flatnonzero(d2 <= max(rules.gate, ALONE_GATE))
    near = near[met[ends[near, 0], ends[near, 1]] < TOGETHER_LEAST]
    near = near[np.argsort(d2[near], kind="stable")[:PAIRS_MAX]]
    ends, S, d2 = ends[near], S[near], d2[near]
    if not len(ends) or len(keys) < 3:  # with two landmarks nothing says how far the next may be
        return Duplicates([], 0.0)
    D = mean[ends[:, 0]] - mean[ends[:, 1]]
    reach = np.linalg.norm(D, axis=1) + ALONE_SIGMAS * np.sqrt(np.linalg.eigvalsh(S)[:, -1])
    apart = nearest_m(mean, 2)
    same = 2.0 * reach <= np.maximum(apart, spacing_m(mean, met))[ends].min(axis=1)
    found = [(int(keys[a]), int(keys[b])) for a, b in ends[same].tolist()]
    ends, D = ends[d2 <= rules.gate], D[d2 <= rules.gate]
    density = np.full(len(ends), 2.0 / (np.pi * np.median(apart) ** 2))
    candidates = Candidates(D, _joint_differences(local.P, rows[ends]), ends, np.eye(len(keys), dtype=bool), density)
    verdicts, _ = judged(candidates, mean, rules)
    fits = [verdict is Reason.MERGED for verdict in verdicts]
    pairs = sorted({*found, *((int(keys[a]), int(keys[b])) for a, b in ends[fits].tolist())})
    unclear = {int(keys[i]) for i in ends.ravel()} - {key for pair in pairs for key in pair}
    return Duplicates(pairs, len(unclear) / len(keys))


def crowded(local: LocalMap, met: Ints) -> float:
    """Share of a map's landmarks that lie where hardly two can, by place alone, whatever covariances say.

    Nearer to one that they were never sighted together with than half the usual distance to the second nearest.

    Args:
        met: as in `own_duplicates`.
    """
    mean = local.landmarks[local.keys >= 0]
    if len(mean) < 3:
        return 0.0
    close = scipy.spatial.KDTree(mean).query_pairs(0.5 * float(np.median(nearest_m(mean, 2))), output_type="ndarray")
    found = close[met[close[:, 0], close[:, 1]] < TOGETHER_LEAST]
    return len(np.unique(found)) / len(mean)


def _differences(P: Floats, rows: Ints) -> Floats:
    """Covariance of each difference of two points, whose first rows are rows (m, 2): shape (m, 2, 2)."""
    a, b = (rows[:, side, None] + np.arange(2) for side in range(2))

    def block(one: Ints, other: Ints) -> Floats:
        return np.asarray(P[one[:, :, None], other[:, None, :]])

    return block(a, a) + block(b, b) - block(a, b) - block(b, a)


def _joint_differences(P: Floats, rows: Ints) -> Floats:
    """Joint covariance of the same, shape (2 m, 2 m)."""
    a, b = ((rows[:, side, None] + np.arange(2)).ravel() for side in range(2))
    S = P[np.ix_(a, a)] + P[np.ix_(b, b)] - P[np.ix_(a, b)] - P[np.ix_(b, a)]
    return np.asarray(S + 1e-12 * np.eye(len(S)))
