"""The parts of a step on their own, many times over on what one step of a real run works on.

Parts change their block in place, so each repetition begins with a fresh copy of it; `copy_block` does only that, and
its time is taken off. The filter's buffers are left as they were: what is scattered is what was gathered.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from fleet_seif.jit import kernel
from fleet_seif.local_updates import NORMALISED, measurement_update_into, motion_update_into
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats, Ints
from fleet_seif.seif_arrays import arrays
from fleet_seif.seif_step import (
    accept_sightings,
    block_delta,
    check_reading,
    gather,
    published,
    quantise,
    recover_mean_into,
    relax,
    row_entries,
    scatter,
    sparsify_block,
)
from tests.benchmarks.captured import Captured
from tests.benchmarks.runs import SETTINGS

REPEATS: Final = 100
RELAXED: Final = 8
"""Landmarks that the step relaxes at most; here always so many."""


@kernel
def copy_into(H: Floats, b: Floats, mu: Floats, from_H: Floats, from_b: Floats, from_mu: Floats) -> None:
    n = len(b)
    for i in range(n):
        b[i], mu[i] = from_b[i], from_mu[i]
        for j in range(n):
            H[i, j] = from_H[i, j]


@kernel
def copies(repeats: int, H: Floats, b: Floats, mu: Floats) -> float:
    work_H, work_b, work_mu = np.empty_like(H), np.empty_like(b), np.empty_like(mu)
    done = 0.0
    for k in range(repeats):
        copy_into(work_H, work_b, work_mu, H, b, mu)
        done += work_H[k % len(b), 0]
    return done


@kernel
def motions(repeats: int, H: Floats, b: Floats, mu: Floats, u: Floats, cov: Floats) -> float:
    work_H, work_b, work_mu = np.empty_like(H), np.empty_like(b), np.empty_like(mu)
    done = 0.0
    for _ in range(repeats):
        copy_into(work_H, work_b, work_mu, H, b, mu)
        motion_update_into(work_H, work_b, work_mu, RANGE_BEARING, u, cov)
        done += work_b[0]
    return done


@kernel
def sightings(repeats: int, H: Floats, b: Floats, mu: Floats, z: Floats, Z: Floats, at: int) -> float:
    work_H, work_b, work_mu = np.empty_like(H), np.empty_like(b), np.empty_like(mu)
    done = 0.0
    for _ in range(repeats):
        copy_into(work_H, work_b, work_mu, H, b, mu)
        measurement_update_into(work_H, work_b, work_mu, RANGE_BEARING, z, Z, at)
        done += work_b[0]
    return done


@kernel
def checks(repeats: int, u: Floats, cov: Floats, z: Floats, Z: Floats) -> int:
    done = 0
    for _ in range(repeats):
        done += check_reading(RANGE_BEARING, u, cov, z, Z)
    return done


@kernel
def gates(
    repeats: int, floats: Floats, ints: Ints, ids: Ints, H: Floats, mu: Floats, z: Floats, Z: Floats, at: Ints
) -> float:
    s = arrays(floats, ints)
    fresh, full = np.zeros(len(ids), np.int64), np.zeros(len(ids), np.int64)
    done = 0.0
    for _ in range(repeats):
        done += accept_sightings(s, H, mu, ids, RANGE_BEARING, at, z, Z, 1e12, 3, fresh, full)[1]
    return done


@kernel
def recoveries(repeats: int, H: Floats, b: Floats, mu: Floats, pull: Floats) -> int:
    work_H, work_b, work_mu = np.empty_like(H), np.empty_like(b), np.empty_like(mu)
    done = 0
    for _ in range(repeats):
        copy_into(work_H, work_b, work_mu, H, b, mu)
        done += recover_mean_into(work_mu, work_H, work_b, pull)
    return done


@kernel
def sparsifications(repeats: int, H: Floats, b: Floats, mu: Floats, active_max: int) -> int:
    work_H, work_b, work_mu = np.empty_like(H), np.empty_like(b), np.empty_like(mu)
    done = 0
    for _ in range(repeats):
        copy_into(work_H, work_b, work_mu, H, b, mu)
        done += sparsify_block(work_H, work_b, work_mu, active_max, NORMALISED, 1.0)
    return done


@kernel
def gathers_and_scatters(repeats: int, floats: Floats, ints: Ints, ids: Ints, q_H: Ints, q_b: Ints) -> float:
    s = arrays(floats, ints)
    done = 0.0
    for _ in range(repeats):
        H, b, mu, links, pull = gather(s, ids)
        scatter(s, ids, links, H, b, mu, q_H, q_b)
        done += pull[3]
    return done


@kernel
def deltas(repeats: int, floats: Floats, ints: Ints, ids: Ints, links: Ints, H: Floats, b: Floats, mu: Floats) -> int:
    s = arrays(floats, ints)
    done = 0
    for _ in range(repeats):
        q_H, q_b, _ = quantise(H, b, mu, row_entries(s, ids, H, links))
        old_H, old_b = published(s, ids, links)
        done += len(block_delta(ids, q_H, q_b, old_H, old_b)[0])
    return done


@kernel
def relaxations(repeats: int, floats: Floats, ints: Ints, chosen: Ints) -> float:
    s = arrays(floats, ints)
    done = 0.0
    for _ in range(repeats):
        for y in chosen:
            done += relax(s, y)[0]
    return done


def copy_block(c: Captured, repeats: int) -> None:
    copies(repeats, *c.moved)


def motion(c: Captured, repeats: int) -> None:
    motions(repeats, *c.before, c.u, c.cov)


def one_sighting(c: Captured, repeats: int) -> None:
    sightings(repeats, *c.moved, c.z[0], c.Z[0], int(c.at[0]))


def check(c: Captured, repeats: int) -> None:
    checks(repeats, c.u, c.cov, c.z, c.Z)


def gate(c: Captured, repeats: int) -> None:
    gates(repeats, c.floats, c.ints, c.ids, c.moved.H, c.moved.mu, c.z, c.Z, c.at)


def recover(c: Captured, repeats: int) -> None:
    recoveries(repeats, *c.seen, c.pull)


def sparsify(c: Captured, repeats: int) -> None:
    sparsifications(repeats, *c.recovered, SETTINGS.active_max)


def gather_and_scatter(c: Captured, repeats: int) -> None:
    gathers_and_scatters(repeats, c.floats, c.ints, c.ids, c.old_H, c.old_b)


def quantise_and_delta(c: Captured, repeats: int) -> None:
    deltas(repeats, c.floats, c.ints, c.ids, c.links, *c.cut)


def relax_eight(c: Captured, repeats: int) -> None:
    """Landmarks outside the block."""
    outside = np.setdiff1d(np.arange(int(arrays(c.floats, c.ints).counts[0])), c.ids)
    floats = c.floats.copy()
    relaxations(repeats, floats, c.ints, outside[:: max(1, len(outside) // RELAXED)][:RELAXED])


PARTS: Final[dict[str, tuple[Callable[[Captured, int], None], bool]]] = {
    "check_reading": (check, False),
    "gather_and_scatter": (gather_and_scatter, False),
    "motion": (motion, True),
    "gate": (gate, False),
    "one_sighting": (one_sighting, True),
    "recover": (recover, True),
    "sparsify": (sparsify, True),
    "quantise_and_delta": (quantise_and_delta, False),
    "relax_eight": (relax_eight, False),
}
"""Each part by name, and whether it begins with a copy of the block."""
