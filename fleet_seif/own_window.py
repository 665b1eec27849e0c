"""Which of a vehicle's own frames tell what lies around where it is, so that closing one costs the same in any map.

1. Up to WHOLE_FRAMES all do. Beyond, a window does: the RECENT newest, those that have changed since, and of each
   landmark that may be among the nearest the SEEN_IN newest that saw it.
2. Frames between two of them that are left out become one, which says where the next one starts as seen from where the
   first of them does: each frame's own word on its end, landmarks marginalised out, one after the other, each with the
   robust weight it had when it was solved last. What they know together by landmarks they share is left out.
3. So the window's information is a part of all there is: with W of the window and M what the whole map says about the
   same variables, M - W is positive semidefinite, and no covariance is smaller than that of the whole map.
4. Frames that are left out stay where they were, moved along with the ends of their gap. This only says which frames
   are near, and where the next solution begins.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy.linalg

from fleet_seif.errors import NumericalError
from fleet_seif.frame_deltas import quantised
from fleet_seif.geometry import compose, compose_jacobians
from fleet_seif.information import POSE, FrameDelta, to_information
from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints

WHOLE_FRAMES: Final = 64
"""Maps of at most so many frames are solved as a whole."""
RECENT: Final = 16
"""So many newest frames are always in the window."""
SEEN_IN: Final = 3
"""Of a landmark around, so many of the frames that saw it are in the window."""
MORE: Final = 1.2
"""So many times the landmarks asked for are looked for: where they are is known only roughly before it is solved."""
ENOUGH: Final = 1e-3
"""A window is solved when a step is shorter than this, in sigmas squared over all variables."""


class View(NamedTuple):
    """What a frame by itself says, as seen from its start.

    end (3,): its last pose. end_cov (3, 3): its covariance. numbers (k,): of landmarks; landmarks (k, 2), m.
    """

    end: Floats
    end_cov: Floats
    numbers: Ints
    landmarks: Floats


def view(delta: FrameDelta) -> View:
    """Raises NumericalError where a frame says nothing about its pose, or is not positive definite on its own."""
    if not len(delta.variables) or delta.variables[0] != POSE:
        raise NumericalError("a frame holds no information about its pose: nothing can be joined to it")
    info = to_information(delta)
    try:
        factor = scipy.linalg.cho_factor(info.H.toarray())
    except scipy.linalg.LinAlgError:
        raise NumericalError("a frame's information matrix is not positive definite: a delta is wrong") from None
    mean = scipy.linalg.cho_solve(factor, info.b)
    end_cov = scipy.linalg.cho_solve(factor, np.eye(len(mean), 3))[:3]
    return View(mean[:3], end_cov, delta.variables[1:] - 1, mean[3:].reshape(-1, 2))


@kernel
def _chained(ends: Floats, covs: Floats) -> tuple[Floats, Floats]:
    """x = e_1 e_2 ... e_k of independent e_i (k, 3) with covariances (k, 3, 3): P <- J_x P J_x' + J_e Q J_e'."""
    x, P = ends[0].copy(), covs[0].copy()
    for k in range(1, len(ends)):
        J_x, J_e = compose_jacobians(x, ends[k])
        new = np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                for a in range(3):
                    for b in range(3):
                        new[i, j] += J_x[i, a] * P[a, b] * J_x[j, b] + J_e[i, a] * covs[k, a, b] * J_e[j, b]
        x, P = compose(x, ends[k]), new
    return x, P


def joined(views: Sequence[View], weights: Floats) -> FrameDelta:
    """Frames one after the other as one that is about its last pose only (rule 2). Raises NumericalError.

    Args:
        weights (k,): by which each frame's information counts.
    """
    covs = np.array([each.end_cov for each in views]) / weights[:, None, None]
    x, P = _chained(np.array([each.end for each in views]), covs)
    H = np.linalg.inv((P + P.T) / 2)
    H = (H + H.T) / 2
    return quantised(np.zeros(1, np.int64), H, H @ x, x)


def starts(poses: Floats, views: Sequence[View]) -> Floats:
    """Where each frame starts, and where the last one ends, (n + 1, 3): as known, poses (k, 3) of frames 1 .. k, then
    as the frames themselves say."""
    known = np.concatenate([np.zeros((1, 3)), poses])[: len(views) + 1]
    more = [known[-1]]
    for each in views[len(known) - 1 :]:
        more.append(compose(more[-1], each.end))
    return np.concatenate([known, np.array(more[1:]).reshape(-1, 3)])


def nearby(views: Sequence[View], at: Floats, first: Ints, most: int, changed: set[int]) -> Ints:
    """Numbers of the frames in the window, ascending (rule 1).

    Args:
        at (n + 1, 3): see `starts`. first (m,): the landmark that each number is of. most: landmarks asked for.
    """
    frame = np.repeat(np.arange(len(views)), [len(each.numbers) for each in views])
    landmark = first[np.concatenate([each.numbers for each in views])]
    local = np.concatenate([each.landmarks for each in views])
    c, s = np.cos(at[frame, 2]), np.sin(at[frame, 2])
    x = at[frame, 0] + c * local[:, 0] - s * local[:, 1]
    y = at[frame, 1] + s * local[:, 0] + c * local[:, 1]
    away = np.full(len(first), np.inf)
    np.minimum.at(away, landmark, np.hypot(x - at[-1, 0], y - at[-1, 1]))
    around = np.zeros(len(first), bool)
    around[np.argsort(away, kind="stable")[: int(MORE * most) + 1]] = True
    newest_first = np.flatnonzero(around[landmark])[::-1]
    order = newest_first[np.argsort(landmark[newest_first], kind="stable")]
    turn = np.arange(len(order)) - np.searchsorted(landmark[order], landmark[order])
    recent = np.arange(max(len(views) - RECENT, 0), len(views))
    return np.unique(np.concatenate([frame[order[turn < SEEN_IN]], recent, np.array(sorted(changed), np.int64)]))


def chain(
    frames: Sequence[FrameDelta], views: Sequence[View], weights: Floats, chosen: Ints
) -> tuple[list[FrameDelta], Ints]:
    """The window as frames that follow each other, gaps joined; and the number of the frame that each starts with."""
    deltas, numbers = list[FrameDelta](), list[int]()
    for k in chosen.tolist():
        if numbers and numbers[-1] + 1 < k:
            numbers.append(numbers[-1] + 1)
            deltas.append(joined(views[numbers[-1] : k], weights[numbers[-1] : k]))
        numbers.append(k)
        deltas.append(frames[k])
    return deltas, np.array(numbers, np.int64)


def carried(old: Floats, numbers: Ints, new: Floats) -> Floats:
    """Where all frames start, (n + 1, 3), where these are known to start at new (k, 3), the window's first one at its
    old place. The others of a gap move with both its ends, more with the nearer one (rule 4)."""
    found = old.copy()
    found[numbers] = new
    for a, b in zip(numbers[:-1].tolist(), numbers[1:].tolist(), strict=True):
        share = (np.arange(a + 1, b)[:, None] - a) / (b - a)
        left, right = (_moved(old[k], found[k], old[a + 1 : b]) for k in (a, b))
        found[a + 1 : b] = (1.0 - share) * left + share * right
    return found


def _moved(old: Floats, new: Floats, poses: Floats) -> Floats:
    """Poses (n, 3) moved as the rigid motion that takes one pose from `old` to `new`; headings are not wrapped."""
    turn = new[2] - old[2]
    c, s = np.cos(turn), np.sin(turn)
    d = poses[:, :2] - old[:2]
    return np.column_stack([new[0] + c * d[:, 0] - s * d[:, 1], new[1] + s * d[:, 0] + c * d[:, 1], poses[:, 2] + turn])
