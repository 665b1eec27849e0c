"""Everything that makes a fleet secure, made in one go: certificates, signing keys and Zenoh configurations.

1. Every link is mutual TLS. A certificate says who a process is ("vehicle-v1", "node-fusion", ...), and fusion nodes
   let it do what `scenarios.access` grants and nothing else.
2. A configuration holds its certificates, so it can be copied to any machine and any folder.
3. Making keys for the same folder again adds what is new and keeps every key, unless it is told to renew some.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import ValidationError

from fleet_seif.bus import is_loopback
from fleet_seif.config import Settings
from fleet_seif.errors import RunError
from fleet_seif.messages import check_name
from fleet_seif.signing import KeyRing, Role, generate_signer, load_key_ring, write_file, write_key_ring, write_signer
from scenarios.access import Kind, Member, access_control
from scenarios.certificates import general_name, is_address, issue, open_authority, tls_settings

AUTHORITY: Final = "ca"
FLEET_FILE: Final = "ca/fleet.json"
RING_FILE: Final = "fleet_keys.json"
DAYS_MAX: Final = 3650
MEMBERS_MAX: Final = 2000
ENDPOINT: Final = re.compile(r"tls/([A-Za-z0-9._-]+):\d{1,5}")  # Zenoh 1.10 cannot connect to tls/[IPv6 address]


@dataclass(frozen=True, kw_only=True)
class Made:
    """Labels. new: got keys; changed: their configuration changed and is to be copied to them again."""

    new: tuple[str, ...]
    changed: tuple[str, ...]


class _Fleet(Settings):
    format: Literal[1] = 1
    fleet: str
    members: tuple[Member, ...] = ()


def make_keys(
    folder: Path, *, fleet: str, members: Sequence[Member], now: datetime, days: int = 365, renew: bool = False
) -> Made:
    """Make a fleet's keys, or add members to a fleet whose keys were made before.

    Leaves for each member `<kind>-<name>.json5`, a Zenoh configuration, and `<kind>-<name>.key.json`, its signing key
    (viewers sign nothing); further `fleet_keys.json`, the key ring, and `ca/`: whoever has that can admit anybody.

    Args:
        now: certificates are valid from a day before, as clocks differ, until `days` after.
        renew: give these members new keys if they have some; their old signing keys are void.

    Raises RunError where something is malformed, cannot be written, or would replace a key.
    """
    if not 1 <= days <= DAYS_MAX:
        raise RunError(f"certificates for {days} days: give 1 to {DAYS_MAX} --days")
    known = _load_fleet(folder, fleet)
    everyone = _joined(known, members, renew)
    _check(fleet, everyone)
    labels = {member.label for member in known}
    new = [member for member in members if renew or member.label not in labels]
    kept = [member for member in everyone if member not in new]
    old_configs = [_read_config(folder, member) for member in kept]
    if not renew:
        _check_no_files(folder, new)

    authority = open_authority(folder / AUTHORITY, fleet, now)
    ring = _ring(folder, fleet, everyone)
    changed = []
    for member, old in zip(kept, old_configs):
        config = _with_others(fleet, everyone, member, old)
        if config != old:
            _write_config(folder, fleet, member, config)
            changed.append(member.label)
    for member in new:
        if member.kind is not Kind.VIEWER:
            signer = generate_signer(fleet, Role(member.kind), member.name)
            write_signer(_key_path(folder, member), signer, replace=renew)
            ring = ring.with_signers(signer)
        identity = issue(authority, member.label, _hosts(member), now, days)
        own = _own_config(member, tls_settings(authority, identity, listens=member.kind is Kind.NODE))
        _write_config(folder, fleet, member, _with_others(fleet, everyone, member, own))
    write_key_ring(folder / RING_FILE, ring)
    state = _Fleet(fleet=fleet, members=tuple(everyone))
    write_file(folder / FLEET_FILE, state.model_dump_json(indent=2) + "\n", private=False)
    return Made(new=tuple(member.label for member in new), changed=tuple(changed))


def _load_fleet(folder: Path, fleet: str) -> tuple[Member, ...]:
    path = folder / FLEET_FILE
    try:
        known = _Fleet.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return ()
    except (OSError, ValidationError) as error:
        raise RunError(f"{path} cannot be read: {error}; put back what was there, or give another folder") from None
    if known.fleet != fleet:
        raise RunError(f"{folder} has the keys of fleet {known.fleet!r}: give --fleet {known.fleet}, or another folder")
    return known.members


def _joined(known: Sequence[Member], named: Sequence[Member], renew: bool) -> list[Member]:
    """Everybody, in the order in which they joined."""
    if len({member.label for member in named}) < len(named):
        raise RunError("a name is given twice for one kind of process: give it once")
    everyone = {member.label: member for member in known}
    for member in named:
        old = everyone.get(member.label, member)
        if old != member and not renew:
            raise RunError(f"{member.label} has keys for {old.endpoint}: to move it, give --renew too")
        everyone[member.label] = member
    return list(everyone.values())


def _check(fleet: str, everyone: Sequence[Member]) -> None:
    """Raise RunError for what cannot be."""
    nodes = [member for member in everyone if member.kind is Kind.NODE]
    if not nodes:
        raise RunError("a fleet needs a fusion node: give --node NAME --endpoint tls/HOST:PORT")
    if len(everyone) > MEMBERS_MAX:
        raise RunError(f"a fleet of {len(everyone)} processes: at most {MEMBERS_MAX}")
    try:
        check_name(fleet, "fleet")
        for member in everyone:
            check_name(member.name, member.kind)
    except ValueError as error:
        raise RunError(str(error)) from None
    for node in nodes:
        if not ENDPOINT.fullmatch(node.endpoint):
            raise RunError(
                f"endpoint {node.endpoint!r} of {node.label}: expected tls/HOST:PORT, where others reach it, "
                "with the HOST's name or IPv4 address"
            )
        for host in _hosts(node):
            general_name(host)


def _check_no_files(folder: Path, new: Sequence[Member]) -> None:
    for path in (path(folder, member) for member in new for path in (_config_path, _key_path)):
        if path.exists():
            raise RunError(f"{path} is there already, and a key is never overwritten: move it, or give --renew")


def _ring(folder: Path, fleet: str, everyone: Sequence[Member]) -> KeyRing:
    """The public keys of those who belong to the fleet."""
    path = folder / RING_FILE
    belong = {member.label for member in everyone}
    known = load_key_ring(path).public_keys if path.exists() else {}
    return KeyRing(fleet, {(role, name): key for (role, name), key in known.items() if f"{role}-{name}" in belong})


def _hosts(member: Member) -> list[str]:
    """By which names and addresses others know a node."""
    match = ENDPOINT.fullmatch(member.endpoint)
    return [match[1], *member.hosts] if match else []


def _own_config(member: Member, tls: dict[str, object]) -> dict[str, Any]:
    """What of a configuration does not depend on the others, and is left alone later.

    A node listens at its own address. Where that is a name, it may stand for an address that the machine does not have
    or, in /etc/hosts, for loopback: then it listens at all of its addresses.
    """
    link = {"protocols": ["tls"], "tls": tls}
    if member.kind is not Kind.NODE:
        return {"mode": "client", "transport": {"link": link}}
    own_address = is_loopback(member.endpoint) or is_address(_hosts(member)[0])
    listen = member.endpoint if own_address else f"tls/0.0.0.0:{member.endpoint.rpartition(':')[2]}"
    return {"mode": "router", "listen": {"endpoints": [listen]}, "transport": {"link": link}}


def _with_others(fleet: str, everyone: Sequence[Member], member: Member, own: dict[str, Any]) -> dict[str, Any]:
    """A configuration, with whom to connect to, and at a node with who may do what.

    A node connects to those before it, so each pair of nodes has one link.
    """
    nodes = [other for other in everyone if other.kind is Kind.NODE]
    if member.kind is not Kind.NODE:
        return own | {"connect": {"endpoints": [node.endpoint for node in nodes]}}
    before = [node.endpoint for node in nodes[: nodes.index(member)]]
    control = json.loads(json.dumps(access_control(fleet, everyone)))  # as it is read back
    return own | {"connect": {"endpoints": before}, "access_control": control}


def _config_path(folder: Path, member: Member) -> Path:
    return folder / f"{member.label}.json5"


def _key_path(folder: Path, member: Member) -> Path:
    return folder / f"{member.label}.key.json"


def _read_config(folder: Path, member: Member) -> dict[str, Any]:
    path = _config_path(folder, member)
    try:
        text = path.read_text()
    except OSError as error:
        raise RunError(
            f"{member.label} has keys, but {path} cannot be kept up to date ({error.strerror}): put it back, or make "
            f"new keys with --renew and its name, or shut it out for good by taking it out of {folder / FLEET_FILE}"
        ) from None
    try:
        config: dict[str, Any] = json.loads("\n".join(x for x in text.splitlines() if not x.startswith("//")))
    except ValueError as error:
        raise RunError(f"{path}: {error}; it is to be plain JSON, with comments on lines that begin with //") from None
    return config


def _write_config(folder: Path, fleet: str, member: Member, config: dict[str, Any]) -> None:
    head = (
        f"// Zenoh configuration of {member.label} in fleet {fleet}. It holds a private key: show it to nobody.\n"
        "// `fleet-seif keys` rewrites connect and access_control; the rest may be edited, as plain JSON.\n"
    )
    write_file(_config_path(folder, member), head + json.dumps(config, indent=1) + "\n", private=True)
