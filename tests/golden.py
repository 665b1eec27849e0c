"""Golden messages: records written by hand, their bytes (`golden/*.bin`) and the same for people (`golden/*.json`).

The files change by one command only: `python -m tests.golden --rewrite`. Whoever runs it changes the format, and says
so in FORMAT.md.
"""

import argparse
import json
import re
import typing
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from fleet_seif import envelope, map_wire, merge_wire, node_wire, wire
from fleet_seif.information import QUANTA_MAX, VARIABLE_MAX, FrameDelta, block_size, row_offsets, variable_size
from fleet_seif.map_wire import Piece
from fleet_seif.merge_records import Differing, KeptApart, MergeReport, Reason
from fleet_seif.messages import (
    Ack,
    Action,
    Continues,
    DeltaMessage,
    Epoch,
    Evidence,
    FramePart,
    FrameStatus,
    Heartbeat,
    Hello,
    JointMap,
    LandmarkName,
    NodeStatus,
    OperatorEvent,
    RangeRequest,
    Snapshot,
    StreamPosition,
    VehicleState,
)
from fleet_seif.records import Floats
from fleet_seif.signing import KeyRing, Role, Signer

FOLDER = Path(__file__).parent / "golden"
FLEET = "f"
SEQUENCE_MAX = 2**53


def signer(role: Role, name: str, seed: int) -> Signer:
    """The test key of somebody: 32 bytes that count up from a seed. For tests and nothing else."""
    return Signer(FLEET, role, name, bytes(range(seed, seed + 32)))


VEHICLE = signer(Role.VEHICLE, "v1", 0)
NODE = signer(Role.NODE, "fusion", 1)
OPERATOR = signer(Role.OPERATOR, "ops", 2)
RING = KeyRing(FLEET, {(s.role, s.name): s.public_key() for s in (VEHICLE, NODE, OPERATOR)})


@dataclass(frozen=True)
class Kind:
    """A kind of message: its number, its record, and its writer and reader."""

    number: int
    record: type
    encode: Callable[[Any, Signer | None], bytes]
    decode: Callable[[bytes], Any]


def encode_piece(piece: Piece, by: Signer | None = None) -> bytes:
    """A single piece, which the library writes with its neighbours only (`map_pieces`)."""
    return envelope.seal(envelope.KIND_PIECE, (piece.node, piece.version, piece.index, piece.count, piece.data), by)


KINDS = {
    "delta": Kind(1, DeltaMessage, wire.encode_message, wire.decode_message),
    "heartbeat": Kind(2, Heartbeat, wire.encode_heartbeat, wire.decode_heartbeat),
    "ack": Kind(3, Ack, wire.encode_ack, wire.decode_ack),
    "range": Kind(4, RangeRequest, wire.encode_range, wire.decode_range),
    "snapshot": Kind(5, Snapshot, wire.encode_snapshot, wire.decode_snapshot),
    "piece": Kind(6, Piece, encode_piece, map_wire.read_piece),
    "map": Kind(7, JointMap, map_wire.encode_map, map_wire.decode_map),
    "event": Kind(8, OperatorEvent, node_wire.encode_event, node_wire.decode_event),
    "status": Kind(9, NodeStatus, node_wire.encode_status, node_wire.decode_status),
    "evidence": Kind(10, Evidence, node_wire.encode_evidence, node_wire.decode_evidence),
    "merges": Kind(11, MergeReport, merge_wire.encode_merges, merge_wire.decode_merges),
}


# The records.


def delta_of(blocks: dict[tuple[int, int], list[int]], b: dict[int, list[int]]) -> FrameDelta:
    """A delta from its blocks, by variables, and its vectors. Zeros where a variable of a block has no vector."""
    names = sorted({v for pair in blocks for v in pair} | set(b))
    at = {v: i for i, v in enumerate(names)}
    places = sorted((at[i], at[j]) for i, j in blocks)
    H = [x for i, j in places for x in blocks[names[i], names[j]]]
    vector = [x for v in names for x in b.get(v, [0] * variable_size(v))]
    return FrameDelta(
        variables=np.array(names, np.int64),
        rows=np.array([i for i, _ in places], np.int64),
        cols=np.array([j for _, j in places], np.int64),
        H=np.array(H, np.int64),
        b=np.array(vector, np.int64),
    )


NOTHING = FrameDelta.nothing()
STEP = delta_of({(0, 0): [1, 0, 0, 2, 0, 3], (0, 3): [-1, 0, 0, -2, 0, 0], (3, 3): [100, 0, -100]},
                {0: [5, 0, 0], 3: [-7, 300]})  # fmt: skip
"""The example of FORMAT.md, section 5."""
START = delta_of({(0, 0): [2**48, 0, 0, 2**48, 0, 2**48]}, {})
EDGE = delta_of(
    {
        (0, VARIABLE_MAX): [QUANTA_MAX - 1, 1 - QUANTA_MAX, 0, 64, -64, -65],
        (1, 2): [63, -1, 8191, -8192],
        (VARIABLE_MAX, VARIABLE_MAX): [QUANTA_MAX - 1, 0, 1 - QUANTA_MAX],
    },
    {0: [0, 1 - QUANTA_MAX, 0], VARIABLE_MAX: [0, QUANTA_MAX - 1]},
)
"""The largest numbers that there are."""
COV = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, -0.002], [0.0, -0.002, 0.0025]])
DIGEST_1, DIGEST_2 = bytes(range(32)), bytes(range(100, 132))
GIVEN = Hello(
    software="by hand", life=0, placed=True, start_pose=np.array([1.5, -2.0, 0.25]), start_pose_cov=np.zeros((3, 3)),
    start_information=1e6, step_information_max=1e9,
)  # fmt: skip
CONTINUING = Hello(
    software="", life=3, placed=True, start_pose=np.array([1.5, -2.0, 7.0]), start_pose_cov=COV, start_information=0.5,
    step_information_max=2.0**-20, continues=Continues(epoch=Epoch(1, 7), last=41, prefix_digest=DIGEST_1),
)  # fmt: skip
UNPLACED = Hello(
    software="é" * 200, life=VARIABLE_MAX, placed=False, start_pose=np.array([-0.0, 5e-324, -1e9]),
    start_pose_cov=np.zeros((3, 3)), start_information=1e9, step_information_max=1e9,
)  # fmt: skip


def part(status: FrameStatus, delta: FrameDelta = NOTHING, frame: int = 0) -> FramePart:
    ends = status in (FrameStatus.ENDED, FrameStatus.CORRECTED)
    end_pose = np.array([3.25, -0.5, 6.5]) if ends else None
    return FramePart(frame=frame, status=status, delta=delta, end_pose=end_pose)


def message(first: int, last: int | None = None, **changes: Any) -> DeltaMessage:
    last = first if last is None else last
    plain: dict[str, Any] = {
        "fleet": FLEET, "vehicle": "v1", "epoch": Epoch(0, 7), "first": first, "last": last, "step": last,
        "time_s": 0.5 * last, "parts": (), "hello": GIVEN if first == 0 else None,
    }  # fmt: skip
    return DeltaMessage(**{**plain, **changes})


OPENED, CONTINUED, ENDED, CORRECTED = FrameStatus
WHOLE = (part(OPENED, STEP), part(ENDED), part(OPENED, START, frame=1))
STATE = VehicleState(
    name="v1", life=0, epoch=Epoch(0, 7), cut=12, checked=4, behind=3, parked=1, duplicates=2, gaps_repaired=0,
    refused=0, placed=True, stalled=False, ended=False, healthy=True,
)  # fmt: skip
STOPPED = VehicleState(
    name="v2", life=1, epoch=Epoch(SEQUENCE_MAX, 2**64 - 1), cut=-1, checked=-1, behind=SEQUENCE_MAX, parked=0,
    duplicates=0, gaps_repaired=0, refused=7, placed=False, stalled=True, ended=True, healthy=False,
    fault="it contradicts itself from message 5 on",
)  # fmt: skip
MAP = JointMap(
    fleet=FLEET, node="fusion", version=17, canonical=False, final=False, map_digest=DIGEST_1, ledger_digest=DIGEST_2,
    landmark_mean=np.array([[1.0, 2.0], [-3.5, 0.125]]),
    landmark_cov=np.array([[[0.01, 0.001], [0.001, 0.02]], [[0.5, 0.0], [0.0, 0.25]]]), cov_version=15,
    names=((LandmarkName("v1", 0, 0), LandmarkName("v2", 1, 4)), (LandmarkName("v1", 0, 1),)), signature=(9000, -1),
    poses=("v1",), pose_mean=np.array([[0.5, 0.25, -0.125]]), pose_cov=np.array([np.diag([0.01, 0.02, 0.03])]),
    vehicles=(STATE, STOPPED), counters={"forks": 0, "malformed": 3},
)  # fmt: skip
MAP_WITHOUT = JointMap(
    fleet=FLEET, node="fusion", version=SEQUENCE_MAX, canonical=True, final=True, map_digest=DIGEST_1,
    ledger_digest=DIGEST_2, landmark_mean=np.array([[1e6, -1e6]]), landmark_cov=np.empty((0, 2, 2)), cov_version=-1,
    names=((LandmarkName("v1", 0, VARIABLE_MAX),),), signature=(2**63 - 1,), poses=("v1", "v2"),
    pose_mean=np.array([[0.0, -0.0, 0.0], [1.0, 2.0, 3.0]]), pose_cov=np.empty((0, 3, 3)), vehicles=(),
)  # fmt: skip
MAP_EMPTY = JointMap(
    fleet=FLEET, node="fusion", version=0, canonical=True, final=False, map_digest=bytes(32), ledger_digest=bytes(32),
    landmark_mean=np.empty((0, 2)), landmark_cov=np.empty((0, 2, 2)), cov_version=-1, names=(), signature=(),
    poses=(), pose_mean=np.empty((0, 3)), pose_cov=np.empty((0, 3, 3)), vehicles=(),
)  # fmt: skip
PAIR = (LandmarkName("v1", 0, 2), LandmarkName("v2", 0, 5))


def event(action: Action, number: int = 1) -> OperatorEvent:
    about = {"vehicle": "v2"} if action in (Action.RETRACT, Action.RESTORE) else {"landmarks": PAIR}
    return OperatorEvent(fleet=FLEET, number=number, operator="ops", action=action, **about)


SAID = Heartbeat(
    fleet=FLEET, vehicle="v1", epoch=Epoch(0, 7), last=130, prefix_digest=DIGEST_1, checked=128,
    checked_digest=DIGEST_2, ended=False,
)  # fmt: skip
SILENT = Heartbeat(
    fleet=FLEET, vehicle="v1", epoch=Epoch(0, 0), last=0, prefix_digest=DIGEST_1, checked=-1, checked_digest=bytes(32),
    ended=False,
)  # fmt: skip
OVER = Heartbeat(
    fleet=FLEET, vehicle="v1", epoch=Epoch(SEQUENCE_MAX, 2**64 - 1), last=SEQUENCE_MAX, prefix_digest=DIGEST_1,
    checked=SEQUENCE_MAX, checked_digest=DIGEST_1, ended=True,
)  # fmt: skip
HELD = Ack(fleet=FLEET, node="fusion", vehicle="v1", epoch=Epoch(0, 7), last=130, prefix_digest=DIGEST_1)
FAULT = Ack(
    fleet=FLEET, node="fusion", vehicle="v1", epoch=Epoch(0, 7), last=0, prefix_digest=bytes(32),
    fault="message 64: the information in frame 0 is not positive definite",
)  # fmt: skip
POSITIONS = (
    StreamPosition("v1", Epoch(0, 7), 130, DIGEST_1, b""),
    StreamPosition("v2", Epoch(0, 2**63), -1, bytes(32), DIGEST_2),
)
KNOWN = NodeStatus(fleet=FLEET, node="fusion", streams=POSITIONS, events=DIGEST_2)
RANGE = RangeRequest(fleet=FLEET, vehicle="v1", epoch=Epoch(0, 7), first=64, last=127, count=256)
RANGE_EDGE = RangeRequest(
    fleet="-" * 32, vehicle="_" * 32, epoch=Epoch(0, 0), first=SEQUENCE_MAX, last=SEQUENCE_MAX, count=4096
)
ONE, OTHER, THIRD = LandmarkName("v1", 0, 3), LandmarkName("v2", 1, 0), LandmarkName("v3", 0, VARIABLE_MAX)
MERGES = MergeReport(
    fleet=FLEET, node="fusion", version=17, canonical=True, map_digest=DIGEST_1, ledger_digest=DIGEST_2,
    kept_apart=((Reason.AMBIGUOUS, 12), (Reason.UNSOLVED, 1)),
    nearest=(KeptApart(ONE, OTHER, Reason.AMBIGUOUS, 2.5), KeptApart(OTHER, THIRD, Reason.UNSOLVED, None)),
    differing=(Differing("fusion2", (ONE, OTHER), ((ONE,), (OTHER, THIRD))), Differing("n", (THIRD,), ())),
)  # fmt: skip
MERGES_EMPTY = MergeReport(
    fleet="-" * 32, node="_" * 32, version=SEQUENCE_MAX, canonical=False, map_digest=bytes(32), ledger_digest=bytes(32),
    kept_apart=(), nearest=(),
)  # fmt: skip

Example = tuple[Any, Signer | None]
EXAMPLES: dict[str, Example] = {
    "delta-step": (message(
        1, parts=(part(CONTINUED, STEP),), landmarks=((2, 9),), innovation=1.5, innovation_dof=2
    ), None),
    "delta-step-signed": (message(
        1, parts=(part(CONTINUED, STEP),), landmarks=((2, 9),), innovation=1.5, innovation_dof=2
    ), VEHICLE),
    "delta-hello": (message(0, parts=(part(OPENED, START),)), VEHICLE),
    "delta-continues": (message(0, epoch=Epoch(2, 2**64 - 1), hello=CONTINUING), None),
    "delta-unplaced": (message(0, hello=UNPLACED, parts=(part(OPENED, START),)), None),
    "delta-empty": (message(2, parts=(part(CONTINUED),), healthy=False), None),
    "delta-no-parts": (message(3), None),
    "delta-coalesced": (message(
        60, 70, parts=(part(CONTINUED, STEP),), landmarks=((3, -1), (4, 0)), innovation=12.25, innovation_dof=18,
        refused=4,
    ), None),
    "delta-opened-and-ended": (message(0, parts=WHOLE, landmarks=((0, 5), (1, 6), (2, 7))), None),
    "delta-corrected": (message(5, parts=(part(CORRECTED, STEP), part(CONTINUED, NOTHING, frame=1))), None),
    "delta-end": (message(6, parts=(part(ENDED, frame=1),), end=True), VEHICLE),
    "delta-largest": (message(
        SEQUENCE_MAX, epoch=Epoch(SEQUENCE_MAX, 2**64 - 1), fleet="F" * 32, vehicle="aA0-_" + "z" * 27, time_s=-1.5e308,
        parts=(part(CORRECTED, EDGE, frame=VARIABLE_MAX),), landmarks=((VARIABLE_MAX - 1, 2**63 - 1),),
        aliases=((0, VARIABLE_MAX - 1, True), (7, 3, False)), healthy=False, innovation=-0.0,
        innovation_dof=SEQUENCE_MAX, refused=SEQUENCE_MAX, end=True,
    ), None),
    "heartbeat": (SAID, VEHICLE),
    "heartbeat-nothing-checked": (SILENT, None),
    "heartbeat-ended": (OVER, None),
    "ack": (HELD, NODE),
    "ack-fault": (FAULT, None),
    "range": (RANGE, None),
    "range-edge": (RANGE_EDGE, NODE),
    "snapshot-by-vehicle": (Snapshot(
        message=message(0, 64, parts=(part(OPENED, STEP),), landmarks=((0, 5), (1, 6), (2, 7))), prefix_digest=DIGEST_1
    ), VEHICLE),
    "snapshot-by-node": (Snapshot(message=message(0, 5, parts=WHOLE, end=True), prefix_digest=DIGEST_2, maker="fusion"),
                         NODE),
    "piece": (Piece(node="fusion", version=17, index=0, count=2, data=bytes(range(256))), None),
    "piece-last": (Piece(node="n", version=SEQUENCE_MAX, index=4095, count=4096, data=b""), None),
    "map": (MAP, NODE),
    "map-without-covariances": (MAP_WITHOUT, None),
    "map-empty": (MAP_EMPTY, None),
    "event-force": (event(Action.FORCE), OPERATOR),
    "event-forbid": (event(Action.FORBID), None),
    "event-release": (event(Action.RELEASE, SEQUENCE_MAX), None),
    "event-retract": (event(Action.RETRACT), OPERATOR),
    "event-restore": (event(Action.RESTORE), None),
    "status": (KNOWN, NODE),
    "status-empty": (NodeStatus(fleet=FLEET, node="fusion", streams=(), events=bytes(32)), None),
    "evidence": (Evidence(
        first=wire.encode_message(message(5, parts=(part(CONTINUED, STEP),))),
        second=wire.encode_message(message(4, 6), VEHICLE),
    ), None),
    "evidence-empty": (Evidence(first=b"", second=b""), None),
    "merges": (MERGES, NODE),
    "merges-empty": (MERGES_EMPTY, None),
}  # fmt: skip
"""Name and record; the name begins with the kind. Who signs it, None: nobody."""


def kind_of(name: str) -> Kind:
    return KINDS[name.split("-")[0]]


def encoded(name: str) -> bytes:
    """The bytes of an example."""
    record, by = EXAMPLES[name]
    return kind_of(name).encode(record, by)


# Records for people: what is named is an object, binary is hexadecimal, a delta shows its blocks by variable.

SHAPES = {
    "start_pose": (3,), "start_pose_cov": (3, 3), "end_pose": (3,), "landmark_mean": (-1, 2),
    "landmark_cov": (-1, 2, 2), "pose_mean": (-1, 3), "pose_cov": (-1, 3, 3),
}  # fmt: skip


def to_json(value: Any) -> Any:
    """A record as what JSON can say."""
    if isinstance(value, FrameDelta):
        return _delta_to_json(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Enum):
        return value.name.lower()
    if is_dataclass(value):
        return {f.name: to_json(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, tuple):
        named = getattr(value, "_fields", None)
        return [to_json(x) for x in value] if named is None else dict(zip(named, map(to_json, value), strict=True))
    return value


def _delta_to_json(delta: FrameDelta) -> Any:
    names, H, starts = delta.variables.tolist(), delta.H.tolist(), row_offsets(delta.variables)
    blocks, at = [], 0
    for i, j in zip(delta.rows.tolist(), delta.cols.tolist(), strict=True):
        size = block_size(names[i], names[j])
        blocks.append({"row": names[i], "column": names[j], "H": H[at : at + size]})
        at += size
    b = [delta.b[starts[i] : starts[i + 1]].tolist() for i in range(len(names))]
    return {"variables": names, "blocks": blocks, "b": b}


def _delta_from_json(value: Any) -> FrameDelta:
    blocks = {(block["row"], block["column"]): block["H"] for block in value["blocks"]}
    return delta_of(blocks, dict(zip(value["variables"], value["b"], strict=True)))


def from_json(type_: Any, value: Any, name: str = "") -> Any:
    """The record of a type that `to_json` has described."""
    origin, args = typing.get_origin(type_), typing.get_args(type_)
    if type_ is FrameDelta:
        return _delta_from_json(value)
    if type_ is Floats:
        return np.array(value, np.float64).reshape(SHAPES[name])
    if type_ is bytes:
        return bytes.fromhex(value)
    if NoneType in args:
        return None if value is None else from_json(next(a for a in args if a is not NoneType), value, name)
    if origin is tuple:
        types = [args[0]] * len(value) if args[-1] is Ellipsis else args
        return tuple(from_json(t, v) for t, v in zip(types, value, strict=True))
    if isinstance(type_, type) and issubclass(type_, Enum):
        return type_[value.upper()]
    if is_dataclass(type_) or hasattr(type_, "_fields"):
        hints = typing.get_type_hints(type_)
        return type_(**{key: from_json(hints[key], each, key) for key, each in value.items()})
    return value


def json_of(name: str, data: bytes) -> str:
    """The twin of an example's bytes."""
    record, by = kind_of(name).decode(data), EXAMPLES[name][1]
    whole = {
        "kind": data[4],
        "version": data[3],
        "digest": envelope.body_digest(data).hex(),
        "signed_by": None if by is None else f"{by.role} {by.name}",
        "bytes": len(data),
        "record": to_json(record),
    }
    text = json.dumps(whole, indent=1)
    return re.sub(r"\[[^][{}]*]", lambda numbers: " ".join(numbers.group().split()), text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description="Golden messages.")
    parser.add_argument("--rewrite", action="store_true", required=True, help="write all files anew from the examples")
    parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    for old in [*FOLDER.glob("*.bin"), *FOLDER.glob("*.json")]:
        old.unlink()
    for name in EXAMPLES:
        data = encoded(name)
        (FOLDER / f"{name}.bin").write_bytes(data)
        (FOLDER / f"{name}.json").write_text(json_of(name, data))
    size = sum(path.stat().st_size for path in FOLDER.iterdir())
    print(f"{len(EXAMPLES)} messages, {size} bytes in {FOLDER}")


if __name__ == "__main__":
    main()
