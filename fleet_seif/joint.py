"""The joint map: frame totals of all vehicles, assembled into one sparse system and solved.

Every frame contributes (H_f, b_f) over z_f = (T_f^-1 T_f+1, T_f^-1 y_j ...), in its own coordinates. With J the
Jacobian of z_f in the joint state x, and w_f = 1 but for frames that disagree with all others,

    H = sum_f w_f J_f' H_f J_f  (+ priors of start poses)        g = sum_f w_f J_f' (b_f - H_f z_f)

solved by Gauss-Newton. Landmarks of one class share columns of J: that is the paper's merging by addition (section
4.2). Where every vehicle has one frame and a given start pose, z is linear in x and one step solves it. MATHS.md has
the derivation.

Rows of x: landmarks (two each) in canonical order, then the poses (three each): per life its frame starts that are not
given, then its newest pose.

How it is done, from the bottom up: joint_frames (what frames say), joint_assembly (cost, gradient and blocks),
joint_tree (the sparse factor), joint_registry (names and numbers), joint_estimate (Gauss-Newton), joint_solver (as
frames arrive, and warm).
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from fleet_seif.information import POSE
from fleet_seif.jit import one_thread
from fleet_seif.joint_frames import SparseFactor
from fleet_seif.joint_records import Classes, JointSolution, Life
from fleet_seif.joint_solver import JointSolver
from fleet_seif.joint_tree import Tree
from fleet_seif.messages import LandmarkName
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints

__all__ = [
    "JointSolution", "JointSolver", "Life", "Pair", "landmark_chi_square", "landmark_classes", "landmark_names",
    "marginal_chi_square", "marginal_covariances", "solve",
]  # fmt: skip

Pair = tuple[LandmarkName, LandmarkName]


def landmark_names(life: Life) -> list[LandmarkName]:
    """The landmarks of a life, ascending; one whose rows are all zero in every frame is none."""
    present = [delta.variables[delta.variables != POSE] - 1 for delta in life.frames]
    numbers = np.unique(np.concatenate(present)).tolist() if present else []
    return [LandmarkName(life.vehicle, life.life, number) for number in numbers]


def landmark_classes(
    lives: Sequence[Life],
    forced: Sequence[Pair] = (),
    forbidden: Sequence[Pair] = (),
    merged: Sequence[Pair] = (),
) -> Classes:
    """Which landmarks are the same: those that carry one signature, and aliases. In order of their first names.

    Landmarks whose rows are all zero in every frame are none and do not appear.

    Args:
        forced: pairs that are one landmark whatever they carry, joined first and in this order.
        forbidden: pairs that are two: what would join them, a forced pair too, does nothing.
        merged: pairs that were found to be one, joined last, but for those that would give a life another name.
    """
    groups: dict[object, list[LandmarkName]] = {}
    names: list[LandmarkName] = []
    aliases: list[Pair] = []
    for life in lives:
        for name in landmark_names(life):
            names.append(name)
            signature = life.signatures[name.number]
            groups.setdefault(name if signature == UNKNOWN_SIGNATURE else signature, []).append(name)
        aliases += [
            (LandmarkName(life.vehicle, life.life, a), LandmarkName(life.vehicle, life.life, b))
            for a, b in life.aliases
        ]
    if forced or forbidden or aliases or merged:
        same = [(group[0], other) for group in map(sorted, groups.values()) for other in group[1:]]
        linking = {name for pair in aliases for name in pair}.difference(
            names
        )  # of no landmark, but aliases go on there
        joined = _joined([*names, *linking], [*forced, *sorted([*same, *aliases])], forbidden, merged)
        return joined if not linking else _without(joined, linking)
    return tuple(sorted(tuple(sorted(group)) for group in groups.values()))


def _without(classes: Classes, absent: set[LandmarkName]) -> Classes:
    present = (tuple(name for name in names if name not in absent) for names in classes)
    return tuple(sorted(names for names in present if names))


def _joined(
    names: Sequence[LandmarkName], pairs: Sequence[Pair], forbidden: Sequence[Pair], merged: Sequence[Pair]
) -> Classes:
    """Classes of names: pairs are joined in order, but for those that would put a forbidden pair into one class, then
    those merged, but for those that would put two names of one life into one class, too."""
    classes = {name: {name} for name in names}
    apart: dict[LandmarkName, set[LandmarkName]] = {}
    for a, b in forbidden:
        apart.setdefault(a, set()).add(b)
        apart.setdefault(b, set()).add(a)
    decided = len(pairs)
    for i, (a, b) in enumerate([*pairs, *merged]):
        if a not in classes or b not in classes or classes[a] is classes[b]:
            continue
        one, other = classes[a], classes[b]
        if any(not apart[name].isdisjoint(other) for name in one & apart.keys()):
            continue
        if i >= decided and not {name[:2] for name in one}.isdisjoint(name[:2] for name in other):
            continue
        one |= other
        for name in other:
            classes[name] = one
    return tuple(sorted({tuple(sorted(group)) for group in classes.values()}))


def solve(lives: Sequence[Life], classes: Classes) -> JointSolution:
    """The joint map of these lives, in canonical order (by vehicle, then life): JointSolver.replay.

    Raises NumericalError where the system is not positive definite or Gauss-Newton does not settle.
    """
    return JointSolver().replay(lives, classes)


@one_thread
def marginal_covariances(solution: JointSolution) -> tuple[Floats, Floats]:
    """Exact marginals of every landmark (n, 2, 2), m^2, and pose (p, 3, 3): diagonal blocks of H^-1.

    By selected inversion, linearised at the mean, robust weights included.
    """
    system = solution.system
    tree = Tree()
    tree.know(system.size.tolist())
    tree.add(system.pieces)
    tree.factor(system.frames, system.at)
    blocks = tree.inverse_blocks()
    count = len(solution.classes)
    return blocks[system.variable[:count], :2, :2], blocks[system.variable[count:]]


def landmark_chi_square(solution: JointSolution, error: Floats, chosen: NDArray[np.bool_] | None = None) -> float:
    """d' P^-1 d with the joint covariance P of the chosen landmarks (all by default).

    Args:
        error: d, shape (k, 2), m, one row for each chosen landmark.
        chosen: which landmarks, shape (n,).
    """
    every = np.ones(len(solution.classes), bool)
    return marginal_chi_square(solution.H, np.flatnonzero(np.repeat(every if chosen is None else chosen, 2)), error)


def marginal_chi_square(H: scipy.sparse.csr_array, rows: Ints, error: Floats) -> float:
    """d' P^-1 d with the joint covariance P of the chosen rows of a system with information H.

    P^-1 is the Schur complement of all other variables: H_cc - H_co H_oo^-1 H_oc.

    Args:
        rows: which rows, ascending, shape (k,).
        error: d, k values in any shape.

    Raises:
        NumericalError: H is not positive definite.
    """
    other = np.setdiff1d(np.arange(H.shape[0]), rows)
    d = error.ravel()
    value = float(d @ (H[rows][:, rows] @ d))
    if len(other):
        pulled = H[other][:, rows] @ d
        value -= float(pulled @ SparseFactor(H[other][:, other]).solve(pulled))
    return value
