"""Frames of a vehicle that finds out by itself what it sees: what it publishes, and that it goes on to the bit."""

import dataclasses
import itertools
import logging
from functools import cache
from typing import Any

import msgpack
import numpy as np
import pytest

from fleet_seif import own_map, own_window
from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.filters import StepResult
from fleet_seif.frames import FramedFilter
from fleet_seif.information import FrameTotal, delta_digest
from fleet_seif.messages import DeltaMessage, Epoch, FramePart
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.own_map import OwnMap
from fleet_seif.records import UNKNOWN_SIGNATURE, Reading, Sightings
from fleet_seif.wire import decode_message
from fusion.life import LifeTotal
from scenarios.association import associate
from scenarios.config import load_scenario
from scenarios.recording import Log
from scenarios.source import record
from tests.drives import FLEET, ODOMETRY_STD, Drive, drive, put, reading, square
from vehicles.core import Identity, VehicleCore

SETTINGS = FilterSettings(identities="associated")


@cache
def flown() -> Log:
    """Clutter, missed sightings, and turns so noisy that some landmarks are begun twice."""
    changed = ("world.steps=110", "noise.turn_std_rad=0.1")
    return record(load_scenario("three_air_vehicles_unknown", changed, 4), "v1").logs["v1"]


def flight() -> Drive:
    log = flown()
    return Drive(log.start_pose, log.sightings_at(0), tuple(log.readings()), log.truth_pose)


def compass() -> Drive:
    """Along the axes of the world, which are those of every frame: headings stay zero."""
    log = drive(square(25, 5.0, 7), steps=80, seed=8, model=COMPASS_XY)
    ahead = np.array([1.0, 1.0, 0.0])
    cov = np.diag([*ODOMETRY_STD[:2] ** 2, 1e-10])
    readings = tuple(
        dataclasses.replace(each, odometry=each.odometry * ahead, odometry_cov=cov) for each in log.readings
    )
    return dataclasses.replace(log, readings=readings)


def told(result: StepResult, parts: tuple[FramePart, ...], framed: FramedFilter) -> tuple[Any, ...]:
    """Everything that a step publishes."""
    said = [
        (p.frame, p.status, delta_digest(p.delta), None if p.end_pose is None else p.end_pose.tobytes()) for p in parts
    ]
    return result.first_new, result.new, result.innovation, result.sightings, framed.take_aliases(), said


def run(log: Drive, settings: FilterSettings = SETTINGS, model: int = RANGE_BEARING) -> tuple[FramedFilter, list[Any]]:
    framed = FramedFilter(settings, model)
    said = [told(*framed.start(log.start), framed)]
    said += [told(*framed.step(each), framed) for each in log.readings]
    framed.end()
    return framed, said


def stored(framed: FramedFilter) -> bytes:
    return bytes(msgpack.packb(framed.state()))


def restarted(framed: FramedFilter) -> FramedFilter:
    """Another one, from what a store would keep."""
    other = FramedFilter(framed.settings, framed.model)
    other.restore(msgpack.unpackb(stored(framed), use_list=False))
    return other


def relabelled(log: Drive, seed: int) -> Drive:
    """The same sightings under other signatures, most of them wrong."""
    rng = np.random.default_rng(seed)

    def other(seen: Sightings) -> Sightings:
        return dataclasses.replace(seen, signature=rng.integers(-3, 5, len(seen.z)))

    readings = tuple(dataclasses.replace(each, sightings=other(each.sightings)) for each in log.readings)
    return dataclasses.replace(log, start=other(log.start), readings=readings)


def messages(log: Drive, settings: FilterSettings) -> tuple[DeltaMessage, ...]:
    """The messages of a whole flight."""
    identity = Identity(
        fleet=FLEET, vehicle="ann", epoch=Epoch(1, 7), start_pose=log.start_pose, start_pose_cov=np.zeros((3, 3))
    )
    core = VehicleCore(identity, settings, PublishSettings(window=10_000))
    core.start(0.0, log.start)
    for each in log.readings:
        core.step(each)
    core.end()
    return tuple(decode_message(data) for data in put(core))


@cache
def published() -> tuple[DeltaMessage, ...]:
    return messages(flight(), SETTINGS)


LOGS = pytest.mark.parametrize(
    ("log", "model"), [(flight(), RANGE_BEARING), (compass(), COMPASS_XY)], ids=["air", "compass"]
)


def assert_restored_after_every_step_it_publishes_the_same_bits(
    log: Drive, settings: FilterSettings, model: int
) -> None:
    whole, again = FramedFilter(settings, model), FramedFilter(settings, model)
    whole.start(log.start)
    again.start(log.start)
    for each in log.readings:
        again = restarted(again)
        assert told(*again.step(each), again) == told(*whole.step(each), whole)
        assert stored(again) == stored(whole)
    again = restarted(again)
    assert [delta_digest(p.delta) for p in again.end()] == [delta_digest(p.delta) for p in whole.end()]
    assert again.take_aliases() == whole.take_aliases()
    assert np.array_equal(again.assigned, whole.assigned)
    assert stored(again) == stored(whole)


@LOGS
def test_restored_after_every_step_it_publishes_the_same_bits(log: Drive, model: int) -> None:
    assert_restored_after_every_step_it_publishes_the_same_bits(log, SETTINGS, model)


def test_restored_where_only_a_window_of_its_own_map_is_solved_it_publishes_the_same_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(own_map, "WHOLE_FRAMES", 2)
    monkeypatch.setattr(own_window, "RECENT", 1)
    monkeypatch.setattr(own_window, "SEEN_IN", 1)
    whole, again = FramedFilter(SETTINGS), FramedFilter(SETTINGS)
    whole.start(flight().start)
    again.start(flight().start)
    for k, each in enumerate(flight().readings):
        if k % 6 == 0:
            again = restarted(again)
        assert told(*again.step(each), again) == told(*whole.step(each), whole)
    assert len(whole.ends) > len(whole._own_map._numbers)
    assert stored(again) == stored(whole)
    assert (associate(flown(), whole.assigned).precision or 0.0) > 0.95


@pytest.mark.parametrize("steps", [50, 100])
def test_restored_where_a_frame_has_just_closed_it_ends_with_the_same_bits(steps: int) -> None:
    whole = FramedFilter(SETTINGS)
    whole.start(flight().start)
    for each in flight().readings[:steps]:
        whole.step(each)
    assert not whole._opened
    again = restarted(whole)
    parts = [(part.frame, delta_digest(part.delta)) for part in whole.end()]
    assert [(part.frame, delta_digest(part.delta)) for part in again.end()] == parts
    assert len({frame for frame, _ in parts}) > 1
    assert stored(again) == stored(whole)


def test_signatures_are_not_looked_at() -> None:
    plain, said = run(flight())
    for seed in (1, 2):
        other, other_said = run(relabelled(flight(), seed))
        assert other_said == said
        assert stored(other) == stored(plain)


def test_names_are_published_in_order_and_without_signature() -> None:
    names = [name for message in published() for name in message.landmarks]
    assert names == [(number, UNKNOWN_SIGNATURE) for number in range(len(names))]
    assert len(names) > 20


def test_an_alias_is_published_once_and_joins_landmarks_that_were_named_before() -> None:
    known, said = 0, []
    for message in published():
        known += len(message.landmarks)
        for a, b, added in message.aliases:
            assert 0 <= a < b < known
            assert added
            said.append((a, b))
    assert len(said) == len(set(said)) > 0
    assert said == run(flight())[0]._own_map.aliases


def test_a_node_takes_every_message_and_every_frame_is_positive_definite_after_each() -> None:
    life = LifeTotal()
    for message in published():
        assert life.fold(message, check=True) is None
    framed, _ = run(flight())
    assert {k: delta_digest(delta) for k, delta in life.checked.frames.items()} == {
        k: delta_digest(delta) for k, delta in enumerate(framed.published())
    }
    assert life.checked.aliases == tuple(sorted(framed._own_map.aliases))


def test_what_sightings_are_taken_for_is_right_with_few_exceptions() -> None:
    log = flown()
    framed, _ = run(flight())
    score = associate(log, framed.assigned)
    assert (score.precision or 0.0) > 0.97  # turns are three times as noisy as in the mild world
    assert (score.recall or 0.0) > 0.9
    framed, _ = run(compass(), model=COMPASS_XY)
    truth = np.concatenate([compass().start.signature, *(each.sightings.signature for each in compass().readings)])
    told_of = framed.assigned >= 0
    pairs = set(zip(framed.assigned[told_of].tolist(), truth[told_of].tolist(), strict=True))
    assert len(pairs) == len(set(truth.tolist())) == len(framed.signatures)
    assert np.mean(told_of) > 0.95


def test_the_local_map_is_bounded_and_a_frame_closes_before_the_vehicle_leaves_it() -> None:
    few = SETTINGS.association.model_copy(update={"local_landmarks_max": 10})
    framed, log = FramedFilter(SETTINGS.model_copy(update={"association": few})), flight()
    framed.start(log.start)
    numbers, frame = 0, 0
    for each in log.readings:
        result, _ = framed.step(each)
        associator = framed._associator
        assert associator is not None
        numbers = numbers + len(result.new) if framed.frame == frame else 0
        frame = framed.frame
        assert np.count_nonzero(associator.local.keys >= 0) <= 10 + numbers or frame == 0
        assert np.hypot(*framed.filter.pose[:2]) < associator.travel_max_m
    assert len(framed.ends) > len(run(log)[0].ends)


BAD = {
    "range not finite": {"z": np.array([[np.nan, 0.1]])},
    "range not positive": {"z": np.array([[-0.1, 0.1]])},
    "bearing not finite": {"z": np.array([[0.1, np.inf]])},
    "covariance not positive": {"cov": np.diag([1e-4, 0.0])[None]},
    "covariance not symmetric": {"cov": np.array([[[1e-4, 1e-6], [0.0, 1e-4]]])},
    "shapes": {"z": np.zeros((2, 2))},
}


@pytest.mark.parametrize("why", BAD)
def test_a_refused_sighting_changes_nothing_though_the_filter_is_not_told_of_it(why: str) -> None:
    """One sighting of nothing known: it would begin a provisional landmark."""
    framed = FramedFilter(SETTINGS)
    framed.start(flight().start)
    for each in flight().readings[:30]:
        framed.step(each)
    before = stored(framed)
    fine = Sightings(z=np.array([[0.19, 3.0]]), cov=np.diag([1e-4, 1e-4])[None], signature=np.array([-1]))
    with pytest.raises(ReadingRefused):
        framed.step(reading(100.0, dataclasses.replace(fine, **BAD[why])))
    assert stored(framed) == before


@pytest.mark.parametrize("cov", [np.zeros((3, 3)), np.diag([1e-4, -1e-4, 1e-4]), np.full((3, 3), np.nan)])
def test_odometry_that_is_refused_is_refused_as_a_reading_and_changes_nothing(cov: np.ndarray) -> None:
    framed = FramedFilter(SETTINGS)
    framed.start(flight().start)
    before = stored(framed)
    with pytest.raises(ReadingRefused, match=r"odometry_cov|finite"):
        framed.step(dataclasses.replace(flight().readings[0], odometry_cov=cov))
    assert stored(framed) == before


def test_steps_without_sightings_are_taken() -> None:
    framed = FramedFilter(SETTINGS)
    framed.start(Sightings.none())
    nothing: tuple[Reading, ...] = tuple(reading(float(k), Sightings.none()) for k in range(1, 60))
    for each in nothing:
        framed.step(each)
    framed.end()
    assert framed.assigned.shape == (0,)
    assert len(framed.ends) == 3


def test_where_its_own_map_cannot_be_solved_it_goes_on_with_what_it_has(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*arguments: object) -> None:
        raise NumericalError("no")

    monkeypatch.setattr(OwnMap, "around", fails)
    with caplog.at_level(logging.WARNING):
        framed, _ = run(flight())
    assert "own_map_not_solved" in caplog.text
    aliases = framed._own_map.aliases
    assert len(aliases) == len(set(aliases)) > 0
    assert len(framed.ends) == 5
    assert (associate(flown(), framed.assigned).precision or 0.0) > 0.9


def test_what_is_published_adds_up_to_what_the_filter_says_it_has_published() -> None:
    framed = FramedFilter(SETTINGS)
    log = flight()
    said = [framed.start(log.start)[1], *(framed.step(each)[1] for each in log.readings), framed.end()]
    totals: dict[int, FrameTotal] = {}
    for parts in said:
        for part in parts:
            totals.setdefault(part.frame, FrameTotal()).add(part.delta)
    assert [delta_digest(totals[k].delta()) for k in sorted(totals)] == [delta_digest(d) for d in framed.published()]


@pytest.mark.parametrize("lie_rad", [0.0, 0.5])
def test_where_odometry_lies_the_vehicle_does_not_see_what_should_be_in_view_and_says_so(lie_rad: float) -> None:
    """It begins its map a second time, turned: that fits itself, and no landmark may be another one."""
    log = record(load_scenario("three_air_vehicles_unknown", (), 101), "v1").logs["v1"]
    framed = FramedFilter(SETTINGS)
    framed.start(log.sightings_at(0))
    for step, each in enumerate(itertools.islice(log.readings(), 230), start=1):
        lie = np.array([0.0, 0.0, lie_rad if step == 150 else 0.0])
        framed.step(dataclasses.replace(each, odometry=each.odometry + lie))
    assert framed._associator is not None
    assert framed.doubtful == (framed._associator.unseen > SETTINGS.association.unseen_max) == (lie_rad > 0.0)
