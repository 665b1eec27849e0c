"""What a decision about sightings is made from, and what one pair costs by itself."""

import math
from typing import Final, NamedTuple

import numpy as np

from fleet_seif.jit import kernel
from fleet_seif.models import innovation_numbers
from fleet_seif.records import Floats

UNPAIRED: Final = -1


class Limits(NamedTuple):
    """The settings as kernels take them; gates are squared normalised innovations.

    joint_gates: by number of pairs, ascending, shape (m + 1,). joint_rivals: see AssociationSettings.rivals.
    """

    gate: float
    joint_gates: Floats
    birth_gate: float
    cost_unpaired: float
    ambiguity_margin: float
    joint_rivals: bool
    nodes_max: int


class Problem(NamedTuple):
    """What one decision is about, for m sightings and n candidates.

    r: innovation of every pair, angles wrapped, m and rad, shape (m, n, 2).
    Z: noise covariance of the sightings, shape (m, 2, 2). C: joint covariance of the predictions, shape (2n, 2n).
    log_det_Z: shape (m,).
    d2: squared normalised innovation of every pair by itself, shape (m, n).
    """

    r: Floats
    Z: Floats
    C: Floats
    log_det_Z: Floats
    d2: Floats


@kernel
def problem(model: int, z: Floats, Z: Floats, h: Floats, C: Floats) -> Problem:
    """Innovations of all pairs, and what each amounts to by itself; infinite where S is not positive definite."""
    m, n = len(z), len(h)
    r, log_det_Z, d2 = np.empty((m, n, 2)), np.empty(m), np.full((m, n), np.inf)
    for i in range(m):
        log_det_Z[i] = math.log(Z[i, 0, 0] * Z[i, 1, 1] - Z[i, 1, 0] * Z[i, 1, 0])
        for j in range(n):
            r0, r1 = innovation_numbers(model, z[i, 0], z[i, 1], h[j, 0], h[j, 1])
            r[i, j, 0], r[i, j, 1] = r0, r1
            s00 = C[2 * j, 2 * j] + Z[i, 0, 0]
            s10 = C[2 * j + 1, 2 * j] + Z[i, 1, 0]
            s11 = C[2 * j + 1, 2 * j + 1] + Z[i, 1, 1]
            det = s00 * s11 - s10 * s10
            if s00 > 0.0 and det > 0.0:
                d2[i, j] = (s11 * r0 * r0 - 2.0 * s10 * r0 * r1 + s00 * r1 * r1) / det
    return Problem(r, Z, C, log_det_Z, d2)


@kernel
def is_sound(p: Problem) -> bool:
    """Whether every pair has a finite innovation with a positive definite covariance, and so has every noise."""
    m, n = p.d2.shape
    for i in range(m):
        if not math.isfinite(p.log_det_Z[i]) or not p.Z[i, 0, 0] > 0.0:
            return False
        for j in range(n):
            if not math.isfinite(p.d2[i, j]):
                return False
    return True


@kernel
def normal_cost(t00: float, t10: float, t11: float, v0: float, v1: float) -> tuple[float, float]:
    """v' T^-1 v of a symmetric T, and the same with log det T; infinite where T is not positive definite."""
    det = t00 * t11 - t10 * t10
    if not (t00 > 0.0 and det > 0.0):
        return np.inf, np.inf
    d2 = (t11 * v0 * v0 - 2.0 * t10 * v0 * v1 + t00 * v1 * v1) / det
    return d2, d2 + math.log(det)


@kernel
def pair_cost(p: Problem, i: int, j: int) -> float:
    """r' S^-1 r + log(det S / det Z) of one pair by itself."""
    a = 2 * j
    s00, s10, s11 = p.C[a, a] + p.Z[i, 0, 0], p.C[a + 1, a] + p.Z[i, 1, 0], p.C[a + 1, a + 1] + p.Z[i, 1, 1]
    _, cost = normal_cost(s00, s10, s11, p.r[i, j, 0], p.r[i, j, 1])
    return cost - float(p.log_det_Z[i])
