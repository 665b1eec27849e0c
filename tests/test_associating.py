"""Whole fleets without identities, against the same readings with them."""

import dataclasses

import pytest

from fleet_seif.errors import RunError
from scenarios.association import Association
from scenarios.config import load_scenario
from scenarios.report import evaluate
from scenarios.source import record
from tests.association_ceiling import ceiling
from tests.fleets import run_virtual
from tests.identities import DUPLICATES_MAX, Errors, SeedScore, VehicleScore, pooled_association, score

SCENARIO = "three_air_vehicles_unknown"
SMALL = ("world.steps=100",)
HEALTHY = VehicleScore(
    name="v1", association=Association(assigned=100, right=99, true=100, found=98), own=Errors(10, 0.1, 10, 0.1),
    flagged=False,
)  # fmt: skip


def scored(seed: int, *settings: str) -> SeedScore:
    return score(SCENARIO, load_scenario(SCENARIO, settings, seed))


@pytest.mark.parametrize(
    ("changed", "diverged"),
    [
        (HEALTHY, False),
        (dataclasses.replace(HEALTHY, association=Association(assigned=100, right=96)), True),
        (dataclasses.replace(HEALTHY, association=Association(duplicate_landmarks=DUPLICATES_MAX - 1)), False),
        (dataclasses.replace(HEALTHY, association=Association(duplicate_landmarks=DUPLICATES_MAX)), True),
        (dataclasses.replace(HEALTHY, own=Errors(10, 0.24, 10, 0.1)), False),
        (dataclasses.replace(HEALTHY, own=Errors(10, 0.30, 10, 0.2)), False),
        (dataclasses.replace(HEALTHY, own=Errors(10, 0.30, 10, 0.1)), True),
    ],
)
def test_a_vehicle_has_diverged_by_its_precision_its_duplicates_or_its_map(
    changed: VehicleScore, diverged: bool
) -> None:
    assert changed.diverged is diverged


def test_what_a_flagged_vehicle_associated_is_left_out_of_the_pool() -> None:
    lost = dataclasses.replace(HEALTHY, name="v2", association=Association(assigned=100, right=10), flagged=True)
    row = SeedScore(
        seed=1, vehicles=(HEALTHY, lost), found=0, wrong=0, missed=0, known=0, fused=Errors(), fused_all=Errors()
    )
    assert pooled_association([row, row]) == HEALTHY.association + HEALTHY.association
    assert (row.diverged, row.flagged) == (1, 1)


def test_a_short_run_without_identities_is_nearly_as_good_as_with_them() -> None:
    row = scored(101, *SMALL)
    assert row.diverged == row.flagged == row.wrong == 0
    assert row.found > 0
    assert (row.association.precision or 0.0) >= 0.99
    assert (row.association.recall or 0.0) >= 0.9
    assert row.fused.ratio < 2.0


def test_doubtful_vehicles_are_not_fused_and_a_run_of_such_says_so() -> None:
    run = run_virtual(SCENARIO, *SMALL, "filter.association={misfit_max=1e-9}", seed=101)
    assert run.ledger.lives() == ()
    with pytest.raises(RunError, match="no vehicle is part of the map; doubtful by their own word: v1, v2, v3"):
        evaluate(run)


def test_from_true_poses_almost_every_sighting_is_told() -> None:
    scenario = load_scenario(SCENARIO, SMALL, 101)
    found = ceiling(record(scenario), scenario.filter.association)
    assert (found.precision or 0.0) >= 0.997
    assert (found.recall or 0.0) >= 0.97


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", [101, 102, 103])
def test_no_merge_is_wrong_and_hardly_a_sighting(seed: int) -> None:
    row = scored(seed)
    assert row.wrong == 0
    assert (row.association.precision or 0.0) >= 0.99
