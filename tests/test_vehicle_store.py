"""A vehicle that is killed and starts again: the same filter to the bit, and a stream that adds up to the same."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.envelope import KIND_SNAPSHOT, kind_of
from fleet_seif.errors import RunError
from fleet_seif.information import delta_digest
from fleet_seif.messages import Ack, Epoch, RangeRequest
from fleet_seif.store import Change, MemoryStore, Put, StoreError
from fleet_seif.wire import decode_heartbeat, decode_message, encode_ack, encode_range
from fusion.ledger import Ledger, Receipt
from tests.drives import FLEET, Drive, commit, drive, put, square
from tests.strategies import settled
from vehicles import Vehicle, records
from vehicles.core import EPOCHS_KEPT, Identity, VehicleCore

STEPS = 30
FILTER = FilterSettings(active_max=4, frame_steps_max=8)
"""Several frames in STEPS."""


@cache
def readings() -> Drive:
    return drive(square(15, 5.0, 3), steps=STEPS, seed=10)


def new_core(
    store: MemoryStore | None = None, *, fresh: bool = False, filter_settings: FilterSettings = FILTER,
    required: tuple[str, ...] = (), name: str = "v", fleet: str = FLEET,
) -> VehicleCore:  # fmt: skip
    """A process of the vehicle, resumed from its store if that holds anything."""
    identity = Identity(
        fleet=fleet, vehicle=name, epoch=Epoch(1, 77), start_pose=readings().start_pose,
        start_pose_cov=np.zeros((3, 3)),
    )  # fmt: skip
    core = VehicleCore(identity, filter_settings, PublishSettings(window=1000), durable=True, required=required)
    if store is not None:
        core.resume(store.load(), fresh=fresh)
    return core


def go(core: VehicleCore, upto: int = STEPS) -> None:
    """Take the readings that it has not taken yet, up to a step."""
    if core.outbox.last < 0:
        core.start(0.0, readings().start)
    for reading in readings().readings[:upto]:
        if reading.time_s > core.time_s:
            core.step(reading)


def bits(core: VehicleCore) -> object:
    return core.filter.state(), core.steps, core.time_s, core.healthy


def filled(messages: Iterable[bytes]) -> Ledger:
    ledger = Ledger(FLEET)
    for data in messages:
        receipt, stream = ledger.accept(data, "v")
        assert receipt in (Receipt.FOLDED, Receipt.DUPLICATE, Receipt.PARKED), stream.quarantine
    assert not any(stream.parked for stream in ledger.streams.values())
    return ledger


@cache
def uninterrupted() -> tuple[object, object, Ledger]:
    """A whole run: the filter before and after its end, and what a node makes of it."""
    core = new_core()
    go(core)
    before = core.filter.state()
    core.end()
    return before, bits(core), filled(put(core))


def asked(core: VehicleCore, epoch: Epoch, first: int = 0) -> list[bytes]:
    request = RangeRequest(fleet=FLEET, vehicle="v", epoch=epoch, first=first, last=10**6, count=4096)
    return core.on_range(encode_range(request))


# Kill and go on.


@pytest.mark.parametrize("kept_bytes", [0, 3000, 64 * 1024])
@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("killed_at", [0, 1, 7, 20, STEPS])
def test_killed_before_or_after_a_commit_it_goes_on_with_the_same_bits_and_the_same_sum(
    kept_bytes: int, after: bool, killed_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """kept_bytes: of readings, after which the filter's whole state is kept instead."""
    monkeypatch.setattr("vehicles.core.STATE_BYTES_LEAST", kept_bytes)
    store, core, sent = MemoryStore(), new_core(), []
    for step in range(killed_at + 1):
        go(core, step)
        if step < killed_at:
            sent += put(core, store)
    if after:
        commit(core, store)
    core = new_core(store)
    assert core.steps == max(killed_at - (not after), 0)
    go(core)
    assert core.filter.state() == uninterrupted()[0]
    core.end()
    assert bits(core) == uninterrupted()[1]
    sent += put(core, store)
    ledger = filled(sent)
    assert ledger.map_digest() == uninterrupted()[2].map_digest()
    assert len(ledger.streams) == (1 if killed_at == 0 and not after else 2)
    assert [s.ended for _, s in sorted(ledger.streams.items())][-1]


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 3), st.booleans()), min_size=1, max_size=8))
@settings(settled, max_examples=40)
def test_however_often_it_is_killed_the_sum_is_that_of_one_run(lives: list[tuple[int, int, bool]]) -> None:
    """Each process takes some steps, commits, takes more, and is killed with or without a last commit."""
    store, sent, steps = MemoryStore(), [], 0
    for steps_kept, more, last in lives:
        core = new_core(store)
        steps = core.steps
        go(core, steps + steps_kept)
        sent += put(core, store)
        go(core, steps + steps_kept + more)
        if last:
            commit(core, store)
    core = new_core(store)
    go(core)
    core.end()
    sent += put(core, store)
    assert bits(core) == uninterrupted()[1]
    assert filled(sent).map_digest() == uninterrupted()[2].map_digest()


def test_what_an_earlier_process_could_not_send_is_sent_by_the_next() -> None:
    store, core = MemoryStore(), new_core()
    go(core, 10)
    commit(core, store)  # and nothing is put
    core = new_core(store)
    go(core)
    core.end()
    assert filled(put(core, store)).map_digest() == uninterrupted()[2].map_digest()


def acknowledge(core: VehicleCore, ledger: Ledger, node: str = "hub") -> None:
    for (vehicle, epoch), stream in ledger.streams.items():
        ack = Ack(
            fleet=FLEET, node=node, vehicle=vehicle, epoch=epoch, last=stream.next - 1,
            prefix_digest=stream.prefix_digest,
        )  # fmt: skip
        core.on_ack(encode_ack(ack))


def test_every_epoch_can_be_repaired_from_the_next_process_on_though_all_was_forgotten() -> None:
    """A node that has lost its memory gets snapshots and messages of all three epochs."""
    store, ledger = MemoryStore(), Ledger(FLEET)
    for upto in (10, 20, STEPS):
        core = new_core(store)
        go(core, upto)
        if upto == STEPS:
            core.end()
        for data in put(core, store):
            ledger.accept(data, "v")
        acknowledge(core, ledger)
        commit(core, store)
    core = new_core(store)
    put(core, store)
    answers = [asked(core, epoch) for _, epoch in sorted(ledger.streams)]
    assert [kind_of(found[0]) for found in answers] == [KIND_SNAPSHOT] * 3
    again = filled(data for found in answers for data in found)
    assert again.map_digest() == ledger.map_digest() == uninterrupted()[2].map_digest()
    assert again.ledger_digest() == ledger.ledger_digest()
    assert not core.done
    acknowledge(core, again)
    assert core.done


def test_each_process_has_an_epoch_of_its_own_that_continues_the_last() -> None:
    store, epochs = MemoryStore(), []
    for upto in (3, 6, 9):
        core = new_core(store)
        go(core, upto)
        commit(core, store)
        epochs.append(core.identity.epoch)
    assert [epoch.counter for epoch in epochs] == [1, 2, 3]
    hellos = [decode_message(each.record.hello).hello for each in core._outboxes]
    assert [None if h is None or h.continues is None else h.continues.epoch for h in hellos] == [None, *epochs[:2]]
    assert {h.life for h in hellos if h is not None} == {0}


def test_a_process_that_was_killed_before_anything_was_committed_leaves_nothing() -> None:
    core = new_core(MemoryStore())
    assert core.outbox.last == -1
    assert core.identity.epoch == Epoch(1, 77)


def test_a_stream_that_had_ended_has_ended_after_a_restart() -> None:
    store, core = MemoryStore(), new_core()
    go(core, 5)
    core.end()
    commit(core, store)
    core = new_core(store)
    assert core.ended
    assert len(core._outboxes) == 1
    assert decode_message(put(core, store)[-1]).end
    assert [decode_heartbeat(data).ended for data in core.tick(0.0)] == [True]


def test_no_more_epochs_are_kept_than_the_limit() -> None:
    store, ledger = MemoryStore(), Ledger(FLEET)
    for _ in range(EPOCHS_KEPT + 8):
        core = new_core(store)
        go(core, 0)
        for data in put(core, store):
            ledger.accept(data, "v")
        acknowledge(core, ledger)
        commit(core, store)
    assert len(core._outboxes) == EPOCHS_KEPT
    assert sum(key[:1] == records.EPOCH for key, _ in store.load()) == EPOCHS_KEPT
    assert new_core(store).identity.epoch.counter == EPOCHS_KEPT + 9


def unhealthy(core: VehicleCore) -> None:
    """As after a reading that its filter could not take."""
    core.healthy = False


def test_a_vehicle_that_was_not_healthy_is_not_healthy_after_a_restart() -> None:
    for forgotten in (False, True):
        store, core, ledger = MemoryStore(), new_core(), Ledger(FLEET)
        core.start(0.0, readings().start)
        unhealthy(core)
        go(core, 5)
        core.end()
        for data in put(core, store):
            ledger.accept(data, "v")
        if forgotten:
            acknowledge(core, ledger)
            commit(core, store)
        assert not new_core(store).healthy


# Fresh lives.


def test_a_fresh_life_begins_anew_beside_the_old_one() -> None:
    store, core = MemoryStore(), new_core()
    go(core, 12)
    sent = put(core, store)
    core = new_core(store, fresh=True)
    assert core.outbox.last == -1
    assert (core.steps, core.time_s) == (0, -np.inf)
    go(core)
    core.end()
    sent += put(core, store)
    assert bits(core) == uninterrupted()[1]
    ledger = filled(sent)
    assert [(s.vehicle, s.number, s.hello is not None and s.hello.continues) for s in ledger.placed()] == [
        ("v", 0, None), ("v", 1, None)
    ]  # fmt: skip
    core = new_core(store)
    assert (core.ended, core.outbox.record.life) == (True, 1)


@pytest.mark.parametrize("spoil", ["nothing", "settings", "reading"])
def test_after_a_fresh_life_the_old_one_is_answered_for_truly_or_not_at_all(spoil: str) -> None:
    """With other settings, or readings that cannot be replayed, the earlier snapshot cannot be made any more."""
    store, core, ledger = MemoryStore(), new_core(), Ledger(FLEET)
    go(core, 12)
    for data in put(core, store):
        ledger.accept(data, "v")
    acknowledge(core, ledger)
    commit(core, store)
    if spoil == "reading":
        tamper(store, 4)
    core = new_core(
        store,
        fresh=True,
        filter_settings=FILTER.model_copy(update={"active_max": 3}) if spoil == "settings" else FILTER,
    )
    go(core, 3)
    put(core, store)
    for process in (core, new_core(store, filter_settings=core.filter.settings)):
        again = Ledger(FLEET)
        put(process)
        for data in asked(process, Epoch(1, 77)):
            receipt, stream = again.accept(data, "v")
            assert receipt in (Receipt.FOLDED, Receipt.PARKED)
            if receipt is Receipt.FOLDED:
                assert stream.life is not None
                known = ledger.stream("v", Epoch(1, 77)).life
                assert known is not None
                ours, theirs = (
                    [delta_digest(f.total.delta()) for f in x.frames.values()] for x in (stream.life, known)
                )
                assert (ours == theirs) == (stream.next == 13)
        assert spoil != "nothing" or again.ledger_digest() == ledger.ledger_digest()


# Stores that cannot be gone on with.


def tamper(store: MemoryStore, step: int) -> None:
    """Another odometry in a reading that has been kept."""
    key = records.numbered(records.READING, step)
    reading, mark = records.read_reading(dict(store.load())[key])
    changed = replace(reading, odometry=reading.odometry + np.array([1e-3, 0.0, 0.0]))
    data = records.pack_reading(changed, decode_message(put(new_core_at(step))[-1]).parts[0].delta)
    assert records.read_reading(data)[1] == mark
    store.commit([Put(key, data)])


def new_core_at(step: int) -> VehicleCore:
    core = new_core()
    go(core, step)
    return core


def kept_after(steps: int) -> MemoryStore:
    store, core = MemoryStore(), new_core()
    go(core, steps)
    commit(core, store)
    return store


def test_readings_that_do_not_give_the_same_any_more_are_refused() -> None:
    store = kept_after(10)
    tamper(store, 4)
    with pytest.raises(RunError, match="step 4 gives another result"):
        new_core(store)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"filter_settings": FILTER.model_copy(update={"gate": 20.0})}, "other filter settings"),
        ({"name": "w"}, "vehicle 'v'"),
        ({"fleet": "other"}, "fleet 'test'"),
    ],
)
def test_a_store_of_another_vehicle_or_other_settings_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(RunError, match=words):
        new_core(kept_after(3), **change)  # type: ignore[arg-type]


def test_a_fresh_life_may_have_other_settings_but_not_another_name() -> None:
    other = FILTER.model_copy(update={"gate": 20.0})
    core = new_core(kept_after(3), fresh=True, filter_settings=other)
    assert core.outbox.record.life == 1
    with pytest.raises(RunError, match="vehicle 'v'"):
        new_core(kept_after(3), fresh=True, name="w")


# What is kept.


def test_readings_are_kept_until_the_state_is_no_larger_than_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readings are kept until they take as much as the state, which then takes their place."""
    monkeypatch.setattr("vehicles.core.STATE_BYTES_LEAST", 2000)
    core, store = new_core(), MemoryStore()
    states = 0
    for step in range(STEPS + 1):
        go(core, step)
        changes = core.take_changes()[0]
        store.commit(changes)
        states += sum(isinstance(c, Put) and c.key == records.STATE for c in changes)
        kept = sum(len(value) for key, value in store.load() if key[:1] == records.READING)
        assert kept <= 1000 + max(2000, len(dict(store.load()).get(records.STATE, b"")))
    assert states > 0


def test_without_a_store_nothing_of_the_readings_is_kept() -> None:
    identity = new_core().identity
    core = VehicleCore(identity, FILTER, PublishSettings())
    go(core, 5)
    assert not any(isinstance(c, Put) and c.key[:1] in (records.READING, records.STATE) for c in core.take_changes()[0])


# Several nodes.


def test_a_vehicle_is_done_when_every_required_node_holds_all() -> None:
    core = new_core(required=("a", "b"))
    go(core, 5)
    core.end()
    ledger = filled(put(core))
    for node, done in (("c", False), ("a", False), ("b", True)):
        acknowledge(core, ledger, node)
        assert core.done == done
    assert core.outbox.last_acknowledged == core.outbox.last


def test_acknowledgements_of_a_node_that_is_not_required_leave_everything_in_the_store() -> None:
    store, core = MemoryStore(), new_core(required=("a",))
    go(core, 5)
    ledger = filled(put(core, store))
    for node, kept in (("c", 6), ("a", 5)):
        acknowledge(core, ledger, node)
        commit(core, store)
        assert sum(key[:1] == records.MESSAGE for key, _ in store.load()) == kept


def test_a_node_that_takes_no_more_is_not_waited_for_and_those_that_do_are() -> None:
    core = new_core(required=("a", "b"))
    go(core, 5)
    core.end()
    ledger = filled(put(core))
    ack = Ack(
        fleet=FLEET,
        node="a",
        vehicle="v",
        epoch=core.identity.epoch,
        last=0,
        prefix_digest=bytes(32),
        fault="message 1: no",
    )
    core.on_ack(encode_ack(ack))
    assert not core.done
    acknowledge(core, ledger, "b")
    assert core.done


# In its shell.


class Disk(MemoryStore):
    """A store that fails from its n-th commit on."""

    def __init__(self, commits: int) -> None:
        super().__init__()
        self.left = commits

    def commit(self, changes: Sequence[Change]) -> None:
        if self.left == 0:
            raise StoreError("the disk is full: make room")
        self.left -= 1
        super().commit(changes)


def test_a_vehicle_whose_store_fails_says_so_to_whoever_calls_next() -> None:
    with Vehicle("v", store=Disk(0)) as vehicle:
        vehicle.start(time_s=0.0)
        calls: list[Callable[[], object]] = [
            lambda: vehicle.wait_until_acknowledged(20.0),
            lambda: vehicle.step((0.1, 0, 0), np.eye(3), time_s=1.0),
            lambda: vehicle.wait_for_room(20.0),
            vehicle.end,
        ]
        for call in calls:
            with pytest.raises(StoreError, match="full"):
                call()


def test_a_vehicle_goes_on_from_its_store() -> None:
    store = MemoryStore()
    with Vehicle("v", store=store) as vehicle:
        assert not vehicle.resumed
        for k in range(1, 6):
            vehicle.step((0.1, 0, 0), 1e-4 * np.eye(3), time_s=float(k))
        pose = vehicle.pose
    with Vehicle("v", store=store) as vehicle:
        assert vehicle.resumed
        assert vehicle.started
        assert (vehicle.steps, vehicle.time_s) == (5, 5.0)
        assert np.array_equal(vehicle.pose, pose)
    with Vehicle("v", store=store, fresh=True, start_pose=(7, 0, 0)) as vehicle:
        assert (vehicle.started, vehicle.steps, vehicle.pose[0]) == (False, 0, 7.0)


def test_a_vehicle_that_cannot_go_on_from_its_store_says_what_to_do() -> None:
    store = MemoryStore()
    with Vehicle("v", store=store) as vehicle:
        vehicle.start(time_s=0.0)
    with pytest.raises(RunError, match="store of its own"):
        Vehicle("w", store=store)
