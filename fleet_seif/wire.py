"""Bytes of the records in `messages`; FORMAT.md is the specification.

Writer and reader of each record stand side by side. Reading is strict: bytes that the writer would not make raise
WireError, nothing else.
"""

import hashlib
import math
from typing import Any, Final

import msgpack
import numpy as np

from fleet_seif.errors import WireError
from fleet_seif.information import QUANTA_MAX, VARIABLE_MAX, FrameDelta, block_size, row_offsets
from fleet_seif.jit import kernel
from fleet_seif.messages import (
    Ack,
    Continues,
    DeltaMessage,
    Epoch,
    FramePart,
    FrameStatus,
    Heartbeat,
    Hello,
    JointMap,
    LandmarkName,
    RangeRequest,
    Snapshot,
    VehicleState,
    check_name,
)
from fleet_seif.records import Floats, Ints
from fleet_seif.varints import decode_ints, encode_ints

MAGIC: Final = b"FSF"
VERSION: Final = 1
HEADER: Final = 5
DIGEST: Final = 32
MESSAGE_MAX: Final = 16 * 2**20
PARTS_MAX: Final = 64
ENTRIES_MAX: Final = 2**20
STEP_MAX: Final = ENTRIES_MAX**2  # of a column of ENTRIES_MAX steps: their sums stay below 2^63
SEQUENCE_MAX: Final = 2**53
PIECE_BYTES: Final = 48_000
PIECES_MAX: Final = 4096

KIND_DELTA: Final = 1
KIND_HEARTBEAT: Final = 2
KIND_ACK: Final = 3
KIND_RANGE: Final = 4
KIND_SNAPSHOT: Final = 5
KIND_PIECE: Final = 6
KIND_MAP: Final = 7


def _seal(kind: int, fields: object) -> bytes:
    head = MAGIC + bytes([VERSION, kind])
    body: bytes = msgpack.packb(fields)
    return head + hashlib.blake2b(head + body, digest_size=DIGEST).digest() + body


def _open(kind: int, data: bytes) -> Any:
    """The fields of a message of a kind, as tuples; types and ranges are the caller's to check."""
    if len(data) > MESSAGE_MAX:
        raise WireError(f"message of {len(data)} bytes: at most {MESSAGE_MAX}")
    if len(data) < HEADER + DIGEST or data[:3] != MAGIC:
        raise WireError("not a fleet_seif message")
    if data[3] != VERSION:
        raise WireError(f"message of format {data[3]}: this software reads format {VERSION}")
    if data[4] != kind:
        raise WireError(f"message of kind {data[4]} where kind {kind} belongs")
    body = data[HEADER + DIGEST :]
    if hashlib.blake2b(data[:HEADER] + body, digest_size=DIGEST).digest() != data[HEADER : HEADER + DIGEST]:
        raise WireError("digest does not match: damaged on the way")
    try:
        fields = msgpack.unpackb(body, use_list=False, raw=False, strict_map_key=True, max_array_len=ENTRIES_MAX)
        canonical = msgpack.packb(fields)
    except Exception as error:  # msgpack raises many kinds, and all of them mean bytes that are not ours
        raise WireError(f"body is not msgpack: {error!r}"[:200]) from None
    if canonical != body:
        raise WireError("body is not in its one canonical form")
    return fields


def body_digest(data: bytes) -> bytes:
    """The digest inside an encoded message, 32 bytes; it covers kind, version and body."""
    return data[HEADER : HEADER + DIGEST]


def _fields(value: Any, count: int, what: str) -> tuple[Any, ...]:
    if not isinstance(value, tuple) or len(value) != count:
        raise WireError(f"{what}: expected {count} fields")
    return value


def _items(value: Any, count_max: int, what: str) -> tuple[Any, ...]:
    if not isinstance(value, tuple) or len(value) > count_max:
        raise WireError(f"{what}: expected a list of at most {count_max}")
    return value


def _int(value: Any, low: int, high: int, what: str) -> int:
    if type(value) is not int or not low <= value <= high:
        raise WireError(f"{what}: expected an integer from {low} to {high}")
    return value


def _float(value: Any, what: str) -> float:
    if type(value) is not float or not math.isfinite(value):
        raise WireError(f"{what}: expected a finite float")
    return value


def _bool(value: Any, what: str) -> bool:
    if type(value) is not bool:
        raise WireError(f"{what}: expected true or false")
    return value


def _digest(value: Any, what: str) -> bytes:
    if type(value) is not bytes or len(value) != DIGEST:
        raise WireError(f"{what}: expected {DIGEST} bytes")
    return value


def _text(value: Any, what: str) -> str:
    if type(value) is not str or len(value) > 200:
        raise WireError(f"{what}: expected a text of at most 200 characters")
    return value


def _name(value: Any, what: str) -> str:
    try:
        return check_name(_text(value, what), what)
    except ValueError as error:
        raise WireError(str(error)) from None


def _array(value: Any, shape: tuple[int, ...], what: str) -> Floats:
    """An array of finite float64; a first dimension of -1 follows the length."""
    step = math.prod(k for k in shape if k >= 0) * 8
    if type(value) is not bytes or len(value) % 8 or (len(value) != step if shape[0] >= 0 else len(value) % step):
        raise WireError(f"{what}: expected float64 numbers of shape {shape}")
    array = np.frombuffer(value, "<f8").reshape(shape).copy()
    if not np.all(np.isfinite(array)):
        raise WireError(f"{what}: a number is not finite")
    return array


def _raw(array: Floats) -> bytes:
    return np.ascontiguousarray(array, "<f8").tobytes()


def _epoch(value: Any) -> Epoch:
    counter, nonce = _fields(value, 2, "epoch")
    return Epoch(_int(counter, 0, SEQUENCE_MAX, "epoch counter"), _int(nonce, 0, 2**64 - 1, "epoch nonce"))


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
    for name, data in zip(("variables", "blocks", "H", "b"), _fields(value, 4, "delta"), strict=True):
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
    end = None if part.end_pose is None else _raw(part.end_pose)
    return part.frame, int(part.status), _pack_delta(part.delta), end


def _read_part(value: Any) -> FramePart:
    frame, status, delta, end = _fields(value, 4, "frame part")
    status = FrameStatus(_int(status, 0, 3, "frame status"))
    ends = status in (FrameStatus.ENDED, FrameStatus.CORRECTED)
    if ends != (end is not None):
        raise WireError("frame part: an end pose belongs to frames that ended or are corrected, and only to those")
    return FramePart(
        frame=_int(frame, 0, VARIABLE_MAX, "frame number"),
        status=status,
        delta=_read_delta(delta),
        end_pose=_array(end, (3,), "end pose") if ends else None,
    )


def _pack_hello(hello: Hello) -> tuple[object, ...]:
    c = hello.continues
    return (
        hello.software,
        hello.life,
        hello.placed,
        _raw(hello.start_pose),
        _raw(hello.start_pose_cov),
        hello.sighting_information_max,
        hello.sightings_max,
        None if c is None else (tuple(c.epoch), c.last, c.prefix_digest),
    )


def _read_hello(value: Any) -> Hello:
    software, life, placed, pose, cov, information, sightings, continues = _fields(value, 8, "hello")
    if continues is not None:
        epoch, last, digest = _fields(continues, 3, "continues")
        continues = Continues(
            epoch=_epoch(epoch), last=_int(last, 0, SEQUENCE_MAX, "continues"), prefix_digest=_digest(digest, "prefix")
        )
    start_pose_cov = _array(cov, (3, 3), "start pose covariance")
    if np.any(start_pose_cov) and not (
        np.array_equal(start_pose_cov, start_pose_cov.T) and np.linalg.eigvalsh(start_pose_cov)[0] > 0
    ):
        raise WireError("start pose covariance: neither zeros nor symmetric and positive definite")
    return Hello(
        software=_text(software, "software"),
        life=_int(life, 0, VARIABLE_MAX, "life"),
        placed=_bool(placed, "placed"),
        start_pose=_array(pose, (3,), "start pose"),
        start_pose_cov=start_pose_cov,
        sighting_information_max=_float(information, "sighting information"),
        sightings_max=_int(sightings, 1, ENTRIES_MAX, "sightings"),
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
     healthy, innovation, dof, refused, hello, end) = _fields(value, 16, "message")  # fmt: skip
    first = _int(first, 0, SEQUENCE_MAX, "first")
    if (first == 0) != (hello is not None):
        raise WireError("a hello belongs to sequence 0, and only there")
    return DeltaMessage(
        fleet=_name(fleet, "fleet"),
        vehicle=_name(vehicle, "vehicle"),
        epoch=_epoch(epoch),
        first=first,
        last=_int(last, first, SEQUENCE_MAX, "last"),
        step=_int(step, 0, SEQUENCE_MAX, "step"),
        time_s=_float(time_s, "time"),
        parts=tuple(_read_part(part) for part in _items(parts, PARTS_MAX, "parts")),
        landmarks=tuple(_read_landmark(item) for item in _items(landmarks, ENTRIES_MAX, "landmarks")),
        aliases=tuple(_read_alias(item) for item in _items(aliases, ENTRIES_MAX, "aliases")),
        healthy=_bool(healthy, "health"),
        innovation=_float(innovation, "innovation"),
        innovation_dof=_int(dof, 0, SEQUENCE_MAX, "degrees of freedom"),
        refused=_int(refused, 0, SEQUENCE_MAX, "refused"),
        hello=None if hello is None else _read_hello(hello),
        end=_bool(end, "end"),
    )


def _read_landmark(value: Any) -> tuple[int, int]:
    number, signature = _fields(value, 2, "landmark")
    return _int(number, 0, VARIABLE_MAX - 1, "landmark"), _int(signature, -1, 2**63 - 1, "signature")


def _read_alias(value: Any) -> tuple[int, int, bool]:
    a, b, added = _fields(value, 3, "alias")
    limit = VARIABLE_MAX - 1
    return _int(a, 0, limit, "alias"), _int(b, 0, limit, "alias"), _bool(added, "alias")


def encode_message(message: DeltaMessage) -> bytes:
    """Bytes of a DeltaMessage."""
    return _seal(KIND_DELTA, _pack_message(message))


def decode_message(data: bytes) -> DeltaMessage:
    """A DeltaMessage from bytes. Raises WireError."""
    return _read_message(_open(KIND_DELTA, data))


def encode_snapshot(snapshot: Snapshot) -> bytes:
    """Bytes of a Snapshot."""
    return _seal(KIND_SNAPSHOT, (_pack_message(snapshot.message), snapshot.prefix_digest))


def decode_snapshot(data: bytes) -> Snapshot:
    """A Snapshot from bytes. Raises WireError."""
    message, digest = _fields(_open(KIND_SNAPSHOT, data), 2, "snapshot")
    snapshot = Snapshot(message=_read_message(message), prefix_digest=_digest(digest, "prefix digest"))
    if snapshot.message.first != 0:
        raise WireError("snapshot: does not start at sequence 0")
    return snapshot


def kind_of(data: bytes) -> int:
    """The kind a message claims to be, 0 for bytes that are not ours."""
    return data[4] if len(data) > HEADER and data[:3] == MAGIC else 0


def encode_heartbeat(h: Heartbeat) -> bytes:
    """Bytes of a Heartbeat."""
    return _seal(KIND_HEARTBEAT, (h.vehicle, tuple(h.epoch), h.last, h.prefix_digest, h.ended))


def decode_heartbeat(data: bytes) -> Heartbeat:
    """A Heartbeat from bytes. Raises WireError."""
    vehicle, epoch, last, digest, ended = _fields(_open(KIND_HEARTBEAT, data), 5, "heartbeat")
    return Heartbeat(
        vehicle=_name(vehicle, "vehicle"),
        epoch=_epoch(epoch),
        last=_int(last, 0, SEQUENCE_MAX, "last"),
        prefix_digest=_digest(digest, "prefix digest"),
        ended=_bool(ended, "ended"),
    )


def encode_ack(a: Ack) -> bytes:
    """Bytes of an Ack."""
    return _seal(KIND_ACK, (a.node, a.vehicle, tuple(a.epoch), a.last, a.prefix_digest))


def decode_ack(data: bytes) -> Ack:
    """An Ack from bytes. Raises WireError."""
    node, vehicle, epoch, last, digest = _fields(_open(KIND_ACK, data), 5, "ack")
    return Ack(
        node=_name(node, "node"),
        vehicle=_name(vehicle, "vehicle"),
        epoch=_epoch(epoch),
        last=_int(last, 0, SEQUENCE_MAX, "last"),
        prefix_digest=_digest(digest, "prefix digest"),
    )


def encode_range(r: RangeRequest) -> bytes:
    """Bytes of a RangeRequest."""
    return _seal(KIND_RANGE, (tuple(r.epoch), r.first, r.last, r.count))


def decode_range(data: bytes) -> RangeRequest:
    """A RangeRequest from bytes. Raises WireError."""
    epoch, first, last, count = _fields(_open(KIND_RANGE, data), 4, "range")
    first = _int(first, 0, SEQUENCE_MAX, "first")
    return RangeRequest(
        epoch=_epoch(epoch),
        first=first,
        last=_int(last, first, SEQUENCE_MAX, "last"),
        count=_int(count, 1, 4096, "count"),
    )


def encode_map(joint: JointMap) -> bytes:
    """Bytes of a JointMap."""
    return _seal(
        KIND_MAP,
        (
            (joint.fleet, joint.version, joint.canonical, joint.final, joint.map_digest, joint.ledger_digest),
            (_raw(joint.landmark_mean), _raw(joint.landmark_cov), joint.cov_version),
            tuple(tuple(tuple(name) for name in names) for names in joint.names),
            joint.signature,
            (joint.poses, _raw(joint.pose_mean), _raw(joint.pose_cov)),
            tuple(_pack_state(state) for state in joint.vehicles),
            joint.counters,
        ),
    )


def _pack_state(s: VehicleState) -> tuple[object, ...]:
    counts = (s.cut, s.behind, s.parked, s.duplicates, s.gaps_repaired, s.refused)
    return s.name, s.life, tuple(s.epoch), counts, (s.stalled, s.ended, s.healthy)


def _read_state(value: Any) -> VehicleState:
    name, life, epoch, counts, flags = _fields(value, 5, "vehicle state")
    numbers = [_int(n, -1, SEQUENCE_MAX, "count") for n in _fields(counts, 6, "counts")]
    stalled, ended, healthy = (_bool(flag, "flag") for flag in _fields(flags, 3, "flags"))
    return VehicleState(
        name=_name(name, "vehicle"),
        life=_int(life, 0, VARIABLE_MAX, "life"),
        epoch=_epoch(epoch),
        cut=numbers[0],
        behind=numbers[1],
        parked=numbers[2],
        duplicates=numbers[3],
        gaps_repaired=numbers[4],
        refused=numbers[5],
        stalled=stalled,
        ended=ended,
        healthy=healthy,
    )


def _read_landmark_name(value: Any) -> LandmarkName:
    vehicle, life, number = _fields(value, 3, "landmark name")
    return LandmarkName(_name(vehicle, "vehicle"), _int(life, 0, VARIABLE_MAX, "life"), _int(number, 0, 2**31, "n"))


def decode_map(data: bytes) -> JointMap:
    """A JointMap from bytes. Raises WireError."""
    head, landmarks, names, signature, poses, vehicles, counters = _fields(_open(KIND_MAP, data), 7, "map")
    fleet, version, canonical, final, map_digest, ledger_digest = _fields(head, 6, "map head")
    mean, cov, cov_version = _fields(landmarks, 3, "map landmarks")
    pose_names, pose_mean, pose_cov = _fields(poses, 3, "map poses")
    if not isinstance(counters, dict):
        raise WireError("map counters: expected a table")
    joint = JointMap(
        fleet=_name(fleet, "fleet"),
        version=_int(version, 0, SEQUENCE_MAX, "version"),
        canonical=_bool(canonical, "canonical"),
        final=_bool(final, "final"),
        map_digest=_digest(map_digest, "map digest"),
        ledger_digest=_digest(ledger_digest, "ledger digest"),
        landmark_mean=_array(mean, (-1, 2), "landmark means"),
        landmark_cov=_array(cov, (-1, 2, 2), "landmark covariances"),
        cov_version=_int(cov_version, -1, SEQUENCE_MAX, "covariance version"),
        names=tuple(
            tuple(_read_landmark_name(name) for name in _items(group, ENTRIES_MAX, "names"))
            for group in _items(names, ENTRIES_MAX, "landmark names")
        ),
        signature=tuple(_int(s, -1, 2**63 - 1, "signature") for s in _items(signature, ENTRIES_MAX, "signatures")),
        poses=tuple(_name(name, "vehicle") for name in _items(pose_names, ENTRIES_MAX, "poses")),
        pose_mean=_array(pose_mean, (-1, 3), "poses"),
        pose_cov=_array(pose_cov, (-1, 3, 3), "pose covariances"),
        vehicles=tuple(_read_state(state) for state in _items(vehicles, ENTRIES_MAX, "vehicles")),
        counters={_text(key, "counter"): _int(n, 0, SEQUENCE_MAX, "counter") for key, n in counters.items()},
    )
    n = len(joint.landmark_mean)
    if len(joint.names) != n or len(joint.signature) != n or len(joint.landmark_cov) not in (0, n):
        raise WireError("map: tables of landmarks differ in length")
    if len(joint.pose_mean) != len(joint.poses) or len(joint.pose_cov) not in (0, len(joint.poses)):
        raise WireError("map: tables of poses differ in length")
    return joint


def map_pieces(data: bytes, version: int) -> list[bytes]:
    """An encoded map in pieces that fit small links; each says which version it belongs to."""
    chunks = [data[i : i + PIECE_BYTES] for i in range(0, len(data), PIECE_BYTES)]
    return [_seal(KIND_PIECE, (version, k, len(chunks), chunk)) for k, chunk in enumerate(chunks)]


def read_piece(data: bytes) -> tuple[int, int, int, bytes]:
    """Version, index, count and bytes of a piece. Raises WireError."""
    version, index, count, chunk = _fields(_open(KIND_PIECE, data), 4, "piece")
    count = _int(count, 1, PIECES_MAX, "pieces")
    if type(chunk) is not bytes or len(chunk) > PIECE_BYTES:
        raise WireError(f"piece: expected at most {PIECE_BYTES} bytes")
    return _int(version, 0, SEQUENCE_MAX, "version"), _int(index, 0, count - 1, "piece"), count, chunk
