"""A vehicle that is killed on its way back from doubt, and one of a single frame: the same bits, the same sum."""

from collections.abc import Sequence

import numpy as np
import pytest

from fleet_seif import frames as frames_module
from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.errors import NumericalError
from fleet_seif.messages import Epoch
from fleet_seif.records import Reading
from fleet_seif.store import MemoryStore
from fusion.ledger import Ledger
from tests.drives import FLEET, Drive, put
from tests.test_frames_associated import SETTINGS as ADAPTIVE
from tests.test_frames_associated import flight
from tests.test_single_associated import SETTINGS as SINGLE
from tests.test_vehicle_store_associated import aliases, filled
from tests.test_way_back import BACK, LOST, slipped
from vehicles.core import Identity, VehicleCore


def lost() -> Drive:
    log = slipped()
    return Drive(log.start_pose, log.sightings_at(0), tuple(log.readings()), log.truth_pose)


def new_core(store: MemoryStore, log: Drive, settings: FilterSettings) -> VehicleCore:
    """A process of the vehicle, resumed from its store if that holds anything."""
    identity = Identity(
        fleet=FLEET, vehicle="v", epoch=Epoch(1, 77), start_pose=log.start_pose, start_pose_cov=np.zeros((3, 3))
    )
    core = VehicleCore(identity, settings, PublishSettings(window=1000), durable=True)
    core.resume(store.load())
    return core


def go(core: VehicleCore, log: Drive, readings: Sequence[Reading]) -> None:
    """Take the readings that it has not taken yet."""
    if core.outbox.last < 0:
        core.start(0.0, log.start)
    for reading in readings:
        if reading.time_s > core.time_s:
            core.step(reading)


def killed_at(
    log: Drive, settings: FilterSettings, steps: Sequence[int], uncommitted: int
) -> tuple[VehicleCore, Ledger]:
    """Killed after so many steps, and each time `uncommitted` more that are lost; then what a node makes of it."""
    store, sent = MemoryStore(), []
    for upto in steps:
        core = new_core(store, log, settings)
        go(core, log, log.readings[:upto])
        sent += put(core, store)
        go(core, log, log.readings[: upto + uncommitted])
    core = new_core(store, log, settings)
    go(core, log, log.readings)
    core.end()
    sent += put(core, store)
    return core, filled(sent)


def assert_same(one: tuple[VehicleCore, Ledger], other: tuple[VehicleCore, Ledger]) -> None:
    assert one[0].filter.state() == other[0].filter.state()
    assert np.array_equal(one[0].assigned, other[0].assigned)
    assert one[1].map_digest() == other[1].map_digest()
    assert aliases(one[1]) == aliases(other[1])


@pytest.mark.parametrize("kept_bytes", [0, 64 * 1024])
def test_killed_on_the_way_back_it_goes_on_with_the_same_bits_and_the_same_sum(
    kept_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it is lost, before, at and after the step that finds the way back, and while corrections are pending."""
    monkeypatch.setattr("vehicles.core.STATE_BYTES_LEAST", kept_bytes)
    monkeypatch.setattr(frames_module, "CORRECTIONS_EACH", 2)
    whole = killed_at(lost(), ADAPTIVE, (), 0)
    steps = (LOST - 1, LOST, LOST + 1, BACK - 1, BACK, BACK + 1, BACK + 2, BACK + 3)
    assert_same(killed_at(lost(), ADAPTIVE, steps, 1), whole)


@pytest.mark.parametrize("kept_bytes", [0, 64 * 1024])
def test_killed_in_its_single_frame_it_goes_on_with_the_same_bits_and_the_same_sum(
    kept_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before, at and after the steps at which it looks around; never doubtful, so that a node has its map."""
    monkeypatch.setattr("vehicles.core.STATE_BYTES_LEAST", kept_bytes)
    monkeypatch.setattr(frames_module, "CROWDED_MAX", 1.0)
    clear = SINGLE.association.model_copy(update={"unclear_max": 1.0})
    settings = SINGLE.model_copy(update={"association": clear})
    whole = killed_at(flight(), settings, (), 0)
    assert len(aliases(whole[1])) > 0
    assert_same(killed_at(flight(), settings, (1, 24, 25, 26, 50, 75, 99, 100), 1), whole)


def test_that_its_filter_has_refused_a_reading_it_still_says_after_a_restart_in_doubt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its messages say that it is not healthy either way."""
    store = MemoryStore()
    core = new_core(store, lost(), ADAPTIVE)
    go(core, lost(), lost().readings[:LOST])
    assert core.filter.doubtful
    assert core.healthy
    with monkeypatch.context() as patched:
        patched.setattr(core.filter, "step", fails)
        with pytest.raises(NumericalError):
            core.step(lost().readings[LOST])
    go(core, lost(), lost().readings[: LOST + 2])
    put(core, store)
    assert not new_core(store, lost(), ADAPTIVE).healthy


def fails(reading: Reading) -> None:
    raise NumericalError("no")
