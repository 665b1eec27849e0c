"""The records that travel between processes. `wire` writes and reads their bytes, FORMAT.md specifies them."""

import re
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from functools import lru_cache
from typing import Final, NamedTuple

from fleet_seif.information import FrameDelta
from fleet_seif.records import Floats

NAME_MAX: Final = 32
_NAME = re.compile(rf"[A-Za-z0-9_-]{{1,{NAME_MAX}}}")


@lru_cache(maxsize=4096)
def check_name(name: str, what: str) -> str:
    """The name itself, if it can be part of a key. Raises ValueError otherwise."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"{what} {name!r}: use 1 to {NAME_MAX} of the characters A-Z a-z 0-9 _ -")
    return name


class Epoch(NamedTuple):
    """One run of a vehicle process: a durable counter and a random nonce."""

    counter: int
    nonce: int


class FrameStatus(IntEnum):
    """What a message does to a frame. ENDED: its last pose is now the next frame's start."""

    OPENED = 0
    CONTINUED = 1
    ENDED = 2
    CORRECTED = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class FramePart:
    """A message's share in one frame. end_pose: mean of the frame's end pose (3,), with ENDED and CORRECTED."""

    frame: int
    status: FrameStatus
    delta: FrameDelta
    end_pose: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Continues:
    """The epoch that a new one continues: its last committed sequence number and the prefix digest there."""

    epoch: Epoch
    last: int
    prefix_digest: bytes


@dataclass(frozen=True, eq=False, kw_only=True)
class Hello:
    """What a vehicle says of itself in sequence 0.

    start_pose (3,) and start_pose_cov (3, 3): T_0 in the world; a covariance of zeros means given; `placed` is False
    where the start pose is not known. start_information: of a frame's first pose, per m^2 and rad^2.
    step_information_max: the most that a diagonal entry of H grows by in one step, per m^2 or rad^2.
    life: number of the vehicle's life; an epoch that continues another is of the same life and starts nothing anew.
    """

    software: str
    life: int
    placed: bool
    start_pose: Floats
    start_pose_cov: Floats
    start_information: float
    step_information_max: float
    continues: Continues | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class DeltaMessage:
    """What a vehicle's filter learned in the messages `first` .. `last` of an epoch.

    step: index of the newest pose. time_s: the vehicle's own time, opaque. landmarks: (number, signature) of new ones;
    aliases: (number, number, added). innovation, innovation_dof, refused: sum of normalised squares, its degrees of
    freedom and the sightings refused, over the steps covered. end: the stream ends here.
    """

    fleet: str
    vehicle: str
    epoch: Epoch
    first: int
    last: int
    step: int
    time_s: float
    parts: tuple[FramePart, ...]
    landmarks: tuple[tuple[int, int], ...] = ()
    aliases: tuple[tuple[int, int, bool], ...] = ()
    healthy: bool = True
    innovation: float = 0.0
    innovation_dof: int = 0
    refused: int = 0
    hello: Hello | None = None
    end: bool = False


@dataclass(frozen=True, kw_only=True)
class Heartbeat:
    """The last message a vehicle has put, and the digest of the stream up to it.

    checked, checked_digest: the same for its last check point (see streams.is_check_point), -1 and zeros for none.
    """

    fleet: str
    vehicle: str
    epoch: Epoch
    last: int
    prefix_digest: bytes
    checked: int
    checked_digest: bytes
    ended: bool


@dataclass(frozen=True, kw_only=True)
class Ack:
    """A node holds everything of a stream up to `last`, and will after a crash. fault: why it takes no more, or ""."""

    fleet: str
    node: str
    vehicle: str
    epoch: Epoch
    last: int
    prefix_digest: bytes
    fault: str = ""


@dataclass(frozen=True, kw_only=True)
class RangeRequest:
    """Asks for messages first .. last of an epoch of a vehicle, at most `count` of them."""

    fleet: str
    vehicle: str
    epoch: Epoch
    first: int
    last: int
    count: int


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """Everything that folding the prefix 0 .. last of one epoch leaves behind, as one message, with its digest.

    maker: the fusion node that made it, "" for the vehicle itself.
    """

    message: DeltaMessage
    prefix_digest: bytes
    maker: str = ""


class Action(StrEnum):
    """What an operator can decide. FORCE, FORBID and RELEASE are about two landmarks, the others about a vehicle."""

    FORCE = "force"
    FORBID = "forbid"
    RELEASE = "release"
    RETRACT = "retract"
    RESTORE = "restore"


class LandmarkName(NamedTuple):
    """A vehicle's own name of a landmark: vehicle, life, number."""

    vehicle: str
    life: int
    number: int


@dataclass(frozen=True, kw_only=True)
class OperatorEvent:
    """One decision of an operator. Its id is (number, operator); of several on one subject the largest id wins.

    landmarks: two names in ascending order, with FORCE, FORBID and RELEASE. vehicle: with RETRACT and RESTORE.
    """

    fleet: str
    number: int
    operator: str
    action: Action
    landmarks: tuple[LandmarkName, LandmarkName] | None = None
    vehicle: str = ""


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Two messages of one vehicle that cannot both belong to one history; see streams.contradiction."""

    first: bytes
    second: bytes


class StreamPosition(NamedTuple):
    """How far a node is with one stream."""

    vehicle: str
    epoch: Epoch
    last: int
    prefix_digest: bytes
    evidence: bytes


@dataclass(frozen=True, kw_only=True)
class NodeStatus:
    """What a fusion node tells the others: its streams, and a digest of the operator events it holds."""

    fleet: str
    node: str
    streams: tuple[StreamPosition, ...]
    events: bytes


@dataclass(frozen=True, kw_only=True)
class VehicleState:
    """What a fusion node says of one epoch of a vehicle.

    epoch, cut: the last message folded; checked: the last one that canonical maps rest on. parked, duplicates,
    gaps_repaired, refused: messages waiting for an earlier one, received again, obtained by asking, and rejected.
    behind: messages announced but not folded. placed: part of the joint map. fault: why the stream is quarantined, "".
    """

    name: str
    life: int
    epoch: Epoch
    cut: int
    checked: int
    behind: int
    parked: int
    duplicates: int
    gaps_repaired: int
    refused: int
    placed: bool
    stalled: bool
    ended: bool
    healthy: bool
    fault: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class JointMap:
    """The fused map of a fleet.

    node, version: who made it; the version grows with every map of a node.
    landmark_mean (n, 2) m; landmark_cov (n, 2, 2) m^2, empty (0, 2, 2) where none has been computed yet; cov_version:
    the map version that the covariances belong to, -1 for none.
    names: for each landmark, who saw it; signature (n,), -1 unknown. pose_mean (v, 3), pose_cov (v, 3, 3) in the
    order of `poses`, the names of the placed vehicles. canonical: from checked prefixes only, solved
    from nothing in canonical order, and so that of every node that holds the same messages; a live map goes on from the
    one before.
    """

    fleet: str
    node: str
    version: int
    canonical: bool
    final: bool
    map_digest: bytes
    ledger_digest: bytes
    landmark_mean: Floats
    landmark_cov: Floats
    cov_version: int
    names: tuple[tuple[LandmarkName, ...], ...]
    signature: tuple[int, ...]
    poses: tuple[str, ...]
    pose_mean: Floats
    pose_cov: Floats
    vehicles: tuple[VehicleState, ...]
    counters: dict[str, int] = field(default_factory=dict)
