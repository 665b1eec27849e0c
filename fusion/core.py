"""What a fusion node does, without I/O: bytes and time in, effects out.

1. Every message goes to the ledger; what it says decides about acknowledgements and repairs.
2. A gap is known from a parked message or a heartbeat. It is asked for after `repair_after_s`; without progress the
   wait doubles up to `repair_max_s`. One query a stream at a time, which counts as lost after `QUERY_LOST_S`.
3. Acknowledgements go out every `ack_every` messages or `ack_s`, and again with every heartbeat.
4. Times are this node's own monotonic clock; nothing compares them with another's.
"""

import logging
from collections import Counter
from dataclasses import dataclass

from fleet_seif.config import FusionSettings
from fleet_seif.errors import WireError
from fleet_seif.messages import Ack, Epoch, RangeRequest, VehicleState
from fleet_seif.wire import decode_heartbeat, encode_ack, encode_range
from fusion.ledger import Ledger, Receipt, Stream

log = logging.getLogger(__name__)
QUERY_LOST_S = 4.0


@dataclass(frozen=True)
class PutAck:
    """Send an acknowledgement to a vehicle."""

    vehicle: str
    data: bytes


@dataclass(frozen=True)
class AskRange:
    """Query a vehicle's outbox; feed replies to `on_reply` and the end to `on_reply_done`."""

    vehicle: str
    epoch: Epoch
    data: bytes


Effect = PutAck | AskRange


@dataclass
class Link:
    """What the node knows of one stream beside the ledger. Times in s."""

    announced: int = -1
    heard_s: float = 0.0
    acked: int = -1
    ack_due_s: float | None = None
    gap_since_s: float | None = None
    wait_s: float = 0.0
    asking_until_s: float | None = None
    next_at_ask: int = 0
    repaired: int = 0


class FusionCore:
    """See the rules above. `expected`: vehicles whose streams must end before the run is complete; 0 never ends."""

    def __init__(self, fleet: str, node: str, settings: FusionSettings, expected: int = 0) -> None:
        self.ledger = Ledger(fleet, settings.parked_max)
        self.counters: Counter[str] = Counter()
        self.changed = False
        self.node = node
        self._settings = settings
        self._expected = expected
        self._links: dict[tuple[str, Epoch], Link] = {}

    def on_delta(self, vehicle: str, data: bytes, now_s: float) -> list[Effect]:
        """A message that a vehicle put."""
        return self._take(vehicle, data, now_s, repair=False)

    def on_reply(self, vehicle: str, data: bytes, now_s: float) -> list[Effect]:
        """A message that came as an answer to a range query."""
        return self._take(vehicle, data, now_s, repair=True)

    def _take(self, vehicle: str, data: bytes, now_s: float, *, repair: bool) -> list[Effect]:
        try:
            receipt, stream = self.ledger.accept(data, vehicle)
        except WireError as error:
            return self._malformed(vehicle, error)
        if receipt is Receipt.REFUSED:
            log.warning("message_refused vehicle=%s next=%d fault=%s", vehicle, stream.next, stream.fault)
        link = self._link(stream)
        link.heard_s = now_s
        if receipt is Receipt.FOLDED:
            self.changed = True
            link.repaired += repair
            link.gap_since_s, link.wait_s = None, self._settings.repair_after_s
        newest = max(stream.parked, default=-1)
        link.announced = max(link.announced, stream.next - 1, newest)
        return self._acknowledge(stream, link, now_s) + self._repair(stream, link, now_s)

    def on_heartbeat(self, vehicle: str, data: bytes, now_s: float) -> list[Effect]:
        """A heartbeat."""
        try:
            heartbeat = decode_heartbeat(data)
            if heartbeat.vehicle != vehicle:
                raise WireError(f"heartbeat of {heartbeat.vehicle!r} under the key of {vehicle!r}")
            stream = self.ledger.stream(vehicle, heartbeat.epoch)
        except WireError as error:
            return self._malformed(vehicle, error)
        link = self._link(stream)
        link.heard_s = now_s
        link.announced = max(link.announced, heartbeat.last)
        if heartbeat.last == stream.next - 1 and heartbeat.prefix_digest != stream.prefix_digest:
            self.counters["forks"] += 1
            log.error("stream_forked vehicle=%s last=%d: it says that it sent something else", vehicle, heartbeat.last)
        if stream.next > 0:
            link.ack_due_s = now_s  # an acknowledgement may have been lost: repeat it
        return self._acknowledge(stream, link, now_s) + self._repair(stream, link, now_s)

    def _malformed(self, vehicle: str, error: WireError) -> list[Effect]:
        self.counters["malformed"] += 1
        log.warning("malformed vehicle=%s reason=%s", vehicle, error)
        return []

    def on_reply_done(self, vehicle: str, epoch: Epoch, now_s: float) -> list[Effect]:
        """A range query is over: ask on at once after progress, later without."""
        stream = self.ledger.stream(vehicle, epoch)
        link = self._link(stream)
        link.asking_until_s = None
        link.gap_since_s = now_s
        progress = stream.next > link.next_at_ask
        settings = self._settings
        link.wait_s = 0.0 if progress else min(max(2 * link.wait_s, settings.repair_after_s), settings.repair_max_s)
        return self._repair(stream, link, now_s)

    def tick(self, now_s: float) -> list[Effect]:
        """What is due by now."""
        effects: list[Effect] = []
        for key, link in self._links.items():
            stream = self.ledger.streams[key]
            if link.ack_due_s is not None and now_s >= link.ack_due_s:
                effects += self._acknowledge(stream, link, now_s)
            effects += self._repair(stream, link, now_s)
        return effects

    def _link(self, stream: Stream) -> Link:
        return self._links.setdefault((stream.vehicle, stream.epoch), Link(wait_s=self._settings.repair_after_s))

    def _acknowledge(self, stream: Stream, link: Link, now_s: float) -> list[Effect]:
        last = stream.next - 1
        if last > link.acked and link.ack_due_s is None:
            link.ack_due_s = now_s + self._settings.ack_s
        due = link.ack_due_s is not None and now_s >= link.ack_due_s
        if last < 0 or not (due or last - link.acked >= self._settings.ack_every):
            return []
        link.acked, link.ack_due_s = last, None
        return [self.ack_now(stream.vehicle, stream.epoch)]

    def ack_now(self, vehicle: str, epoch: Epoch) -> PutAck:
        """The acknowledgement of all that is folded of a stream, whatever has been sent before."""
        stream = self.ledger.stream(vehicle, epoch)
        ack = Ack(
            node=self.node,
            vehicle=vehicle,
            epoch=epoch,
            last=max(stream.next - 1, 0),
            prefix_digest=stream.prefix_digest,
        )
        return PutAck(vehicle, encode_ack(ack))

    def _repair(self, stream: Stream, link: Link, now_s: float) -> list[Effect]:
        if link.announced < stream.next or stream.fault is not None:
            link.gap_since_s = None
            return []
        if link.asking_until_s is not None and now_s < link.asking_until_s:
            return []
        if link.gap_since_s is None:
            link.gap_since_s = now_s
        if now_s < link.gap_since_s + link.wait_s:
            return []
        last = min(stream.parked) - 1 if stream.parked else link.announced
        link.asking_until_s, link.next_at_ask = now_s + QUERY_LOST_S, stream.next
        request = RangeRequest(
            epoch=stream.epoch, first=stream.next, last=max(last, stream.next), count=self._settings.repair_batch
        )
        self.counters["queries"] += 1
        return [AskRange(stream.vehicle, stream.epoch, encode_range(request))]

    def states(self, now_s: float) -> tuple[VehicleState, ...]:
        """Every stream that is known, by vehicle and epoch."""
        placed = {(stream.vehicle, stream.epoch) for stream in self.ledger.placed()}
        return tuple(self._state(key, link, now_s, key in placed) for key, link in sorted(self._links.items()))

    def _state(self, key: tuple[str, Epoch], link: Link, now_s: float, placed: bool) -> VehicleState:
        stream = self.ledger.streams[key]
        return VehicleState(
            name=stream.vehicle,
            life=stream.life,
            epoch=stream.epoch,
            cut=stream.next - 1,
            behind=max(link.announced - stream.next + 1, 0),
            parked=len(stream.parked),
            duplicates=stream.duplicates,
            gaps_repaired=link.repaired,
            refused=stream.refused,
            placed=placed,
            stalled=not stream.ended and now_s - link.heard_s > self._settings.stalled_s,
            ended=stream.ended,
            healthy=stream.healthy and stream.fault is None,
        )

    @property
    def complete(self) -> bool:
        """Whether every expected vehicle's stream has ended and is folded (or can go no further)."""
        over = {stream.vehicle for stream in self.ledger.streams.values() if stream.ended or stream.fault is not None}
        return 0 < self._expected <= len(over)
