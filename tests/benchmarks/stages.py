"""The step once more, with a clock between its parts, so that each is timed where it runs: in a real loop.

`staged_step` is seif_step.seif_step without what never happens in these runs (ESEIF, a landmark with all the neighbours
it may have, refused readings). bench_parts.py checks that both leave the same bits; when the step changes, this copy
has to follow.
"""

import math
from typing import Final

import numpy as np

from fleet_seif.jit import kernel
from fleet_seif.local_updates import measurement_update_into, motion_update_into
from fleet_seif.models import place
from fleet_seif.records import Floats, Ints
from fleet_seif.seif_arrays import ACTIVE, LANDMARKS, arrays
from fleet_seif.seif_step import (
    NOT_POSITIVE_DEFINITE,
    OK,
    accept_sightings,
    block_delta,
    block_ids,
    check_reading,
    connect,
    enqueue_around,
    gather,
    published,
    quantise,
    recover_mean_into,
    relax_queued,
    row_entries,
    scatter,
    sparsify_block,
)
from tests.benchmarks.clock import stamp_into

STAGES: Final = (
    "check the reading",
    "gather the block",
    "motion",
    "gate",
    "sightings",
    "recover the mean",
    "sparsify",
    "quantise",
    "gather what was published",
    "new links",
    "delta",
    "scatter",
    "relax",
)
STAMPS: Final = 1 + len(STAGES)


@kernel
def staged_step(
    stamps: Ints, floats: Floats, ints: Ints, model: int, moves: bool, u: Floats, cov: Floats, sighted: Ints, z: Floats,
    Z: Floats, kind: int, active_max: int, measure: int, soften: float, others: int, gate: float, patience: int,
    neighbours_max: int, growth_max: int,
) -> tuple[int, Floats, Ints, Ints, Ints, Ints, Ints]:  # fmt: skip
    """See seif_step.seif_step. stamps (STAMPS, 2): the time before the first part and after each, (s, ns)."""
    stamp_into(stamps, 0)
    s = arrays(floats, ints)
    none = np.empty(0, np.int64)
    statistics = np.zeros(3)
    code = check_reading(model, u, cov, z, Z)
    if code != OK:
        return code, statistics, none, none, none, none, none
    stamp_into(stamps, 1)
    ids = block_ids(s.active[: s.counts[ACTIVE]], sighted)
    m, known = len(ids), s.counts[LANDMARKS]
    H, b, mu, links, pull = gather(s, ids)
    full = np.zeros(m, np.int64)
    refusals = np.zeros(m, np.int64)
    for i in range(m):
        if ids[i] < known:
            refusals[i] = s.refusals[ids[i]]
    stamp_into(stamps, 2)
    if moves:
        motion_update_into(H, b, mu, model, u, cov)
    stamp_into(stamps, 3)
    at = 3 + 2 * np.searchsorted(ids, sighted)
    accepted, statistics[0], used, definite = accept_sightings(
        s, H, mu, ids, model, at, z, Z, gate, patience, refusals, full
    )
    if not definite:
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    statistics[1], statistics[2] = used, len(z) - np.sum(accepted)
    stamp_into(stamps, 4)
    for k in range(len(z)):
        y = (at[k] - 3) // 2
        if ids[y] >= known and H[at[k], at[k]] == 0.0:
            mu[at[k] : at[k] + 2] = place(model, mu[:3], z[k])
        if accepted[k]:
            measurement_update_into(H, b, mu, model, z[k], Z[k], at[k])
    stamp_into(stamps, 5)
    before = mu.copy()
    if not recover_mean_into(mu, H, b, pull):
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    stamp_into(stamps, 6)
    if not sparsify_block(H, b, mu, active_max, measure, soften):
        return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    for i in range(len(mu)):
        if not math.isfinite(mu[i]):
            return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    stamp_into(stamps, 7)
    q_H, q_b, fits = quantise(H, b, mu, row_entries(s, ids, H, links))
    stamp_into(stamps, 8)
    old_H, old_b = published(s, ids, links)
    for i in range(len(q_H)):
        if not fits or q_H[i, i] - old_H[i, i] > growth_max:
            return NOT_POSITIVE_DEFINITE, statistics, none, none, none, none, none
    for i in range(m):
        if ids[i] >= known:
            s.counts[LANDMARKS] = ids[i] + 1
        s.refusals[ids[i]] = refusals[i]
    stamp_into(stamps, 9)
    connect(s, ids, H, links)
    stamp_into(stamps, 10)
    variables, rows, cols, values, b_values = block_delta(ids, q_H, q_b, old_H, old_b)
    stamp_into(stamps, 11)
    scatter(s, ids, links, H, b, mu, q_H, q_b)
    stamp_into(stamps, 12)
    if others > 0:
        enqueue_around(s, ids, known, mu, before)
        relax_queued(s, others)
    stamp_into(stamps, 13)
    return OK, statistics, variables, rows, cols, values, b_values
