"""Landmarks that a vehicle has begun twice, found by where they are (MATHS.md 19).

Two landmarks that were never sighted together may be one. Their difference is an error with a known covariance, and so
are those of all such pairs, jointly. The search for sets of pairs that agree is that between vehicles
(fleet_seif.alignments): a pattern of landmarks says more than each of them. A pair by itself counts where its place is
so well known that it cannot be taken for a neighbour. How dense landmarks are is told by how far the second nearest is:
where many have been begun twice the nearest is the landmark itself.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
import scipy.spatial

from fleet_seif.alignments import judged
from fleet_seif.consistent import Candidates
from fleet_seif.joint_covariance import halved, squared_distances
from fleet_seif.local_map import LocalMap
from fleet_seif.merge_records import MergeRules, Reason
from fleet_seif.records import Floats, Ints

RULES: Final = MergeRules(set_min=3, inflation=1.0, repeat=0.0)
ALONE_GATE: Final = 9.2
"""Squared distance up to which a pair by itself is one landmark (chi-square, 2 degrees of freedom: 99 %)."""
ALONE_SIGMAS: Final = 3.0
"""A pair by itself counts where so many standard deviations reach at most half way to the next landmark."""

PAIRS_MAX: Final = 512
"""Of pairs that may be one so many are looked at, those whose difference is known best: where a vehicle hardly knows
where it is, all may be."""


def nearest_m(places: Floats, k: int = 1) -> Floats:
    """How far the k-th nearest other place is, m, shape (n,); infinite where there are not so many."""
    return np.asarray(scipy.spatial.KDTree(places).query(places, [k + 1])[0])[:, 0] if len(places) else np.empty(0)


def own_duplicates(
    local: LocalMap, together: Callable[[int, int], bool], rules: MergeRules = RULES
) -> list[tuple[int, int]]:
    """Pairs of keys that are one landmark. together: whether two have been sighted from one pose."""
    accepted = np.flatnonzero(local.keys >= 0)
    mean, keys = local.landmarks[accepted], local.keys[accepted]
    ends = np.stack(np.triu_indices(len(keys), 1), axis=1)
    rows = 3 + 2 * accepted
    S = _differences(local.P, rows[ends])
    d2 = squared_distances(mean[ends[:, 0]] - mean[ends[:, 1]], S)
    near = np.flatnonzero(d2 <= rules.gate)
    near = near[[not together(int(keys[a]), int(keys[b])) for a, b in ends[near].tolist()]]
    if not len(near) or len(keys) < 3:  # with two landmarks nothing says how far the next may be
        return []
    std = np.sqrt(np.linalg.eigvalsh(S[near])[:, -1])
    best = np.sort(np.argsort(std, kind="stable")[:PAIRS_MAX])
    near, std = near[best], std[best]
    ends, d2 = ends[near], d2[near]
    apart = nearest_m(mean, 2)
    same = (2.0 * ALONE_SIGMAS * std <= apart[ends].min(axis=1)) & (d2 <= ALONE_GATE)
    density = 2.0 / (np.pi * np.median(apart) ** 2)
    for some in halved(mean[ends].mean(axis=1), rules.group_max):
        pairs = Candidates(
            mean[ends[some, 0]] - mean[ends[some, 1]], _joint_differences(local.P, rows[ends[some]]), ends[some],
            np.eye(len(keys), dtype=bool), np.full(len(some), density),
        )  # fmt: skip
        verdicts, _ = judged(pairs, mean, rules)
        same[some] |= np.array([verdict is Reason.MERGED for verdict in verdicts], bool)
    return [(int(keys[a]), int(keys[b])) for a, b in ends[same].tolist()]


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
