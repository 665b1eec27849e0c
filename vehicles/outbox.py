"""The messages of one epoch that nobody has acknowledged yet.

1. Messages are put in order; at most `window` past the last acknowledgement.
2. A message is fixed for ever once its bytes were put; before that it may be coalesced with its neighbour.
3. Above `outbox_max` messages a pair of unsent ones becomes one: nothing is lost, the stream gets coarser.
4. What has been acknowledged is forgotten; a snapshot is all that the filter has published less what is still here.
"""

import dataclasses
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from fleet_seif.config import PublishSettings
from fleet_seif.envelope import body_digest
from fleet_seif.information import FrameDelta, FrameTotal
from fleet_seif.messages import (
    DeltaMessage,
    Epoch,
    FramePart,
    FrameStatus,
    Heartbeat,
    Hello,
    RangeRequest,
    Snapshot,
)
from fleet_seif.streams import EMPTY_PREFIX, Coalescer, extend_prefix
from fleet_seif.wire import encode_message, encode_snapshot


@dataclass(frozen=True, eq=False)
class _Sent:
    message: DeltaMessage
    data: bytes
    prefix_digest: bytes


class Outbox:
    """See the rules above."""

    def __init__(self, settings: PublishSettings) -> None:
        self._settings = settings
        self._sent: deque[_Sent] = deque()
        self._unsent: deque[DeltaMessage] = deque()
        self._next_pair = 0
        self._hello: Hello | None = None
        self._acknowledged: _Sent | None = None
        self._innovation, self._innovation_dof, self._refused = 0.0, 0, 0
        self.last_acknowledged = -1
        self.last_put = -1
        self.last = -1
        self.prefix_digest = EMPTY_PREFIX

    def append(self, message: DeltaMessage) -> None:
        """Take the next message. Raises ValueError if it is not the next."""
        if message.first != self.last + 1:
            raise ValueError(f"outbox: message {message.first} after {self.last}")
        self.last = message.last
        self._unsent.append(message)
        self._hello = message.hello or self._hello
        if len(self._unsent) > 1 and len(self._sent) + len(self._unsent) > self._settings.outbox_max:
            self._coalesce()

    def _coalesce(self) -> None:
        """Make one message of the next pair; the pairs are taken in turn, so that all get coarser alike."""
        if self._next_pair + 1 >= len(self._unsent):
            self._next_pair = 0
        pair = Coalescer(self._unsent[self._next_pair])
        pair.add(self._unsent[self._next_pair + 1])
        self._unsent[self._next_pair] = pair.message()
        del self._unsent[self._next_pair + 1]
        self._next_pair += 1

    @property
    def full(self) -> bool:
        """Whether a vehicle that can wait should wait for acknowledgements."""
        return len(self._sent) >= self._settings.window

    def release(self) -> list[bytes]:
        """Bytes of the messages to put now."""
        released = []
        while self._unsent and not self.full:
            message = self._unsent[0]
            data = encode_message(message)
            self._unsent.popleft()
            self.prefix_digest = extend_prefix(self.prefix_digest, body_digest(data))
            self.last_put = message.last
            self._sent.append(_Sent(message, data, self.prefix_digest))
            released.append(data)
        return released

    def acknowledge(self, last: int, prefix_digest: bytes) -> bool:
        """Forget what a node holds. False where it acknowledges something that this vehicle never put."""
        if last <= self.last_acknowledged:
            return True
        match = next((sent for sent in self._sent if sent.message.last == last), None)
        if match is None or match.prefix_digest != prefix_digest:
            return False
        while self._sent and self._sent[0].message.last <= last:
            self._acknowledged = self._sent.popleft()
            message = self._acknowledged.message
            self._innovation += message.innovation
            self._innovation_dof += message.innovation_dof
            self._refused += message.refused
        self.last_acknowledged = last
        return True

    def heartbeat(self, vehicle: str, epoch: Epoch, ended: bool) -> Heartbeat:
        """What has been put so far; `ended` where the stream will not go on."""
        all_put = ended and self.last_put == self.last
        return Heartbeat(
            vehicle=vehicle, epoch=epoch, last=self.last_put, prefix_digest=self.prefix_digest, ended=all_put
        )

    def snapshot(self, published: FrameDelta, signatures: list[int]) -> Snapshot | None:
        """The acknowledged prefix as one message; None before the first acknowledgement.

        published, signatures: all that the filter has published in frame 0 so far, and the names in it.
        """
        if self._acknowledged is None:
            return None
        total, known = FrameTotal(), len(signatures)
        total.add(published)
        for message in [*(sent.message for sent in self._sent), *self._unsent]:
            known -= len(message.landmarks)
            for part in message.parts:
                total.subtract(part.delta)
        parts = [FramePart(frame=0, status=FrameStatus.OPENED, delta=total.delta())]
        newest = self._acknowledged.message
        if newest.end:
            # The last message may have been coalesced: then its own delta is in the total already.
            end_pose = newest.parts[-1].end_pose
            parts.append(FramePart(frame=0, status=FrameStatus.ENDED, delta=FrameDelta.nothing(), end_pose=end_pose))
        message = dataclasses.replace(
            newest, first=0, hello=self._hello, parts=tuple(parts), landmarks=tuple(enumerate(signatures[:known])),
            innovation=self._innovation, innovation_dof=self._innovation_dof, refused=self._refused,
        )  # fmt: skip
        return Snapshot(message=message, prefix_digest=self._acknowledged.prefix_digest)

    def answer(self, request: RangeRequest, snapshot: Callable[[], Snapshot | None]) -> list[bytes]:
        """Messages of a range; where its start is acknowledged and gone, a snapshot first."""
        found = []
        if request.first <= self.last_acknowledged:
            taken = snapshot()
            found += [encode_snapshot(taken)] if taken is not None else []
        for sent in self._sent:
            if len(found) >= request.count:
                break
            if sent.message.last >= request.first and sent.message.first <= request.last:
                found.append(sent.data)
        return found
