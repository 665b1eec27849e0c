"""A whole small fleet with everything that `fleet-seif keys` makes, through the commands a user types."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from fleet_seif.config import FusionSettings
from fleet_seif.envelope import KIND_SNAPSHOT, kind_of
from fleet_seif.messages import RangeRequest
from fleet_seif.signing import load_key_ring
from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.store import Put
from fleet_seif.wire import encode_range
from fusion import records
from fusion.core import FusionCore
from scenarios.output import read_ledger
from tests.fleets import run_virtual
from tests.processes import Child, Fleet, fleet_of, invoke, refused, wait_until

FLEET = "demo"
SETTINGS = ("fleet.vehicles=2", "world.steps=80", "world.landmarks=40", "run.rate_hz=50", f"fleet.name='{FLEET}'")
HERE = "tls/127.0.0.1:0"
VEHICLES = ("v1", "v2")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    named = [part for name in VEHICLES for part in ("--vehicle", name)]
    nodes = ("--node", "fusion", "--endpoint", HERE)
    made = invoke("keys", str(folder), "--fleet", FLEET, *nodes, *named, "--viewer", "screen", "--operator", "ops")
    assert made.exit_code == 0, made.stderr
    return folder


def secured(keys: Path, label: str) -> list[str]:
    """What a process of a secured fleet is started with."""
    ring = ["--config", str(keys / f"{label}.json5"), "--key-ring", str(keys / "fleet_keys.json")]
    signs = not label.startswith("viewer")
    return [*ring, *(["--signing-key", str(keys / f"{label}.key.json")] if signs else [])]


@dataclass
class Secured:
    """A fleet that has finished, and its node, which goes on."""

    fleet: Fleet
    node: Child


@pytest.fixture(scope="module")
def finished(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    with fleet_of("fleet", tmp_path_factory.mktemp("fleet"), *SETTINGS) as fleet:
        node = fleet.node(*secured(keys, "node-fusion"), listen=HERE)
        assert node.endpoint.startswith("tls/127.0.0.1:")
        vehicles = [fleet.vehicle(name, [node.endpoint], *secured(keys, f"vehicle-{name}")) for name in VEHICLES]
        for vehicle in vehicles:
            vehicle.finish()
        yield Secured(fleet, node)


def test_a_secured_fleet_has_the_digest_of_the_virtual_run(finished: Secured) -> None:
    ledger = read_ledger(finished.fleet.store("fusion"), FLEET)
    assert ledger.map_digest() == run_virtual("fleet", *SETTINGS).ledger.map_digest()
    assert all(data[37] == 1 for stream in ledger.streams.values() for data in stream.log)  # every one is signed


def test_a_viewer_sees_the_map_and_how_everybody_is(finished: Secured, keys: Path) -> None:
    viewer = ["--fleet", FLEET, *secured(keys, "viewer-screen")]
    told = invoke("status", finished.node.endpoint, "--json", *viewer)
    assert told.exit_code == 0, told.stderr
    joint = json.loads(told.stdout)
    assert [(state["name"], state["ended"], state["refused"]) for state in joint["vehicles"]] == [
        ("v1", True, 0),
        ("v2", True, 0),
    ]
    assert joint["counters"].get("malformed", 0) == 0


def test_a_signed_ledger_stays_signed_when_it_is_compacted(finished: Secured, keys: Path, tmp_path: Path) -> None:
    source = SqliteStore.open(finished.fleet.store("fusion"), records.KIND, records.SCHEMA, read_only=True)
    copy = SqliteStore.open(tmp_path / "copy", records.KIND, records.SCHEMA)
    copy.commit([Put(key, value) for key, value in source.load()])
    for store in (source, copy):
        store.close()
    compact = ("ledger", "compact", str(tmp_path / "copy"))
    without = invoke(*compact)  # what it would make, no other node would take
    assert (without.exit_code, "--signing-key" in without.stderr) == (1, True), without.stdout
    signed = invoke(*compact, "--signing-key", str(keys / "node-fusion.key.json"))
    assert signed.exit_code == 0, signed.stderr
    ring = load_key_ring(keys / "fleet_keys.json")
    peer = FusionCore(FLEET, "peer", FusionSettings(), keys=ring)
    other = FusionCore(FLEET, "fusion", FusionSettings(), keys=ring)
    held = read_ledger(tmp_path / "copy", FLEET)
    other.ledger.restore((change.key, change.value) for change in held.contents() if isinstance(change, Put))
    for vehicle, epoch in held.streams:
        asked = RangeRequest(fleet=FLEET, vehicle=vehicle, epoch=epoch, first=0, last=10**6, count=256)
        replies = other.answer_range(vehicle, encode_range(asked))
        assert kind_of(replies[1]) == KIND_SNAPSHOT
        for reply in replies:
            peer.on_reply(vehicle, reply, 0.0)
    assert peer.counters["malformed"] == 0
    assert peer.ledger.ledger_digest() == held.ledger_digest()


def test_without_a_certificate_nobody_sees_anything(finished: Secured) -> None:
    said = refused(1, "status", finished.node.endpoint, "--fleet", FLEET)
    assert f"cannot reach a fusion node at {finished.node.endpoint}" in said


def test_what_is_not_signed_is_counted_and_changes_nothing(keys: Path, tmp_path: Path) -> None:
    ring = ("--key-ring", str(keys / "fleet_keys.json"), "--signing-key", str(keys / "node-fusion.key.json"))
    with fleet_of("fleet", tmp_path, *SETTINGS) as fleet:
        node = fleet.node(*ring)
        signs = fleet.vehicle(
            "v1", [node.endpoint], *ring[:2], "--signing-key", str(keys / "vehicle-v1.key.json"),
        )  # fmt: skip
        signs.finish()
        unsigned = fleet.vehicle("v2", [node.endpoint])
        wait_until(lambda: (unsigned.find("progress") or {"done": 0})["done"] == 80, "all steps of v2")
        told = invoke("status", node.endpoint, "--fleet", FLEET, "--json", *ring[:2])
        assert told.exit_code == 0, told.stderr
    joint = json.loads(told.stdout)
    assert joint["counters"]["malformed"] > 0
    assert [state["name"] for state in joint["vehicles"]] == ["v1"]
    ledger = read_ledger(fleet.store("fusion"), FLEET)
    assert {name for name, _ in ledger.streams} == {"v1"}


def test_an_operator_decides_with_the_operators_key_and_nobody_else_does(finished: Secured, keys: Path) -> None:
    where = ["--connect", finished.node.endpoint, "--fleet", FLEET]
    config = ["--config", str(keys / "operator-ops.json5")]
    signed = [*config, "--signing-key", str(keys / "operator-ops.key.json")]
    for undo in ([], ["--undo"]):
        done = invoke("retract", "v2", *undo, *where, *signed)
        assert done.exit_code == 0, done.stderr
        assert "of ops" in done.stdout
    assert "not signed" in refused(1, "retract", "v2", *where, *config)
    viewer = ["--config", str(keys / "viewer-screen.json5")]
    assert "may you ask it?" in refused(1, "retract", "v2", *where, *viewer)
