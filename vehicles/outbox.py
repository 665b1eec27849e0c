"""The messages of one epoch that nobody has acknowledged yet.

1. Messages are put in order; at most `window` past the last acknowledgement.
2. A message is fixed for ever once its bytes were put; before that it may be coalesced with its neighbour.
3. Above `outbox_max` messages the unsent ones are coalesced in pairs: nothing is lost, the stream gets coarser.
4. What has been acknowledged lives on as one summed message, the snapshot.
"""

from collections import deque
from dataclasses import dataclass

from fleet_seif.config import PublishSettings
from fleet_seif.messages import DeltaMessage, Epoch, Heartbeat, RangeRequest, Snapshot
from fleet_seif.streams import EMPTY_PREFIX, Coalescer, extend_prefix
from fleet_seif.wire import body_digest, encode_message, encode_snapshot


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
        self._acknowledged: Coalescer | None = None
        self._acknowledged_prefix = EMPTY_PREFIX
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
        if len(self._unsent) > 1 and len(self._sent) + len(self._unsent) > self._settings.outbox_max:
            self._coalesce()

    def _coalesce(self) -> None:
        messages, self._unsent = list(self._unsent), deque()
        for i in range(0, len(messages) - 1, 2):
            pair = Coalescer(messages[i])
            pair.add(messages[i + 1])
            self._unsent.append(pair.message())
        if len(messages) % 2:
            self._unsent.append(messages[-1])

    @property
    def full(self) -> bool:
        """Whether a vehicle that can wait should wait for acknowledgements."""
        return len(self._sent) >= self._settings.window

    def release(self) -> list[bytes]:
        """Bytes of the messages to put now."""
        released = []
        while self._unsent and not self.full:
            message = self._unsent.popleft()
            data = encode_message(message)
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
            message = self._sent.popleft().message
            if self._acknowledged is None:
                self._acknowledged = Coalescer(message)
            else:
                self._acknowledged.add(message)
        self.last_acknowledged, self._acknowledged_prefix = last, prefix_digest
        return True

    def heartbeat(self, vehicle: str, epoch: Epoch, ended: bool) -> Heartbeat:
        """What has been put so far; `ended` where the stream will not go on."""
        all_put = ended and self.last_put == self.last
        return Heartbeat(
            vehicle=vehicle, epoch=epoch, last=self.last_put, prefix_digest=self.prefix_digest, ended=all_put
        )

    def answer(self, request: RangeRequest) -> list[bytes]:
        """Messages of a range; where its start is acknowledged and gone, the snapshot first."""
        found = []
        if request.first <= self.last_acknowledged and self._acknowledged is not None:
            snapshot = Snapshot(message=self._acknowledged.message(), prefix_digest=self._acknowledged_prefix)
            found.append(encode_snapshot(snapshot))
        for sent in self._sent:
            if len(found) >= request.count:
                break
            if sent.message.last >= request.first and sent.message.first <= request.last:
                found.append(sent.data)
        return found
