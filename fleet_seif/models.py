"""Motion and sighting models: the one place to add another.

A model is an integer, so that kernels can be compiled once for all of them. Every function below has one branch a
model. The pose is (x m, y m, theta rad) in each.

RANGE_BEARING: increments in the frame of the pose they leave; z = (range m, bearing rad).
COMPASS_XY: a linear world for tests and for vehicles with a compass: increments along the axes of the frame,
    z = landmark - position along the axes of the frame (m, m). Headings take no part.
"""

import math
from typing import Final

import numpy as np

from fleet_seif.geometry import compose, compose_jacobians, wrap
from fleet_seif.jit import kernel
from fleet_seif.records import Floats

RANGE_BEARING: Final = 0
COMPASS_XY: Final = 1


@kernel
def move(model: int, x: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
    """Pose after increment u, and its Jacobians: x' = g(x, u), J_x'_x (3, 3), J_x'_u (3, 3)."""
    if model == COMPASS_XY:
        return x + u, np.eye(3), np.eye(3)
    J_new_x, J_new_u = compose_jacobians(x, u)
    return compose(x, u), J_new_x, J_new_u


@kernel
def sight(model: int, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Expected sighting of landmark y from pose x: h (2,), J_z_x (2, 3), J_z_y (2, 2). y = x's position is singular."""
    dx, dy = y[0] - x[0], y[1] - x[1]
    if model == COMPASS_XY:
        return np.array([dx, dy]), np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.eye(2)
    q = dx * dx + dy * dy
    d = math.sqrt(q)
    h = np.array([d, wrap(math.atan2(dy, dx) - x[2])])
    J_z_y = np.array([[dx / d, dy / d], [-dy / q, dx / q]])
    J_z_x = np.array([[-dx / d, -dy / d, 0.0], [dy / q, -dx / q, -1.0]])
    return h, J_z_x, J_z_y


@kernel
def innovation(model: int, z: Floats, h: Floats) -> Floats:
    """r = z - h with bearings wrapped, shape (2,)."""
    r = z - h
    if model == RANGE_BEARING:
        r[1] = wrap(r[1])
    return r


@kernel
def place(model: int, x: Floats, z: Floats) -> Floats:
    """The landmark that pose x sees at z: the inverse of `sight`, shape (2,), m."""
    if model == COMPASS_XY:
        return x[:2] + z
    return np.array([x[0] + z[0] * math.cos(x[2] + z[1]), x[1] + z[0] * math.sin(x[2] + z[1])])
