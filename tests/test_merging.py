"""Merging by place: what is one is found, what is not is never joined, and ambiguity is said."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif.joint import Life, landmark_classes
from fleet_seif.joint_solver import JointSolver
from fleet_seif.merging import MergeRules, Merges, Reason, merged
from fleet_seif.messages import LandmarkName
from fleet_seif.records import Floats
from fusion.events import Decisions
from fusion.merges import Merger
from tests.fleets import run_virtual
from tests.made_lives import grid, made_life
from tests.merging import pairs_in, score
from tests.strategies import settled

BY = pytest.mark.parametrize("by", ["joint", "clique"])
WORLD = grid(range(5), range(4)) + 0.3 * np.random.default_rng(5).uniform(-1.0, 1.0, (20, 2))
"""Twenty landmarks that are nowhere like a grid, about a metre apart."""


def two(a: Floats, b: Floats, seed: int, drift_m: float, noise_m: float = 0.02, turn_rad: float = 1e-3) -> list[Life]:
    rng = np.random.default_rng(seed)
    seen = {"a": a, "b": b}
    return [
        made_life(name, points, rng, drift_m=drift_m, noise_m=noise_m, turn_rad=turn_rad)
        for name, points in seen.items()
    ]


def wrong(merges: Merges, a: Floats, b: Floats) -> int:
    """Pairs joined that are not one in truth."""
    seen = {"a": a, "b": b}
    found = pairs_in(merges.classes)
    return sum(not np.array_equal(seen[p.vehicle][p.number], seen[q.vehicle][q.number]) for p, q in found)


@BY
@given(seed=st.integers(0, 10**6), drift_m=st.floats(0.001, 0.6))
@settings(settled, max_examples=25)
def test_a_pattern_is_found_again_however_far_it_has_drifted(by: str, seed: int, drift_m: float) -> None:
    """Of seven landmarks seen by both, nearly all; they drift by up to half the distance between two."""
    a, b = WORLD[:14], WORLD[7:]
    merges = merged(two(a, b, seed, drift_m), rules=MergeRules(by=by))  # type: ignore[arg-type]
    assert wrong(merges, a, b) == 0
    found = len(pairs_in(merges.classes))
    assert found >= 6 or all(each.reason is not Reason.FEW for each in merges.refused)
    assert found >= 6 or drift_m > 0.1


@BY
@given(seed=st.integers(0, 10**6), drift_m=st.floats(0.001, 1.5), shift=st.integers(0, 6))
@settings(settled, max_examples=60)
def test_in_a_perfectly_regular_world_nothing_is_ever_joined_wrongly(
    by: str, seed: int, drift_m: float, shift: int
) -> None:
    """Two maps of a grid, the same part of it or parts that overlap less and less, or only touch."""
    a, b = grid(range(6), range(4)), grid(range(shift, 6 + shift), range(4))
    merges = merged(two(a, b, seed, drift_m), rules=MergeRules(by=by))  # type: ignore[arg-type]
    assert wrong(merges, a, b) == 0


@pytest.mark.parametrize("drift_m", [0.3, 1.0])
def test_in_a_regular_world_ambiguity_is_said(drift_m: float) -> None:
    a = grid(range(6), range(4))
    merges = merged(two(a, a, 3, drift_m))
    assert not merges.pairs
    assert merges.refused
    assert {each.reason for each in merges.refused} <= {Reason.AMBIGUOUS, Reason.REPEATS}


def test_where_place_tells_them_apart_a_regular_world_is_no_problem() -> None:
    a = grid(range(6), range(4))
    assert len(merged(two(a, a, 4, 0.05)).pairs) == 24


def test_fewer_landmarks_than_must_agree_stay_apart_where_place_alone_says_too_little() -> None:
    a, b = WORLD[:10], WORLD[7:]
    merges = merged(two(a, b, 1, 0.4))
    assert not merges.pairs
    assert {each.reason for each in merges.refused} <= {Reason.FEW, Reason.AMBIGUOUS}


def test_where_every_landmark_carries_a_signature_nothing_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    lives = [
        dataclasses.replace(life, signatures=tuple(range(k, 20 + k)))
        for k, life in enumerate(two(WORLD, WORLD, 1, 0.1))
    ]  # fmt: skip
    monkeypatch.setattr(JointSolver, "replay", None)
    assert merged(lives) == Merges(landmark_classes(lives))


def test_two_different_signatures_are_two_landmarks_wherever_they_lie() -> None:
    lives = two(WORLD, WORLD, 1, 0.01)
    lives = [
        dataclasses.replace(life, signatures=(k, *life.signatures[1:])) for k, life in enumerate(lives)
    ]  # fmt: skip
    classes = merged(lives).classes
    assert len(classes) == 21
    assert (LandmarkName("a", 0, 0),) in classes


@given(seed=st.integers(0, 10**6), data=st.data())
@settings(settled, max_examples=20)
def test_the_order_of_lives_changes_nothing(seed: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(seed)
    lives = [made_life(v, WORLD, rng, drift_m=0.1, noise_m=0.03) for v in "abc"]
    shuffled = data.draw(st.permutations(lives))
    assert merged(shuffled) == merged(lives)


@given(seed=st.integers(0, 10**6), drift_m=st.floats(0.01, 0.5), noise_m=st.floats(0.01, 0.3))
@settings(settled, max_examples=30)
def test_no_landmark_has_two_names_of_one_life_and_all_pairs_are_accounted_for(
    seed: int, drift_m: float, noise_m: float
) -> None:
    rng = np.random.default_rng(seed)
    lives = [made_life(v, WORLD, rng, drift_m=drift_m, noise_m=noise_m) for v in "abc"]
    merges = merged(lives)
    for names in merges.classes:
        assert len({name[:2] for name in names}) == len(names)
    assert sorted(name for names in merges.classes for name in names) == sorted(
        name for names in landmark_classes(lives) for name in names
    )
    assert merges.classes == landmark_classes(lives, merged=merges.pairs)
    joined = [each for each in merges.considered if each.reason is Reason.MERGED]
    assert len(joined) == len(merges.pairs)
    assert all(each.d2 <= MergeRules().gate for each in joined)


def test_operators_overrule_what_is_seen() -> None:
    lives = two(WORLD, WORLD, 1, 0.01)
    one, same, other = LandmarkName("a", 0, 0), LandmarkName("b", 0, 0), LandmarkName("b", 0, 9)
    classes = merged(lives, forced=[(one, other)], forbidden=[(one, same)]).classes
    assert (one, other) in classes
    assert not any(one in names and same in names for names in classes)
    assert len(merged(lives, forbidden=[(one, same)]).pairs) == 19


def test_an_alias_counts_before_places_are_compared() -> None:
    """A vehicle's own duplicates are one landmark, and that is one with the other vehicle's."""
    twice = np.vstack([WORLD, WORLD[:1]])
    a, b = two(twice, WORLD, 2, 0.01)
    names = (LandmarkName("a", 0, 0), LandmarkName("a", 0, 20), LandmarkName("b", 0, 0))
    plain = merged([a, b])
    assert not any(set(names) <= set(group) for group in plain.classes)
    assert names in merged([dataclasses.replace(a, aliases=((0, 20),)), b]).classes


def test_a_vehicle_that_does_not_fit_its_own_sightings_is_not_merged_with_others() -> None:
    a, b = two(WORLD, WORLD, 1, 0.01)
    assert len(merged([a, b]).pairs) == 20
    assert merged([a, dataclasses.replace(b, consistent=False)]) == Merges(landmark_classes([a, b]))
    c = made_life("c", WORLD, np.random.default_rng(9), drift_m=0.01, noise_m=0.02)
    kept = merged([a, dataclasses.replace(b, consistent=False), c])
    assert {name.vehicle for pair in kept.pairs for name in pair} == {"a", "c"}


def moved(life: Life, number: int, by_m: float) -> Life:
    """The life, had it seen one landmark elsewhere."""
    rng = np.random.default_rng(1)
    at = np.array([WORLD[k] for k in range(len(life.signatures))])
    at[number, 0] += by_m
    other = made_life(life.vehicle, at, rng, drift_m=1e-3, noise_m=0.02)
    return dataclasses.replace(other, start_pose=life.start_pose, start_pose_cov=life.start_pose_cov)


def test_a_merge_that_has_become_improbable_is_undone_and_leaves_no_trace() -> None:
    a, b = two(WORLD, WORLD, 1, 1e-3)
    merger = Merger()
    pair = (LandmarkName("a", 0, 4), LandmarkName("b", 0, 4))
    assert pair in merger.of((a, moved(b, 4, 0.0)), Decisions()).pairs
    later = merger.of((a, moved(b, 4, 0.4)), Decisions())
    assert pair not in later.pairs
    assert later == merged((a, moved(b, 4, 0.4)))
    assert len(later.pairs) == 19


def test_a_merger_solves_only_where_something_has_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    lives = tuple(two(WORLD, WORLD, 1, 0.01))
    merger = Merger()
    first = merger.of(lives, Decisions())
    monkeypatch.setattr(JointSolver, "replay", None)
    again = tuple(dataclasses.replace(life) for life in lives)
    assert merger.of(again, Decisions()) is first
    with pytest.raises(TypeError):
        merger.of(again, Decisions(forbidden=((LandmarkName("a", 0, 0), LandmarkName("b", 0, 0)),)))


def test_a_life_that_cannot_be_solved_does_not_keep_others_apart() -> None:
    a, b = two(WORLD, WORLD, 1, 0.01)
    broken = dataclasses.replace(made_life("c", WORLD, np.random.default_rng(1), drift_m=0.1, noise_m=0.02), frames=())
    frame = a.frames[0]
    broken = dataclasses.replace(broken, frames=(dataclasses.replace(frame, H=-frame.H),))
    merges = merged([a, b, broken])
    assert len(merges.pairs) == 20
    assert sum(names[0].vehicle == "c" for names in merges.classes) == 20


def lives_of_run(scenario: str, seed: int) -> Sequence[Life]:
    return run_virtual(scenario, seed=seed).ledger.lives()


def test_without_signatures_three_vehicles_find_what_they_have_in_common() -> None:
    found, _ = score(lives_of_run("three_air_vehicles_mild", 2), MergeRules())
    assert found.wrong == 0
    assert found.missed <= 0.02 * found.true


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_over_twenty_seeds_no_merge_is_wrong_and_of_mild_noise_99_in_100_are_found() -> None:
    for scenario, share in (("three_air_vehicles_mild", 0.99), ("three_air_vehicles", 0.9)):
        scores = [score(lives_of_run(scenario, seed), MergeRules())[0] for seed in range(1, 21)]
        true, missed = sum(s.true for s in scores), sum(s.missed for s in scores)
        print(f"{scenario}: {true} true pairs, {missed} missed, {sum(s.wrong for s in scores)} wrong")
        assert sum(s.wrong for s in scores) == 0
        assert true - missed >= share * true
