"""A vehicle that slipped finds a way back: it tells the last frames anew, and is doubtful until that is published."""

from functools import cache

import numpy as np
import pytest

from fleet_seif import frames as frames_module
from fleet_seif import own_map, own_window
from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.frames import FramedFilter
from fleet_seif.information import FrameTotal, delta_digest
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus
from fleet_seif.own_map import first_names
from fleet_seif.streams import Coalescer
from fleet_seif.way_back import told_anew
from fleet_seif.wire import decode_message
from fusion.life import LifeTotal
from scenarios.association import Association, associate
from scenarios.config import load_scenario
from scenarios.recording import Log
from scenarios.source import record
from tests import reference
from tests.drives import FLEET, put
from tests.identities import HALFWAY
from tests.test_frames_associated import restarted, stored, told
from vehicles.core import Identity, VehicleCore

SETTINGS = FilterSettings(identities="associated")
LOST, BACK = 125, 150
"""When the frames close after which the vehicle of `slipped` is doubtful, and after which it has found its way back."""


@cache
def slipped() -> Log:
    """Noise half way to the paper's, with which some vehicles take landmarks for their neighbours."""
    return record(load_scenario("three_air_vehicles_unknown", ("world.steps=220", *HALFWAY), 24), "v1").logs["v1"]


def flown(framed: FramedFilter) -> list[tuple[tuple[FramePart, ...], bool]]:
    """What each step publishes, and whether the vehicle is doubtful after it."""
    said = [(framed.start(slipped().sightings_at(0))[1], framed.doubtful)]
    for each in slipped().readings():
        said.append((framed.step(each)[1], framed.doubtful))
    return said


def without_a_way_back(monkeypatch: pytest.MonkeyPatch) -> FramedFilter:
    with monkeypatch.context() as patched:
        patched.setattr(frames_module, "told_anew", lambda *arguments: None)
        framed = FramedFilter(SETTINGS)
        flown(framed)
        framed.end()
    return framed


def scored(framed: FramedFilter) -> Association:
    return associate(slipped(), framed.assigned)


def corrected(parts: tuple[FramePart, ...]) -> list[int]:
    return [part.frame for part in parts if part.status is FrameStatus.CORRECTED]


def test_it_is_doubtful_until_it_has_told_its_last_frames_anew_and_then_knows_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    framed = FramedFilter(SETTINGS)
    doubtful = [step for step, (_, doubt) in enumerate(flown(framed)) if doubt]
    assert doubtful == list(range(LOST, BACK))
    framed.end()
    lost = without_a_way_back(monkeypatch)
    assert (scored(framed).recall or 0.0) > (scored(lost).recall or 1.0)
    assert scored(framed).duplicate_landmarks == 0 < scored(lost).duplicate_landmarks


def test_what_it_publishes_adds_up_to_what_it_says_it_has_published() -> None:
    framed = FramedFilter(SETTINGS)
    said = [parts for parts, _ in flown(framed)]
    assert sorted(corrected(said[BACK])) == list(range(6))
    totals: dict[int, FrameTotal] = {}
    for part in (part for parts in (*said, framed.end()) for part in parts):
        totals.setdefault(part.frame, FrameTotal()).add(part.delta)
    assert [delta_digest(totals[k].delta()) for k in sorted(totals)] == [delta_digest(d) for d in framed.published()]


def test_where_it_takes_several_messages_it_is_doubtful_until_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, little = FramedFilter(SETTINGS), FramedFilter(SETTINGS)
    flown(whole)
    monkeypatch.setattr(frames_module, "CORRECTIONS_EACH", 2)
    said = flown(little)
    parts = [corrected(said[step][0]) for step in range(BACK, BACK + 3)]
    assert sorted(frame for some in parts for frame in some) == list(range(6))
    assert all(parts)
    assert [said[step][1] for step in range(BACK, BACK + 4)] == [True, True, False, False]
    assert stored(little) == stored(whole)


def test_restored_after_every_step_it_finds_the_same_way_back_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frames_module, "CORRECTIONS_EACH", 2)
    whole, again = FramedFilter(SETTINGS), FramedFilter(SETTINGS)
    whole.start(slipped().sightings_at(0))
    again.start(slipped().sightings_at(0))
    for each in slipped().readings():
        again = restarted(again)
        assert told(*again.step(each), again) == told(*whole.step(each), whole)
        assert again.take_begun() == whole.take_begun()
        assert stored(again) == stored(whole)
    assert [delta_digest(p.delta) for p in restarted(again).end()] == [delta_digest(p.delta) for p in whole.end()]


def core_of(settings: FilterSettings) -> VehicleCore:
    identity = Identity(
        fleet=FLEET, vehicle="ann", epoch=Epoch(1, 7), start_pose=slipped().start_pose, start_pose_cov=np.zeros((3, 3))
    )
    return VehicleCore(identity, settings, PublishSettings(window=10_000))


def assert_has_all_of(life: LifeTotal, framed: FramedFilter) -> None:
    assert {k: delta_digest(delta) for k, delta in life.checked.frames.items()} == {
        k: delta_digest(delta) for k, delta in enumerate(framed.published())
    }
    for frame, end_pose in enumerate(framed.ends):
        assert reference.same(life.frames[frame].end_pose, end_pose)
    assert life.checked.aliases == tuple(sorted(framed._own_map.aliases))
    assert life.checked.names == len(framed.signatures)


@cache
def published() -> tuple[tuple[DeltaMessage, ...], FramedFilter]:
    """The messages of the whole flight, and the filter that is behind them."""
    core, log = core_of(SETTINGS), slipped()
    core.start(0.0, log.sightings_at(0))
    for each in log.readings():
        core.step(each)
    core.end()
    return tuple(decode_message(data) for data in put(core)), core.filter


def test_a_node_has_what_the_vehicle_has_and_takes_back_what_is_one_no_more() -> None:
    messages, framed = published()
    life = LifeTotal()
    for message in messages:
        assert life.fold(message, check=True) is None
    assert_has_all_of(life, framed)
    assert any(not added for message in messages for _, _, added in message.aliases)
    assert [message.step for message in messages if not message.healthy] == list(range(LOST, BACK))


@pytest.mark.parametrize("whole_frames", [2, 64])
def test_however_often_it_finds_a_way_back_its_messages_are_what_it_knows(
    whole_frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It always doubts; short frames are told anew two times out of three, the first one too, and a step publishes one
    correction: more are due before they are through. Restored after every step; messages one by one and coalesced."""
    monkeypatch.setattr(FramedFilter, "_looks_wrong", lambda *arguments: True)
    monkeypatch.setattr(FramedFilter, "_looks_right", lambda framed, *arguments: framed.frame % 3 != 0)
    monkeypatch.setattr(frames_module, "CORRECTIONS_EACH", 1)
    monkeypatch.setattr(own_map, "WHOLE_FRAMES", whole_frames)
    monkeypatch.setattr(own_window, "RECENT", 1)
    settings, log = SETTINGS.model_copy(update={"frame_steps_max": 6}), slipped()
    core, again = core_of(settings), FramedFilter(settings)
    core.start(0.0, log.sightings_at(0))
    again.start(log.sightings_at(0))
    for each in list(log.readings())[:75]:
        core.step(each)
        again = restarted(again)
        again.step(each)
        assert stored(again) == stored(core.filter)
    core.end()
    again.end()
    assert stored(again) == stored(core.filter)
    messages = [decode_message(data) for data in put(core)]
    assert sum(len(corrected(message.parts)) for message in messages) > 3 * len(core.filter.ends)
    for count in (1, 7, len(messages)):
        life = LifeTotal()
        for at in range(0, len(messages), count):
            joined = Coalescer(messages[at])
            for message in messages[at + 1 : at + count]:
                joined.add(message)
            assert life.fold(joined.message(), check=True) is None
        assert_has_all_of(life, core.filter)


def test_what_is_told_anew_changes_nothing_that_it_is_given() -> None:
    framed = FramedFilter(SETTINGS)
    framed.start(slipped().sightings_at(0))
    for each in list(slipped().readings())[:140]:
        framed.step(each)
    before = stored(framed)
    assert framed._associator is not None
    known = len(framed._names.signatures)
    found = told_anew(framed._kept, framed._own_map, framed._associator, SETTINGS, framed.model, known)
    assert found is not None
    assert stored(framed) == before
    assert [closed.frame for closed in found.frames] == [closed.frame for closed in framed._kept]
    assert found.known > known


def test_nothing_in_these_frames_is_taken_for_what_was_known_before_but_for_what_is_found_again() -> None:
    framed = FramedFilter(SETTINGS)
    framed.start(slipped().sightings_at(0))
    for each in list(slipped().readings())[:140]:
        framed.step(each)
    assert framed._associator is not None
    known, last = len(framed._names.signatures), framed._kept[-2:]
    found = told_anew(last, framed._own_map, framed._associator, SETTINGS, framed.model, known)
    assert found is not None
    anew = first_names(found.own_map.aliases, found.known)[known:]
    keys = np.concatenate([names for closed in found.frames for _, names, _, _ in closed.log.sightings])
    assert np.any(anew < known)
    keys = keys[keys >= 0]
    assert np.all((keys >= known) | np.isin(keys, anew))


def test_readings_are_kept_for_so_many_frames_only() -> None:
    framed = FramedFilter(SETTINGS.model_copy(update={"frame_steps_max": 2}))
    flown(framed)
    since = framed.frame if framed._doubtful_since is None else framed._doubtful_since
    first = max(since - frames_module.KEPT_FRAMES, framed.frame - frames_module.KEPT_FRAMES_MAX)
    assert [closed.frame for closed in framed._kept] == list(range(first, framed.frame))


def test_a_vehicle_that_is_told_what_it_sees_keeps_readings_until_their_frame_is_corrected() -> None:
    log = record(load_scenario("three_air_vehicles_mild", ("world.steps=89",), 1), "v1").logs["v1"]
    framed = FramedFilter(FilterSettings(frame_steps_max=4, close_lag_steps=6))
    framed.start(log.sightings_at(0))
    for each in log.readings():
        framed.step(each)
        assert {id(closed) for closed in framed._closed} <= {id(closed) for closed in framed._kept}
        assert len(framed._kept) <= 3
