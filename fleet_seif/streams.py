"""What vehicles and fusion nodes must agree on about a stream of messages: its prefix digest, and coalescing."""

import dataclasses
import hashlib
from typing import Final

from fleet_seif.information import FrameDelta, FrameTotal
from fleet_seif.messages import DeltaMessage, FramePart, FrameStatus
from fleet_seif.records import Floats

EMPTY_PREFIX: Final = bytes(32)


def extend_prefix(prefix: bytes, digest: bytes) -> bytes:
    """Digest of a stream's prefix after one more message: blake2b-256(prefix digest, body digest)."""
    return hashlib.blake2b(prefix + digest, digest_size=32).digest()


class Coalescer:
    """Adds consecutive messages of one epoch into one that has the effect of all."""

    def __init__(self, first: DeltaMessage) -> None:
        self._newest = first
        self._first = first
        self._totals: dict[int, FrameTotal] = {}
        self._opened: set[int] = set()
        self._ends: dict[int, tuple[FrameStatus, Floats]] = {}
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
            self._totals.setdefault(part.frame, FrameTotal()).add(part.delta)
            if part.status is FrameStatus.OPENED:
                self._opened.add(part.frame)
            if part.end_pose is not None:
                status = FrameStatus.ENDED if part.frame in self._ends else part.status
                self._ends[part.frame] = (status, part.end_pose)
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
            parts=tuple(part for frame in sorted(self._totals) for part in self._parts(frame)),
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
            return [FramePart(frame=frame, status=end[0], delta=delta, end_pose=end[1])]
        return [
            FramePart(frame=frame, status=FrameStatus.OPENED, delta=delta),
            FramePart(frame=frame, status=FrameStatus.ENDED, delta=FrameDelta.nothing(), end_pose=end[1]),
        ]
