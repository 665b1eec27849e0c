"""Lives made by hand: one frame each, over a map that is precise in itself and begins somewhere nearly known."""

from collections.abc import Sequence

import numpy as np

from fleet_seif.joint import Life
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats
from tests import reference


def made_life(
    vehicle: str, seen: Floats, rng: np.random.Generator, *, drift_m: float, noise_m: float, turn_rad: float = 1e-3,
    said_m: float | None = None, life: int = 0, signatures: Sequence[int] | None = None,
) -> Life:  # fmt: skip
    """A life that has seen these landmarks (n, 2), in their order.

    Args:
        drift_m, turn_rad: standard deviation of where it starts. noise_m: that of each landmark in its own map.
        said_m: the drift that it declares, if not the true one.
    """
    n = len(seen)
    z = np.concatenate([[0.1, 0.0, 0.0], seen.ravel()])
    z[3:] += noise_m * rng.standard_normal(2 * n)
    H = np.diag(np.concatenate([[1e6, 1e6, 1e6], np.full(2 * n, noise_m**-2)]))
    said = drift_m if said_m is None else said_m
    off = np.array([drift_m, drift_m, turn_rad]) * rng.standard_normal(3)
    return Life(
        vehicle=vehicle, life=life, start_pose=off,
        start_pose_cov=np.diag([said**2, said**2, turn_rad**2]),
        frames=(reference.quantised(H, H @ z, list(range(n + 1))),),
        signatures=tuple(signatures) if signatures is not None else (UNKNOWN_SIGNATURE,) * n,
    )  # fmt: skip


def grid(columns: range, rows: range) -> Floats:
    """Points one metre apart."""
    return np.array([[float(x), float(y)] for x in columns for y in rows])
