"""What a vehicle takes its sightings for: when a landmark is accepted, what dies, what is not compared, or refused."""

import dataclasses
import math
from collections.abc import Sequence

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.associator import Associator, Decision, beside
from fleet_seif.config import AssociationSettings
from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.frame_log import NONE
from fleet_seif.local_map import LocalMap, moved, sighted, with_new
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats
from tests import reference
from tests.strategies import settled, spd

STD = 0.01
STILL = np.zeros(3), np.diag([1e-10, 1e-10, 1e-10])
"""Odometry of a vehicle that stands, as good as known."""
SETTINGS = AssociationSettings()


class Standing:
    """A vehicle that stands at the origin and looks around, step by step."""

    def __init__(self, settings: AssociationSettings = SETTINGS, model: int = RANGE_BEARING) -> None:
        self.associator = Associator(settings, model)
        self.step = 0
        self.numbers: list[int] = []

    def decide(self, *places: Sequence[float] | Floats) -> Decision:
        z, Z = self.seen(*places)
        return self.associator.decide(self.step, STILL if self.step else None, z, Z, len(self.numbers))

    def seen(self, *places: Sequence[float] | Floats) -> tuple[Floats, Floats]:
        """Sightings of what is at these places (x, y), without noise; as wide across as along."""
        model = self.associator.model
        z = np.array([reference.expected(model, np.zeros(3), np.array(place)) for place in places]).reshape(-1, 2)
        across = np.ones(len(z)) if model == COMPASS_XY else np.hypot(*np.array(places).reshape(-1, 2).T)
        return z, np.array([np.diag([STD**2, (STD / r) ** 2]) for r in across.tolist()]).reshape(-1, 2, 2)

    def look(self, *places: Sequence[float] | Floats) -> list[int]:
        """One step; what its sightings are taken for."""
        decision = self.decide(*places)
        self.associator.take(decision, self.seen(*places)[0])
        self.numbers += sorted(decision.accepted.values())
        self.step += 1
        return [int(key) for key in decision.keys]


def stored(associator: Associator) -> bytes:
    return bytes(msgpack.packb(associator.state()))


def around(count: int) -> list[tuple[float, float]]:
    """Places 1 m away, all around."""
    return [(math.cos(a), math.sin(a)) for a in np.arange(count) * math.tau / count]


def accepted_at(visible: Sequence[bool], sightings: int, steps: int) -> int | None:
    """The step of the sighting at which a landmark is accepted, by the rule itself."""
    first = 0
    while first < len(visible):
        if not visible[first]:
            first += 1
            continue
        seen = [k for k in range(first, min(first + steps, len(visible))) if visible[k]]
        if len(seen) >= sightings:
            return seen[sightings - 1]
        first += steps
    return None


@given(st.lists(st.booleans(), min_size=1, max_size=20), st.integers(1, 4), st.integers(1, 8), st.integers(0, 1))
@settled
def test_a_landmark_is_accepted_at_its_mth_sighting_within_n_steps(
    visible: list[bool], sightings: int, steps: int, model: int
) -> None:
    vehicle = Standing(AssociationSettings(confirm_sightings=sightings, confirm_steps=steps), model)
    at = accepted_at(visible, sightings, steps)
    for k, seen in enumerate(visible):
        keys = vehicle.look(*([(1.0, 0.5)] if seen else []))
        assert vehicle.numbers == ([] if at is None or k < at else [0])
        assert all((key >= 0) == (at is not None and k >= at) for key in keys)


def test_three_sightings_within_eight_steps_are_what_it_takes() -> None:
    for gap, accepted in ((6, True), (7, False)):
        vehicle = Standing()
        for k in range(9):
            vehicle.look(*([(1.0, 0.0)] if k in (0, 1, gap + 1) else []))
        assert bool(vehicle.numbers) == accepted


@given(st.permutations(range(5)))
@settled
def test_landmarks_are_numbered_in_the_order_of_the_sightings_that_confirm_them(order: list[int]) -> None:
    vehicle, places = Standing(), around(5)
    for _ in range(2):
        assert all(key < NONE for key in vehicle.look(*places))
    assert vehicle.look(*(places[i] for i in order)) == list(range(5))
    assert vehicle.look(*places) == [order.index(i) for i in range(5)]


def test_clutter_is_forgotten_and_nothing_of_it_is_left() -> None:
    vehicle, rng = Standing(), np.random.default_rng(3)
    places = rng.permutation([(0.3 * x, 0.3 * y) for x in range(-9, 10) for y in range(-9, 10) if x or y])
    for k in range(60):
        vehicle.look(*around(2), *places[2 * k : 2 * k + 2])
        assert len(vehicle.associator.local.keys) <= 2 + 2 * SETTINGS.confirm_steps
    assert vehicle.numbers == [0, 1]
    for _ in range(SETTINGS.confirm_steps):
        vehicle.look()
    assert vehicle.associator.local.keys.tolist() == [0, 1]
    assert vehicle.associator.state()["provisional"] == []


@given(st.floats(5.0, 60.0), st.floats(-3.0, 3.0))
@settled
def test_what_moves_by_five_sigmas_a_step_is_not_accepted(sigmas: float, heading: float) -> None:
    vehicle = Standing()
    step = sigmas * STD * np.array([math.cos(heading), math.sin(heading)])
    for k in range(20):
        vehicle.look(*around(3), *([np.array([3.0, 0.0]) + k * step] if k < 20 else []))
    assert vehicle.numbers == [0, 1, 2]


def test_a_decision_changes_nothing_until_it_is_taken() -> None:
    vehicle = Standing()
    for k in range(4):
        before = stored(vehicle.associator)
        first, second = (vehicle.decide(*around(3), (0.5, 2.0 - 0.1 * k)) for _ in range(2))
        assert stored(vehicle.associator) == before
        assert first.keys.tolist() == second.keys.tolist()
        assert reference.same(first.local.P, second.local.P)
        vehicle.look(*around(3), (0.5, 2.0 - 0.1 * k))
        assert stored(vehicle.associator) != before


def test_it_goes_on_from_its_state_to_the_bit() -> None:
    whole, again = Standing(), Standing()
    rng = np.random.default_rng(5)
    for k in range(40):
        restored = Associator(SETTINGS, RANGE_BEARING)
        restored.restore(msgpack.unpackb(stored(again.associator), use_list=False))
        again.associator = restored
        places = [np.array(place) + 0.5 * STD * rng.standard_normal(2) for place in around(6)]
        places = [place for place in places if rng.random() < 0.7] + [3.0 * rng.standard_normal(2)]
        assert again.look(*places) == whole.look(*places)
        if k == 20:
            near = LocalMap(np.array([0.0, 0.0, 0.0, 1.0, 0.0]), np.diag([0.0, 0.0, 0.0, 1e-4, 1e-4]), np.array([0]))
            for each in (whole, again):
                each.associator.begin(near, 7.0)
        assert stored(again.associator) == stored(whole.associator)
    assert len(whole.numbers) > 5


REFUSED = {
    "range not finite": ([[np.nan, 0.1]], np.eye(2)),
    "bearing not finite": ([[1.0, np.inf]], np.eye(2)),
    "range not positive": ([[0.0, 0.1]], np.eye(2)),
    "range negative": ([[-1.0, 0.1]], np.eye(2)),
    "covariance zero": ([[1.0, 0.1]], np.zeros((2, 2))),
    "covariance indefinite": ([[1.0, 0.1]], np.diag([1.0, -1.0])),
    "covariance singular": ([[1.0, 0.1]], np.ones((2, 2))),
    "covariance not symmetric": ([[1.0, 0.1]], np.array([[1.0, 0.5], [0.0, 1.0]])),
    "covariance not finite": ([[1.0, 0.1]], np.diag([1.0, np.nan])),
}


@pytest.mark.parametrize("why", REFUSED)
def test_sightings_that_are_none_are_refused_and_change_nothing(why: str) -> None:
    vehicle = Standing()
    for _ in range(4):
        vehicle.look(*around(3))
    before = stored(vehicle.associator)
    z, Z = REFUSED[why]
    fine = vehicle.seen((1.0, 0.0))
    with pytest.raises(ReadingRefused):
        vehicle.associator.decide(
            4, STILL, np.concatenate([fine[0], z]), np.concatenate([fine[1], np.array(Z, float)[None]]), 3
        )
    assert stored(vehicle.associator) == before


@pytest.mark.parametrize("u", [np.nan, np.inf])
def test_a_motion_that_is_none_is_refused(u: float) -> None:
    vehicle = Standing()
    for motion in ((np.array([u, 0.0, 0.0]), STILL[1]), (STILL[0], -STILL[1]), (STILL[0], np.diag([u, 1.0, 1.0]))):
        with pytest.raises(ReadingRefused):
            vehicle.associator.decide(1, motion, *vehicle.seen((1.0, 0.0)), 0)


def test_a_local_map_that_is_none_is_a_numerical_error() -> None:
    vehicle = Standing()
    for _ in range(3):
        vehicle.look((1.0, 0.0))
    local = vehicle.associator.local
    vehicle.associator.local = dataclasses.replace(local, P=-np.eye(len(local.P)))
    with pytest.raises(NumericalError):
        vehicle.decide((1.0, 0.0))


def test_a_step_without_sightings_is_taken_and_moves_the_pose() -> None:
    vehicle = Standing()
    vehicle.look(*around(2))
    u, cov = np.array([0.1, 0.0, 0.2]), np.diag([1e-4, 1e-4, 1e-4])
    z, Z = vehicle.seen()
    decision = vehicle.associator.decide(1, (u, cov), z, Z, 0)
    assert (decision.keys.tolist(), decision.accepted, decision.dof) == ([], {}, 0)
    assert np.array_equal(decision.local.pose, u)
    vehicle.associator.take(decision, z)
    assert np.array_equal(vehicle.associator.local.pose, u)


@given(spd(3), st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6))
@settled
def test_the_local_map_is_the_ekf_over_what_was_decided(cov: Floats, noise: list[float]) -> None:
    """Known landmarks first, all at once; then what is new, from where that has put the pose."""
    vehicle = Standing()
    for _ in range(3):
        vehicle.look(*around(3))
    cov = 1e-5 * (cov + cov.T)
    z, Z = vehicle.seen((0.3, 2.0), *around(3))
    z[1:] += STD * np.array(noise).reshape(3, 2)
    decision = vehicle.associator.decide(3, (np.zeros(3), cov), z, Z, 3)
    if decision.keys.tolist()[1:] != [0, 1, 2]:  # one is beyond the gate, or doubtful
        return
    local = moved(RANGE_BEARING, vehicle.associator.local, np.zeros(3), cov)
    local, squared = sighted(RANGE_BEARING, local, np.arange(3), z[1:], Z[1:])
    assert decision.innovation == pytest.approx(squared, rel=1e-9)
    assert decision.dof == 6
    if decision.keys[0] < NONE:
        local = with_new(RANGE_BEARING, local, int(decision.keys[0]), z[0], Z[0])
    np.testing.assert_allclose(decision.local.mean, local.mean, atol=1e-12)
    np.testing.assert_allclose(decision.local.P, local.P, atol=1e-15)
    assert np.array_equal(decision.local.keys, local.keys)


# What is not compared, and frames.


def two_known(std_m: float) -> Standing:
    """Landmarks 0 and 1, one metre apart, seen last at step 2; then a frame begins where they are known so well."""
    vehicle = Standing()
    for _ in range(3):
        vehicle.look((2.0, 0.0), (2.0, 1.0))
    mean = np.array([0.0, 0.0, 0.0, 2.0, 0.0, 2.0, 1.0])
    near = LocalMap(mean, np.diag([0.0, 0.0, 0.0, *[std_m**2] * 4]), np.array([0, 1]))
    vehicle.associator.begin(near, 10.0)
    return vehicle


@pytest.mark.parametrize(("std_m", "after", "compared"), [(0.1, 1, True), (0.18, 1, False), (0.16, 1000, True)])
def test_a_landmark_is_not_compared_where_its_place_is_no_better_known_than_half_way_to_the_next(
    std_m: float, after: int, compared: bool
) -> None:
    """6 sigmas against one metre."""
    vehicle = two_known(std_m)
    vehicle.step = 2 + after
    (key,) = vehicle.look((2.0, 0.0))
    assert key == 0 if compared else key < NONE


def test_a_landmark_that_was_sighted_in_this_frame_is_compared_however_well_it_is_known() -> None:
    vehicle = two_known(0.1)
    assert vehicle.look((2.0, 0.0)) == [0]
    local = vehicle.associator.local
    vehicle.associator.local = dataclasses.replace(local, P=local.P + np.diag([0.0, 0.0, 0.0, *[0.18**2] * 4]))
    assert vehicle.look((2.0, 0.0)) == [0]


def test_what_lies_where_a_doubtful_landmark_may_be_begins_anew() -> None:
    vehicle = two_known(0.18)
    vehicle.step = 100
    keys = [vehicle.look((2.0, 0.0)) for _ in range(3)]
    assert keys[-1] == [2]
    assert vehicle.numbers == [0, 1, 2]
    assert vehicle.associator.local.keys.tolist() == [0, 1, 2]


def test_a_provisional_landmark_is_carried_into_the_next_frame() -> None:
    vehicle = Standing()
    for _ in range(2):
        vehicle.look((1.0, 0.0), (0.0, 1.0))
    near = LocalMap(np.array([0.0, 0.0, 0.0, 3.0, 3.0]), np.diag([0.0, 0.0, 0.0, 1e-4, 1e-4]), np.array([9]))
    vehicle.associator.begin(near, 5.0)
    assert vehicle.look((1.0, 0.0), (0.0, 1.0)) == [0, 1]
    assert vehicle.associator.local.keys.tolist() == [9, 0, 1]


def test_a_frame_has_been_left_where_the_local_map_may_lack_what_is_sighted() -> None:
    associator = Associator(SETTINGS, RANGE_BEARING)
    assert not associator.has_left(np.array([1e9, 0.0, 0.0]))
    associator.begin(LocalMap(np.zeros(3), np.zeros((3, 3)), np.empty(0, np.int64)), 5.0)
    assert not associator.has_left(np.array([2.9, 4.0, 3.0]))
    assert associator.has_left(np.array([3.0, 4.0, 0.0]))


def test_two_maps_beside_each_other_keep_their_covariances_and_nothing_links_them() -> None:
    rng = np.random.default_rng(1)
    a, b = (rng.standard_normal((7, 7)) for _ in range(2))
    first = LocalMap(np.arange(7.0), a @ a.T, np.array([3, 4]))
    second = LocalMap(np.arange(10.0, 17.0), b @ b.T, np.array([-2, -3]))
    whole = beside(first, second)
    assert np.array_equal(whole.mean, [*first.mean, *second.mean[3:]])
    assert whole.keys.tolist() == [3, 4, -2, -3]
    assert np.array_equal(whole.P[:7, :7], first.P)
    assert np.array_equal(whole.P[7:, 7:], second.P[3:, 3:])
    assert not np.any(whole.P[:7, 7:])


def test_landmarks_that_are_sighted_together_are_two_however_near() -> None:
    """Begun together, and drawn onto each other afterwards: only what is never sighted together may be one."""
    vehicle = Standing()
    for _ in range(4):
        vehicle.look(*around(3))
    local = vehicle.associator.local
    assert sorted(vehicle.numbers) == local.keys.tolist() == [0, 1, 2]
    mean = local.mean.copy()
    mean[5:7] = mean[3:5]
    vehicle.associator.local = dataclasses.replace(local, mean=mean)
    assert vehicle.associator.duplicates().pairs == []
