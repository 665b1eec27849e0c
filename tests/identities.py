"""How a run without identities compares with the same readings with them, for tests and tests.associating.

With identities: clutter left out, true landmarks as signatures; of the settings only filter.identities differs.

1. A vehicle has diverged where its precision is below PRECISION_LEAST, where it has DUPLICATES_MAX duplicate landmarks
   or more, or where its own map is off.
2. Its own map is off where the mean error of its live landmarks, after the best rigid alignment, is above OFF_M and
   above OFF_RATIO times what it is with identities, over the landmarks of both. Drift turns and shifts a map and is no
   fault of association; a wrong pair bends it. OFF_M is half the least distance between two landmarks of the shipped
   worlds: from there on one is taken for another. Where noise alone does that, OFF_RATIO decides.
3. Flagged is who says so itself: `doubtful_vehicles` of the report. Everything but divergence is over the others.
4. Merges are over pairs of vehicles' landmarks, as in the report; `known` are those with identities, where a landmark
   that was sighted once counts too. Errors are the mean over the landmarks of the fused map that are in both maps,
   absolute; so is their ratio, pooled as the ratio of the means over all landmarks of all seeds.
5. `fused` has the same vehicles in both maps; `fused_all` all of them in the one with identities: what it costs to
   leave the flagged ones out is in it.
"""

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from fleet_seif.errors import RunError
from fleet_seif.joint import JointSolution, solve
from fleet_seif.merging import merged
from fleet_seif.records import Floats, Ints
from scenarios import virtual
from scenarios.association import Association, associate
from scenarios.config import Scenario
from scenarios.recording import Recording
from scenarios.report import FinishedRun, evaluate
from scenarios.score import align, landmark_truths
from scenarios.source import record

HALFWAY: Final = (
    "noise.forward_std_m=0.007",
    "noise.turn_std_rad=0.055",
    "noise.range_std_m=0.02",
    "noise.bearing_std_rad=0.033",
)
"""Noise half way from mild to the paper's."""
PRECISION_LEAST: Final = 0.97
DUPLICATES_MAX: Final = 3
OFF_M: Final = 0.025
OFF_RATIO: Final = 2.0


class MapOfTruths(NamedTuple):
    """Landmarks that are true ones: where they are, (n, 2) m, and which, (n,)."""

    mean: Floats
    truth: Ints


@dataclass(frozen=True)
class Errors:
    """Of two maps over the landmarks of both, m: sums over `ours` and `known` landmarks."""

    ours: int = 0
    ours_sum_m: float = 0.0
    known: int = 0
    known_sum_m: float = 0.0

    def __add__(self, other: "Errors") -> "Errors":
        return Errors(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    @property
    def ours_m(self) -> float:
        return self.ours_sum_m / self.ours if self.ours else float("nan")

    @property
    def known_m(self) -> float:
        return self.known_sum_m / self.known if self.known else float("nan")

    @property
    def ratio(self) -> float:
        return self.ours_m / self.known_m if self.known_sum_m else float("nan")


@dataclass(frozen=True, kw_only=True)
class VehicleScore:
    """One vehicle. own: the errors of its own map, aligned."""

    name: str
    association: Association
    own: Errors
    flagged: bool

    @property
    def is_off(self) -> bool:
        return self.own.ours_m > OFF_M and self.own.ratio > OFF_RATIO

    @property
    def diverged(self) -> bool:
        found = self.association
        precise = found.precision is None or found.precision >= PRECISION_LEAST
        return not precise or found.duplicate_landmarks >= DUPLICATES_MAX or self.is_off

    @property
    def remark(self) -> str:
        found = self.association
        return (
            f"{self.name} {'diverged' if self.diverged else 'healthy'}, {'' if self.flagged else 'not '}flagged: "
            f"precision {found.precision or 0.0:.4f}, {found.duplicate_landmarks} duplicates, "
            f"own map {self.own.ours_m:.4f} m, with identities {self.own.known_m:.4f} m"
        )


@dataclass(frozen=True, kw_only=True)
class SeedScore:
    """One seed. found: true merges; wrong, missed: see rule 4; fused: errors of the fused map; all: see rule 5."""

    seed: int
    vehicles: tuple[VehicleScore, ...]
    found: int
    wrong: int
    missed: int
    known: int
    fused: Errors
    fused_all: Errors

    @property
    def association(self) -> Association:
        """Of the vehicles that are not flagged."""
        return sum((each.association for each in self.vehicles if not each.flagged), Association())

    @property
    def diverged(self) -> int:
        return sum(each.diverged for each in self.vehicles)

    @property
    def flagged(self) -> int:
        return sum(each.flagged for each in self.vehicles)

    @property
    def remarks(self) -> list[str]:
        return [each.remark for each in self.vehicles if each.diverged or each.flagged]


def identified_run(scenario: Scenario, recording: Recording) -> FinishedRun:
    """The same readings with identities."""
    known = recording.identified()
    logs = {name: log.chosen(np.flatnonzero(log.sighting_truth >= 0)) for name, log in known.logs.items()}
    told = scenario.model_copy(update={"filter": scenario.filter.model_copy(update={"identities": "signatures"})})
    return virtual.run_virtual("with identities", told, replace(known, logs=logs))


def own_map(run: FinishedRun, vehicle: str) -> MapOfTruths:
    """The live map of a vehicle at the end."""
    mean, truths = run.drives[vehicle].landmarks, run.truths[vehicle]
    truth = np.array([truths.get(number, -1) for number in range(len(mean))], np.int64)
    chosen = (truth >= 0) & np.isfinite(mean).all(axis=1)
    return MapOfTruths(mean[chosen], truth[chosen])


def fused_map(run: FinishedRun, solution: JointSolution) -> MapOfTruths:
    """What a joint map of this run holds of true landmarks."""
    truth = landmark_truths(solution, run.truths)
    return MapOfTruths(solution.landmark_mean[truth >= 0], truth[truth >= 0])


def solved_without(run: FinishedRun, left_out: AbstractSet[str]) -> JointSolution:
    """The canonical map of a run in which these vehicles had no part."""
    lives = [life for life in run.ledger.lives() if life.vehicle not in left_out]
    return solve(lives, merged(lives).classes)


def merges_in(solution: JointSolution) -> int:
    """Pairs of different vehicles' landmarks that are one."""
    sets = [{name.vehicle for name in names} for names in solution.classes]
    return sum(len(each) * (len(each) - 1) // 2 for each in sets)


def errors(ours: MapOfTruths, known: MapOfTruths, landmarks: Floats, *, aligned: bool = False) -> Errors:
    """Of two maps, over the landmarks of both. landmarks: the true ones."""
    (n, sum_m), (known_n, known_sum_m) = (
        _error_sum(one, other, landmarks, aligned) for one, other in ((ours, known), (known, ours))
    )
    return Errors(n, sum_m, known_n, known_sum_m)


def _error_sum(of: MapOfTruths, other: MapOfTruths, landmarks: Floats, aligned: bool) -> tuple[int, float]:
    common = np.isin(of.truth, other.truth)
    at, there = of.mean[common], landmarks[of.truth[common]]
    d = (align(at, there) if aligned and len(at) else at) - there
    return len(d), float(np.hypot(d[:, 0], d[:, 1]).sum())


def pooled_association(rows: Sequence[SeedScore]) -> Association:
    return sum((row.association for row in rows), Association())


def pooled_errors(rows: Sequence[SeedScore]) -> Errors:
    return sum((row.fused for row in rows), Errors())


def score(name: str, scenario: Scenario) -> SeedScore:
    """Both runs of one seed."""
    recording = record(scenario)
    run = virtual.run_virtual(name, scenario, recording)
    known = identified_run(scenario, recording)
    try:
        outcome = evaluate(run)
    except RunError:  # no vehicle is part of the map: all say that they are doubtful
        flagged = frozenset(recording.logs)
    else:
        flagged = frozenset(outcome.report["doubtful_vehicles"])
    vehicles = tuple(
        VehicleScore(
            name=vehicle,
            association=associate(log, run.drives[vehicle].assigned),
            own=errors(own_map(run, vehicle), own_map(known, vehicle), recording.landmarks, aligned=True),
            flagged=vehicle in flagged,
        )
        for vehicle, log in recording.logs.items()
    )
    seed = scenario.run.seed
    if len(flagged) == len(recording.logs):
        return SeedScore(
            seed=seed, vehicles=vehicles, found=0, wrong=0, missed=0, known=0, fused=Errors(), fused_all=Errors()
        )
    ours, theirs = outcome.solution, solved_without(known, flagged)
    everyones = solved_without(known, frozenset()) if flagged else theirs
    return SeedScore(
        seed=seed,
        vehicles=vehicles,
        found=outcome.score.merges - outcome.score.wrong_merges,
        wrong=outcome.score.wrong_merges,
        missed=outcome.score.missed_merges,
        known=merges_in(theirs),
        fused=errors(fused_map(run, ours), fused_map(known, theirs), recording.landmarks),
        fused_all=errors(fused_map(run, ours), fused_map(known, everyones), recording.landmarks),
    )
