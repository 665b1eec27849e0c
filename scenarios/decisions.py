"""Decisions of operators: given to the running fusion nodes of a fleet, or to the store of one that is down."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from fleet_seif.bus import Bus, open_bus
from fleet_seif.config import FusionSettings
from fleet_seif.envelope import KIND_EVENT, is_signed, kind_of
from fleet_seif.errors import RunError, WireError
from fleet_seif.keys import Keys
from fleet_seif.messages import Action, LandmarkName, OperatorEvent, check_name
from fleet_seif.node_wire import decode_event, encode_event
from fleet_seif.signing import Role, Signer, load_signer
from fleet_seif.sqlite_store import SqliteStore
from fusion import records
from fusion.core import REFUSED, TAKEN, FusionCore
from fusion.service import restore
from scenarios.tools import whose

ANSWER_S = 15.0


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What an operator has decided: about two landmarks, in ascending order, or about a vehicle."""

    action: Action
    landmarks: tuple[LandmarkName, LandmarkName] | None = None
    vehicle: str = ""


@dataclass(frozen=True, kw_only=True)
class Desk:
    """Where decisions go and whose they are. store: of a node that is down; else endpoints of running nodes."""

    endpoints: Sequence[str]
    fleet: str
    operator: str
    store: Path | None = None
    signing_key: Path | None = None
    config: Path | None = None
    insecure: bool = False


def read_landmark(text: str) -> LandmarkName:
    """A landmark from vehicle/life/number, as `watch --json` shows it. Raises RunError."""
    parts = text.split("/")
    if len(parts) != 3 or not all(part.isdecimal() for part in parts[1:]):
        raise RunError(f"landmark {text!r}: write vehicle/life/number, as in v1/0/12")
    try:
        return LandmarkName(check_name(parts[0], "vehicle"), int(parts[1]), int(parts[2]))
    except ValueError as error:
        raise RunError(f"landmark {text!r}: {error}") from None


def about_landmarks(action: Action, a: str, b: str) -> Decision:
    """Raises RunError where these are not two landmarks."""
    first, second = sorted((read_landmark(a), read_landmark(b)))
    if first == second:
        raise RunError(f"{a} and {b} are the same landmark already")
    return Decision(action=action, landmarks=(first, second))


def about_vehicle(action: Action, vehicle: str) -> Decision:
    try:
        return Decision(action=action, vehicle=check_name(vehicle, "vehicle"))
    except ValueError as error:
        raise RunError(str(error)) from None


def decide(desk: Desk, decision: Decision, console: Console) -> None:
    """Make a decision last. Raises RunError where nobody takes it."""
    signer = _signer_of(desk)
    operator = desk.operator if signer is None else signer.name
    said = _in_store(desk, decision, operator, signer) if desk.store else _on_bus(desk, decision, operator, signer)
    for text in said:
        console.print(text, highlight=False, soft_wrap=True)


def _signer_of(desk: Desk) -> Signer | None:
    if desk.signing_key is None:
        return None
    signer = load_signer(desk.signing_key)
    if signer.role is not Role.OPERATOR or (desk.store is None and signer.fleet != desk.fleet):
        raise RunError(
            f"private key {desk.signing_key} is that of {signer.role} {signer.name!r} of fleet {signer.fleet!r}: "
            f"decisions about fleet {desk.fleet!r} need that of one of its operators"
        )
    return signer


def _on_bus(desk: Desk, decision: Decision, operator: str, signer: Signer | None) -> list[str]:
    with open_bus(connect=desk.endpoints, config=desk.config, insecure=desk.insecure) as bus:
        keys = Keys(desk.fleet)
        held = [decode_event(data) for data in _asked(bus, keys.events("*"), b"") if kind_of(data) == KIND_EVENT]
        event = OperatorEvent(
            fleet=desk.fleet, number=1 + max((event.number for event in held), default=0), operator=operator,
            action=decision.action, landmarks=decision.landmarks, vehicle=decision.vehicle,
        )  # fmt: skip
        answers = [answer.decode() for answer in _asked(bus, keys.decisions("*"), encode_event(event, signer))]
    if not answers:
        raise RunError(f"no fusion node of fleet {desk.fleet!r} has answered: is that its name, and may you ask it?")
    taken = [answer.removeprefix(TAKEN) for answer in answers if answer.startswith(TAKEN)]
    if not taken:
        raise RunError("; ".join(answer.removeprefix(REFUSED) for answer in answers))
    return taken


def _asked(bus: Bus, key: str, payload: bytes) -> list[bytes]:
    """All answers to a query."""
    found: list[bytes] = []
    done = threading.Event()
    bus.ask(key, payload, found.append, done.set)
    done.wait(ANSWER_S)
    return found


def _in_store(desk: Desk, decision: Decision, operator: str, signer: Signer | None) -> list[str]:
    assert desk.store is not None
    fleet, node = whose(desk.store)
    if signer is not None and signer.fleet != fleet:
        raise RunError(f"{desk.store} is of fleet {fleet!r}, the private key of fleet {signer.fleet!r}")
    store = SqliteStore.open(desk.store, records.KIND, records.SCHEMA)
    try:
        core = FusionCore(fleet, node, FusionSettings())
        restore(core, store, 0.0)
        if signer is None and any(is_signed(data) for s in core.ledger.streams.values() for data in s.log):
            raise RunError(f"{desk.store} holds signed messages: give --signing-key, so that other nodes believe it")
        try:
            data = core.ledger.issue(
                operator, decision.action, landmarks=decision.landmarks, vehicle=decision.vehicle, signer=signer
            )
        except WireError as error:
            raise RunError(str(error)) from None
        store.commit(core.ledger.take_changes())
        return [core.words_of(decode_event(data))]
    finally:
        store.close()
