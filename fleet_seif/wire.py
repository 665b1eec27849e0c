"""Bytes of what vehicles and fusion nodes say to each other; FORMAT.md is the specification.

Writer and reader of each record stand side by side. Readers raise WireError, nothing else.
"""

from typing import Any, Final

import numpy as np

from fleet_seif.delta_wire import pack_delta, read_delta
from fleet_seif.envelope import (
    DELTA_MAX,
    ENTRIES_MAX,
    KIND_ACK,
    KIND_DELTA,
    KIND_HEARTBEAT,
    KIND_RANGE,
    KIND_SNAPSHOT,
    PARTS_MAX,
    REPLIES_MAX,
    SEQUENCE_MAX,
    array_of,
    bool_of,
    digest_of,
    epoch_of,
    fields_of,
    float_of,
    int_of,
    items_of,
    name_of,
    raw_bytes,
    seal,
    text_of,
    unseal,
)
from fleet_seif.errors import WireError
from fleet_seif.information import VARIABLE_MAX
from fleet_seif.messages import (
    Ack,
    Continues,
    DeltaMessage,
    FramePart,
    FrameStatus,
    Heartbeat,
    Hello,
    RangeRequest,
    Snapshot,
)
from fleet_seif.records import Floats
from fleet_seif.signing import Signer

STATUSES: Final = tuple(FrameStatus)
CORRELATION_MARGIN: Final = 1e-9
"""Least eigenvalue of a start pose's correlation matrix."""
VARIANCE_MIN: Final = 1e-12
VARIANCE_MAX: Final = 1e12
"""Of a start pose, m^2 and rad^2."""
POSE_MAX: Final = 1e9
"""Largest coordinate of a start pose, m and rad."""
INFORMATION_MAX: Final = 1e9
"""Most information that a vehicle may declare for a frame's first pose or for a step, per m^2 or rad^2."""


def _pack_part(part: FramePart) -> tuple[object, ...]:
    end = None if part.end_pose is None else raw_bytes(part.end_pose)
    return part.frame, int(part.status), pack_delta(part.delta), end


def _read_part(value: Any) -> FramePart:
    frame, status, delta, end = fields_of(value, 4, "frame part")
    status = STATUSES[int_of(status, 0, 3, "frame status")]
    ends = status in (FrameStatus.ENDED, FrameStatus.CORRECTED)
    if ends != (end is not None):
        raise WireError("frame part: an end pose belongs to frames that ended or are corrected, and only to those")
    return FramePart(
        frame=int_of(frame, 0, VARIABLE_MAX, "frame number"),
        status=status,
        delta=read_delta(delta),
        end_pose=array_of(end, (3,), "end pose") if ends else None,
    )


def _pack_hello(hello: Hello) -> tuple[object, ...]:
    c = hello.continues
    return (
        hello.software,
        hello.life,
        hello.placed,
        raw_bytes(hello.start_pose),
        raw_bytes(hello.start_pose_cov),
        hello.start_information,
        hello.step_information_max,
        None if c is None else (tuple(c.epoch), c.last, c.prefix_digest),
    )


def is_start_covariance(cov: Floats) -> bool:
    """Whether a start pose's covariance is symmetric and clearly positive definite: its inverse becomes a prior."""
    variance = np.diag(cov)
    if not (np.array_equal(cov, cov.T) and np.all((variance >= VARIANCE_MIN) & (variance <= VARIANCE_MAX))):
        return False
    scale = np.sqrt(variance)
    correlation = cov / np.outer(scale, scale)  # far beyond 1 only where it is not positive definite, and may overflow
    return bool(np.all(np.abs(correlation) < 1.5) and np.linalg.eigvalsh(correlation)[0] > CORRELATION_MARGIN)


def _read_hello(value: Any) -> Hello:
    software, life, placed, pose, cov, start, step, continues = fields_of(value, 8, "hello")
    if continues is not None:
        epoch, last, digest = fields_of(continues, 3, "continues")
        continues = Continues(
            epoch=epoch_of(epoch),
            last=int_of(last, 0, SEQUENCE_MAX, "continues"),
            prefix_digest=digest_of(digest, "prefix"),
        )
    start_pose = array_of(pose, (3,), "start pose")
    if np.any(np.abs(start_pose) > POSE_MAX):
        raise WireError(f"start pose: beyond {POSE_MAX:g} m or rad")
    start_pose_cov = array_of(cov, (3, 3), "start pose covariance")
    if np.any(start_pose_cov) and not is_start_covariance(start_pose_cov):
        raise WireError(
            "start pose covariance: neither zeros nor symmetric and positive definite with variances "
            f"from {VARIANCE_MIN:g} to {VARIANCE_MAX:g}"
        )
    return Hello(
        software=text_of(software, "software"),
        life=int_of(life, 0, VARIABLE_MAX, "life"),
        placed=bool_of(placed, "placed"),
        start_pose=start_pose,
        start_pose_cov=start_pose_cov,
        start_information=_information_of(start, "start information"),
        step_information_max=_information_of(step, "information a step"),
        continues=continues,
    )


def _information_of(value: Any, what: str) -> float:
    if not 0 < float_of(value, what) <= INFORMATION_MAX:
        raise WireError(f"{what}: expected a number above 0, at most {INFORMATION_MAX:g}")
    return float(value)


def _pack_message(m: DeltaMessage) -> tuple[object, ...]:
    return (
        m.fleet,
        m.vehicle,
        tuple(m.epoch),
        m.first,
        m.last,
        m.step,
        m.time_s,
        tuple(_pack_part(part) for part in m.parts),
        m.landmarks,
        m.aliases,
        m.healthy,
        m.innovation,
        m.innovation_dof,
        m.refused,
        None if m.hello is None else _pack_hello(m.hello),
        m.end,
    )


def _read_message(value: Any) -> DeltaMessage:
    (fleet, vehicle, epoch, first, last, step, time_s, parts, landmarks, aliases,
     healthy, innovation, dof, refused, hello, end) = fields_of(value, 16, "message")  # fmt: skip
    first = int_of(first, 0, SEQUENCE_MAX, "first")
    if (first == 0) != (hello is not None):
        raise WireError("a hello belongs to sequence 0, and only there")
    return DeltaMessage(
        fleet=name_of(fleet, "fleet"),
        vehicle=name_of(vehicle, "vehicle"),
        epoch=epoch_of(epoch),
        first=first,
        last=int_of(last, first, SEQUENCE_MAX, "last"),
        step=int_of(step, 0, SEQUENCE_MAX, "step"),
        time_s=float_of(time_s, "time"),
        parts=tuple(_read_part(part) for part in items_of(parts, PARTS_MAX, "parts")),
        landmarks=tuple(_read_landmark(item) for item in items_of(landmarks, ENTRIES_MAX, "landmarks")),
        aliases=tuple(_read_alias(item) for item in items_of(aliases, ENTRIES_MAX, "aliases")),
        healthy=bool_of(healthy, "health"),
        innovation=float_of(innovation, "innovation"),
        innovation_dof=int_of(dof, 0, SEQUENCE_MAX, "degrees of freedom"),
        refused=int_of(refused, 0, SEQUENCE_MAX, "refused"),
        hello=None if hello is None else _read_hello(hello),
        end=bool_of(end, "end"),
    )


def _read_landmark(value: Any) -> tuple[int, int]:
    number, signature = fields_of(value, 2, "landmark")
    return int_of(number, 0, VARIABLE_MAX - 1, "landmark"), int_of(signature, -1, 2**63 - 1, "signature")


def _read_alias(value: Any) -> tuple[int, int, bool]:
    a, b, added = fields_of(value, 3, "alias")
    limit = VARIABLE_MAX - 1
    return int_of(a, 0, limit, "alias"), int_of(b, 0, limit, "alias"), bool_of(added, "alias")


def encode_message(message: DeltaMessage, signer: Signer | None = None) -> bytes:
    """Bytes of a DeltaMessage. Raises ValueError where they would be more than DELTA_MAX."""
    data = seal(KIND_DELTA, _pack_message(message), signer)
    if len(data) > DELTA_MAX:
        raise ValueError(f"message {message.first} has {len(data)} bytes, at most {DELTA_MAX} may be sent")
    return data


def decode_message(data: bytes) -> DeltaMessage:
    """A DeltaMessage from bytes. Raises WireError."""
    if len(data) > DELTA_MAX:
        raise WireError(f"delta message of {len(data)} bytes: at most {DELTA_MAX}")
    return _read_message(unseal(KIND_DELTA, data))


def encode_snapshot(snapshot: Snapshot, signer: Signer | None = None) -> bytes:
    """Bytes of a Snapshot."""
    fields = (_pack_message(snapshot.message), snapshot.prefix_digest, snapshot.maker or None)
    return seal(KIND_SNAPSHOT, fields, signer)


def decode_snapshot(data: bytes) -> Snapshot:
    """A Snapshot from bytes. Raises WireError."""
    message, digest, maker = fields_of(unseal(KIND_SNAPSHOT, data), 3, "snapshot")
    snapshot = Snapshot(
        message=_read_message(message),
        prefix_digest=digest_of(digest, "prefix digest"),
        maker="" if maker is None else name_of(maker, "maker"),
    )
    if snapshot.message.first != 0:
        raise WireError("snapshot: does not start at sequence 0")
    return snapshot


def encode_heartbeat(h: Heartbeat, signer: Signer | None = None) -> bytes:
    """Bytes of a Heartbeat."""
    fields = (h.fleet, h.vehicle, tuple(h.epoch), h.last, h.prefix_digest, h.checked, h.checked_digest, h.ended)
    return seal(KIND_HEARTBEAT, fields, signer)


def decode_heartbeat(data: bytes) -> Heartbeat:
    """A Heartbeat from bytes. Raises WireError."""
    fields = fields_of(unseal(KIND_HEARTBEAT, data), 8, "heartbeat")
    fleet, vehicle, epoch, last, digest, checked, checked_digest, ended = fields
    last = int_of(last, 0, SEQUENCE_MAX, "last")
    return Heartbeat(
        fleet=name_of(fleet, "fleet"),
        vehicle=name_of(vehicle, "vehicle"),
        epoch=epoch_of(epoch),
        last=last,
        prefix_digest=digest_of(digest, "prefix digest"),
        checked=int_of(checked, -1, last, "checked"),
        checked_digest=digest_of(checked_digest, "checked digest"),
        ended=bool_of(ended, "ended"),
    )


def encode_ack(a: Ack, signer: Signer | None = None) -> bytes:
    """Bytes of an Ack."""
    return seal(KIND_ACK, (a.fleet, a.node, a.vehicle, tuple(a.epoch), a.last, a.prefix_digest, a.fault), signer)


def decode_ack(data: bytes) -> Ack:
    """An Ack from bytes. Raises WireError."""
    fleet, node, vehicle, epoch, last, digest, fault = fields_of(unseal(KIND_ACK, data), 7, "ack")
    return Ack(
        fleet=name_of(fleet, "fleet"),
        node=name_of(node, "node"),
        vehicle=name_of(vehicle, "vehicle"),
        epoch=epoch_of(epoch),
        last=int_of(last, 0, SEQUENCE_MAX, "last"),
        prefix_digest=digest_of(digest, "prefix digest"),
        fault=text_of(fault, "fault"),
    )


def encode_range(r: RangeRequest, signer: Signer | None = None) -> bytes:
    """Bytes of a RangeRequest."""
    return seal(KIND_RANGE, (r.fleet, r.vehicle, tuple(r.epoch), r.first, r.last, r.count), signer)


def decode_range(data: bytes) -> RangeRequest:
    """A RangeRequest from bytes. Raises WireError."""
    fleet, vehicle, epoch, first, last, count = fields_of(unseal(KIND_RANGE, data), 6, "range")
    first = int_of(first, 0, SEQUENCE_MAX, "first")
    return RangeRequest(
        fleet=name_of(fleet, "fleet"),
        vehicle=name_of(vehicle, "vehicle"),
        epoch=epoch_of(epoch),
        first=first,
        last=int_of(last, first, SEQUENCE_MAX, "last"),
        count=int_of(count, 1, REPLIES_MAX, "count"),
    )
