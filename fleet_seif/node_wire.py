"""Bytes of what fusion nodes tell each other: decisions of operators, evidence, and how far they are.

FORMAT.md is the specification. Readers raise WireError, nothing else.
"""

from typing import Any, Final

from fleet_seif.envelope import (
    DELTA_MAX,
    DIGEST,
    KIND_EVENT,
    KIND_EVIDENCE,
    KIND_STATUS,
    SEQUENCE_MAX,
    digest_of,
    epoch_of,
    fields_of,
    int_of,
    items_of,
    landmark_name_of,
    name_of,
    seal,
    text_of,
    unseal,
)
from fleet_seif.errors import WireError
from fleet_seif.messages import Action, Evidence, NodeStatus, OperatorEvent, StreamPosition
from fleet_seif.signing import Signer

STREAMS_MAX: Final = 5000
EVENTS_MAX: Final = 10_000
ABOUT_LANDMARKS: Final = (Action.FORCE, Action.FORBID, Action.RELEASE)


def encode_event(e: OperatorEvent, signer: Signer | None = None) -> bytes:
    """Bytes of an OperatorEvent."""
    subject: object = e.vehicle if e.landmarks is None else tuple(tuple(name) for name in e.landmarks)
    return seal(KIND_EVENT, (e.fleet, e.number, e.operator, str(e.action), subject), signer)


def decode_event(data: bytes) -> OperatorEvent:
    """An OperatorEvent from bytes. Raises WireError."""
    fleet, number, operator, action, subject = fields_of(unseal(KIND_EVENT, data), 5, "event")
    if text_of(action, "action") not in set(Action):
        raise WireError(f"event: unknown action {action!r}, one of {', '.join(Action)}")
    landmarks, vehicle = None, ""
    if Action(action) in ABOUT_LANDMARKS:
        first, second = (landmark_name_of(name) for name in fields_of(subject, 2, "event subject"))
        if not first < second:
            raise WireError("event: two different landmarks in ascending order belong together")
        landmarks = (first, second)
    else:
        vehicle = name_of(subject, "event subject")
    return OperatorEvent(
        fleet=name_of(fleet, "fleet"),
        number=int_of(number, 1, SEQUENCE_MAX, "event number"),
        operator=name_of(operator, "operator"),
        action=Action(action),
        landmarks=landmarks,
        vehicle=vehicle,
    )


def encode_evidence(e: Evidence, signer: Signer | None = None) -> bytes:
    """Bytes of an Evidence."""
    return seal(KIND_EVIDENCE, (e.first, e.second), signer)


def decode_evidence(data: bytes) -> Evidence:
    """An Evidence from bytes; the messages inside are not looked at. Raises WireError."""
    first, second = fields_of(unseal(KIND_EVIDENCE, data), 2, "evidence")
    if not all(type(part) is bytes and len(part) <= DELTA_MAX for part in (first, second)):
        raise WireError("evidence: expected the bytes of two messages")
    return Evidence(first=first, second=second)


def encode_status(s: NodeStatus, signer: Signer | None = None) -> bytes:
    """Bytes of a NodeStatus."""
    streams = tuple((p.vehicle, tuple(p.epoch), p.last, p.prefix_digest, p.evidence) for p in s.streams)
    return seal(KIND_STATUS, (s.fleet, s.node, streams, s.events), signer)


def decode_status(data: bytes) -> NodeStatus:
    """A NodeStatus from bytes. Raises WireError."""
    fleet, node, streams, events = fields_of(unseal(KIND_STATUS, data), 4, "status")
    return NodeStatus(
        fleet=name_of(fleet, "fleet"),
        node=name_of(node, "node"),
        streams=tuple(_read_position(item) for item in items_of(streams, STREAMS_MAX, "streams")),
        events=digest_of(events, "events"),
    )


def _read_position(value: Any) -> StreamPosition:
    vehicle, epoch, last, digest, evidence = fields_of(value, 5, "stream position")
    if type(evidence) is not bytes or len(evidence) not in (0, DIGEST):
        raise WireError("stream position: evidence is a digest or empty")
    return StreamPosition(
        name_of(vehicle, "vehicle"), epoch_of(epoch), int_of(last, -1, SEQUENCE_MAX, "last"),
        digest_of(digest, "prefix digest"), evidence,
    )  # fmt: skip
