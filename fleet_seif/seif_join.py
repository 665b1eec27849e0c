"""Two landmarks of a filter that are one: held together, with the rest of the map following.

"They are at the same place" enters as a measurement of their difference, with information W per m^2 in x and in y:

    y_a - y_b = 0:      H_aa += W I      H_bb += W I      H_ab -= W I      b stays

With a and b collapsed, as everything downstream of the alias has it (DESIGN D6), these terms cancel: H_aa + H_bb + H_ab
+ H_ba is what it was. So what is published says nothing twice; the filter alone is held together. MATHS.md 19.
"""

import numpy as np

from fleet_seif.jit import kernel
from fleet_seif.records import Floats, Ints
from fleet_seif.seif_arrays import LANDMARKS, arrays
from fleet_seif.seif_step import (
    NOT_POSITIVE_DEFINITE,
    OK,
    TOO_LARGE,
    blanket,
    block_delta,
    connect,
    enqueue_around,
    gather,
    published,
    quantise,
    recover_mean_into,
    relax_queued,
    row_entries,
    scatter,
)


@kernel
def seif_join(
    floats: Floats, ints: Ints, pairs: Ints, W: float, others: int, called: Ints
) -> tuple[int, Ints, Ints, Ints, Ints, Ints]:
    """Hold landmarks pairs (p, 2) together; the mean of their combined Markov blanket is solved for.

    W: information of each, per m^2. The other arguments are those of `seif_step`; capacity for p links must suffice.
    Returns a code (OK ...) and the arrays of the FrameDelta. On failure the arrays are as they were.
    """
    s, none = arrays(floats, ints), np.empty(0, np.int64)
    ids = blanket(s, pairs.ravel())
    H, b, mu, links, pull = gather(s, ids)
    for p in range(len(pairs)):
        i, j = 3 + 2 * np.searchsorted(ids, pairs[p, 0]), 3 + 2 * np.searchsorted(ids, pairs[p, 1])
        for k in range(2):
            H[i + k, i + k] += W
            H[j + k, j + k] += W
            H[i + k, j + k] -= W
            H[j + k, i + k] -= W
    before = mu.copy()
    if not recover_mean_into(mu, H, b, pull) or not np.all(np.isfinite(mu)):
        return NOT_POSITIVE_DEFINITE, none, none, none, none, none
    q_H, q_b, fits = quantise(H, b, mu, row_entries(s, ids, H, links))
    if not fits:
        return TOO_LARGE, none, none, none, none, none
    old_H, old_b = published(s, ids, links)
    connect(s, ids, H, links)
    names = called[ids] if len(called) > 0 else ids
    variables, rows, cols, values, b_values = block_delta(names, q_H, q_b, old_H, old_b)
    scatter(s, ids, links, H, b, mu, q_H, q_b)
    enqueue_around(s, ids, s.counts[LANDMARKS], mu, before)
    relax_queued(s, others)
    return OK, variables, rows, cols, values, b_values
