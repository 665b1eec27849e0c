"""The messages of one epoch that the required nodes have not all acknowledged yet.

1. A message may be put once it has been committed to the store; at most `window` past the last acknowledgement are.
2. A message is fixed for ever once its bytes may have been put; before that it may be coalesced with its neighbour.
   The newest takes in what follows until it covers `every_steps` or a frame ends; until then it is not put.
3. Above `outbox_max` messages a pair of those that are not fixed becomes one: nothing is lost, the stream gets coarser.
4. A message is forgotten when every required node (none required: any node) has acknowledged a check point at or after
   it, so that a snapshot is always one of a check point. A snapshot is all that the epoch has published less what is
   still here.
5. No I/O: what the store must keep is in `changes`; the caller commits it and says so.
"""

import dataclasses
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fleet_seif.config import PublishSettings
from fleet_seif.envelope import DELTA_MAX, body_digest
from fleet_seif.information import FrameDelta, FrameTotal
from fleet_seif.messages import DeltaMessage, FramePart, FrameStatus, Heartbeat, RangeRequest, Snapshot
from fleet_seif.records import Floats
from fleet_seif.signing import Signer
from fleet_seif.store import Change, Delete, Put
from fleet_seif.streams import EMPTY_PREFIX, Coalescer, extend_prefix, is_check_point
from fleet_seif.wire import decode_message, encode_message, encode_snapshot
from vehicles import records
from vehicles.records import EpochRecord, Trimmed

ANSWER_BYTES_MAX = 4 * 2**20
Published = tuple[FrameDelta, ...]
"""All that has been published, frame by frame."""
COALESCED_MAX = DELTA_MAX // 4
"""Bytes of a message above which it is not made larger."""


@dataclass(frozen=True, eq=False)
class _Sent:
    message: DeltaMessage
    data: bytes
    prefix_digest: bytes


@dataclass(eq=False)
class _Unsent:
    """A message that waits. commit: the number of the commit that keeps it."""

    message: DeltaMessage
    data: bytes
    commit: int


class Outbox:
    """See the rules above.

    Args:
        record: the epoch. ordinal: its number in the store. required: names of the nodes whose word counts.
    """

    def __init__(
        self,
        settings: PublishSettings,
        record: EpochRecord,
        *,
        ordinal: int = 0,
        required: Sequence[str] = (),
        signer: Signer | None = None,
    ) -> None:
        self.record = record
        self.ordinal = ordinal
        self.changes: list[Change] = []
        self.commits = 0
        self.committed = -1
        self.last_put = -1
        self.last = -1
        self.ended = False
        self.prefix_digest = EMPTY_PREFIX
        self.checked, self.checked_digest = -1, EMPTY_PREFIX
        self._settings = settings
        self._required = tuple(required)
        self._signer = signer
        self._sent: deque[_Sent] = deque()
        self._unsent: deque[_Unsent] = deque()
        self._fixed = 0
        self._acknowledged = 0
        self._next_pair = 0
        self._acked: dict[str, int] = {}
        self._trimmed: Trimmed | None = None
        self._trimmed_last = -1
        self._ends: dict[int, Floats] = {}

    def restore(self, trimmed: Trimmed | None, ends: Mapping[int, Floats], messages: Sequence[bytes]) -> None:
        """Take what the store has kept; any of it may have been put, so all of it is fixed."""
        self._ends = dict(ends)
        if trimmed is not None:
            newest = decode_message(trimmed.newest)
            self._trimmed, self._trimmed_last = trimmed, newest.last
            self.last = self.last_put = newest.last
            self.prefix_digest = self.checked_digest = trimmed.prefix_digest
            self.checked, self.ended = newest.last, newest.end
        for data in messages:
            message = decode_message(data)
            self._unsent.append(_Unsent(message, data, -1))
            self._fixed += 1
            self.last, self.ended = message.last, message.end

    @property
    def newest(self) -> DeltaMessage | None:
        """The last message of this epoch, acknowledged or not."""
        if self._unsent:
            return self._unsent[-1].message
        if self._sent:
            return self._sent[-1].message
        return None if self._trimmed is None else decode_message(self._trimmed.newest)

    def digest_of_all(self) -> bytes:
        """Prefix digest at the last message, put or not."""
        digest = self.prefix_digest
        for waiting in self._unsent:
            digest = extend_prefix(digest, body_digest(waiting.data))
        return digest

    def append(self, message: DeltaMessage) -> None:
        """Take the next message. Raises ValueError if it is not the next."""
        if message.first != self.last + 1:
            raise ValueError(f"outbox: message {message.first} after {self.last}")
        data = encode_message(message, self._signer)
        if message.hello is not None:
            self.record = dataclasses.replace(self.record, hello=data)
            self.changes.append(Put(records.numbered(records.EPOCH, self.ordinal), self.record.pack()))
        self.last, self.ended = message.last, message.end
        grows = len(self._unsent) > self._fixed and self._is_open(self._unsent[-1])
        self._unsent.append(_Unsent(message, data, self.commits))
        self.changes.append(Put(records.numbered(records.MESSAGE, self.ordinal, message.first), data))
        if grows:
            self._join(len(self._unsent) - 2)
        if len(self._sent) + len(self._unsent) > self._settings.outbox_max:
            self._coalesce()

    def _is_open(self, waiting: _Unsent) -> bool:
        """Whether a message is to take in those that follow."""
        message = waiting.message
        return (
            message.last - message.first + 1 < self._settings.every_steps
            and message.hello is None
            and not message.end
            and len(waiting.data) <= COALESCED_MAX
            and not any(part.status is FrameStatus.ENDED for part in message.parts)
        )

    def _coalesce(self) -> None:
        """Make one message of the next pair; the pairs are taken in turn, so that all get coarser alike."""
        for _ in range(len(self._unsent)):
            if not self._fixed <= self._next_pair < len(self._unsent) - 1:
                self._next_pair = self._fixed  # those that may have been put come first
            if self._next_pair + 1 >= len(self._unsent):
                return
            a, b = self._unsent[self._next_pair], self._unsent[self._next_pair + 1]
            if len(a.data) + len(b.data) <= COALESCED_MAX:
                break
            self._next_pair += 1
        else:
            return
        self._join(self._next_pair)
        self._next_pair += 1

    def _join(self, at: int) -> None:
        """Make one of two unsent messages."""
        a, b = self._unsent[at], self._unsent[at + 1]
        pair = Coalescer(a.message)
        pair.add(b.message)
        a.message = pair.message()
        a.data, a.commit = encode_message(a.message, self._signer), self.commits
        del self._unsent[at + 1]
        low, high = (records.numbered(records.MESSAGE, self.ordinal, n) for n in (a.message.first, a.message.last + 1))
        self.changes += [Delete(low, high), Put(low, a.data)]

    def take_changes(self) -> list[Change]:
        """What the store must keep before what is here now may be put."""
        changes, self.changes = self.changes, []
        self.commits += 1
        return changes

    def note_commit(self, number: int) -> None:
        """What `take_changes` gave when `commits` became `number` is durable."""
        self.committed = max(self.committed, number - 1)

    @property
    def full(self) -> bool:
        """Whether a vehicle that can wait should wait for acknowledgements."""
        return len(self._sent) - self._acknowledged >= self._settings.window

    def release(self) -> list[bytes]:
        """Bytes of the messages to put now."""
        released: list[bytes] = []
        room = self._settings.window - (len(self._sent) - self._acknowledged)
        while self._unsent and len(released) < room and self._unsent[0].commit <= self.committed:
            if not self._fixed and len(self._unsent) == 1 and self._is_open(self._unsent[0]):
                break
            waiting = self._unsent.popleft()
            self._next_pair, self._fixed = max(self._next_pair - 1, 0), max(self._fixed - 1, 0)
            self.prefix_digest = extend_prefix(self.prefix_digest, body_digest(waiting.data))
            self.last_put = waiting.message.last
            if is_check_point(waiting.message):
                self.checked, self.checked_digest = self.last_put, self.prefix_digest
            self._sent.append(_Sent(waiting.message, waiting.data, self.prefix_digest))
            released.append(waiting.data)
        return released

    @property
    def last_acknowledged(self) -> int:
        """The last number that every required node holds (none required: any node)."""
        if self._required:
            last = min(self._acked.get(node, -1) for node in self._required)
        else:
            last = max(self._acked.values(), default=-1)
        return max(last, self._trimmed_last)

    def held_by(self, node: str) -> bool:
        """Whether a node holds everything here."""
        return max(self._acked.get(node, -1), self._trimmed_last) == self.last

    @property
    def done(self) -> bool:
        """Whether everything here has been put and acknowledged."""
        return self.last_acknowledged == self.last

    def acknowledge(self, node: str, last: int, prefix_digest: bytes) -> bool:
        """Note what a node holds. False where it acknowledges something that this vehicle never put."""
        if last <= max(self._acked.get(node, -1), self._trimmed_last):
            return True
        match = next((sent for sent in self._sent if sent.message.last == last), None)
        if match is None or match.prefix_digest != prefix_digest:
            return False
        if node in self._required or len(self._acked) < self._settings.nodes_max:
            self._acked[node] = last
        self._trim()
        return True

    def _trim(self) -> None:
        acknowledged = self.last_acknowledged
        held = [sent.message for sent in self._sent if sent.message.last <= acknowledged]
        points = [message.last for message in held if is_check_point(message)]
        self._acknowledged = len(held)
        if not points:
            return
        old = self._trimmed
        innovation, dof, refused = (old.innovation, old.innovation_dof, old.refused) if old else (0.0, 0, 0)
        aliases = {(a, b): added for a, b, added in old.aliases} if old else {}
        while self._sent and self._sent[0].message.last <= points[-1]:
            gone = self._sent.popleft()
            self._acknowledged -= 1
            innovation += gone.message.innovation
            dof += gone.message.innovation_dof
            refused += gone.message.refused
            aliases.update({(min(a, b), max(a, b)): added for a, b, added in gone.message.aliases})
            for part in gone.message.parts:
                if part.end_pose is not None:
                    self._ends[part.frame] = part.end_pose
                    key = records.numbered(records.ENDS, self.ordinal, part.frame)
                    self.changes.append(Put(key, np.asarray(part.end_pose, float).tobytes()))
        self._trimmed = Trimmed(
            newest=gone.data, prefix_digest=gone.prefix_digest,
            innovation=innovation, innovation_dof=dof, refused=refused,
            aliases=tuple((*pair, added) for pair, added in aliases.items()),
        )  # fmt: skip
        self._trimmed_last = gone.message.last
        low, high = (records.numbered(records.MESSAGE, self.ordinal, n) for n in (0, self._trimmed_last + 1))
        self.changes += [
            Delete(low, high), Put(records.numbered(records.TRIMMED, self.ordinal), self._trimmed.pack())
        ]  # fmt: skip

    def heartbeat(self, fleet: str, vehicle: str) -> Heartbeat:
        """What has been put so far; `ended` where the stream will not go on."""
        return Heartbeat(
            fleet=fleet,
            vehicle=vehicle,
            epoch=self.record.epoch,
            last=self.last_put,
            prefix_digest=self.prefix_digest,
            checked=self.checked,
            checked_digest=self.checked_digest,
            ended=self.ended and self.last_put == self.last,
        )

    def close(self, published: Published, signatures: Sequence[int]) -> None:
        """This epoch takes no more: remember what the filter had published and named at its end."""
        self.record = dataclasses.replace(self.record, closed=published, closed_names=tuple(signatures))
        self.changes.append(Put(records.numbered(records.EPOCH, self.ordinal), self.record.pack()))

    def snapshot(self, published: Callable[[], Published] | None, signatures: Sequence[int]) -> Snapshot | None:
        """The forgotten prefix as one message; None where nothing has been forgotten yet, or nobody knows it any more.

        published, signatures: all that the filter has published so far, and the names in it; a closed epoch knows them
        itself.
        """
        record = self.record
        if record.closed is not None:
            whole, signatures = record.closed, record.closed_names
        elif published is not None:
            whole = published()
        else:
            return None
        if self._trimmed is None:
            return None
        totals, known = [FrameTotal() for _ in whole], len(signatures)
        for total, delta in zip(totals, whole, strict=True):
            total.add(delta)
        for total, delta in zip(totals, record.base, strict=False):
            total.subtract(delta)
        for message in [*(sent.message for sent in self._sent), *(waiting.message for waiting in self._unsent)]:
            known -= len(message.landmarks)
            for part in message.parts:
                totals[part.frame].subtract(part.delta)
        newest = decode_message(self._trimmed.newest)
        named = tuple(enumerate(signatures))[record.names : known]
        hello = decode_message(record.hello).hello
        message = dataclasses.replace(
            newest, first=0, hello=hello, parts=self._parts([total.delta() for total in totals]), landmarks=named,
            innovation=self._trimmed.innovation, innovation_dof=self._trimmed.innovation_dof,
            refused=self._trimmed.refused, aliases=self._trimmed.aliases,
        )  # fmt: skip
        return Snapshot(message=message, prefix_digest=self._trimmed.prefix_digest)

    def _parts(self, changes: Sequence[FrameDelta]) -> tuple[FramePart, ...]:
        """What the prefix says of each frame: opened in it or before it, ended or corrected in it, or neither."""
        parts, nothing = [], FrameDelta.nothing()
        for frame, delta in enumerate(changes):
            end = self._ends.get(frame)
            status = FrameStatus.CONTINUED
            if end is not None:
                status = FrameStatus.CORRECTED if frame < self.record.ended else FrameStatus.ENDED
            if frame >= len(self.record.base) and len(delta.variables):
                parts.append(FramePart(frame=frame, status=FrameStatus.OPENED, delta=delta))
                delta = nothing
            if end is not None or (len(delta.variables) and status is FrameStatus.CONTINUED):
                parts.append(FramePart(frame=frame, status=status, delta=delta, end_pose=end))
        return tuple(parts)

    def answer(
        self, request: RangeRequest, published: Callable[[], Published] | None, signatures: Sequence[int]
    ) -> list[bytes]:
        """Messages of a range; where its start has been forgotten, a snapshot first."""
        found = []
        if request.first <= self._trimmed_last:
            snapshot = self.snapshot(published, signatures)
            found += [] if snapshot is None else [encode_snapshot(snapshot, self._signer)]
        size = 0
        for sent in self._sent:
            if len(found) >= request.count or size > ANSWER_BYTES_MAX:
                break
            size += len(sent.data)
            if sent.message.last >= request.first and sent.message.first <= request.last:
                found.append(sent.data)
        return found
