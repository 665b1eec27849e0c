"""SE(2): poses (x m, y m, theta rad), their composition and its Jacobians.

A pose `T_ab` maps coordinates in b to coordinates in a: `p_a = act(T_ab, p_b)`. Jacobians are named
`J_<out>_<in>` and are taken with respect to the plain coordinates (x, y, theta).
"""

import math

import numpy as np
from numpy.typing import NDArray

from fleet_seif.jit import kernel

Floats = NDArray[np.float64]


@kernel
def wrap(angle: float) -> float:
    """The angle in [-pi, pi] that differs from `angle` (rad) by a multiple of 2 pi (math.remainder's rule)."""
    if -math.pi <= angle <= math.pi:
        return angle
    return float(angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi)))


@kernel
def compose(T_ab: Floats, T_bc: Floats) -> Floats:
    """T_ac = T_ab T_bc, shape (3,). Headings add and are not wrapped."""
    c, s = math.cos(T_ab[2]), math.sin(T_ab[2])
    return np.array(
        [T_ab[0] + c * T_bc[0] - s * T_bc[1], T_ab[1] + s * T_bc[0] + c * T_bc[1], T_ab[2] + T_bc[2]],
    )


@kernel
def compose_jacobians(T_ab: Floats, T_bc: Floats) -> tuple[Floats, Floats]:
    """J_ac_ab and J_ac_bc of `compose`, each (3, 3)."""
    c, s = math.cos(T_ab[2]), math.sin(T_ab[2])
    J_ac_ab = np.eye(3)
    J_ac_ab[0, 2] = -s * T_bc[0] - c * T_bc[1]
    J_ac_ab[1, 2] = c * T_bc[0] - s * T_bc[1]
    J_ac_bc = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return J_ac_ab, J_ac_bc


@kernel
def inverse(T_ab: Floats) -> Floats:
    """T_ba, shape (3,)."""
    c, s = math.cos(T_ab[2]), math.sin(T_ab[2])
    return np.array([-c * T_ab[0] - s * T_ab[1], s * T_ab[0] - c * T_ab[1], -T_ab[2]])


@kernel
def between(T_wa: Floats, T_wb: Floats) -> Floats:
    """T_ab = T_wa^-1 T_wb, shape (3,). Headings subtract and are not wrapped."""
    c, s = math.cos(T_wa[2]), math.sin(T_wa[2])
    dx, dy = T_wb[0] - T_wa[0], T_wb[1] - T_wa[1]
    return np.array([c * dx + s * dy, -s * dx + c * dy, T_wb[2] - T_wa[2]])


@kernel
def between_jacobians(T_wa: Floats, T_wb: Floats) -> tuple[Floats, Floats]:
    """J_ab_wa and J_ab_wb of `between`, each (3, 3)."""
    c, s = math.cos(T_wa[2]), math.sin(T_wa[2])
    dx, dy = T_wb[0] - T_wa[0], T_wb[1] - T_wa[1]
    J_ab_wb = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    J_ab_wa = -J_ab_wb
    J_ab_wa[0, 2] = -s * dx + c * dy
    J_ab_wa[1, 2] = -c * dx - s * dy
    return J_ab_wa, J_ab_wb


@kernel
def act(T_ab: Floats, p_b: Floats) -> Floats:
    """p_a = R_ab p_b + t_ab, shape (2,)."""
    c, s = math.cos(T_ab[2]), math.sin(T_ab[2])
    return np.array([T_ab[0] + c * p_b[0] - s * p_b[1], T_ab[1] + s * p_b[0] + c * p_b[1]])


def act_all(T_ab: Floats, p_b: Floats) -> Floats:
    """`act` on every row of p_b, shape (n, 2)."""
    c, s = math.cos(T_ab[2]), math.sin(T_ab[2])
    p_a: Floats = p_b @ np.array([[c, s], [-s, c]]) + T_ab[:2]
    return p_a


@kernel
def act_inverse(T_ab: Floats, p_a: Floats) -> Floats:
    """p_b = R_ab' (p_a - t_ab), shape (2,)."""
    c, s = math.cos(T_ab[2]), math.sin(T_ab[2])
    dx, dy = p_a[0] - T_ab[0], p_a[1] - T_ab[1]
    return np.array([c * dx + s * dy, -s * dx + c * dy])
