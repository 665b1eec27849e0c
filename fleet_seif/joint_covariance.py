"""Covariances between any parts of a solved joint map, exact, from the factor over its tree of frames.

With H = L L' (L by nodes of the tree), the covariance of linear functions G'x of the state is

    G' H^-1 G = Y'Y        Y = L^-1 G

and forward substitution alone touches only the nodes where something of G is eliminated, and those above: functions of
a few variables that lie near each other cost a path to the root, however large the map is.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
import scipy.linalg
import scipy.sparse

from fleet_seif.joint_records import JointSolution
from fleet_seif.joint_tree import Tree
from fleet_seif.records import Floats, Ints

TOGETHER_MAX: Final = 64
"""Differences that are substituted at a time: BLAS is at its best, and memory stays small."""


def halved(points: Floats, most: int) -> Iterator[Ints]:
    """Points (n, 2) in groups of at most `most` that lie together: halved along the longer side as often as needed."""
    waiting = [np.arange(len(points))]
    while waiting:
        group = waiting.pop()
        if len(group) <= most:
            if len(group):
                yield group
            continue
        axis = int(np.argmax(np.ptp(points[group], axis=0)))
        order = group[np.argsort(points[group, axis], kind="stable")]
        waiting += [order[len(order) // 2 :], order[: len(order) // 2]]


_blas = scipy.linalg.blas


class JointCovariance:
    """Covariances of one solution, linearised at its mean, robust weights included."""

    def __init__(self, solution: JointSolution) -> None:
        system = solution.system
        self._tree = Tree()
        self._tree.know(system.size.tolist())
        self._tree.add(system.pieces)
        self._tree.factor(system.frames, system.at)
        self._nodes = self._tree.nodes()
        self._home = np.full(len(system.size), -1)
        for k, node in enumerate(self._nodes):
            self._home[node.variables[: node.eliminated]] = k
        number = {node: k for k, node in enumerate(self._nodes)}
        self._above = [-1 if node.parent is None else number[node.parent] for node in self._nodes]
        self._place = np.zeros(3 * len(system.size), np.int64)
        self._variable = system.variable
        self._mean = solution.landmark_mean

    def landmarks(self) -> Floats:
        """The marginal of every landmark, m^2, shape (n, 2, 2)."""
        return self._tree.inverse_blocks()[self._variable[: len(self._mean)], :2, :2]

    def whitened(self, G: scipy.sparse.coo_array) -> Floats:
        """Y (r, c) with Y'Y = G' H^-1 G, for c linear functions G (3 v, c) of the state (three rows a variable)."""
        path: set[int] = set()
        for k in np.unique(self._home[G.row // 3]).tolist():
            while k >= 0 and k not in path:
                path.add(k)
                k = self._above[k]
        nodes = [self._nodes[k] for k in sorted(path)]
        rows = np.concatenate([*(node.rows[: len(node.D)] for node in nodes), np.empty(0, np.int64)])
        self._place[rows] = np.arange(len(rows))
        g, at = np.zeros((len(rows), G.shape[1])), 0
        np.add.at(g, (self._place[G.row], G.col), G.data)
        for node in nodes:
            e = len(node.D)
            if e:
                g[at : at + e] = y = _blas.dtrsm(1.0, node.D.T, g[at : at + e], lower=1)
                if len(node.rows) > e:
                    g[self._place[node.rows[e:]]] -= node.W.T @ y
            at += e
        return g

    def differences(self, pairs: Ints) -> Floats:
        """The joint covariance of the differences y_a - y_b of pairs (m, 2) of landmarks, m^2, shape (2 m, 2 m)."""
        m = len(pairs)
        rows = 3 * self._variable[pairs.T.ravel()][:, None] + np.arange(2)
        cols = np.tile(np.arange(2 * m).reshape(m, 2), (2, 1))
        sign = np.repeat([1.0, -1.0], 2 * m)
        G = scipy.sparse.coo_array((sign, (rows.ravel(), cols.ravel())), shape=(3 * len(self._tree.size), 2 * m))
        Y = self.whitened(G)
        return np.asarray(Y.T @ Y)

    def difference_blocks(self, pairs: Ints) -> Floats:
        """The covariance of each difference y_a - y_b alone, m^2, shape (m, 2, 2)."""
        blocks = np.empty((len(pairs), 2, 2))
        for some in halved(self._mean[pairs[:, 0]], TOGETHER_MAX):
            blocks[some] = diagonal_blocks(self.differences(pairs[some]))
        return blocks


def diagonal_blocks(S: Floats) -> Floats:
    """The (2, 2) blocks on the diagonal of S (2 m, 2 m), shape (m, 2, 2)."""
    m = len(S) // 2
    at = np.arange(m)
    return np.asarray(S.reshape(m, 2, m, 2)[at, :, at, :])


def squared_distances(d: Floats, S: Floats) -> Floats:
    """d' S^-1 d of each d (m, 2) with its covariance S (m, 2, 2), shape (m,)."""
    return np.asarray(np.einsum("mi,mi->m", d, np.linalg.solve(S, d[..., None])[..., 0]))
