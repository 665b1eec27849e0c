"""Bytes of what vehicles and fusion nodes say to each other; FORMAT.md is the specification.

Writer and reader of each record stand side by side. Readers raise WireError, nothing else.
"""

from typing import Any, Final

import numpy as np

from fleet_seif.envelope import (
    ENTRIES_MAX,
    KIND_ACK,
    KIND_DELTA,
    KIND_HEARTBEAT,
    KIND_RANGE,
    KIND_SNAPSHOT,
    PARTS_MAX,
    SEQUENCE_MAX,
    STEP_MAX,
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
from fleet_seif.information import QUANTA_MAX, VARIABLE_MAX, FrameDelta, block_size, row_offsets
from fleet_seif.jit import kernel
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
from fleet_seif.records import Floats, Ints
from fleet_seif.varints import decode_ints, encode_ints

CORRELATION_MARGIN: Final = 1e-9
"""Least eigenvalue of a start pose's correlation matrix."""


@kernel
def _values_needed(variables: Ints, rows: Ints, cols: Ints) -> int:
    total = 0
    for k in range(len(rows)):
        total += block_size(variables[rows[k]], variables[cols[k]])
    return total


def _pack_delta(delta: FrameDelta) -> tuple[bytes, bytes, bytes, bytes]:
    places = delta.rows * len(delta.variables) + delta.cols
    return (
        encode_ints(np.diff(delta.variables, prepend=0)),
        encode_ints(np.diff(places, prepend=0)),
        encode_ints(delta.H),
        encode_ints(delta.b),
    )


def _read_delta(value: Any) -> FrameDelta:
    columns = []
    for name, data in zip(("variables", "blocks", "H", "b"), fields_of(value, 4, "delta"), strict=True):
        numbers = decode_ints(data) if type(data) is bytes else None
        if numbers is None:
            raise WireError(f"delta {name}: expected integers")
        if len(numbers) > ENTRIES_MAX:
            raise WireError(f"delta {name}: {len(numbers)} entries, at most {ENTRIES_MAX}")
        columns.append(numbers)
    steps, place_steps, H, b = columns
    for name, numbers in (("variables", steps), ("blocks", place_steps)):
        if len(numbers) and (numbers[0] < 0 or np.any(numbers[1:] <= 0) or np.any(numbers > STEP_MAX)):
            raise WireError(f"delta {name}: not ascending")
    variables, places = np.cumsum(steps), np.cumsum(place_steps)
    if len(variables) and variables[-1] > VARIABLE_MAX:
        raise WireError(f"delta: variable {variables[-1]}, at most {VARIABLE_MAX}")
    rows, cols = np.divmod(places, max(len(variables), 1))
    if len(places) and (places[-1] >= len(variables) ** 2 or places[0] < 0 or np.any(rows > cols)):
        raise WireError("delta: a block outside the upper triangle")
    if len(H) != _values_needed(variables, rows, cols) or len(b) != row_offsets(variables)[-1]:
        raise WireError("delta: number of values does not fit the blocks")
    for numbers in (H, b):
        if len(numbers) and not -QUANTA_MAX < numbers.min() <= numbers.max() < QUANTA_MAX:
            raise WireError("delta: a value reaches 2^60 quanta")
    return FrameDelta(variables=variables, rows=rows, cols=cols, H=H, b=b)


def _pack_part(part: FramePart) -> tuple[object, ...]:
    end = None if part.end_pose is None else raw_bytes(part.end_pose)
    return part.frame, int(part.status), _pack_delta(part.delta), end


def _read_part(value: Any) -> FramePart:
    frame, status, delta, end = fields_of(value, 4, "frame part")
    status = FrameStatus(int_of(status, 0, 3, "frame status"))
    ends = status in (FrameStatus.ENDED, FrameStatus.CORRECTED)
    if ends != (end is not None):
        raise WireError("frame part: an end pose belongs to frames that ended or are corrected, and only to those")
    return FramePart(
        frame=int_of(frame, 0, VARIABLE_MAX, "frame number"),
        status=status,
        delta=_read_delta(delta),
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
        hello.sighting_information_max,
        hello.sightings_max,
        None if c is None else (tuple(c.epoch), c.last, c.prefix_digest),
    )


def is_start_covariance(cov: Floats) -> bool:
    """Whether a start pose's covariance is symmetric and clearly positive definite: its inverse becomes a prior."""
    if not np.array_equal(cov, cov.T):
        return False
    scale = np.sqrt(np.maximum(np.diag(cov), 0.0))
    return bool(np.all(scale > 0) and np.linalg.eigvalsh(cov / np.outer(scale, scale))[0] > CORRELATION_MARGIN)


def _read_hello(value: Any) -> Hello:
    software, life, placed, pose, cov, information, sightings, continues = fields_of(value, 8, "hello")
    if continues is not None:
        epoch, last, digest = fields_of(continues, 3, "continues")
        continues = Continues(
            epoch=epoch_of(epoch),
            last=int_of(last, 0, SEQUENCE_MAX, "continues"),
            prefix_digest=digest_of(digest, "prefix"),
        )
    information_max = float_of(information, "sighting information")
    if not information_max > 0:
        raise WireError("sighting information: expected a positive number")
    start_pose_cov = array_of(cov, (3, 3), "start pose covariance")
    if np.any(start_pose_cov) and not is_start_covariance(start_pose_cov):
        raise WireError("start pose covariance: neither zeros nor symmetric and positive definite")
    return Hello(
        software=text_of(software, "software"),
        life=int_of(life, 0, VARIABLE_MAX, "life"),
        placed=bool_of(placed, "placed"),
        start_pose=array_of(pose, (3,), "start pose"),
        start_pose_cov=start_pose_cov,
        sighting_information_max=information_max,
        sightings_max=int_of(sightings, 1, ENTRIES_MAX, "sightings"),
        continues=continues,
    )


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


def encode_message(message: DeltaMessage) -> bytes:
    """Bytes of a DeltaMessage."""
    return seal(KIND_DELTA, _pack_message(message))


def decode_message(data: bytes) -> DeltaMessage:
    """A DeltaMessage from bytes. Raises WireError."""
    return _read_message(unseal(KIND_DELTA, data))


def encode_snapshot(snapshot: Snapshot) -> bytes:
    """Bytes of a Snapshot."""
    return seal(KIND_SNAPSHOT, (_pack_message(snapshot.message), snapshot.prefix_digest))


def decode_snapshot(data: bytes) -> Snapshot:
    """A Snapshot from bytes. Raises WireError."""
    message, digest = fields_of(unseal(KIND_SNAPSHOT, data), 2, "snapshot")
    snapshot = Snapshot(message=_read_message(message), prefix_digest=digest_of(digest, "prefix digest"))
    if snapshot.message.first != 0:
        raise WireError("snapshot: does not start at sequence 0")
    return snapshot


def encode_heartbeat(h: Heartbeat) -> bytes:
    """Bytes of a Heartbeat."""
    return seal(KIND_HEARTBEAT, (h.vehicle, tuple(h.epoch), h.last, h.prefix_digest, h.ended))


def decode_heartbeat(data: bytes) -> Heartbeat:
    """A Heartbeat from bytes. Raises WireError."""
    vehicle, epoch, last, digest, ended = fields_of(unseal(KIND_HEARTBEAT, data), 5, "heartbeat")
    return Heartbeat(
        vehicle=name_of(vehicle, "vehicle"),
        epoch=epoch_of(epoch),
        last=int_of(last, 0, SEQUENCE_MAX, "last"),
        prefix_digest=digest_of(digest, "prefix digest"),
        ended=bool_of(ended, "ended"),
    )


def encode_ack(a: Ack) -> bytes:
    """Bytes of an Ack."""
    return seal(KIND_ACK, (a.node, a.vehicle, tuple(a.epoch), a.last, a.prefix_digest))


def decode_ack(data: bytes) -> Ack:
    """An Ack from bytes. Raises WireError."""
    node, vehicle, epoch, last, digest = fields_of(unseal(KIND_ACK, data), 5, "ack")
    return Ack(
        node=name_of(node, "node"),
        vehicle=name_of(vehicle, "vehicle"),
        epoch=epoch_of(epoch),
        last=int_of(last, 0, SEQUENCE_MAX, "last"),
        prefix_digest=digest_of(digest, "prefix digest"),
    )


def encode_range(r: RangeRequest) -> bytes:
    """Bytes of a RangeRequest."""
    return seal(KIND_RANGE, (tuple(r.epoch), r.first, r.last, r.count))


def decode_range(data: bytes) -> RangeRequest:
    """A RangeRequest from bytes. Raises WireError."""
    epoch, first, last, count = fields_of(unseal(KIND_RANGE, data), 4, "range")
    first = int_of(first, 0, SEQUENCE_MAX, "first")
    return RangeRequest(
        epoch=epoch_of(epoch),
        first=first,
        last=int_of(last, first, SEQUENCE_MAX, "last"),
        count=int_of(count, 1, 4096, "count"),
    )
