"""Covariances between any parts of a solved joint map, exact, from the factor over its tree of frames.

With H = L L' (L by nodes of the tree), the covariance of linear functions G'x of the state is

    G' H^-1 G = Y'Y        Y = L^-1 G

and forward substitution alone touches only the nodes where something of G is eliminated, and those above: functions of
a few variables that lie near each other cost a path to the root, however large the map is.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import scipy.linalg

from fleet_seif.joint_records import JointSolution
from fleet_seif.joint_tree import Tree
from fleet_seif.records import Floats, Ints

TOGETHER_MAX: Final = 64
"""Differences that are substituted at a time: BLAS is at its best, and memory stays small."""


def halved(points: Floats, most: int) -> Iterator[Ints]:
    """Points (n, 2) in groups of at most `most` that lie together: halved along the longer side while there are more."""
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


class JointCovariance:
    """Covariances of one solution, linearised at its mean, robust weights included."""

    def __init__(self, solution: JointSolution) -> None:
        system = solution.system
        self._tree = Tree()
        self._tree.know(system.size.tolist())
        self._tree.add(system.pieces)
        self._tree.factor(system.frames, system.at)
        self._variable = system.variable
        self._mean = solution.landmark_mean

    def landmarks(self) -> Floats:
        """The marginal of every landmark, m^2, shape (n, 2, 2)."""
        return self._tree.inverse_blocks()[self._variable[: len(self._mean)], :2, :2]

    def whitened(self, G: Floats) -> Floats:
        """Y (r, c) with Y'Y = G' H^-1 G, for c linear functions G (3 v, c) of the state (three rows a variable)."""
        g, touched, found = G.copy(), np.any(G, axis=1), []
        for node in self._tree.nodes():
            e, rows = len(node.D), node.rows
            if not e or not np.any(touched[rows[:e]]):
                continue
            y = scipy.linalg.solve_triangular(node.D, g[rows[:e]], trans=1, check_finite=False)
            found.append(y)
            if len(rows) > e:
                g[rows[e:]] -= node.W.T @ y
                touched[rows[e:]] = True
        return np.concatenate([*found, np.empty((0, G.shape[1]))])

    def differences(self, pairs: Ints) -> Floats:
        """The joint covariance of the differences y_a - y_b of pairs (m, 2) of landmarks, m^2, shape (2 m, 2 m)."""
        G = np.zeros((3 * len(self._tree.size), 2 * len(pairs)))
        columns = 2 * np.arange(len(pairs))
        for end, sign in ((0, 1.0), (1, -1.0)):
            for axis in range(2):
                G[3 * self._variable[pairs[:, end]] + axis, columns + axis] += sign
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


