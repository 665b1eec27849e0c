"""How well each part of a merged landmark fits the rest, with its own merge removed and all others kept.

A landmark y_c made of several parts is split: part u becomes y_c + delta. With the information matrix H_s and gradient
g_s of the frames in which u has a variable of its own, and A, which copies a merged state into its parts,

    S^-1 = H_uu - (A' H_s E_u)' H^-1 (A' H_s E_u)        delta = S g_u        d^2 = g_u' S g_u

S is the covariance of delta given everything else, delta where u would be by itself: what a solution without this one
merge would give, linearised at the one with it.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse

from fleet_seif.joint_assembly import Evaluation, assembled, evaluate_into, turns_into
from fleet_seif.joint_covariance import TOGETHER_MAX, JointCovariance, diagonal_blocks, halved
from fleet_seif.joint_frames import Frames
from fleet_seif.joint_records import Classes, JointSolution
from fleet_seif.records import Floats, Ints


class LeftOut(NamedTuple):
    """Parts of merged landmarks, each against the rest of its landmark.

    landmark (p,): which landmark of the solution. part (p,): which of the parts. moved (p, 2): where the part would be
    by itself, from the merged landmark, m. S (p, 2, 2): covariance of that. d2 (p,): its squared distance.
    """

    landmark: Ints
    part: Ints
    moved: Floats
    S: Floats
    d2: Floats


class _Split(NamedTuple):
    """Variables of parts: which landmark and part each is, its own joint variable, and the one it is merged into."""

    landmark: Ints
    part: Ints
    own: Ints
    merged: Ints


def left_out(solution: JointSolution, parts: Classes, covariance: JointCovariance) -> LeftOut:
    """Every part of every landmark that has several.

    Args:
        parts: classes that those of the solution are made of; of one life a landmark has names in one part only.
    """
    split, tables = _split(solution, parts)
    H, g = _system(solution, split, tables)
    v = len(solution.system.size)
    fold = _fold(split, v)
    place = solution.landmark_mean[split.landmark]
    S, moved = np.empty((len(split.own), 2, 2)), np.empty((len(split.own), 2))
    for some in halved(place, TOGETHER_MAX):
        columns = (3 * split.own[some, None] + np.arange(2)).ravel()
        own = H[:, columns]
        Y = covariance.whitened((fold.T @ own).tocoo())
        rows = own[columns].toarray()
        information = diagonal_blocks(rows) - diagonal_blocks(Y.T @ Y)
        S[some] = np.linalg.inv((information + information.transpose(0, 2, 1)) / 2)
        moved[some] = np.einsum("pij,pj->pi", S[some], g[split.own[some], :2])
    d2 = np.einsum("pi,pi->p", moved, g[split.own, :2])
    return LeftOut(split.landmark, split.part, moved, S, d2)


def _split(solution: JointSolution, parts: Classes) -> tuple[_Split, dict[tuple[str, int], dict[int, int]]]:
    """The parts that get a variable of their own; for each life, by which one each merged variable is replaced."""
    part_of = {name: p for p, names in enumerate(parts) for name in names}
    found: list[tuple[int, int, int, int]] = []
    tables: dict[tuple[str, int], dict[int, int]] = {}
    v = len(solution.system.size)
    for c, names in enumerate(solution.classes):
        inside = sorted({part_of[name] for name in names})
        if len(inside) < 2:
            continue
        merged = int(solution.system.variable[c])
        own = {p: v + len(found) + i for i, p in enumerate(inside)}
        found += [(c, p, own[p], merged) for p in inside]
        for name in names:
            tables.setdefault((name.vehicle, name.life), {})[merged] = own[part_of[name]]
    columns = np.array(found, np.int64).reshape(-1, 4).T
    return _Split(*columns), tables


def _fold(split: _Split, v: int) -> scipy.sparse.csr_array:
    """A (3 (v + p), 3 v): a state without parts into one with them."""
    kept = np.arange(3 * v)
    rows = np.concatenate([kept, (3 * split.own[:, None] + np.arange(2)).ravel()])
    cols = np.concatenate([kept, (3 * split.merged[:, None] + np.arange(2)).ravel()])
    return scipy.sparse.csr_array((np.ones(len(rows)), (rows, cols)), shape=(3 * (v + len(split.own)), 3 * v))


def _system(
    solution: JointSolution, split: _Split, tables: dict[tuple[str, int], dict[int, int]]
) -> tuple[scipy.sparse.csr_array, Floats]:
    """H_s, three rows a variable, and g_s (v + p, 3), at the merged state."""
    system = solution.system
    v, more = len(system.size), len(split.own)
    maps = {name: np.arange(v) for name in {key[:2] for key in system.keys if key is not None}}
    for name, table in tables.items():
        maps[name][list(table)] = list(table.values())
    frames = system.frames
    variable = frames.variable.copy()
    for f, key in enumerate(system.keys):
        if key is not None:
            first, last = frames.first_variable[f], frames.end_variable[f]
            variable[first:last] = maps[key[:2]][variable[first:last]]
    frames = frames._replace(variable=variable)
    at = _evaluated(frames, np.concatenate([system.at.X, system.at.X[split.merged]]), system.at)
    members = []
    for piece in system.pieces:
        key = system.keys[piece.frame]
        members.append(piece.variables if key is None else maps[key[:2]][piece.variables])
    size = np.concatenate([system.size, np.full(more, 2, np.int64)])
    pieces = np.array([piece[:3] for piece in system.pieces], np.int64)
    H = assembled(frames, pieces, members, at, 3 * np.arange(v + more), size, 3 * (v + more))
    return H, at.g


def _evaluated(frames: Frames, X: Floats, merged: Evaluation) -> Evaluation:
    """What frames say at X, which is the merged state: chi-squares and weights are those of the merged system."""
    active = np.flatnonzero(frames.end_variable - frames.first_variable + (frames.start >= 0) > 0)
    turns, g, z = np.zeros((len(frames.start), 2)), np.zeros_like(X), np.zeros(len(frames.mean))
    turns_into(turns, frames, active, X)
    chi_square, weight = np.zeros(len(frames.start)), np.ones(len(frames.start))
    cost = evaluate_into(g, z, chi_square, weight, frames, active, X, turns)
    return Evaluation(X, cost, g, z, chi_square, merged.weight)
