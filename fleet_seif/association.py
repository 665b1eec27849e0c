"""Which landmark is it: each sighting of a step is given to a candidate, or to none, from the joint Gaussian of both.

`associate` is the whole decision: one of three methods chooses a hypothesis, two guards then look at each sighting.
What is doubtful stays out of the filter: a sighting that another candidate fits nearly as well is ambiguous, and one
that fits none but comes close to one is near: neither paired nor a new landmark. MATHS.md 19.
"""

import functools
from typing import Final, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from fleet_seif.association_guards import PAIRED, leave_one_out, margins, verdicts
from fleet_seif.association_problem import UNPAIRED, Limits, Problem, is_sound, pair_cost, problem
from fleet_seif.config import AssociationSettings
from fleet_seif.errors import NumericalError
from fleet_seif.jcbb import cost_of_rival, insert_sorted, search
from fleet_seif.jit import kernel
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats, Ints


class Association(NamedTuple):
    """What was decided about the m sightings of a step.

    assignment: the candidate of each sighting that is PAIRED, else -1, shape (m,).
    verdict: a Verdict each, shape (m,).
    hypothesis: what the method chose, before the guards: candidate or -1, shape (m,).
    margin: by how much the joint cost grows at least when this sighting changes to another candidate, shape (m,):
        alone, to one that is free and within the birth gate, or (joint rivals; where it is below the ambiguity margin)
        with others changing too. Infinite where there is none.
    squared_innovation: r' S^-1 r of the hypothesis, chi-square of 2 pairs degrees of freedom if it is true.
    pairs: of the hypothesis.
    cut_short: a search ended at nodes_max: the hypothesis, or a rival, is the best it had found.
    """

    assignment: Ints
    verdict: Ints
    hypothesis: Ints
    margin: Floats
    squared_innovation: float
    pairs: int
    cut_short: bool


METHODS: Final = ("nearest_neighbour", "maximum_likelihood", "joint_compatibility")
NEAREST_NEIGHBOUR: Final = 0
MAXIMUM_LIKELIHOOD: Final = 1
JOINT_COMPATIBILITY: Final = 2


@kernel
def nearest_neighbour(p: Problem, at: Limits) -> tuple[Ints, Floats, bool]:
    """Each sighting takes the candidate of least r' S^-1 r, where that passes the gate.

    Where several take the same, the nearest keeps it; the others stay unpaired.
    """
    m, n = p.d2.shape
    assignment, owner = np.full(m, UNPAIRED), np.full(n, -1)
    for i in range(m):
        nearest, least = UNPAIRED, np.inf
        for j in range(n):
            if p.d2[i, j] <= at.gate and p.d2[i, j] < least:
                nearest, least = j, p.d2[i, j]
        if nearest == UNPAIRED or (owner[nearest] >= 0 and p.d2[owner[nearest], nearest] <= least):
            continue
        if owner[nearest] >= 0:
            assignment[owner[nearest]] = UNPAIRED
        owner[nearest], assignment[i] = i, nearest
    return assignment, np.full(m, np.inf), False


@kernel
def maximum_likelihood(p: Problem, at: Limits) -> tuple[Ints, Floats, bool]:
    """The likeliest pair first, of those that pass the gate, then the likeliest of what is left (Liu & Thrun).

    Likeliest: least r' S^-1 r + log(det S / det Z), each pair by itself. A candidate that is taken is out: a landmark
    is sighted once a step, so a sighting may get its second choice.
    """
    m, n = p.d2.shape
    costs, pairs, count = np.empty(m * n), np.empty(m * n, np.int64), 0
    for i in range(m):
        for j in range(n):
            if p.d2[i, j] <= at.gate:
                insert_sorted(costs, pairs, count, pair_cost(p, i, j), i * n + j)
                count += 1
    assignment, taken = np.full(m, UNPAIRED), np.zeros(n, np.int64)
    for pair in pairs[:count]:
        i, j = pair // n, pair % n
        if assignment[i] == UNPAIRED and taken[j] == 0:
            assignment[i], taken[j] = j, 1
    return assignment, np.full(m, np.inf), False


@kernel
def joint_compatibility(p: Problem, at: Limits) -> tuple[Ints, Floats, bool]:
    """The joint hypothesis of least cost (`jcbb`), and how much more joint rivals cost if they are asked for, (m,)."""
    hypothesis, least, _, cut_short = search(p, at, at.nodes_max, -1, -1, np.inf)
    if not at.joint_rivals:
        return hypothesis, np.full(len(hypothesis), np.inf), cut_short
    more, rivals_cut_short = cost_of_rival(p, at, hypothesis, least)
    return hypothesis, more, cut_short or rivals_cut_short


@kernel
def decide(
    model: int, method: int, z: Floats, Z: Floats, h: Floats, C: Floats, at: Limits
) -> tuple[bool, Ints, Ints, Ints, Floats, float, int, bool]:
    """`associate` on arrays: whether its input is sound, then the fields of Association."""
    p = problem(model, z, Z, h, C)
    sound = is_sound(p)
    if not sound or method == NEAREST_NEIGHBOUR:
        hypothesis, margin, cut_short = nearest_neighbour(p, at)
    elif method == MAXIMUM_LIKELIHOOD:
        hypothesis, margin, cut_short = maximum_likelihood(p, at)
    else:
        hypothesis, margin, cut_short = joint_compatibility(p, at)
    known = leave_one_out(p, hypothesis)
    margin = np.minimum(margin, margins(p, hypothesis, known, at))
    verdict = verdicts(p, hypothesis, margin, at)
    assignment = hypothesis.copy()
    for i in range(len(z)):
        if verdict[i] != PAIRED:
            assignment[i] = UNPAIRED
    return sound, assignment, verdict, hypothesis, margin, known.d2, len(known.sightings), cut_short


@functools.lru_cache(maxsize=256)
def limits(settings: AssociationSettings, m: int) -> Limits:
    """Of a decision about m sightings: chi-square quantiles for the probabilities in the settings.

    The quantile for 2k degrees of freedom is 2 P^-1(k, probability), P the regularised lower incomplete gamma function.
    """
    joint_gates = np.zeros(m + 1)
    joint_gates[1:] = 2.0 * gammaincinv(np.arange(1.0, m + 1.0), settings.joint_gate_probability)
    return Limits(
        gate=float(2.0 * gammaincinv(1.0, settings.gate_probability)),
        joint_gates=joint_gates,
        birth_gate=float(2.0 * gammaincinv(1.0, settings.birth_gate_probability)),
        cost_unpaired=settings.cost_unpaired,
        ambiguity_margin=settings.ambiguity_margin,
        joint_rivals=settings.rivals == "joint",
        nodes_max=settings.nodes_max,
    )


def associate(
    z: Floats, Z: Floats, h: Floats, C: Floats, settings: AssociationSettings, *, model: int = RANGE_BEARING
) -> Association:
    """Decide which candidate each sighting belongs to.

    Args:
        z: the sightings of one step, range (m) and bearing (rad), shape (m, 2). Z: their noise covariance, (m, 2, 2).
        h: what is expected of each candidate, shape (n, 2).
        C: joint covariance J P J' of these expectations, without sensor noise, shape (2n, 2n).
        model: of the sightings, as in `models`; says which of their rows wrap.

    All arrays C-contiguous float64, or kernels are compiled anew.

    Raises:
        ValueError: shapes that do not go together.
        NumericalError: something is not finite, or a noise covariance not positive definite.
    """
    m, n = len(z), len(h)
    if z.shape != (m, 2) or Z.shape != (m, 2, 2) or h.shape != (n, 2) or C.shape != (2 * n, 2 * n):
        raise ValueError(
            f"z {z.shape}, Z {Z.shape}, h {h.shape}, C {C.shape} do not go together: give m sightings (m, 2), "
            "(m, 2, 2) and n candidates (n, 2), (2n, 2n)"
        )
    sound, assignment, verdict, hypothesis, margin, squared_innovation, pairs, cut_short = decide(
        model, METHODS.index(settings.method), z, Z, h, C, limits(settings, m)
    )
    if not sound:
        raise NumericalError(
            "sightings cannot be associated: a number is not finite, or a covariance not positive definite; "
            "check the reading and the filter's covariance"
        )
    return Association(assignment, verdict, hypothesis, margin, squared_innovation, pairs, cut_short)
