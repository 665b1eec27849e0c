"""What a step works on, taken from a real run: the filter's buffers before the step, and its block after each part."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleet_seif import seif_step as kernels
from fleet_seif.local_updates import NORMALISED, measurement_update_into, motion_update_into
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats, Ints, Reading
from fleet_seif.seif import Seif
from fleet_seif.seif_arrays import ACTIVE, arrays, put_back, reserve, used
from tests.benchmarks.runs import SETTINGS, interior, taken, world


class Block(NamedTuple):
    """The dense block: H (n, n), b (n,), mu (n,)."""

    H: Floats
    b: Floats
    mu: Floats

    def copy(self) -> "Block":
        return Block(self.H.copy(), self.b.copy(), self.mu.copy())


class Captured(NamedTuple):
    """A step with six sightings of known landmarks, in the middle of a run.

    floats, ints: the filter's buffers before the step, just as large as they must be. u, cov, z, Z: the reading.
    at (6,): first row in the block of the landmark of each sighting. ids (m,), links (m, m), pull (n,): see
    seif_step.gather. active: landmarks linked to the pose before; dropped: cut from it.
    before, moved, seen, recovered, cut: the block at the beginning and after each part.
    q_H, q_b, old_H, old_b: in quanta, now and as last published.
    """

    floats: Floats
    ints: Ints
    u: Floats
    cov: Floats
    z: Floats
    Z: Floats
    at: Ints
    ids: Ints
    links: Ints
    pull: Floats
    active: Ints
    dropped: Ints
    before: Block
    moved: Block
    seen: Block
    recovered: Block
    cut: Block
    q_H: Ints
    q_b: Ints
    old_H: Ints
    old_b: Ints


def capture(seif: Seif, reading: Reading) -> Captured:
    """What the next step will do; the filter stays as it is."""
    parts = used(seif._s)
    floats, ints = reserve(len(seif.signatures), len(parts["ends"]))
    s = arrays(floats, ints)
    put_back(s, parts)
    u, cov = np.ascontiguousarray(reading.odometry), np.ascontiguousarray(reading.odometry_cov)
    z, Z = np.ascontiguousarray(reading.sightings.z), np.ascontiguousarray(reading.sightings.cov)
    sighted = seif._names.numbers(reading.sightings.signature)[0]
    active = s.active[: s.counts[ACTIVE]].copy()
    ids = kernels.block_ids(active, sighted)
    at = 3 + 2 * np.searchsorted(ids, sighted)
    H, b, mu, links, pull = kernels.gather(s, ids)
    before = Block(H, b, mu)
    moved = before.copy()
    motion_update_into(*moved, RANGE_BEARING, u, cov)
    seen = moved.copy()
    for k in range(len(z)):
        measurement_update_into(*seen, RANGE_BEARING, z[k], Z[k], at[k])
    recovered = seen.copy()
    assert kernels.recover_mean_into(recovered.mu, recovered.H, recovered.b, pull)
    cut = recovered.copy()
    assert kernels.sparsify_block(*cut, SETTINGS.active_max, NORMALISED, 1.0)
    linked, kept = (_linked_to_pose(H) for H in (recovered.H, cut.H))
    q_H, q_b, _ = kernels.quantise(*cut, kernels.row_entries(s, ids, cut.H, links))
    old_H, old_b = kernels.published(s, ids, links)
    return Captured(
        floats, ints, u, cov, z, Z, at, ids, links, pull, np.searchsorted(ids, active), np.setdiff1d(linked, kept),
        before, moved, seen, recovered, cut, q_H, q_b, old_H, old_b,
    )  # fmt: skip


def _linked_to_pose(H: Floats) -> Ints:
    """Which landmarks of a block, counted from 0."""
    return np.flatnonzero(np.any(H[:3, 3:].reshape(3, -1, 2), axis=(0, 2)))


def captures(landmarks: int, mild: bool, last: int) -> list[Captured | None]:
    """Of the last steps of a run: what each works on, None where it is not one with six sightings."""
    at = world(landmarks, mild)
    readings = list(at.log.readings())[-last:]
    chosen = interior(taken(at, at.log.steps - last), readings)
    seif = taken(at, at.log.steps - last)
    found: list[Captured | None] = []
    for reading, wanted in zip(readings, chosen, strict=True):
        found.append(capture(seif, reading) if wanted else None)
        seif.step(reading)
    return found


def only(found: Sequence[Captured | None]) -> list[Captured]:
    return [each for each in found if each is not None]
