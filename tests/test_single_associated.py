"""One frame of a vehicle that finds out by itself what it sees: what enters the filter, and to the bit."""

import logging
from functools import cache

import numpy as np
import pytest

from fleet_seif.associator import Associator
from fleet_seif.config import FilterSettings
from fleet_seif.errors import NumericalError
from fleet_seif.frame_log import NONE
from fleet_seif.frames import CROWDED_MAX, FramedFilter
from fleet_seif.information import FrameDelta, delta_digest, largest_growth, quanta, to_information
from fleet_seif.local_map import LocalMap
from fleet_seif.messages import DeltaMessage
from fleet_seif.own_duplicates import crowded
from fleet_seif.own_map import first_names
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints, Sightings
from fleet_seif.seif import Seif
from fleet_seif.surroundings import around_pose
from fusion.life import LifeTotal
from scenarios.association import associate
from tests.drives import Drive, drive, square, sum_deltas
from tests.test_frames_associated import (
    LOGS,
    assert_restored_after_every_step_it_publishes_the_same_bits,
    flight,
    flown,
    messages,
    relabelled,
    restarted,
    run,
    stored,
)

SETTINGS = FilterSettings(frames="single", identities="associated", active_max=12)


@cache
def flew() -> FramedFilter:
    return run(flight(), SETTINGS)[0]


@LOGS
def test_restored_after_every_step_it_publishes_the_same_bits(log: Drive, model: int) -> None:
    assert_restored_after_every_step_it_publishes_the_same_bits(log, SETTINGS, model)


def test_signatures_are_not_looked_at() -> None:
    _, said = run(flight(), SETTINGS)
    other, other_said = run(relabelled(flight(), 1), SETTINGS)
    assert other_said == said
    assert stored(other) == stored(flew())


def keys_by_step(framed: FramedFilter) -> list[Ints]:
    return [np.array(keys) for keys in framed._assigned]


def test_the_filter_takes_a_landmarks_sightings_from_the_one_that_has_it_accepted_on() -> None:
    """As one does that is told which these are, until the first landmarks are joined."""
    log, framed = flight(), FramedFilter(SETTINGS)
    filter = Seif(SETTINGS)
    framed.start(log.start)
    assert framed.signatures == []
    filter.start(Sightings.none())
    for each in log.readings:
        framed.step(each)
        if framed._own_map.aliases:
            break
        keys = keys_by_step(framed)[-1]
        seen, known = each.sightings, keys >= 0
        filter.step(
            type(each)(
                time_s=each.time_s, odometry=each.odometry, odometry_cov=each.odometry_cov,
                sightings=Sightings(z=seen.z[known], cov=seen.cov[known], signature=keys[known]),
            )
        )  # fmt: skip
        assert delta_digest(framed.published()[0]) == delta_digest(filter.published())
    assert len(filter.signatures) > 5
    assert framed._own_map.aliases


def test_of_what_a_landmark_was_seen_before_it_was_accepted_nobody_says_whose_it_is() -> None:
    keys = keys_by_step(flew())
    provisional = np.concatenate(keys) < NONE
    assert np.count_nonzero(provisional) >= 2 * len(flew().signatures)
    assert np.all(flew().assigned[provisional] == NONE)


def test_what_sightings_are_taken_for_is_right_with_few_exceptions() -> None:
    score = associate(flown(), flew().assigned)
    assert (score.precision or 0.0) > 0.97  # turns are three times as noisy as in the mild world
    assert (score.recall or 0.0) > 0.65


@cache
def published() -> tuple[DeltaMessage, ...]:
    return messages(flight(), SETTINGS)


def test_a_node_takes_every_message_and_the_frame_is_positive_definite_after_each() -> None:
    life = LifeTotal()
    for message in published():
        assert life.fold(message, check=True) is None
    assert [delta_digest(life.checked.frames[0])] == [delta_digest(delta) for delta in flew().published()]
    assert life.checked.aliases == tuple(sorted(flew()._own_map.aliases))
    names = [name for message in published() for name in message.landmarks]
    assert names == [(number, UNKNOWN_SIGNATURE) for number in range(len(flew().signatures))]


@pytest.mark.parametrize(("more", "doubtful"), [(0.01, True), (-0.01, False)])
def test_a_vehicle_with_landmarks_where_hardly_two_can_be_says_that_it_is_doubtful(
    more: float, doubtful: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def share(associator: Associator) -> float:
        return CROWDED_MAX + more

    monkeypatch.setattr(Associator, "crowded", share)
    clear = SETTINGS.association.model_copy(update={"unclear_max": 1.0})
    framed, _ = run(flight(), SETTINGS.model_copy(update={"association": clear}))
    assert framed.doubtful is restarted(framed).doubtful is doubtful


def test_what_a_vehicle_doubts_is_in_its_messages() -> None:
    assert published()[0].healthy
    assert published()[-1].healthy is (not flew().doubtful)


def test_landmarks_that_are_one_are_held_together_and_the_higher_name_is_none_any_more() -> None:
    framed = flew()
    aliases = framed._own_map.aliases
    assert len(aliases) > 0
    mean = framed.filter.landmarks
    for a, b in aliases:
        assert np.hypot(*(mean[a] - mean[b])) < 0.002
    first = first_names(aliases, len(mean))
    gone = first != np.arange(len(mean))
    assert np.array_equal(np.isnan(framed.landmarks[:, 0]), gone)
    assert np.all(first[framed.assigned[framed.assigned >= 0]] == framed.assigned[framed.assigned >= 0])
    assert not np.any(np.isin(framed._associator.local.keys if framed._associator else [], np.flatnonzero(gone)))


def test_where_it_cannot_look_around_it_goes_on_with_what_it_has(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*arguments: object) -> None:
        raise NumericalError("no")

    monkeypatch.setattr(Seif, "blanket_covariance", fails)
    with caplog.at_level(logging.WARNING):
        framed, _ = run(flight(), SETTINGS)
    assert "not_looked_around" in caplog.text
    assert (associate(flown(), framed.assigned).precision or 0.0) > 0.9


# The join.


def driven(**options: object) -> Seif:
    seif = Seif(FilterSettings.model_validate({"active_max": 4, "frames": "single", **options}))
    log = drive(square(30, 5.0, 7), steps=60, seed=8)
    seif.start(log.start)
    for each in log.readings:
        seif.step(each)
    return seif


def collapsed(H: Floats, a: int, b: int) -> Floats:
    """H with landmark b's rows and columns added to those of a."""
    G = np.eye(len(H))
    G[3 + 2 * b : 5 + 2 * b, 3 + 2 * a : 5 + 2 * a] = np.eye(2)
    return np.delete(np.delete(G.T @ H @ G, [3 + 2 * b, 4 + 2 * b], 0), [3 + 2 * b, 4 + 2 * b], 1)


@pytest.mark.parametrize("kind", ["seif", "eif", "eseif"])
def test_a_join_is_a_measurement_of_no_difference_that_is_gone_once_the_two_are_collapsed(kind: str) -> None:
    seif = driven(kind=kind, mean="exact")
    (H, b), a, c = seif.information(), 1, 6
    before = seif.published()
    W = seif.settings.start_information
    delta = seif.join([(a, c)], FrameDelta.nothing())
    (H_after, b_after) = seif.information()
    J = np.zeros((2, len(b)))
    J[:, 3 + 2 * a : 5 + 2 * a], J[:, 3 + 2 * c : 5 + 2 * c] = np.eye(2), -np.eye(2)
    np.testing.assert_allclose(H_after.toarray(), H.toarray() + W * J.T @ J, rtol=1e-12, atol=1e-6)
    np.testing.assert_allclose(b_after, b, rtol=1e-12)
    np.testing.assert_allclose(collapsed(H_after.toarray(), a, c), collapsed(H.toarray(), a, c), rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(seif.mean(), np.linalg.solve(H.toarray() + W * J.T @ J, b), atol=1e-6)
    assert delta_digest(sum_deltas([before, delta])) == delta_digest(seif.published())
    whole = to_information(seif.published()).H.toarray()
    np.testing.assert_allclose(whole, H_after.toarray(), atol=1e-6)


def test_after_a_join_the_mean_follows_though_the_map_is_not_solved() -> None:
    seif = driven()
    a, b = 1, 6
    apart = np.hypot(*(seif.landmarks[a] - seif.landmarks[b]))
    seif.join([(a, b)], FrameDelta.nothing())
    assert apart > 0.3
    assert np.hypot(*(seif.landmarks[a] - seif.landmarks[b])) < 0.1 * apart
    assert not np.any(seif._s.local[:50])


def test_a_join_claims_no_more_than_what_the_step_leaves_of_the_declared_limit() -> None:
    seif = driven(step_information_max=2e5)
    step = seif.start(Sightings.none()).delta
    total = seif.join([(1, 6), (2, 9)], step)
    assert quanta(1e3) < largest_growth(total) <= quanta(2e5)


def test_where_the_step_leaves_nothing_of_the_declared_limit_no_join_is_made() -> None:
    """A frame's start may be more certain than a step may be."""
    seif = driven(step_information_max=2e5)
    step = Seif(seif.settings).start(Sightings.none()).delta
    assert largest_growth(step) > quanta(2e5)
    before = seif.state()
    assert seif.join([(1, 6)], step) is step
    assert seif.state() == before


def test_a_join_that_cannot_be_made_changes_nothing() -> None:
    seif = driven()
    seif._s.H_xx[:] = -np.eye(3)
    before = seif.state()
    with pytest.raises(NumericalError, match="cannot be joined"):
        seif.join([(1, 6)], FrameDelta.nothing())
    assert seif.state() == before
    assert seif.join([], step := FrameDelta.nothing()) is step


# What lies around.


def test_around_the_pose_are_the_nearest_landmarks_as_seen_from_it() -> None:
    seif = driven(kind="eif")
    numbers = np.array([0, 2, 3, 5, 8])
    near, travel_max_m = around_pose(seif, numbers, 3, 0.5)
    away = np.hypot(*(seif.landmarks[numbers] - seif.pose[:2]).T)
    assert near.keys.tolist() == sorted(numbers[np.argsort(away)[:3]].tolist())
    assert travel_max_m == pytest.approx(max(np.sort(away)[3] - 0.5, 0.125))
    np.testing.assert_allclose(np.hypot(*near.landmarks.T), away[np.isin(numbers, near.keys)])
    assert not np.any(near.mean[:3])
    assert not np.any(near.P[:3])
    assert np.linalg.eigvalsh(near.P[3:, 3:])[0] > 0.0
    everything, travel_max_m = around_pose(seif, numbers, 10, 0.5)
    assert (everything.keys.tolist(), travel_max_m) == (numbers.tolist(), np.inf)


def test_landmarks_are_crowded_where_they_are_nearer_than_two_can_be_and_were_never_sighted_together() -> None:
    grid = np.array([(x, y) for x in range(4) for y in range(4)], float)
    places = np.concatenate([grid, [[0.3, 0.0], [2.0, 1.6]]])
    local = LocalMap(np.concatenate([np.zeros(3), places.ravel()]), np.eye(39), np.arange(18))
    apart, met = np.zeros((2, 18, 18), np.int64)
    met[0, 16] = met[16, 0] = 2
    assert crowded(local, apart) == pytest.approx(4 / 18)
    assert crowded(local, met) == pytest.approx(2 / 18)
    assert crowded(LocalMap(np.zeros(7), np.eye(7), np.arange(2)), np.zeros((2, 2), np.int64)) == 0.0
    provisional = LocalMap(local.mean, local.P, np.where(local.keys >= 16, NONE - 1 - local.keys, local.keys))
    assert crowded(provisional, np.zeros((16, 16), np.int64)) == 0.0
