"""Which landmarks of a map come near each other, and what speaks for each pair by itself."""

from typing import Final, NamedTuple

import numpy as np
import scipy.sparse.csgraph
import scipy.spatial

from fleet_seif.consistent import Bools
from fleet_seif.records import Floats, Ints

NEIGHBOURS: Final = 8
"""Landmarks of one life that a density is measured over."""
NEAR_MAX: Final = 100
"""Landmarks around one that are looked at, whoever saw them: a bound on work where uncertainty is large."""
CROWD_MAX: Final = 16
"""Candidates of one landmark that are looked at, the nearest first."""


class Near(NamedTuple):
    """Pairs of landmarks (m, 2) that come near each other, with differences, covariances and squared distances."""

    ends: Ints
    D: Floats
    S: Floats
    d2: Floats

    def take(self, chosen: Ints | Bools) -> "Near":
        return Near(self.ends[chosen], self.D[chosen], self.S[chosen], self.d2[chosen])


def density(mean: Floats, has: Bools) -> Floats:
    """How dense the landmarks of one life lie around each landmark, per m^2; of several lives the densest."""
    density = np.zeros(len(mean))
    for life in range(has.shape[1]):
        own = np.flatnonzero(has[:, life])
        k = min(NEIGHBOURS, len(own) - 1)
        if k < 1:
            density[own] = np.inf  # nothing is known: nothing is merged by it
            continue
        radius = np.asarray(scipy.spatial.KDTree(mean[own]).query(mean[own], [k + 1])[0])[:, 0]
        density[own] = np.maximum(density[own], k / (np.pi * np.maximum(radius, 1e-12) ** 2))
    return density


def within(mean: Floats, reach: Floats) -> Ints:
    """Pairs (m, 2), a < b, ascending, nearer than reach_a + reach_b; of a crowd around one the NEAR_MAX nearest."""
    tree, many = scipy.spatial.KDTree(mean), np.empty(0, np.int64)
    if len(mean) > NEAR_MAX:
        many = np.flatnonzero(tree.query_ball_point(mean, 2.0 * reach, return_length=True) > NEAR_MAX)
    few = np.setdiff1d(np.arange(len(mean)), many)
    near = tree.query_ball_point(mean[few], 2.0 * reach[few])
    nearest = np.asarray(tree.query(mean[many], NEAR_MAX)[1]) if len(many) else np.empty((0, NEAR_MAX), np.int64)
    a = np.concatenate([np.repeat(few, np.array([len(each) for each in near], np.int64)), np.repeat(many, NEAR_MAX)])
    b = np.concatenate([*(np.array(each, np.int64) for each in near), nearest.ravel()])
    ends = np.sort(np.stack([a, b], axis=1)[a != b], axis=1)
    ends = np.unique(ends, axis=0).reshape(-1, 2)
    apart = np.linalg.norm(mean[ends[:, 0]] - mean[ends[:, 1]], axis=1)
    return np.asarray(ends[apart <= reach[ends[:, 0]] + reach[ends[:, 1]]])


def _incident(ends: Ints, n: int) -> list[list[int]]:
    """The pairs of each landmark."""
    found: list[list[int]] = [[] for _ in range(n)]
    for k, (a, b) in enumerate(ends.tolist()):
        found[a].append(k)
        found[b].append(k)
    return found


def not_crowded(near: Near, n: int) -> Bools:
    """Which pairs are among the nearest CROWD_MAX of both of their landmarks."""
    kept = np.ones(len(near.d2), bool)
    for pairs in _incident(near.ends, n):
        if len(pairs) > CROWD_MAX:
            order = np.array(pairs)[np.argsort(near.d2[pairs], kind="stable")]
            kept[order[CROWD_MAX:]] = False
    return kept


def margins(near: Near, has: Bools) -> Floats:
    """By how much the squared distance of the nearest rival of each pair is larger: one that cannot be true with it."""
    margin = np.full(len(near.d2), np.inf)
    for x, pairs in enumerate(_incident(near.ends, len(has))):
        other = near.ends[pairs].sum(axis=1) - x
        for i, k in enumerate(pairs):
            for j, r in enumerate(pairs):
                if i != j and np.any(has[other[i]] & has[other[j]]):
                    margin[k] = min(margin[k], near.d2[r] - near.d2[k])
    return margin


def components(has: Bools) -> Ints:
    """Which lives have landmarks in common, directly or through others: a number for each life."""
    shared = (has.T.astype(np.int64) @ has.astype(np.int64)) > 0
    return np.asarray(scipy.sparse.csgraph.connected_components(shared, directed=False)[1])
