"""What each vehicle has contributed: every message exactly once and in order. The joint map is a view of this.

1. A stream is one epoch of one vehicle. Its messages are folded in sequence order, each exactly once.
2. A message that arrives early is parked; at most `parked_max` a stream, later ones are dropped and asked for again.
3. Two messages of one stream whose ranges overlap and whose bodies differ are refused and counted: the first one stays.
4. A snapshot replaces a shorter prefix of its stream.
5. A stream whose next message cannot be folded stays at its prefix; `fault` says why.
6. A vehicle that starts again without its outbox begins a new epoch of the same life: it is kept, not placed.
7. The same messages in any order, with any duplication, leave the same totals and digests.
8. No I/O and no clock: bytes in, totals out.
"""

import hashlib
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Final

import numpy as np

from fleet_seif.envelope import KIND_SNAPSHOT, body_digest, kind_of
from fleet_seif.errors import NumericalError, WireError
from fleet_seif.information import FrameTotal, delta_digest
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus, Hello, Snapshot
from fleet_seif.records import Floats
from fleet_seif.streams import EMPTY_PREFIX, extend_prefix
from fleet_seif.wire import decode_message, decode_snapshot

STREAMS_MAX: Final = 1000


class Receipt(Enum):
    """What became of a message."""

    FOLDED = auto()
    DUPLICATE = auto()
    PARKED = auto()
    REFUSED = auto()


@dataclass
class Frame:
    """One frame of a stream: the sum of its deltas, and the mean of its end pose once it has ended."""

    total: FrameTotal = field(default_factory=FrameTotal)
    end_pose: Floats | None = None


@dataclass
class Stream:
    """One epoch of one vehicle."""

    vehicle: str
    epoch: Epoch
    hello: Hello | None = None
    next: int = 0
    prefix_digest: bytes = EMPTY_PREFIX
    frames: dict[int, Frame] = field(default_factory=dict)
    signatures: list[int] = field(default_factory=list)
    parked: dict[int, tuple[DeltaMessage, bytes]] = field(default_factory=dict)
    log: list[bytes] = field(default_factory=list)
    firsts: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    step: int = 0
    healthy: bool = True
    ended: bool = False
    fault: str | None = None
    duplicates: int = 0
    refused: int = 0

    @property
    def life(self) -> int:
        return 0 if self.hello is None else self.hello.life

    def bytes_at(self, sequence: int) -> bytes | None:
        """The folded message that covers a sequence number."""
        at = int(np.searchsorted(self.firsts, sequence, side="right")) - 1
        return self.log[at] if at >= 0 else None


class Ledger:
    """See the rules above."""

    def __init__(self, fleet: str, parked_max: int) -> None:
        self.fleet = fleet
        self.streams: dict[tuple[str, Epoch], Stream] = {}
        self._parked_max = parked_max

    def stream(self, vehicle: str, epoch: Epoch) -> Stream:
        """The stream of an epoch, empty if nothing is known of it. Raises WireError at the limit of streams."""
        key = (vehicle, epoch)
        if key not in self.streams:
            if len(self.streams) >= STREAMS_MAX:
                raise WireError(f"epoch {epoch} of {vehicle!r}: {STREAMS_MAX} epochs are known, no more are taken")
            self.streams[key] = Stream(vehicle=vehicle, epoch=epoch)
        return self.streams[key]

    def accept(self, data: bytes, sender: str | None = None) -> tuple[Receipt, Stream]:
        """Take one message or snapshot. `sender`: the vehicle whose key it came by.

        Raises WireError, with nothing changed, for bytes that are no message of this fleet and sender.
        """
        if kind_of(data) == KIND_SNAPSHOT:
            snapshot = decode_snapshot(data)
            self._check_origin(snapshot.message, sender)
            return self._accept_snapshot(snapshot, data)
        message = decode_message(data)
        self._check_origin(message, sender)
        stream = self.stream(message.vehicle, message.epoch)
        receipt = self._accept_message(stream, message, data)
        if receipt is Receipt.FOLDED:
            self._fold_parked(stream)
        elif receipt is Receipt.DUPLICATE:
            stream.duplicates += 1
        elif receipt is Receipt.REFUSED:
            stream.refused += 1
        return receipt, stream

    def _check_origin(self, message: DeltaMessage, sender: str | None) -> None:
        if message.fleet != self.fleet:
            raise WireError(f"message of fleet {message.fleet!r}, this is fleet {self.fleet!r}")
        if sender is not None and message.vehicle != sender:
            raise WireError(f"message of vehicle {message.vehicle!r} came under the key of {sender!r}")

    def _accept_message(self, stream: Stream, message: DeltaMessage, data: bytes) -> Receipt:
        if stream.fault is not None:
            return Receipt.REFUSED
        if message.first == stream.next:
            return self._fold(stream, message, data)
        if message.first < stream.next:
            held = stream.bytes_at(message.first)
            covered = held is not None and (held == data or kind_of(held) == KIND_SNAPSHOT)
            return Receipt.DUPLICATE if covered and message.last < stream.next else Receipt.REFUSED
        held_parked = stream.parked.get(message.first)
        if held_parked is not None:
            return Receipt.DUPLICATE if held_parked[1] == data else Receipt.REFUSED
        if len(stream.parked) >= self._parked_max:
            return Receipt.REFUSED
        stream.parked[message.first] = (message, data)
        return Receipt.PARKED

    def _fold(self, stream: Stream, message: DeltaMessage, data: bytes) -> Receipt:
        """Add the next message, wholly or not at all."""
        if stream.ended or not _names_follow(stream, message):
            stream.fault = f"message {message.first} names unknown or repeated landmarks or frames"
            return Receipt.REFUSED
        done: list[FramePart] = []
        opened = {part.frame for part in message.parts} - set(stream.frames)
        try:
            for part in message.parts:
                stream.frames.setdefault(part.frame, Frame()).total.add(part.delta)
                done.append(part)
        except NumericalError as error:
            stream.fault = f"message {message.first}: {error}"
            for part in done:
                stream.frames[part.frame].total.subtract(part.delta)
            for frame in opened:
                stream.frames.pop(frame, None)
            return Receipt.REFUSED
        for part in message.parts:
            if part.end_pose is not None:
                stream.frames[part.frame].end_pose = part.end_pose
        stream.hello = message.hello or stream.hello
        stream.signatures.extend(signature for _, signature in message.landmarks)
        stream.prefix_digest = extend_prefix(stream.prefix_digest, body_digest(data))
        _take_note(stream, message, data)
        return Receipt.FOLDED

    def _fold_parked(self, stream: Stream) -> None:
        while stream.next in stream.parked:
            message, data = stream.parked.pop(stream.next)
            if self._fold(stream, message, data) is Receipt.REFUSED:
                stream.refused += 1
                return
        for first in [first for first in stream.parked if first < stream.next]:
            message, data = stream.parked.pop(first)
            if self._accept_message(stream, message, data) is Receipt.REFUSED:
                stream.refused += 1

    def _accept_snapshot(self, snapshot: Snapshot, data: bytes) -> tuple[Receipt, Stream]:
        message = snapshot.message
        stream = self.stream(message.vehicle, message.epoch)
        if message.last < stream.next:
            stream.duplicates += 1
            return Receipt.DUPLICATE, stream
        fresh = Stream(
            vehicle=stream.vehicle, epoch=stream.epoch, duplicates=stream.duplicates, refused=stream.refused,
            parked={first: held for first, held in stream.parked.items() if first > message.last},
        )  # fmt: skip
        if self._fold(fresh, message, data) is Receipt.REFUSED:
            stream.refused += 1
            return Receipt.REFUSED, stream
        fresh.prefix_digest = snapshot.prefix_digest
        self.streams[stream.vehicle, stream.epoch] = fresh
        self._fold_parked(fresh)
        return Receipt.FOLDED, fresh

    def placed(self) -> list[Stream]:
        """The streams that the canonical map is made from, in canonical order: of each life its first epoch."""
        usable = [s for s in self.streams.values() if s.hello is not None and s.hello.placed and s.healthy]
        first: dict[tuple[str, int], Stream] = {}
        for stream in sorted(usable, key=lambda s: (s.vehicle, s.life, s.epoch)):
            first.setdefault((stream.vehicle, stream.life), stream)
        return list(first.values())

    def ledger_digest(self) -> bytes:
        """32 bytes that identify all that has been folded."""
        digest = hashlib.blake2b(digest_size=32)
        for vehicle, epoch in sorted(self.streams):
            stream = self.streams[vehicle, epoch]
            if stream.next == 0:
                continue
            digest.update(f"{vehicle} {epoch.counter} {epoch.nonce} {stream.next} ".encode() + stream.prefix_digest)
        return digest.digest()

    def map_digest(self) -> bytes:
        """32 bytes that identify what the canonical map is assembled from; no epoch's nonce enters."""
        digest = hashlib.blake2b(digest_size=32)
        for stream in self.placed():
            assert stream.hello is not None
            digest.update(f"{stream.vehicle} {stream.life} ".encode())
            digest.update(stream.hello.start_pose.tobytes() + stream.hello.start_pose_cov.tobytes())
            digest.update(np.array(stream.signatures, "<i8").tobytes())
            for frame in sorted(stream.frames):
                total = stream.frames[frame].total.delta()
                if len(total.variables):
                    digest.update(frame.to_bytes(8, "little") + delta_digest(total))
        return digest.digest()


def _names_follow(stream: Stream, message: DeltaMessage) -> bool:
    """Whether new landmarks are numbered on from the last, and every delta is about named landmarks."""
    known = len(stream.signatures)
    if any(number != known + i for i, (number, _) in enumerate(message.landmarks)):
        return False
    known += len(message.landmarks)
    frames = set(stream.frames)
    for part in message.parts:
        if len(part.delta.variables) and part.delta.variables[-1] > known:
            return False
        if (part.status is FrameStatus.OPENED) == (part.frame in frames):
            return False
        frames.add(part.frame)
    return True


def _take_note(stream: Stream, message: DeltaMessage, data: bytes) -> None:
    stream.log.append(data)
    stream.firsts.append(message.first)
    stream.times_s.append(message.time_s)
    stream.next = message.last + 1
    stream.step = message.step
    stream.healthy, stream.ended = message.healthy, message.end
