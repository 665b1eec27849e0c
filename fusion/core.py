"""What a fusion node does, without I/O: bytes and time in, effects out.

1. Every message goes to the ledger; what it says decides about acknowledgements and repairs.
2. Effects say "we hold this": whoever carries them out commits `ledger.take_changes()` to the store first.
3. A gap is known from a parked message, a heartbeat or the status of another node. It is asked for after
   `repair_after_s`; without progress the wait doubles up to `repair_max_s`, and vehicle and other nodes are asked in
   turn. One query a stream at a time, `queries_max` a vehicle; a query counts as lost after `QUERY_LOST_S`.
4. Acknowledgements go out every `ack_every` messages or `ack_s`, and again with every heartbeat.
5. Nodes tell each other how far they are every `status_s`; evidence and decisions of operators are fetched if unknown.
   So is another node's map that differs though the ledgers are equal (fusion.comparison).
6. Times are this node's own monotonic clock; nothing compares them with another's.
"""

import contextlib
import logging
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from fleet_seif.config import FusionSettings
from fleet_seif.envelope import KIND_EVENT, KIND_HEARTBEAT, SEQUENCE_MAX, authenticate, kind_of
from fleet_seif.errors import WireError
from fleet_seif.map_wire import decode_map
from fleet_seif.merge_records import Merges
from fleet_seif.merge_wire import decode_merges, encode_merges
from fleet_seif.messages import (
    Ack,
    Epoch,
    JointMap,
    NodeStatus,
    OperatorEvent,
    RangeRequest,
    StreamPosition,
    VehicleState,
)
from fleet_seif.node_wire import decode_event, decode_status, encode_status
from fleet_seif.signing import KeyRing, Role, Signer
from fleet_seif.wire import decode_heartbeat, decode_range, encode_ack, encode_range
from fusion.compaction import compact
from fusion.comparison import Comparison
from fusion.ledger import Ledger, Receipt
from fusion.stream import Stream

log = logging.getLogger(__name__)
QUERY_LOST_S = 4.0
REPLY_BYTES_MAX = 4 * 2**20
ANNOUNCED_MAX = 8
NODES_MAX = 100
NODES_DIFFERING, CLASSES_DIFFERING = "nodes_merging_otherwise", "landmarks_merged_otherwise"
"""Counters that go down again: how many other nodes have another map of the same ledger, and in how many landmarks."""
TAKEN, REFUSED = "+", "-"
"""How the answer to an operator's decision begins."""


@dataclass(frozen=True)
class PutAck:
    """Send an acknowledgement to a vehicle."""

    vehicle: str
    data: bytes


@dataclass(frozen=True)
class AskRange:
    """Query a vehicle's outbox, or the ledgers of the other nodes; replies go to `on_reply`, the end to
    `on_reply_done`."""

    vehicle: str
    epoch: Epoch
    data: bytes
    nodes: bool = False


@dataclass(frozen=True)
class PutStatus:
    """Tell the other nodes how far this one is."""

    data: bytes


@dataclass(frozen=True)
class AskEvents:
    """Query another node's events and evidence; replies go to `on_events`."""

    node: str


@dataclass(frozen=True)
class PutMerges:
    """Tell subscribers and the other nodes about the merges in this one's newest map."""

    data: bytes


@dataclass(frozen=True)
class AskMap:
    """Query another node's map; the reply goes to `on_map`."""

    node: str


Effect = PutAck | AskRange | PutStatus | AskEvents | PutMerges | AskMap


@dataclass
class Link:
    """What the node knows of one stream beside the ledger. Times in s.

    announced: last number that its vehicle says it has put; elsewhere: last number that another node holds.
    """

    announced: int = -1
    elsewhere: int = -1
    heard_s: float = 0.0
    acked: int = -1
    ack_due_s: float | None = None
    gap_since_s: float | None = None
    wait_s: float = 0.0
    asking_until_s: float | None = None
    ask_nodes: bool = False
    next_at_ask: int = 0
    compare_from: int = 0
    repaired: int = 0


@dataclass
class Peer:
    """Another fusion node: when it was heard, and how far it is with each stream."""

    heard_s: float
    last: dict[tuple[str, Epoch], int] = field(default_factory=dict)


class FusionCore:
    """See the rules above.

    Args:
        expected: vehicles whose streams must end before the run is complete; 0 never ends.

    `gone` holds the vehicles that have been here and are not; whoever runs the core keeps it.
    """

    def __init__(
        self,
        fleet: str,
        node: str,
        settings: FusionSettings,
        expected: int = 0,
        *,
        keys: KeyRing | None = None,
        signer: Signer | None = None,
    ) -> None:
        self.ledger = Ledger(fleet, settings, keys)
        self.counters: Counter[str] = Counter()
        self.changed = False
        self.gone: set[str] = set()
        self.node = node
        self._keys = keys
        self._signer = signer
        self._settings = settings
        self._expected = expected
        self._links: dict[tuple[str, Epoch], Link] = {}
        self._peers: dict[str, Peer] = {}
        self._comparison = Comparison()
        self._status_due_s = 0.0
        self._compact_at = settings.compact_bytes

    def restore(self, stored: Iterable[tuple[bytes, bytes]], now_s: float) -> None:
        """Go on from what a store has kept, as if all of it had just been heard. Raises WireError."""
        self.ledger.restore(stored)
        for stream in self.ledger.streams.values():
            self._link(stream).heard_s = now_s
        self.changed = bool(self.ledger.streams)

    def on_delta(self, vehicle: str, data: bytes, now_s: float) -> list[Effect]:
        """A message that a vehicle put."""
        return self._take(vehicle, data, now_s, repair=False)

    def on_reply(self, vehicle: str, data: bytes, now_s: float) -> list[Effect]:
        """A message that came as an answer to a range query; a heartbeat comes before another node's snapshot."""
        if kind_of(data) == KIND_HEARTBEAT:
            return self.on_heartbeat(vehicle, data, now_s)
        return self._take(vehicle, data, now_s, repair=True)

    def _take(self, vehicle: str, data: bytes, now_s: float, *, repair: bool) -> list[Effect]:
        try:
            receipt, stream = self.ledger.accept(data, vehicle)
        except WireError as error:
            return self._malformed(vehicle, error)
        link = self._link(stream)
        link.heard_s = now_s
        if receipt is Receipt.FOLDED:
            self.changed = True
            link.repaired += repair
            link.gap_since_s, link.wait_s = None, self._settings.repair_after_s
        elif receipt is Receipt.PARKED:
            self._expect_continued(stream)
        elif receipt in (Receipt.REFUSED, Receipt.DROPPED):
            self.changed = True
            reason = stream.quarantine or "beyond a limit, or not what is held"
            self._count(f"messages_{receipt.name.lower()}", vehicle, reason)
        return self._acknowledge(stream, link, now_s) + self._repair(stream, link, now_s)

    def _expect_continued(self, stream: Stream) -> None:
        """A hello that waits says how far the epoch went that it continues."""
        hello = stream.parked[0].message.hello if 0 in stream.parked else None
        if hello is not None and hello.continues is not None:
            with contextlib.suppress(WireError):  # no more epochs are taken
                before = self._link(self.ledger.stream(stream.vehicle, hello.continues.epoch))
                before.announced = max(before.announced, hello.continues.last)

    def on_heartbeat(self, vehicle: str, data: bytes, now_s: float) -> list[Effect]:
        """A heartbeat."""
        try:
            authenticate(data, self._keys, Role.VEHICLE, vehicle)
            heartbeat = decode_heartbeat(data)
            if (heartbeat.fleet, heartbeat.vehicle) != (self.ledger.fleet, vehicle):
                raise WireError(
                    f"heartbeat of {heartbeat.vehicle!r} of {heartbeat.fleet!r} under the key of {vehicle!r}"
                )
            stream = self.ledger.stream(vehicle, heartbeat.epoch)
        except WireError as error:
            return self._malformed(vehicle, error)
        link = self._link(stream)
        link.heard_s = now_s
        link.announced = max(link.announced, heartbeat.last)
        for number, digest in (
            (heartbeat.last, heartbeat.prefix_digest),
            (heartbeat.checked, heartbeat.checked_digest),
        ):
            stream.announced.pop(number, None)  # what was said last is forgotten last
            stream.announced[number] = (digest, data)
        while len(stream.announced) > ANNOUNCED_MAX:
            del stream.announced[next(iter(stream.announced))]
        held = stream.check_digests.get(heartbeat.checked)
        if held == heartbeat.checked_digest:
            self.ledger.keep_witness(stream, heartbeat.checked, data)
        forked = heartbeat.last == stream.next - 1 and heartbeat.prefix_digest != stream.prefix_digest
        if forked or held not in (None, heartbeat.checked_digest):
            self._count("forks", vehicle, f"it says that it sent something else up to {heartbeat.last}")
        if stream.next > 0:
            link.ack_due_s = now_s  # an acknowledgement may have been lost: repeat it
        return self._acknowledge(stream, link, now_s) + self._repair(stream, link, now_s)

    def on_status(self, node: str, data: bytes, now_s: float) -> list[Effect]:
        """How far another node is."""
        if node == self.node:
            return []
        try:
            authenticate(data, self._keys, Role.NODE, node)
            status = decode_status(data)
            if (status.fleet, status.node) != (self.ledger.fleet, node):
                raise WireError(f"status of {status.node!r} of {status.fleet!r} under the key of {node!r}")
        except WireError as error:
            return self._malformed(node, error)
        if node not in self._peers and len(self._peers) >= NODES_MAX:
            return self._malformed(node, WireError(f"status of more than {NODES_MAX} nodes"))
        self._peers[node] = Peer(now_s, {(p.vehicle, p.epoch): p.last for p in status.streams})
        effects: list[Effect] = []
        ask = status.events != self.ledger.events_digest()
        for position in status.streams:
            try:
                stream = self.ledger.stream(position.vehicle, position.epoch)
            except WireError:  # no more epochs are taken: those that are known go on
                continue
            link = self._link(stream)
            link.elsewhere = max(link.elsewhere, position.last)
            ask = ask or position.evidence not in (b"", stream.evidence_id)
            effects += self._repair(stream, link, now_s)
            if position.last == stream.next - 1 and position.prefix_digest != stream.prefix_digest:
                effects.append(self._compare(stream, link))
        return [*effects, AskEvents(node)] if ask else effects

    def on_merges(self, node: str, data: bytes) -> list[Effect]:
        """What another node says of its merges."""
        if node == self.node:
            return []
        try:
            authenticate(data, self._keys, Role.NODE, node)
            report = decode_merges(data)
            if (report.fleet, report.node) != (self.ledger.fleet, node):
                raise WireError(f"merges of {report.node!r} of {report.fleet!r} under the key of {node!r}")
        except WireError as error:
            return self._malformed(node, error)
        ask = self._comparison.hear(report)
        self._count_differing()
        return [AskMap(node)] if ask else []

    def on_map(self, node: str, data: bytes) -> list[Effect]:
        """The map of another node, which has differed from this one's."""
        try:
            authenticate(data, self._keys, Role.NODE, node)
            joint = decode_map(data)
            if (joint.fleet, joint.node) != (self.ledger.fleet, node):
                raise WireError(f"map of {joint.node!r} of {joint.fleet!r} under the key of {node!r}")
        except WireError as error:
            return self._malformed(node, error)
        if self._comparison.learn(joint):
            self._count("forks", node, "its ledger is equal and so are its landmarks, but not its totals")
        self._count_differing()
        return []

    def on_served(self, joint: JointMap, merges: Merges) -> list[Effect]:
        """This node's newest map, and the merges in it."""
        self._comparison.serve(joint, merges)
        self._count_differing()
        return self._tell_merges()

    def _tell_merges(self) -> list[Effect]:
        report = self._comparison.report()
        return [] if report is None else [PutMerges(encode_merges(report, self._signer))]

    def _count_differing(self) -> None:
        found = {NODES_DIFFERING: self._comparison.nodes, CLASSES_DIFFERING: self._comparison.landmarks}
        for name, count in found.items():
            if count != self.counters[name]:
                log.info("%s count=%d", name, count)
            self.counters[name] = count
            if not count:
                del self.counters[name]

    def _compare(self, stream: Stream, link: Link) -> AskRange:
        """Two nodes hold different messages for the same numbers: fetch what the others hold, a part at a time. Where
        it differs it is proof against the vehicle."""
        self._count("forks", stream.vehicle, f"nodes hold different messages up to {stream.next - 1}")
        first = link.compare_from if link.compare_from < stream.next else 0
        link.compare_from = first + self._settings.repair_batch
        request = self._request(stream, first, stream.next - 1)
        return AskRange(stream.vehicle, stream.epoch, request, nodes=True)

    def _request(self, stream: Stream, first: int, last: int) -> bytes:
        self.counters["queries"] += 1
        request = RangeRequest(
            fleet=self.ledger.fleet, vehicle=stream.vehicle, epoch=stream.epoch, first=first, last=max(first, last),
            count=self._settings.repair_batch,
        )  # fmt: skip
        return encode_range(request, self._signer)

    def on_events(self, node: str, data: bytes) -> list[Effect]:
        """One event or one piece of evidence of another node."""
        try:
            news = self.ledger.accept_event(data) if kind_of(data) == KIND_EVENT else self.ledger.accept_evidence(data)
        except WireError as error:
            return self._malformed(node, error)
        self.changed = self.changed or news
        return []

    def on_decision(self, data: bytes) -> str:
        """The decision of an operator, from the operator: TAKEN and what it means here, or REFUSED and why."""
        try:
            event = decode_event(data)
            self.changed = self.ledger.accept_event(data) or self.changed
            if self.ledger.events.get((event.number, event.operator)) != data:
                raise WireError("another decision has taken its number meanwhile: decide again")
        except WireError as error:
            self._malformed("operator", error)
            return f"{REFUSED}{self.node}: {error}"
        return f"{TAKEN}{self.words_of(event)}"

    def words_of(self, event: OperatorEvent) -> str:
        """What a decision means in this ledger, in a sentence."""
        known = {(s.vehicle, s.number): s.life for s in self.ledger.streams.values() if s.life is not None}
        subject = event.vehicle or " ".join("/".join(map(str, name)) for name in event.landmarks or ())
        unknown = [] if not event.vehicle or any(v == event.vehicle for v, _ in known) else [event.vehicle]
        for name in event.landmarks or ():
            life = known.get(name[:2])
            if life is None or name.number >= len(life.signatures):
                unknown.append("/".join(map(str, name)))
        words = f"{self.node}: {event.action} {subject}, decision {event.number} of {event.operator}"
        return words + (f"; nothing is known yet of {' and '.join(unknown)}" if unknown else "")

    def answer_events(self) -> list[bytes]:
        """All decisions of operators and all evidence, for another node."""
        return [*self.ledger.events.values(), *(s.evidence for s in self.ledger.streams.values() if s.evidence)]

    def answer_range(self, vehicle: str, data: bytes) -> list[bytes]:
        """Messages of a vehicle for another node; a snapshot comes after the heartbeat that vouches for its digest."""
        try:
            request = decode_range(data)
        except WireError as error:
            self._malformed(vehicle, error)
            return []
        stream = self.ledger.streams.get((vehicle, request.epoch))
        if stream is None or (request.fleet, request.vehicle) != (self.ledger.fleet, vehicle):
            return []
        found: list[bytes] = []
        size = 0
        first = request.first
        while first < stream.next and first <= request.last and len(found) < request.count and size < REPLY_BYTES_MAX:
            at = stream.index_of(first)
            found.append(stream.log[at])
            size += len(stream.log[at])
            first = stream.firsts[at + 1] if at + 1 < len(stream.log) else stream.next
        return [stream.voucher, *found] if stream.voucher and stream.snapshot_covers(request.first) else found

    def _malformed(self, who: str, error: WireError) -> list[Effect]:
        self._count("malformed", who, str(error))
        return []

    def _count(self, what: str, who: str, reason: str) -> None:
        """Count, and log the 1st, 2nd, 4th, 8th ... time: a flood must not fill the log."""
        self.counters[what] += 1
        count = self.counters[what]
        if count & (count - 1) == 0:
            log.warning("%s count=%d from=%s reason=%s", what, count, who, reason)

    def on_reply_done(self, vehicle: str, epoch: Epoch, now_s: float) -> list[Effect]:
        """A range query is over: ask on at once after progress, later without."""
        stream = self.ledger.stream(vehicle, epoch)
        link = self._link(stream)
        link.asking_until_s = None
        link.gap_since_s = now_s
        settings = self._settings
        if stream.next > link.next_at_ask:
            link.wait_s = 0.0
        else:
            link.ask_nodes = not link.ask_nodes
            link.wait_s = min(max(2 * link.wait_s, settings.repair_after_s), settings.repair_max_s)
        return self._repair(stream, link, now_s)

    def tick(self, now_s: float) -> list[Effect]:
        """What is due by now."""
        effects: list[Effect] = []
        for key, link in self._links.items():
            stream = self.ledger.streams[key]
            if link.ack_due_s is not None and now_s >= link.ack_due_s:
                effects += self._acknowledge(stream, link, now_s)
            effects += self._repair(stream, link, now_s)
        if now_s >= self._status_due_s:
            self._status_due_s = now_s + self._settings.status_s
            effects.append(PutStatus(encode_status(self.status(), self._signer)))
            effects += self._tell_merges()
        if self.ledger.bytes_held > self._compact_at:
            self.compact()
        return effects

    def status(self) -> NodeStatus:
        """How far this node is."""
        streams = [s for s in self.ledger.streams.values() if s.next > 0 or s.evidence]
        return NodeStatus(
            fleet=self.ledger.fleet,
            node=self.node,
            streams=tuple(
                StreamPosition(s.vehicle, s.epoch, s.next - 1, s.prefix_digest, s.evidence_id) for s in streams
            ),
            events=self.ledger.events_digest(),
        )

    def compact(self) -> int:
        """Replace prefixes by snapshots where that is safe; returns the bytes saved. See `compaction`."""
        before = self.ledger.bytes_held
        required = [name for name in self._settings.required_acks if name != self.node]
        for key, stream in self.ledger.streams.items():
            held = [self._peers[name].last.get(key, -1) if name in self._peers else -1 for name in required]
            self.ledger.replace(stream, compact(stream, min([stream.checked, *held]), self.node, self._signer))
        self._compact_at = max(self._settings.compact_bytes, 2 * self.ledger.bytes_held)
        log.info("ledger_compacted before=%d after=%d", before, self.ledger.bytes_held)
        return before - self.ledger.bytes_held

    def _link(self, stream: Stream) -> Link:
        return self._links.setdefault(stream.key, Link(wait_s=self._settings.repair_after_s))

    def _acknowledge(self, stream: Stream, link: Link, now_s: float) -> list[Effect]:
        last = stream.next - 1
        if last > link.acked and link.ack_due_s is None:
            link.ack_due_s = now_s + self._settings.ack_s
        due = link.ack_due_s is not None and now_s >= link.ack_due_s
        if last < 0 or not (due or last - link.acked >= self._settings.ack_every):
            return []
        link.acked, link.ack_due_s = last, None
        return [self.ack_now(stream)]

    def ack_now(self, stream: Stream) -> PutAck:
        """The acknowledgement of all that is folded of a stream, whatever has been sent before."""
        ack = Ack(
            fleet=self.ledger.fleet,
            node=self.node,
            vehicle=stream.vehicle,
            epoch=stream.epoch,
            last=max(stream.next - 1, 0),
            prefix_digest=stream.prefix_digest,
            fault=self.ledger.verdict(stream)[:200],
        )
        return PutAck(stream.vehicle, encode_ack(ack, self._signer))

    def _wanted(self, stream: Stream, link: Link) -> int:
        """The last number that there is and that may still count, as far as is known."""
        if stream.over:
            return stream.next - 1
        last = max(link.announced, link.elsewhere, stream.parked_firsts[-1] if stream.parked else -1)
        return last if stream.stop is None else min(last, stream.stop - 1)

    def _repair(self, stream: Stream, link: Link, now_s: float) -> list[Effect]:
        wanted = self._wanted(stream, link)
        if wanted < stream.next:
            link.gap_since_s = None
            return []
        if link.asking_until_s is not None and now_s < link.asking_until_s:
            return []
        if link.gap_since_s is None:
            link.gap_since_s = now_s
        if now_s < link.gap_since_s + link.wait_s or stream.next in stream.parked:
            return []  # not yet, or all it waits for is the epoch that it continues
        if self._asking(stream.vehicle, now_s) >= self._settings.queries_max:
            return []
        last = stream.parked_firsts[0] - 1 if stream.parked else wanted
        link.asking_until_s, link.next_at_ask = now_s + QUERY_LOST_S, stream.next
        nodes = bool(self._peers) and (link.ask_nodes or link.elsewhere > link.announced)
        return [AskRange(stream.vehicle, stream.epoch, self._request(stream, stream.next, last), nodes)]

    def _asking(self, vehicle: str, now_s: float) -> int:
        """Queries about a vehicle that are under way."""
        links = (link for (name, _), link in self._links.items() if name == vehicle)
        return sum(link.asking_until_s is not None and now_s < link.asking_until_s for link in links)

    def states(self, now_s: float) -> tuple[VehicleState, ...]:
        """Every stream that is known, by vehicle and epoch."""
        placed = {(root.vehicle, id(root.life)) for root in self.ledger.placed()}
        return tuple(self._state(key, link, now_s, placed) for key, link in sorted(self._links.items()))

    def _state(self, key: tuple[str, Epoch], link: Link, now_s: float, placed: set[tuple[str, int]]) -> VehicleState:
        stream = self.ledger.streams[key]
        verdict = self.ledger.verdict(stream)
        return VehicleState(
            name=stream.vehicle,
            life=stream.number,
            epoch=stream.epoch,
            cut=stream.next - 1,
            checked=stream.checked,
            behind=min(max(self._wanted(stream, link) - stream.next + 1, 0), SEQUENCE_MAX),
            parked=len(stream.parked),
            duplicates=stream.duplicates,
            gaps_repaired=link.repaired,
            refused=stream.refused,
            placed=(stream.vehicle, id(stream.life)) in placed,
            stalled=not (stream.over or self.ledger.is_continued(stream))
            and now_s - link.heard_s > self._settings.stalled_s,
            ended=stream.ended,
            healthy=stream.healthy and not verdict,
            fault=verdict[:200],
        )

    def waited_for(self, now_s: float) -> bool:
        """Whether another node that is there lacks something that this one holds."""
        for peer in self._peers.values():
            if now_s < peer.heard_s + self._settings.stalled_s:
                for key, stream in self.ledger.streams.items():
                    if stream.next - 1 > peer.last.get(key, -1):
                        return True
        return False

    @property
    def complete(self) -> bool:
        """Whether as many vehicles as expected are over."""
        vehicles = {vehicle for vehicle, _ in self.ledger.streams}
        return 0 < self._expected <= sum(self.over(vehicle) for vehicle in vehicles)

    def over(self, vehicle: str) -> bool:
        """Whether the newest epoch of a vehicle is over: ended and folded, or quarantined and nothing more in sight."""
        streams = [s for s in self.ledger.streams.values() if s.vehicle == vehicle and (s.next > 0 or s.parked)]
        if not streams:
            return False
        newest = max(streams, key=lambda s: s.epoch)
        link = self._link(newest)
        in_sight = link.elsewhere if vehicle in self.gone else self._wanted(newest, link)
        if newest.next == 0:
            return bool(self.ledger.verdict(newest))
        return newest.over or (newest.stop is not None and in_sight < newest.next)
