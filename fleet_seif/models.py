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
def sight_numbers(
    model: int, x: Floats, y0: float, y1: float
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """`sight` without arrays, for kernels that cannot afford them: h, rows of (J_z_x, J_z_y) without the heading.

    The order: h (2), J_z_x[0, :2], J_z_y[0], J_z_x[1, :2], J_z_y[1]. The heading's column is (0, `heading_column`).
    """
    dx, dy = y0 - x[0], y1 - x[1]
    if model == COMPASS_XY:
        return dx, dy, -1.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 1.0
    q = dx * dx + dy * dy
    d = math.sqrt(q)
    bearing = wrap(math.atan2(dy, dx) - x[2])
    return d, bearing, -dx / d, -dy / d, dx / d, dy / d, dy / q, -dx / q, -dy / q, dx / q


@kernel
def heading_column(model: int) -> float:
    """d z[1] / d theta; d z[0] / d theta is zero in every model."""
    return 0.0 if model == COMPASS_XY else -1.0


@kernel
def pose_rows_seen(model: int) -> int:
    """How many of the pose's first entries sightings see: the heading takes no part with a compass."""
    return 2 if model == COMPASS_XY else 3


@kernel
def sight(model: int, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Expected sighting of landmark y from pose x: h (2,), J_z_x (2, 3), J_z_y (2, 2). y = x's position is singular."""
    h0, h1, x00, x01, y00, y01, x10, x11, y10, y11 = sight_numbers(model, x, y[0], y[1])
    J_z_x = np.array([[x00, x01, 0.0], [x10, x11, heading_column(model)]])
    return np.array([h0, h1]), J_z_x, np.array([[y00, y01], [y10, y11]])


@kernel
def innovation_numbers(model: int, z0: float, z1: float, h0: float, h1: float) -> tuple[float, float]:
    """`innovation` without arrays."""
    return z0 - h0, wrap(z1 - h1) if model == RANGE_BEARING else z1 - h1


@kernel
def innovation(model: int, z: Floats, h: Floats) -> Floats:
    """r = z - h with bearings wrapped, shape (2,)."""
    r0, r1 = innovation_numbers(model, z[0], z[1], h[0], h[1])
    return np.array([r0, r1])


@kernel
def place(model: int, x: Floats, z: Floats) -> Floats:
    """The landmark that pose x sees at z: the inverse of `sight`, shape (2,), m."""
    if model == COMPASS_XY:
        return x[:2] + z
    return np.array([x[0] + z[0] * math.cos(x[2] + z[1]), x[1] + z[0] * math.sin(x[2] + z[1])])
