"""What vehicles and fusion nodes must agree on about a stream of messages: its prefix digest, where it is checked, what
contradicts what, and coalescing."""

import dataclasses
import hashlib
from typing import Final, NamedTuple

from fleet_seif.information import FrameDelta, FrameTotal
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus
from fleet_seif.records import Floats

EMPTY_PREFIX: Final = bytes(32)
CHECK_EVERY: Final = 64


def extend_prefix(prefix: bytes, digest: bytes) -> bytes:
    """Digest of a stream's prefix after one more message: blake2b-256(prefix digest, body digest)."""
    return hashlib.blake2b(prefix + digest, digest_size=32).digest()


def is_check_point(message: DeltaMessage) -> bool:
    """Whether positive definiteness is checked after this message: its range contains a multiple of CHECK_EVERY, or it
    ends or corrects a frame, or the stream."""
    if message.last // CHECK_EVERY * CHECK_EVERY >= message.first or message.end:
        return True
    return any(part.end_pose is not None for part in message.parts)


class Stop(NamedTuple):
    """An epoch whose messages from `sequence` on count for nothing, because its vehicle contradicts itself."""

    vehicle: str
    epoch: Epoch
    sequence: int


def contradiction(a: DeltaMessage, b: DeltaMessage) -> Stop | None:
    """Where two messages of one vehicle, whose bodies differ, cannot both belong to one history; None if they can.

    Two messages of one epoch whose ranges overlap; two epochs that continue the same one; a message of an epoch beyond
    the point from which another epoch continues it.
    """
    if a.vehicle != b.vehicle:
        return None
    if a.epoch == b.epoch:
        overlap = a.first <= b.last and b.first <= a.last
        return Stop(a.vehicle, a.epoch, min(a.first, b.first)) if overlap else None
    of_a = None if a.hello is None else a.hello.continues
    of_b = None if b.hello is None else b.hello.continues
    if of_a is not None and of_b is not None and of_a.epoch == of_b.epoch:
        return Stop(a.vehicle, of_a.epoch, min(of_a.last, of_b.last) + 1)
    for continues, other in ((of_a, b), (of_b, a)):
        if continues is not None and continues.epoch == other.epoch and other.last > continues.last:
            return Stop(a.vehicle, other.epoch, min(other.first, continues.last + 1))
    return None


class Coalescer:
    """Adds consecutive messages of one epoch into one that has the effect of all."""

    def __init__(self, first: DeltaMessage) -> None:
        self._newest = first
        self._first = first
        self._totals: dict[int, FrameTotal] = {}
        self._opened: set[int] = set()
        self._ends: dict[int, Floats] = {}
        self._corrections: dict[int, FrameTotal] = {}
        self._corrected_ends: dict[int, Floats] = {}
        self._landmarks: list[tuple[int, int]] = []
        self._aliases: list[tuple[int, int, bool]] = []
        self._innovation, self._dof, self._refused = 0.0, 0, 0
        self._take(first)

    def add(self, message: DeltaMessage) -> None:
        """Raises ValueError if the message is not the next one of the same epoch."""
        if message.epoch != self._newest.epoch or message.first != self._newest.last + 1:
            raise ValueError(f"message {message.first} does not follow {self._newest.last} in the same epoch")
        self._newest = message
        self._take(message)

    def _take(self, message: DeltaMessage) -> None:
        for part in message.parts:
            corrects = part.status is FrameStatus.CORRECTED
            (self._corrections if corrects else self._totals).setdefault(part.frame, FrameTotal()).add(part.delta)
            if part.status is FrameStatus.OPENED:
                self._opened.add(part.frame)
            if part.end_pose is not None:
                (self._corrected_ends if corrects else self._ends)[part.frame] = part.end_pose
        self._landmarks.extend(message.landmarks)
        self._aliases.extend(message.aliases)
        self._innovation += message.innovation
        self._dof += message.innovation_dof
        self._refused += message.refused

    def message(self) -> DeltaMessage:
        """All messages so far as one."""
        return dataclasses.replace(
            self._newest,
            first=self._first.first,
            hello=self._first.hello,
            parts=tuple(part for frame in sorted(self._totals) for part in self._parts(frame))
            + tuple(self._correction(frame) for frame in sorted(self._corrections)),
            landmarks=tuple(self._landmarks),
            aliases=tuple(self._aliases),
            innovation=self._innovation,
            innovation_dof=self._dof,
            refused=self._refused,
        )

    def _parts(self, frame: int) -> list[FramePart]:
        delta, opened, end = self._totals[frame].delta(), frame in self._opened, self._ends.get(frame)
        if end is None:
            status = FrameStatus.OPENED if opened else FrameStatus.CONTINUED
            return [FramePart(frame=frame, status=status, delta=delta)]
        if not opened:
            return [FramePart(frame=frame, status=FrameStatus.ENDED, delta=delta, end_pose=end)]
        return [
            FramePart(frame=frame, status=FrameStatus.OPENED, delta=delta),
            FramePart(frame=frame, status=FrameStatus.ENDED, delta=FrameDelta.nothing(), end_pose=end),
        ]

    def _correction(self, frame: int) -> FramePart:
        """Kept apart: a correction may claim what the steps themselves may not."""
        delta, end = self._corrections[frame].delta(), self._corrected_ends[frame]
        return FramePart(frame=frame, status=FrameStatus.CORRECTED, delta=delta, end_pose=end)
