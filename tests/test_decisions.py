"""The operator's commands: decisions reach running nodes or the store of one that is down, and last."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleet_seif.bus import open_bus
from fleet_seif.config import FusionSettings
from fleet_seif.keys import Keys
from fleet_seif.messages import Action, LandmarkName, OperatorEvent
from fleet_seif.node_wire import encode_event
from fleet_seif.signing import KeyRing, Role, Signer
from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.store import MemoryStore, Put
from fleet_seif.wire import encode_message
from fusion import records
from fusion.core import REFUSED, TAKEN, FusionCore
from fusion.events import Decisions
from fusion.ledger import Ledger
from fusion.service import FusionService
from scenarios import decisions, output
from tests.conftest import Network
from tests.histories import FLEET, HONEST, MAIN
from tests.processes import invoke, refused, wait_until

A, B = LandmarkName("ann", 0, 0), LandmarkName("bob", 0, 1)


def filled(core: FusionCore) -> FusionCore:
    for vehicle in ("ann", "bob"):
        for message in HONEST[vehicle, MAIN]:
            core.on_delta(vehicle, encode_message(message), 0.0)
    return core


class Running:
    """A service at work."""

    def __init__(self, network: Network) -> None:
        settings = FusionSettings(map_s=0.02)
        self.core = filled(FusionCore(FLEET, "fusion", settings))
        self.store = MemoryStore()
        self.service = FusionService(network.bus, self.core, settings, store=self.store)
        self.thread = threading.Thread(target=self.service.run)
        self.thread.start()
        self.where = ("--connect", network.endpoint, "--fleet", FLEET)

    def kept(self) -> Decisions:
        """What a node that starts with the store would decide."""
        ledger = Ledger(FLEET)
        ledger.restore(self.store.load())
        return ledger.decisions


@pytest.fixture
def running(network: Network) -> Iterator[Running]:
    made = Running(network)
    try:
        yield made
    finally:
        made.service.stop()
        made.thread.join()


def test_decisions_are_taken_kept_and_undone(running: Running) -> None:
    for command, expected in (
        (("merge", "bob/0/1", "ann/0/0"), Decisions(forced=((A, B),))),
        (("split", "ann/0/0", "bob/0/1"), Decisions(forbidden=((A, B),))),
        (("split", "ann/0/0", "bob/0/1", "--undo"), Decisions()),
        (("retract", "bob"), Decisions(retracted=frozenset({"bob"}))),
        (("retract", "bob", "--undo"), Decisions()),
    ):
        done = invoke(*command, *running.where)
        assert done.exit_code == 0, done.stderr
        assert "fusion:" in done.stdout
        assert running.core.ledger.decisions == expected
        assert running.kept() == expected


def test_what_is_not_known_yet_may_be_decided_and_is_said(running: Running) -> None:
    done = invoke("merge", "ann/0/0", "eve/0/7", *running.where)
    assert done.exit_code == 0
    assert "nothing is known yet of eve/0/7" in " ".join(done.stdout.split())
    assert running.core.ledger.decisions.forced


def test_a_retracted_vehicle_leaves_the_served_map_and_comes_back(running: Running) -> None:
    for undo, poses in (((), ("ann",)), (("--undo",), ("ann", "bob"))):
        assert invoke("retract", "bob", *undo, *running.where).exit_code == 0
        wait_until(lambda poses=poses: running.service.newest.poses == poses, f"a map of {poses}")  # type: ignore[misc]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("merge", "ann", "bob/0/1"), "write vehicle/life/number"),
        (("merge", "ann/0/x", "bob/0/1"), "write vehicle/life/number"),
        (("split", "ann/0/0", "ann/0/0"), "the same landmark already"),
        (("merge", "a.b/0/0", "bob/0/1"), "use 1 to 32 of the characters"),
        (("retract", "a b"), "use 1 to 32 of the characters"),
    ],
)
def test_what_is_no_subject_is_named(arguments: tuple[str, ...], words: str) -> None:
    assert words in refused(1, *arguments)


def test_another_fleet_does_not_answer(running: Running, network: Network) -> None:
    said = refused(1, "retract", "bob", "--connect", network.endpoint, "--fleet", "other")
    assert "no fusion node of fleet 'other' has answered" in said


def test_a_decision_whose_number_is_taken_is_refused_and_says_so() -> None:
    core = filled(FusionCore(FLEET, "fusion", FusionSettings()))
    events = [
        encode_event(OperatorEvent(fleet=FLEET, number=1, operator="x", action=Action.RETRACT, vehicle=vehicle))
        for vehicle in ("ann", "bob")
    ]
    said = sorted(core.on_decision(data)[:1] for data in (*events, *events[::-1]))
    assert set(said) == {TAKEN, REFUSED}
    assert len(core.ledger.decisions.retracted) == 1


def test_only_an_operator_of_the_fleet_decides_where_it_signs() -> None:
    ops, stranger = (Signer(FLEET, Role.OPERATOR, "ops", bytes([k]) * 32) for k in (1, 2))
    ring = KeyRing(FLEET, {(Role.OPERATOR, "ops"): ops.public_key()})
    core = FusionCore(FLEET, "fusion", FusionSettings(), keys=ring)
    event = OperatorEvent(fleet=FLEET, number=1, operator="ops", action=Action.RETRACT, vehicle="bob")
    for signer in (None, stranger):
        assert core.on_decision(encode_event(event, signer)).startswith(REFUSED)
    assert not core.ledger.events
    assert core.on_decision(encode_event(event, ops)).startswith(TAKEN)


def test_bytes_that_are_no_decision_are_refused_and_counted(running: Running, network: Network) -> None:
    found: list[bytes] = []
    done = threading.Event()
    with open_bus(connect=[network.endpoint]) as client:
        client.ask(Keys(FLEET).decisions("*"), b"rubbish", found.append, done.set)
        assert done.wait(10.0)
    assert [answer.decode()[:1] for answer in found] == [REFUSED]
    assert running.core.counters["malformed"] == 1


@pytest.fixture
def down(tmp_path: Path) -> Path:
    path = tmp_path / "fusion.ledger"
    core = filled(FusionCore(FLEET, "fusion", FusionSettings()))
    output.write_ledger(path, core.ledger)
    store = SqliteStore.open(path, records.KIND, records.SCHEMA)
    store.commit([Put(records.IDENTITY, f"{FLEET}/fusion".encode())])
    store.close()
    return path


def test_the_store_of_a_node_that_is_down_takes_decisions(down: Path) -> None:
    done = invoke("merge", "ann/0/0", "bob/0/1", "--store", str(down))
    assert done.exit_code == 0, done.stderr
    assert output.read_ledger(down, FLEET).decisions == Decisions(forced=((A, B),))
    assert "forced ann/0/0 bob/0/1" in invoke("ledger", "info", str(down)).stdout


def test_the_store_of_a_node_that_runs_takes_none(down: Path) -> None:
    writer = SqliteStore.open(down, records.KIND, records.SCHEMA)
    try:
        assert "has a writer already" in refused(1, "retract", "bob", "--store", str(down))
    finally:
        writer.close()


def test_the_key_of_another_fleet_or_role_is_refused(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    named = ("--node", "fusion", "--endpoint", "tls/127.0.0.1:7447", "--vehicle", "v1", "--operator", "ops")
    assert invoke("keys", str(keys), "--fleet", "demo", *named).exit_code == 0
    for fleet, who in (("other", "operator-ops"), ("demo", "vehicle-v1")):
        said = refused(1, "retract", "v1", "--fleet", fleet, "--signing-key", str(keys / f"{who}.key.json"))
        assert "need that of one of its operators" in said


def test_landmarks_come_in_ascending_order() -> None:
    assert decisions.about_landmarks(Action.FORCE, "bob/0/1", "ann/0/0").landmarks == (A, B)
