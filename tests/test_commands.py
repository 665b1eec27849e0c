"""The commands for those who look after a fleet: what they say, and that bad input is answered in a sentence."""

import asyncio
import itertools
import json
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import Result

from fleet_seif.bus import open_bus
from fleet_seif.config import FusionSettings
from fleet_seif.keys import Keys
from fleet_seif.map_wire import encode_map
from fleet_seif.merge_wire import encode_merges
from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.store import Change, Put
from fusion import records
from fusion.core import CLASSES_DIFFERING, FusionCore
from fusion.ledger import Ledger
from fusion.service import FusionService
from scenarios import children, watch
from scenarios.config import load_scenario
from scenarios.output import read_ledger, write_ledger
from scenarios.recording import Log
from scenarios.source import record
from tests.conftest import Network
from tests.fleets import run_virtual
from tests.processes import invoke, refused, wait_until
from vehicles import Vehicle
from vehicles import records as outbox_records

SETTINGS = ("fleet.vehicles=2", "world.steps=150", "world.landmarks=30")
SUBCOMMANDS = ("info", "merges", "verify", "compact")
Damage = Callable[[Path], object]


@pytest.fixture(autouse=True)
def _no_signals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands run in this process here, which keeps its own signal handlers."""
    monkeypatch.setattr(children, "end_on_sigterm", lambda: None)


@pytest.fixture(scope="module")
def held() -> Ledger:
    return run_virtual("fleet", *SETTINGS).ledger


def write_store(path: Path, held: Ledger, *changes: Change) -> Path:
    """A store as a fusion node leaves it."""
    write_ledger(path, held)
    store = SqliteStore.open(path, records.KIND, records.SCHEMA)
    store.commit([Put(records.IDENTITY, b"fleet/fusion"), *changes])
    store.close()
    return path


@pytest.fixture
def store(tmp_path: Path, held: Ledger) -> Path:
    return write_store(tmp_path / "fusion.ledger", held)


def values_of(path: Path, table: bytes) -> list[tuple[bytes, bytes]]:
    store = SqliteStore.open(path, records.KIND, records.SCHEMA, read_only=True)
    try:
        return [(key, value) for key, value in store.load() if key[:1] == table]
    finally:
        store.close()


def flip(path: Path, value: bytes) -> None:
    """Change a bit in the middle of a value, in the file itself."""
    raw = bytearray(path.read_bytes())
    at = raw.index(value[:200]) + min(len(value), 200) // 2
    raw[at] ^= 1
    path.write_bytes(raw)


def test_info_says_what_a_store_holds(store: Path, held: Ledger) -> None:
    done = invoke("ledger", "info", str(store))
    assert done.exit_code == 0, done.stderr
    for words in ("fleet fleet", "node fusion", held.map_digest().hex(), held.ledger_digest().hex()):
        assert words in done.stdout
    assert [line.split()[:4] for line in done.stdout.splitlines() if line.lstrip().startswith("v")][1:] == [
        ["v1", "0", "1", "152"],
        ["v2", "0", "1", "152"],
    ]


def test_verify_says_that_a_store_is_sound(store: Path) -> None:
    done = invoke("ledger", "verify", str(store))
    assert done.exit_code == 0, done.stderr
    assert "sound" in done.stdout


def test_info_reads_what_a_virtual_run_leaves(tmp_path: Path, held: Ledger) -> None:
    write_ledger(tmp_path / "fusion.ledger", held)
    done = invoke("ledger", "info", str(tmp_path / "fusion.ledger"))
    assert done.exit_code == 0, done.stderr


@pytest.mark.parametrize("at", [0, 70, -1])
def test_verify_finds_a_flipped_bit_in_a_message(store: Path, at: int) -> None:
    flip(store, values_of(store, records.MESSAGE)[at][1])
    said = refused(1, "ledger", "verify", str(store))
    assert str(store) in said
    assert "digest" in said


@pytest.mark.parametrize("subcommand", ["verify", "compact"])
def test_a_damaged_announcement_is_found(store: Path, subcommand: str) -> None:
    flip(store, values_of(store, records.WITNESS)[0][1])
    assert str(store) in refused(1, "ledger", subcommand, str(store))


def test_verify_finds_a_verdict_that_the_messages_do_not_give(tmp_path: Path, held: Ledger) -> None:
    (key, *_) = held.streams
    verdict = Put(records.stream_key(records.QUARANTINE, *key), b"because")
    said = refused(1, "ledger", "verify", str(write_store(tmp_path / "l", held, verdict)))
    assert "verdicts" in said


def test_compacting_keeps_the_digests_and_shrinks_the_file(store: Path, held: Ledger) -> None:
    before = store.stat().st_size
    done = invoke("ledger", "compact", str(store))
    assert done.exit_code == 0, done.stderr
    assert store.stat().st_size < before / 2
    again = read_ledger(store, "fleet")
    assert (again.ledger_digest(), again.map_digest()) == (held.ledger_digest(), held.map_digest())
    assert invoke("ledger", "verify", str(store)).exit_code == 0
    assert invoke("ledger", "compact", str(store)).stdout.startswith("0 bytes of messages saved")


def test_a_store_whose_writer_runs_can_be_looked_at_but_not_compacted(store: Path) -> None:
    writer = SqliteStore.open(store, records.KIND, records.SCHEMA)
    try:
        assert invoke("ledger", "info", str(store)).exit_code == 0
        assert invoke("ledger", "verify", str(store)).exit_code == 0
        assert "has a writer already" in refused(1, "ledger", "compact", str(store))
    finally:
        writer.close()
    assert invoke("ledger", "compact", str(store)).exit_code == 0


def sqlite_file(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE mine (a)")
    connection.close()


def store_of(path: Path, kind: str, version: int) -> None:
    SqliteStore.open(path, kind, version).close()


WRONG: dict[str, Damage] = {
    "no such file": lambda path: None,
    "not a file in an existing folder": Path.mkdir,
    "damaged": lambda path: path.write_bytes(b""),
    "not a store or damaged": lambda path: path.write_text("a letter to my grandmother\n" * 100),
    "not a store of fleet_seif": sqlite_file,
    "a store of kind 'outbox', expected 'ledger'": lambda path: store_of(path, "outbox", 1),
    "version 9, expected 1": lambda path: store_of(path, records.KIND, 9),
    "is empty": lambda path: store_of(path, records.KIND, records.SCHEMA),
}


@pytest.mark.parametrize("subcommand", SUBCOMMANDS)
@pytest.mark.parametrize("words", WRONG)
def test_what_is_no_ledger_is_named(tmp_path: Path, subcommand: str, words: str) -> None:
    path = tmp_path / "file"
    WRONG[words](path)
    said = refused(1, "ledger", subcommand, str(path))
    assert words in said
    assert str(path) in said


def fusion(store: Path, *arguments: str) -> list[str]:
    return ["fusion", "--listen", "tcp/127.0.0.1:0", "--store", str(store), *arguments]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--fleet", "fleet", "--name", "fusion2"], "that of node fleet/fusion, this is fleet/fusion2"),
        (["--fleet", "demo"], "that of node fleet/fusion, this is demo/fusion"),
    ],
)
def test_a_node_refuses_the_store_of_another(store: Path, arguments: list[str], words: str) -> None:
    assert words in refused(1, *fusion(store, *arguments))


def test_a_node_refuses_a_damaged_store(store: Path) -> None:
    flip(store, values_of(store, records.MESSAGE)[5][1])
    assert "never put there" in refused(1, *fusion(store, "--fleet", "fleet"))


def test_a_node_refuses_a_store_that_another_process_writes(store: Path) -> None:
    writer = SqliteStore.open(store, records.KIND, records.SCHEMA)
    try:
        assert "has a writer already" in refused(1, *fusion(store, "--fleet", "fleet"))
    finally:
        writer.close()


@pytest.fixture(scope="module")
def log() -> Log:
    return record(load_scenario("fleet", SETTINGS), only="v1").logs["v1"]


def drive(vehicle: Vehicle, log: Log, steps: int) -> None:
    vehicle.start(log.sightings_at(0), time_s=float(log.time_s[0]))
    for reading in itertools.islice(log.readings(), steps):
        vehicle.step(reading.odometry, reading.odometry_cov, reading.sightings, time_s=reading.time_s)


@pytest.fixture
def outbox(tmp_path: Path, log: Log) -> Path:
    """The store of a vehicle that was never heard."""
    path = tmp_path / "v1.outbox"
    store = SqliteStore.open(path, outbox_records.KIND, outbox_records.SCHEMA)
    with Vehicle("v1", fleet="fleet", store=store, start_pose=log.start_pose) as vehicle:
        drive(vehicle, log, 20)
    store.close()
    return path


def vehicle_command(endpoint: str, store: Path, *arguments: str) -> list[str]:
    settings = [part for each in SETTINGS for part in ("--set", each)]
    return ["vehicle", "fleet", *settings, "--connect", endpoint, "--store", str(store), *arguments]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--name", "v2"], "that of vehicle 'v1' of fleet 'fleet', this is 'v2'"),
        (["--name", "v1", "--fleet", "demo"], "that of vehicle 'v1' of fleet 'fleet', this is 'v1' of 'demo'"),
        (["--name", "v1", "--set", "filter.active_max=9"], "other filter settings"),
    ],
)
def test_a_vehicle_refuses_the_store_of_another(
    network: Network, outbox: Path, arguments: list[str], words: str
) -> None:
    assert words in refused(1, *vehicle_command(network.endpoint, outbox, *arguments))


@pytest.mark.parametrize("table", [outbox_records.MESSAGE, outbox_records.EPOCH, outbox_records.IDENTITY])
def test_a_vehicle_refuses_a_damaged_store(network: Network, outbox: Path, table: bytes) -> None:
    store = SqliteStore.open(outbox, outbox_records.KIND, outbox_records.SCHEMA)
    key, value = next((key, value) for key, value in store.load() if key[:1] == table)
    store.commit([Put(key, value[:-1] + b"\xc1")])
    store.close()
    assert "fresh" in refused(1, *vehicle_command(network.endpoint, outbox, "--name", "v1"))


def test_a_vehicle_refuses_a_ledger_as_its_store(network: Network, store: Path) -> None:
    said = refused(1, *vehicle_command(network.endpoint, store, "--name", "v1"))
    assert "a store of kind 'ledger', expected 'outbox'" in said


@pytest.fixture
def node(network: Network, log: Log) -> Iterator[Network]:
    """A fusion node with what v1 has sent so far."""
    service = FusionService(network.bus, FusionCore("fleet", "fusion", FusionSettings()), FusionSettings())
    working = threading.Thread(target=service.run)
    working.start()
    try:
        with (
            open_bus(connect=[network.endpoint]) as bus,
            Vehicle("v1", fleet="fleet", bus=bus, start_pose=log.start_pose) as vehicle,
        ):
            drive(vehicle, log, 70)
            wait_until(lambda: any(state.cut == 70 for state in service.newest.vehicles), "a map of 70 steps")
            yield network
    finally:
        service.stop()
        working.join()


def status(*arguments: str) -> Result:
    """The command, on a thread of its own: it has an event loop of its own."""
    return asyncio.run(asyncio.to_thread(invoke, "status", *arguments))


def test_status_says_how_every_vehicle_is(node: Network) -> None:
    told = status(node.endpoint)
    assert told.exit_code == 0, told.stderr
    (row,) = (line.split() for line in told.stdout.splitlines() if line.split()[0] == "v1")
    assert "71" in row
    assert row[-1] == "mapping"  # at any width
    joint = json.loads(status(node.endpoint, "--json").stdout)
    assert joint["node"] == "fusion"
    assert [(state["name"], state["cut"], state["behind"]) for state in joint["vehicles"]] == [("v1", 70, 0)]
    assert joint["map_digest"][:16] in told.stdout
    assert joint["merging"]["version"] >= 1  # of this map, or of one that came while it was asked for
    assert joint["merging"]["kept_apart"] == {}


@pytest.fixture
def ended(network: Network, held: Ledger) -> Iterator[Network]:
    """A fusion node that holds all of a run, and waits for more vehicles."""
    core = FusionCore("fleet", "fusion", FusionSettings())
    core.restore([(each.key, each.value) for each in held.contents() if isinstance(each, Put)], 0.0)
    service = FusionService(network.bus, core, FusionSettings())
    working = threading.Thread(target=service.run)
    working.start()
    try:
        wait_until(lambda: service.newest.canonical and service.newest.names, "a canonical map")
        yield network
    finally:
        service.stop()
        working.join()


def test_status_names_the_landmarks_that_another_node_has_merged_otherwise(ended: Network) -> None:
    """It is told so by a node that has joined the first two landmarks in its map of the same ledger."""
    keys = Keys("fleet")
    ours, said = asyncio.run(watch.newest_map(watch.Source([ended.endpoint], "fleet")))
    assert said is not None
    one, two, *others = ours.names
    theirs = replace(
        ours, node="fusion2", map_digest=bytes(32), names=((*one, *two), *others), signature=ours.signature[1:],
        landmark_mean=ours.landmark_mean[1:], landmark_cov=ours.landmark_cov[1:],
    )  # fmt: skip
    report = encode_merges(replace(said, node="fusion2", map_digest=bytes(32)))
    with open_bus(connect=[ended.endpoint]) as bus:
        bus.answer(keys.map("fusion2"), lambda key, data: [encode_map(theirs)])

        def told() -> str:
            bus.put(keys.merges("fusion2"), report)
            return status(ended.endpoint).stdout

        words = f"merged otherwise by fusion2: {'/'.join(map(str, one[0]))}"
        wait_until(lambda: words in told(), "the landmarks to be named")
        wait_until(lambda: f"{CLASSES_DIFFERING} 2" in told(), "the landmarks to be counted")
        assert "malformed" not in told()


def test_status_counts_what_is_malformed(node: Network) -> None:
    with open_bus(connect=[node.endpoint]) as bus:
        for _ in range(3):
            bus.put("fleet_seif/2/fleet/vehicle/v9/delta", b"nonsense")
        wait_until(lambda: "malformed 3" in status(node.endpoint).stdout, "three malformed messages", 5.0)


def test_status_of_a_fleet_that_is_not_there_says_so(node: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "FIRST_S", 0.3)
    assert "no map of fleet 'demo'" in refused(1, "status", node.endpoint, "--fleet", "demo")


KEYS = ("--node", "fusion", "--endpoint", "tls/127.0.0.1:7447", "--vehicle", "v1", "--viewer", "screen")


def test_keys_are_made_and_added_to(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    made = invoke("keys", str(folder), "--fleet", "demo", *KEYS)
    assert made.exit_code == 0, made.stderr
    named = {word for line in made.stdout.splitlines() for word in line.split() if word.startswith(str(folder))}
    assert all(Path(name).exists() for name in named)
    for name in ("node-fusion.json5", "vehicle-v1.key.json", "viewer-screen.json5", "fleet_keys.json", "ca"):
        assert str(folder / name) in named
    assert str(folder / "viewer-screen.key.json") not in named
    added = invoke("keys", str(folder), "--fleet", "demo", "--vehicle", "v2")
    assert "vehicle-v2.key.json" in added.stdout
    assert "vehicle-v1" not in added.stdout
    assert "restart node-fusion" in added.stdout


@pytest.mark.parametrize(
    ("code", "arguments", "words"),
    [
        (1, ["--vehicle", "v1"], "needs a fusion node"),
        (1, ["--node", "fusion"], "give each --node one --endpoint"),
        (1, ["--node", "fusion", "--endpoint", "tcp/127.0.0.1:7447"], "expected tls/HOST:PORT"),
        (1, [*KEYS, "--vehicle", "v1"], "given twice"),
        (1, [*KEYS, "--vehicle", "a/b"], "a/b"),
        (2, [*KEYS, "--days", "0"], "--days"),
        (2, [*KEYS, "--fleet", "a b"], "a b"),
    ],
)
def test_keys_that_cannot_be_are_refused(tmp_path: Path, code: int, arguments: list[str], words: str) -> None:
    assert words in refused(code, "keys", str(tmp_path / "keys"), *arguments)
    assert not (tmp_path / "keys").exists()


def test_keys_of_another_fleet_are_left_alone(tmp_path: Path) -> None:
    folder = str(tmp_path / "keys")
    invoke("keys", folder, "--fleet", "demo", *KEYS)
    assert "--fleet demo" in refused(1, "keys", folder, "--fleet", "other", "--vehicle", "v2")


@pytest.mark.parametrize("option", ["--signing-key", "--key-ring"])
def test_key_files_that_cannot_be_used_are_named(tmp_path: Path, option: str) -> None:
    nonsense = tmp_path / "nonsense"
    said = refused(2, "fusion", "--listen", "tcp/127.0.0.1:0", option, str(nonsense))
    assert "does not exist" in said
    nonsense.write_text("{}")
    nonsense.chmod(0o600)
    said = refused(1, "fusion", "--listen", "tcp/127.0.0.1:0", option, str(nonsense))
    assert str(nonsense) in said
    assert "damaged" in said


def test_a_signing_key_that_others_can_read_is_refused(tmp_path: Path) -> None:
    invoke("keys", str(tmp_path), "--fleet", "fleet", *KEYS)
    key = tmp_path / "node-fusion.key.json"
    key.chmod(0o644)
    said = refused(1, "fusion", "--listen", "tcp/127.0.0.1:0", "--fleet", "fleet", "--signing-key", str(key))
    assert "chmod 600" in said


@pytest.mark.parametrize(
    ("label", "arguments", "words"),
    [
        (
            "vehicle-v1",
            ["vehicle", "fleet", "--name", "v2"],
            "that of vehicle 'v1' of fleet 'fleet', this is vehicle 'v2'",
        ),
        (
            "node-fusion",
            ["vehicle", "fleet", "--name", "v1"],
            "that of node 'fusion' of fleet 'fleet', this is vehicle",
        ),
        (
            "vehicle-v1",
            ["fusion", "--fleet", "fleet", "--name", "v1"],
            "that of vehicle 'v1' of fleet 'fleet', this is node",
        ),
        ("node-fusion", ["fusion", "--fleet", "demo"], "of fleet 'fleet', this is node 'fusion' of fleet 'demo'"),
    ],
)
def test_somebody_elses_signing_key_is_refused(tmp_path: Path, label: str, arguments: list[str], words: str) -> None:
    invoke("keys", str(tmp_path), "--fleet", "fleet", *KEYS)
    assert words in refused(1, *arguments, "--signing-key", str(tmp_path / f"{label}.key.json"))


def test_a_configuration_is_no_key_ring(tmp_path: Path) -> None:
    invoke("keys", str(tmp_path), "--fleet", "fleet", *KEYS)
    shutil.copy(tmp_path / "node-fusion.json5", tmp_path / "ring")
    said = refused(1, "fusion", "--listen", "tcp/127.0.0.1:0", "--key-ring", str(tmp_path / "ring"))
    assert "key ring" in said


@pytest.mark.parametrize(
    ("code", "arguments", "words"),
    [
        (1, ["hub", "--listen", "nonsense"], "PROTOCOL/ADDRESS"),
        (1, ["hub", "--listen", "tcp/0.0.0.0:0"], "--insecure"),
        (1, ["hub", "--listen", "tcp/127.0.0.1:0", "--connect", "tcp/192.0.2.1:7447"], "--insecure"),
        (2, ["hub", "--config", "/nowhere.json5"], "does not exist"),
        (1, ["status", "tcp/192.0.2.1:7447"], "--insecure"),
        (2, ["status", "--fleet", "a b"], "a b"),
        (2, ["ledger"], ""),
        (2, ["ledger", "info"], "Missing argument"),
        (2, ["ledger", "explode", "file"], "explode"),
        (2, ["fusion", "--name", "a/b"], "a/b"),
        (2, ["chaos", "fleet", "--seeds", "many"], "many"),
        (2, ["chaos", "fleet", "--schedule", "{"], ""),
        (2, ["run", "fleet", "--set", 'faults.events=[{at_s=1, what="kill", who="v99"}]'], "v99"),
        (2, ["run", "fleet", "--set", 'faults.events=[{at_s=1, what="burn", who="v1"}]'], "burn"),
        (2, ["run", "fleet", "--set", 'faults.events=[{at_s=-1, what="kill", who="v1"}]'], "-1"),
        (2, ["run", "fleet", "--set", 'faults.hostile=[{who="v1", lie="white"}]'], "white"),
        (2, ["run", "fleet", "--set", "link.cuts=[{from_s=1, for_s=1, who=['v99']}]"], "v99"),
        (2, ["run", "fleet", "--set", "fleet.nodes=0"], "fleet.nodes"),
        (2, ["vehicle", "fleet", "--name", "v1", "--life", "-1"], "--life"),
    ],
)
def test_bad_input_is_answered_in_a_sentence(code: int, arguments: list[str], words: str) -> None:
    assert words in refused(code, *arguments)


def test_a_hub_whose_port_is_taken_says_so(network: Network) -> None:
    assert "cannot listen on" in refused(1, "hub", "--listen", network.endpoint)
