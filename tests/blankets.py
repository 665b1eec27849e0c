"""What the combined Markov blanket costs in accuracy: python -m tests.blankets [--seeds 1..5] [--landmarks N ...].

A vehicle that knows what it sees drives through the paper's world (scenarios.experiments.worlds). Every EVERY_STEPS
steps the joint covariance of the pose and the landmarks around it is taken from their neighbourhood
(Seif.blanket_covariance) and, exactly, from the whole map. Compared:

1. Standard deviations of the expected sightings, blanket over exact; also of landmarks none of whose neighbours is
   active, which is where a loop closes.
2. What the next step's sightings are taken for with one and with the other (fleet_seif.association), and how many of
   either are wrong.
3. Landmarks in the blanket, and in the map.
"""

import argparse
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fleet_seif import seif_step as kernels
from fleet_seif.association import associate
from fleet_seif.association_guards import Verdict
from fleet_seif.associator import REACH_SIGMAS
from fleet_seif.config import AssociationSettings, FilterSettings
from fleet_seif.consistent import Bools
from fleet_seif.jit import one_thread
from fleet_seif.local_map import LocalMap, expected, moved
from fleet_seif.records import Floats, Ints, Reading
from fleet_seif.seif import Seif
from scenarios.chaos_runs import seed_range
from scenarios.experiments.worlds import World, paper_world

EVERY_STEPS = 10
REACH_M = 0.2
"""Of the sensor in the paper's world."""


@dataclass
class Found:
    """ratios, apart: standard deviations, blanket over exact, of all expected sightings and where a loop closes.

    sightings: of known landmarks. taken, wrong: paired, and with the wrong one, by the blanket and exactly. differ:
    sightings that are taken for something else. sizes: landmarks in the blankets.
    """

    ratios: list[float] = field(default_factory=list)
    apart: list[float] = field(default_factory=list)
    sightings: int = 0
    taken: Ints = field(default_factory=lambda: np.zeros(2, np.int64))
    wrong: Ints = field(default_factory=lambda: np.zeros(2, np.int64))
    differ: int = 0
    sizes: list[int] = field(default_factory=list)


def around(filter: Seif) -> Ints:
    """Landmarks that may be in reach of the pose's next sightings."""
    x, exact = filter.pose, filter.covariance_of([])
    reach = REACH_M + REACH_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(exact[:2, :2])[-1]))
    return np.flatnonzero(np.hypot(*(filter.landmarks - x[:2]).T) <= reach)


def look(filter: Seif, world: World, reading: Reading, found: Found) -> None:
    """Compare what both say about the sightings of the next step."""
    near = around(filter)
    if not len(near):
        return
    mean = np.concatenate([filter.pose, filter.landmarks[near].ravel()])
    u, cov = reading.odometry, reading.odometry_cov
    maps = [
        moved(world.model, LocalMap(mean, P, near), u, cov)
        for P in (filter.blanket_covariance(near.tolist()), filter.covariance_of(near.tolist()))
    ]
    which = np.arange(len(near))
    (h, C), (_, C_exact) = (expected(world.model, each.mean, each.P, which) for each in maps)
    ratio = np.sqrt(np.diag(C) / np.diag(C_exact))
    found.ratios += ratio.tolist()
    found.apart += ratio[np.repeat(~meets_active(filter, near), 2)].tolist()
    found.sizes.append(len(kernels.blanket(filter._s, near)))
    decide(filter, world, reading, near, h, (C, C_exact), found)


def meets_active(filter: Seif, near: Ints) -> Bools:
    """Which of these landmarks are active or linked to one that is, (k,)."""
    H, _ = filter.information()
    active = 3 + 2 * filter.active
    links = abs(H[3 + 2 * near][:, active]) + abs(H[4 + 2 * near][:, active])
    return np.asarray(np.isin(near, filter.active) | (np.asarray(links.sum(axis=1)).ravel() > 0.0))


def decide(
    filter: Seif, world: World, reading: Reading, near: Ints, h: Floats, both: tuple[Floats, Floats], found: Found
) -> None:
    signatures = np.array(filter.signatures, np.int64)
    seen, settings = reading.sightings, AssociationSettings()
    truth = np.where(np.isin(seen.signature, signatures), seen.signature, -1)
    said = []
    for k, C in enumerate(both):
        decision = associate(seen.z, seen.cov, h, C, settings, model=world.model)
        paired = decision.assignment >= 0
        taken_for = np.where(paired, signatures[near[decision.assignment]], -1)
        said.append(np.where(decision.verdict == int(Verdict.NEW), -2, taken_for))
        found.taken[k] += np.count_nonzero(paired)
        found.wrong[k] += np.count_nonzero(paired & (taken_for != truth))
    found.sightings += int(np.count_nonzero(truth >= 0))
    found.differ += int(np.count_nonzero(said[0] != said[1]))


@one_thread
def compared(active_max: int, worlds: Sequence[World]) -> Found:
    found = Found()
    for world in worlds:
        filter = Seif(FilterSettings(frames="single", active_max=active_max), world.model)
        filter.start(world.log.sightings_at(0))
        for k, reading in enumerate(world.log.readings()):
            if k % EVERY_STEPS == 0:
                look(filter, world, reading, found)
            filter.step(reading)
    return found


def line(of: Found) -> str:
    ratios, apart = np.array(of.ratios), np.array(of.apart or [np.nan])
    return (
        f"std blanket / exact: median {np.median(ratios):.4f}, 1 % below {np.percentile(ratios, 1):.4f}; where a loop"
        f" closes median {np.median(apart):.4f}, least {apart.min():.4f} ({len(of.apart)}); {of.sightings} sightings,"
        f" {of.differ} taken otherwise, paired {of.taken.tolist()}, wrong {of.wrong.tolist()}; blankets of"
        f" {np.median(of.sizes):.0f} landmarks, at most {max(of.sizes)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="1..5", type=seed_range)
    parser.add_argument("--landmarks", nargs="+", type=int, default=[50, 200], metavar="N")
    parser.add_argument("--active", nargs="+", type=int, default=[6, 10], metavar="N")
    asked = parser.parse_args()
    for landmarks, active_max, mild in itertools.product(asked.landmarks, asked.active, (False, True)):
        worlds = [paper_world(landmarks, seed, mild=mild) for seed in asked.seeds]
        found = line(compared(active_max, worlds))
        print(f"{landmarks} landmarks, {active_max} active, {worlds[0].name}: {found}", flush=True)


if __name__ == "__main__":
    main()
