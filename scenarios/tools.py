"""Commands for those who look after a fleet: its keys, its ledgers, and how it is."""

import asyncio
import json
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.table import Table

from fleet_seif.config import FusionSettings
from fleet_seif.envelope import KIND_SNAPSHOT, authenticate, is_signed, kind_of
from fleet_seif.errors import RunError, WireError
from fleet_seif.signing import Role, load_key_ring
from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.wire import decode_snapshot
from fusion import records
from fusion.core import FusionCore
from fusion.ledger import Ledger
from fusion.merges import merges_of, run_digest
from fusion.service import restore
from scenarios import output, watch
from scenarios.access import Kind, Member
from scenarios.children import signer_of
from scenarios.keys import make_keys
from scenarios.watch_merges import merging


def show_status(source: watch.Source, as_json: bool, console: Console) -> None:
    """Print how every vehicle of a fleet is, as a fusion node sees it. Raises RunError where no map comes."""
    joint, report = asyncio.run(watch.newest_map(source))
    if as_json:
        console.print_json(json.dumps(watch.as_dict(joint, report)))
        return
    console.print(
        f"node {joint.node}  map {joint.version}  {len(joint.names)} landmarks  digest {joint.map_digest.hex()[:16]}"
    )
    console.print(watch.vehicle_table(joint.vehicles))
    for part in merging(joint, report):
        console.print(part, highlight=False, soft_wrap=True)
    for text in (*watch.doubtful(joint.vehicles), *watch.faults(joint.vehicles)):
        console.print(text, highlight=False, soft_wrap=True)
    for name, count in joint.counters.items():
        console.print(f"{name} {count}")


def make_fleet_keys(folder: Path, fleet: str, members: list[Member], days: int, renew: bool, console: Console) -> None:
    """Make the files of `make_keys`, and say which."""
    made = make_keys(folder, fleet=fleet, members=members, now=datetime.now(UTC), days=days, renew=renew)

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    for label in made.new:
        key = "" if label.startswith("viewer-") else f"  {folder / label}.key.json"
        say(f"new      {folder / label}.json5{key}")
    for label in made.changed:
        say(f"changed  {folder / label}.json5  (copy it again, restart {label})")
    say(f"key ring {folder / 'fleet_keys.json'}  (for every process)   keep {folder / 'ca'} to yourself")


def members_of(nodes: list[str], endpoints: list[str], hosts: list[str], named: dict[Kind, list[str]]) -> list[Member]:
    """Raises RunError where nodes and endpoints are not pairs."""
    if len(nodes) != len(endpoints):
        raise RunError("give each --node one --endpoint, in the same order")
    pairs = zip(nodes, endpoints, strict=True)
    members = [Member(kind=Kind.NODE, name=name, endpoint=at, hosts=tuple(hosts)) for name, at in pairs]
    return members + [Member(kind=kind, name=name) for kind, names in named.items() for name in names]


def whose(file: Path) -> tuple[str, str]:
    store = SqliteStore.open(file, records.KIND, records.SCHEMA, read_only=True)
    try:
        found = dict(store.load(records.IDENTITY, records.IDENTITY + b"\0"))
    finally:
        store.close()
    fleet, _, node = found.get(records.IDENTITY, b"").decode().partition("/")
    if not fleet:
        raise RunError(f"{file} is empty: no fusion node has written to it yet")
    return fleet, node


def ledger_info(file: Path, console: Console) -> Ledger:
    """Print what a store holds; every message is folded again."""
    fleet, node = whose(file)
    ledger = output.read_ledger(file, fleet)
    table = Table(box=None)
    for head in ("vehicle", "life", "epoch", "messages", "bytes", "up to", "checked", "state"):
        table.add_column(head, justify="left" if head in ("vehicle", "state") else "right")
    for _, s in sorted(ledger.streams.items()):
        state = s.quarantine or ("ended" if s.ended else "continued" if ledger.is_continued(s) else "open")
        counts = (s.number, s.epoch.counter, len(s.log), s.log_bytes, s.next - 1, s.checked)
        table.add_row(s.vehicle, *(str(count) for count in counts), state)
    size = file.stat().st_size
    console.print(
        f"fleet {fleet}  node {node}  {size} bytes on disk, {ledger.bytes_held} of messages, "
        f"{len(ledger.events)} events",
        soft_wrap=True,
    )
    console.print(table)
    for text in decision_words(ledger):
        console.print(text, highlight=False, soft_wrap=True)
    console.print(
        f"map digest    {run_digest(ledger).hex()}\nledger digest {ledger.ledger_digest().hex()}", highlight=False
    )
    return ledger


def decision_words(ledger: Ledger) -> list[str]:
    """The decisions of operators that count, a line each."""
    pairs = [("forced", pair) for pair in ledger.decisions.forced]
    pairs += [("forbidden", pair) for pair in ledger.decisions.forbidden]
    words = [f"{what} {' '.join('/'.join(map(str, name)) for name in pair)}" for what, pair in pairs]
    return words + [f"retracted {vehicle}" for vehicle in sorted(ledger.decisions.retracted)]


def ledger_merges(file: Path, console: Console) -> None:
    """Print which pairs of landmarks were compared by place, and what became of each."""
    ledger = output.read_ledger(file, whose(file)[0])
    table = Table("landmark", "and", "squared distance", "outcome", box=None)
    for each in merges_of(ledger).considered:
        names = ("/".join(map(str, name)) for name in (each.a, each.b))
        table.add_row(*names, f"{each.d2:.2f}", str(each.reason))
    console.print(table)


def ledger_verify(file: Path, key_ring: Path | None, console: Console) -> None:
    """Check a store: the file itself, every message in it, and that the verdicts kept are those that come out.

    With the key ring of a fleet that signs, every signature too.
    """
    ledger = ledger_info(file, console)
    keys = None if key_ring is None else load_key_ring(key_ring)
    for stream in ledger.streams.values():
        for data in stream.log:
            maker = decode_snapshot(data).maker if kind_of(data) == KIND_SNAPSHOT else ""
            role, name = (Role.NODE, maker) if maker else (Role.VEHICLE, stream.vehicle)
            try:
                authenticate(data, keys, role, name)
            except WireError as error:
                raise RunError(f"{file}: a message of {stream.vehicle!r}: {error}") from None
    store = SqliteStore.open(file, records.KIND, records.SCHEMA, read_only=True)
    try:
        store.verify()
        kept = dict(store.load(records.QUARANTINE, records.QUARANTINE + b"\xff"))
    finally:
        store.close()
    verdicts = {
        records.stream_key(records.QUARANTINE, *s.key): s.quarantine.encode()
        for s in ledger.streams.values()
        if s.quarantine
    }
    if kept != verdicts:
        raise RunError(f"{file}: the verdicts kept are not those that its messages give")
    console.print("sound: the file is whole, and everything in it folds to these digests")


def ledger_compact(file: Path, signing_key: Path | None, console: Console) -> None:
    """Replace single messages by snapshots where the vehicle has announced the digest, and give back the space.

    Raises RunError where the messages are signed and the node's key is not given: nobody would take its snapshots.
    """
    fleet, node = whose(file)
    signer = signer_of(signing_key, fleet, Role.NODE, node)
    held = [data for stream in output.read_ledger(file, fleet).streams.values() for data in stream.log]
    if signer is None and any(is_signed(data) for data in held):
        raise RunError(f"{file} holds signed messages: give --signing-key, so that other nodes take the snapshots")
    store = SqliteStore.open(file, records.KIND, records.SCHEMA)
    try:
        core = FusionCore(fleet, node, FusionSettings(), signer=signer)
        restore(core, store, 0.0)
        digest, before = core.ledger.ledger_digest(), file.stat().st_size
        saved = core.compact()
        store.commit(core.ledger.take_changes())
        store.shrink()
    finally:
        store.close()
    again = output.read_ledger(file, fleet)
    if again.ledger_digest() != digest:
        raise RunError(f"{file}: compacting changed the digest: please report this")
    console.print(f"{saved} bytes of messages saved; {before} -> {file.stat().st_size} bytes on disk; same digests")
