"""Huber's weights: what disagrees beyond a limit pulls no harder than at the limit. For sightings within a frame, and
for whole frames in the joint map."""

import math
from typing import Final

from fleet_seif.jit import kernel

HUBER_DEVIATES: Final = 1.0
"""Where robust weights begin: this many standard deviates up the chi-square distribution of a frame's rows. Of frames
whose noise is as declared one in six at most is weighted down, a little: over 20 seeds nothing is lost (MATHS.md 18).
On MR.CLAM 6 the landmark error is 0.163 m instead of 0.196 m with 6 deviates."""
DOUBTFUL: Final = 0.5
"""Weight below which a frame is shown as one that disagrees: its chi-square is four times where weights begin."""


@kernel
def huber(chi_square: float, limit: float) -> tuple[float, float]:
    """Cost and weight of a squared normalised residual: itself and 1 up to the limit c, beyond it 2 sqrt(c chi) - c and
    sqrt(c / chi)."""
    if chi_square <= limit:
        return chi_square, 1.0
    return 2.0 * math.sqrt(limit * chi_square) - limit, math.sqrt(limit / chi_square)


def huber_limit(dof: int, deviates: float = HUBER_DEVIATES) -> float:
    """The chi-square of `dof` degrees of freedom that far up (Wilson and Hilferty): dof (1 - v + deviates sqrt(v))^3
    with v = 2 / (9 dof)."""
    if not dof:
        return 0.0
    variance = 2.0 / (9.0 * dof)
    return dof * (1.0 - variance + deviates * math.sqrt(variance)) ** 3
