"""A vehicle without identities that is killed and starts again: same bits, same sum, same aliases."""

from functools import cache

import numpy as np
import pytest

from fleet_seif.config import PublishSettings
from fleet_seif.envelope import KIND_SNAPSHOT, kind_of
from fleet_seif.messages import Ack, Epoch, RangeRequest
from fleet_seif.store import MemoryStore
from fleet_seif.wire import encode_ack, encode_range
from fusion.ledger import Ledger, Receipt
from tests.drives import FLEET, commit, put
from tests.test_frames_associated import SETTINGS, flight
from vehicles.core import Identity, VehicleCore

STEPS = 110


def new_core(store: MemoryStore) -> VehicleCore:
    """A process of the vehicle, resumed from its store if that holds anything."""
    identity = Identity(
        fleet=FLEET, vehicle="v", epoch=Epoch(1, 77), start_pose=flight().start_pose, start_pose_cov=np.zeros((3, 3))
    )
    core = VehicleCore(identity, SETTINGS, PublishSettings(window=1000), durable=True)
    core.resume(store.load())
    return core


def go(core: VehicleCore, upto: int = STEPS) -> None:
    """Take the readings that it has not taken yet, up to a step."""
    if core.outbox.last < 0:
        core.start(0.0, flight().start)
    for reading in flight().readings[:upto]:
        if reading.time_s > core.time_s:
            core.step(reading)
            core.filter.localise()


def filled(messages: list[bytes]) -> Ledger:
    ledger = Ledger(FLEET)
    for data in messages:
        receipt, stream = ledger.accept(data, "v")
        assert receipt in (Receipt.FOLDED, Receipt.DUPLICATE), stream.quarantine
    return ledger


def aliases(ledger: Ledger) -> tuple[tuple[int, int], ...]:
    (life,) = ledger.lives()
    return life.aliases


@cache
def uninterrupted() -> tuple[VehicleCore, Ledger]:
    """A whole run, and what a node makes of it."""
    core = new_core(MemoryStore())
    go(core)
    core.end()
    ledger = filled(put(core))
    assert len(aliases(ledger)) > 1
    return core, ledger


def assert_same(core: VehicleCore, ledger: Ledger) -> None:
    whole, expected = uninterrupted()
    assert core.filter.state() == whole.filter.state()
    assert np.array_equal(core.assigned, whole.assigned)
    assert ledger.map_digest() == expected.map_digest()
    assert aliases(ledger) == aliases(expected)


@pytest.mark.parametrize("kept_bytes", [0, 64 * 1024])
@pytest.mark.parametrize("uncommitted", [0, 4])
def test_killed_again_and_again_it_goes_on_with_the_same_bits_and_the_same_sum(
    kept_bytes: int, uncommitted: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before, at and after the ends of frames. kept_bytes: of readings, after which the whole state is kept instead."""
    monkeypatch.setattr("vehicles.core.STATE_BYTES_LEAST", kept_bytes)
    store, sent = MemoryStore(), []
    for killed_at in (1, 24, 25, 26, 37, 50, 51, 62, 75, 87, 100, 101):
        core = new_core(store)
        go(core, killed_at)
        sent += put(core, store)
        go(core, killed_at + uncommitted)
    core = new_core(store)
    go(core)
    core.end()
    sent += put(core, store)
    assert_same(core, filled(sent))


def test_aliases_survive_in_snapshots_where_all_messages_are_gone() -> None:
    """Every message is acknowledged and forgotten; a node that begins anew gets what they left behind."""
    store, ledger = MemoryStore(), Ledger(FLEET)
    for upto in (60, 90, STEPS):
        core = new_core(store)
        go(core, upto)
        if upto == STEPS:
            core.end()
        for data in put(core, store):
            ledger.accept(data, "v")
        for (name, epoch), stream in ledger.streams.items():
            ack = Ack(
                fleet=FLEET, node="hub", vehicle=name, epoch=epoch, last=stream.next - 1,
                prefix_digest=stream.prefix_digest,
            )  # fmt: skip
            core.on_ack(encode_ack(ack))
        commit(core, store)
    answers = []
    for _, epoch in sorted(ledger.streams):
        request = RangeRequest(fleet=FLEET, vehicle="v", epoch=epoch, first=0, last=10**6, count=4096)
        answers.append(core.on_range(encode_range(request)))
    assert [kind_of(found[0]) for found in answers] == [KIND_SNAPSHOT] * 3
    again = filled([data for found in answers for data in found])
    assert_same(core, again)
    assert again.ledger_digest() == ledger.ledger_digest()
