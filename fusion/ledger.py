"""What each vehicle has contributed: every message exactly once and in order. The joint map is a view of this.

1. A stream is one epoch of one vehicle. Its messages are folded in sequence order, each exactly once; an epoch that
   continues another is folded once that one is complete up to where it is continued.
2. A message that arrives early is parked. What goes beyond a limit (messages, bytes, width of the gap) is dropped and
   counted, and asked for again later: limits never condemn anybody.
3. A stream is quarantined where a message of its contiguous prefix breaks the rules (see LifeTotal), or where two
   authentic messages contradict each other (see streams.contradiction). The verdict depends on the messages alone.
4. A quarantined stream stays at its last checked prefix; others go on.
5. The vehicle's own snapshot, or that of another node with a digest the vehicle announced, replaces a shorter prefix.
6. The same messages and events in any order, with any duplication, leave the same totals and digests.
7. No I/O and no clock: bytes in, totals and changes for the store out. Whoever acknowledges commits the changes first.
"""

import hashlib
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from enum import Enum, auto

import numpy as np

from fleet_seif.config import FusionSettings
from fleet_seif.envelope import KIND_SNAPSHOT, authenticate, body_digest, kind_of
from fleet_seif.errors import WireError
from fleet_seif.information import delta_digest
from fleet_seif.joint import Life, landmark_classes
from fleet_seif.joint_records import Classes
from fleet_seif.messages import Action, DeltaMessage, Epoch, Evidence, LandmarkName, OperatorEvent, Snapshot
from fleet_seif.node_wire import EVENTS_MAX, STREAMS_MAX, decode_event, decode_evidence, encode_event, encode_evidence
from fleet_seif.signing import KeyRing, Role, Signer
from fleet_seif.store import Change, Delete, Put
from fleet_seif.streams import Stop, contradiction, is_check_point
from fleet_seif.wire import decode_heartbeat, decode_message, decode_snapshot
from fusion import records
from fusion.events import Decisions, decide
from fusion.life import LifeTotal
from fusion.stream import Parked, Stream

EPOCHS_MAX = 250
"""Epochs of one vehicle that a node takes."""


class Receipt(Enum):
    """What became of a message. DROPPED: beyond a limit, to be asked for again."""

    FOLDED = auto()
    DUPLICATE = auto()
    PARKED = auto()
    DROPPED = auto()
    REFUSED = auto()


class Ledger:
    """See the rules above. With `keys`, only what is signed by the right key counts as authentic."""

    def __init__(self, fleet: str, settings: FusionSettings | None = None, keys: KeyRing | None = None) -> None:
        self.fleet = fleet
        self.streams: dict[tuple[str, Epoch], Stream] = {}
        self.events: dict[tuple[int, str], bytes] = {}
        self.decisions = Decisions()
        self._bytes_of: dict[str, int] = {}
        self._settings = settings or FusionSettings()
        self._keys = keys
        self._changes: list[Change] = []
        self._continued_by: dict[tuple[str, Epoch], list[Stream]] = {}
        self._parked_bytes = 0
        self._restoring = False

    def restore(self, stored: Iterable[tuple[bytes, bytes]]) -> None:
        """Take what a store has kept. Raises WireError, naming the key, where it holds what this ledger never put."""
        found: dict[bytes, list[tuple[bytes, bytes]]] = {}
        for key, value in stored:
            found.setdefault(key[:1], []).append((key, value))
        self._restoring = True
        for _, value in found.get(records.EVENT, []):
            self.accept_event(value, own=True)
        for _, value in found.get(records.EVIDENCE, []):
            self.accept_evidence(value)
        for key, value in found.get(records.MESSAGE, []):
            receipt, stream = self.accept(value)
            if receipt is Receipt.REFUSED and not stream.quarantine:
                raise WireError(f"message {int.from_bytes(key[-8:], 'big')} of {stream.vehicle!r} cannot be folded")
        for _, value in (*found.get(records.WITNESS, []), *found.get(records.VOUCHER, [])):
            decode_heartbeat(value)
        for key, value in found.get(records.WITNESS, []):
            self.stream(*records.stream_of(key)).witness = value
        for key, value in found.get(records.VOUCHER, []):
            self.stream(*records.stream_of(key)).voucher = value
        self._restoring = False
        self._changes.clear()

    @property
    def bytes_held(self) -> int:
        """Bytes of all messages that are folded."""
        return sum(self._bytes_of.values())

    def _count_bytes(self, vehicle: str) -> None:
        self._bytes_of[vehicle] = sum(s.log_bytes for s in self.streams.values() if s.vehicle == vehicle)

    def take_changes(self) -> list[Change]:
        """What the store must keep of all that has happened since the last call."""
        changes, self._changes = self._changes, []
        return changes

    def contents(self) -> list[Change]:
        """What a store must hold to restore all of it."""
        changes: list[Change] = [Put(records.event_key(*key), data) for key, data in self.events.items()]
        for stream in self.streams.values():
            for table, value in (
                (records.WITNESS, stream.witness),
                (records.VOUCHER, stream.voucher),
                (records.EVIDENCE, stream.evidence),
                (records.QUARANTINE, stream.quarantine.encode()),
            ):
                if value:
                    changes.append(Put(records.stream_key(table, *stream.key), value))
            for first, data in zip(stream.firsts, stream.log, strict=True):
                changes.append(Put(records.message_key(*stream.key, first), data))
        return changes

    def stream(self, vehicle: str, epoch: Epoch) -> Stream:
        """The stream of an epoch, empty if nothing is known of it. Raises WireError at the limit of streams."""
        key = (vehicle, epoch)
        if key not in self.streams:
            if len(self.streams) >= STREAMS_MAX or sum(name == vehicle for name, _ in self.streams) >= EPOCHS_MAX:
                raise WireError(
                    f"epoch {epoch} of {vehicle!r}: at most {EPOCHS_MAX} epochs a vehicle and {STREAMS_MAX} in all"
                )
            self.streams[key] = Stream(vehicle=vehicle, epoch=epoch)
        return self.streams[key]

    def accept(self, data: bytes, sender: str | None = None) -> tuple[Receipt, Stream]:
        """Take one message or snapshot. `sender`: the vehicle whose key it came by; None: our own store.

        Raises WireError, with nothing changed, for bytes that are no authentic message of this fleet and sender.
        """
        if kind_of(data) == KIND_SNAPSHOT:
            snapshot = decode_snapshot(data)
            self._check_origin(snapshot.message, sender)
            role, name = (Role.NODE, snapshot.maker) if snapshot.maker else (Role.VEHICLE, snapshot.message.vehicle)
            if sender is not None:
                authenticate(data, self._keys, role, name)
            return self._accept_snapshot(snapshot, data, sender)
        if sender is not None:
            authenticate(data, self._keys, Role.VEHICLE, sender)
        message = decode_message(data)
        self._check_origin(message, sender)
        stream = self.stream(message.vehicle, message.epoch)
        receipt = self._accept_message(stream, message, data)
        if receipt is Receipt.FOLDED or stream.over:
            self._fold_parked(stream)
        stream.duplicates += receipt is Receipt.DUPLICATE
        stream.refused += receipt is Receipt.REFUSED
        return receipt, stream

    def _check_origin(self, message: DeltaMessage, sender: str | None) -> None:
        if message.fleet != self.fleet:
            raise WireError(f"message of fleet {message.fleet!r}, this is fleet {self.fleet!r}")
        if sender is not None and message.vehicle != sender:
            raise WireError(f"message of vehicle {message.vehicle!r} came under the key of {sender!r}")

    def _accept_message(self, stream: Stream, message: DeltaMessage, data: bytes) -> Receipt:
        if message.first < stream.next:
            if stream.snapshot_covers(message.last):
                return Receipt.DUPLICATE
            return self._compare(stream, message, data, stream.bytes_at(message.first))
        if stream.parked:
            for parked in self._overlapping(stream, message):
                if parked.prefix_digest is not None and message.last <= parked.message.last:
                    return Receipt.DUPLICATE  # a snapshot that waits stands for it
                return self._compare(stream, message, data, parked.data)
        if not stream.takes(message.last):
            return Receipt.REFUSED
        if self._contradicts_another_epoch(stream, message, data):
            return Receipt.REFUSED
        if message.first == stream.next and self._may_begin(stream, message):
            if self._full(stream.vehicle, len(data)):
                return Receipt.DROPPED
            self._fold(stream, Parked(message, data))
            return Receipt.REFUSED if stream.fault else Receipt.FOLDED
        return self._park(stream, Parked(message, data))

    def _full(self, vehicle: str, size: int) -> bool:
        """Whether so many bytes more of a vehicle are too many."""
        settings = self._settings
        of_vehicle = self._bytes_of.get(vehicle, 0)
        full = self.bytes_held + size > settings.ledger_bytes_max or of_vehicle + size > settings.vehicle_bytes_max
        return full and not self._restoring

    def _compare(self, stream: Stream, message: DeltaMessage, data: bytes, held: bytes) -> Receipt:
        """A message about numbers that are held already: the same again, or proof against its vehicle."""
        if body_digest(held) == body_digest(data):
            return Receipt.DUPLICATE
        if kind_of(held) != KIND_SNAPSHOT:
            stop = contradiction(decode_message(held), message)
            if stop is not None:
                self._convict(held, data, stop)
        return Receipt.REFUSED

    def _overlapping(self, stream: Stream, message: DeltaMessage) -> list[Parked]:
        exact = stream.parked.get(message.first)
        return ([] if exact is None else [exact]) + stream.overlapping(message.first, message.last)

    def _contradicts_another_epoch(self, stream: Stream, message: DeltaMessage, data: bytes) -> bool:
        """Whether this message and one that is held about another epoch cannot both be true."""
        if message.hello is None and stream.key not in self._continued_by:
            return False
        rivals = [_hello_of(s) for s in self._continued_by.get(stream.key, [])]
        continues = None if message.hello is None else message.hello.continues
        if continues is not None:
            before = self.streams.get((stream.vehicle, continues.epoch))
            rivals += [_hello_of(s) for s in self._continued_by.get((stream.vehicle, continues.epoch), [])]
            if before is not None:
                at = bisect_right(before.parked_firsts, continues.last)
                beyond = [before.parked[first] for first in before.parked_firsts[max(at - 1, 0) : at + 1]]
                rivals += [parked.data for parked in beyond if parked.message.last > continues.last]
                if before.next > continues.last + 1:
                    rivals.append(before.bytes_at(continues.last + 1))
        found = False
        for rival in rivals:
            if rival is None or kind_of(rival) == KIND_SNAPSHOT:
                continue
            stop = contradiction(decode_message(rival), message)
            if stop is not None:
                self._convict(rival, data, stop)
                found = True
        return found

    def _may_begin(self, stream: Stream, message: DeltaMessage) -> bool:
        """Whether the epoch that this one continues is complete to where it does; others may begin at once."""
        if message.first > 0 or message.hello is None or message.hello.continues is None:
            return True
        continues = message.hello.continues
        before = self.streams.get((stream.vehicle, continues.epoch))
        if before is None or before is stream:
            return False
        whole = before.next == continues.last + 1 and before.life is not None
        rivals = self._continued_by.get(before.key, [])
        alone = not any(rival is not stream and rival.next > 0 for rival in rivals)
        return whole and alone and before.fault is None and before.stop is None

    def _park(self, stream: Stream, parked: Parked) -> Receipt:
        settings, message = self._settings, parked.message
        of_vehicle = sum(s.parked_bytes for s in self.streams.values() if s.vehicle == stream.vehicle)
        size = len(parked.data)
        if not self._restoring and (
            len(stream.parked) >= settings.parked_max
            or message.first - stream.next > settings.gap_max
            or of_vehicle + size > settings.parked_bytes_max
            or self._parked_bytes + size > settings.parked_bytes_all_max
        ):
            return Receipt.DROPPED
        stream.park(parked)
        self._parked_bytes += size
        self._note_continues(stream, message)
        return Receipt.PARKED

    def _unpark(self, stream: Stream, first: int) -> Parked:
        parked = stream.unpark(first)
        self._parked_bytes -= len(parked.data)
        return parked

    def _note_continues(self, stream: Stream, message: DeltaMessage) -> None:
        if message.hello is not None and message.hello.continues is not None:
            rivals = self._continued_by.setdefault((stream.vehicle, message.hello.continues.epoch), [])
            if stream not in rivals:
                rivals.append(stream)

    def _fold(self, stream: Stream, parked: Parked, *, keep: bool = True) -> None:
        """Take the next message for good: into the sum, or as the reason why there will be no more."""
        message = parked.message
        self._note_continues(stream, message)
        if message.first == 0:
            stream.life, stream.fault = self._life_of(stream, message)
        if stream.life is not None:
            stream.fault = stream.life.fold(message, check=parked.prefix_digest is not None)
        stream.note(message, parked.data, parked.prefix_digest)
        self._bytes_of[stream.vehicle] = self._bytes_of.get(stream.vehicle, 0) + len(parked.data)
        if stream.fault is None and (parked.prefix_digest is not None or is_check_point(message)):
            stream.note_check()
        if keep:
            self._changes.append(Put(records.message_key(*stream.key, message.first), parked.data))
            if stream.fault is not None:
                self._keep_verdict(stream)

    def _life_of(self, stream: Stream, message: DeltaMessage) -> tuple[LifeTotal | None, str | None]:
        continues = None if message.hello is None else message.hello.continues
        if continues is None:
            return LifeTotal(), None
        before = self.streams[stream.vehicle, continues.epoch]
        if before.prefix_digest != continues.prefix_digest:
            return None, f"continues epoch {continues.epoch} with another history than that epoch has"
        return before.life, None

    def _fold_parked(self, stream: Stream) -> None:
        """Fold what has waited for this stream to come so far, in it and in the epochs that continue it."""
        while stream.next in stream.parked and stream.takes(stream.parked[stream.next].message.last):
            if not self._may_begin(stream, stream.parked[stream.next].message):
                return
            parked = self._unpark(stream, stream.next)
            if parked.prefix_digest is None:
                self._fold(stream, parked)
                stream.refused += stream.fault is not None
            elif not self._replace_prefix(stream, parked):
                return
        behind = [first for first in stream.parked if first < stream.next or stream.over] if stream.parked else []
        for first in behind:
            parked = self._unpark(stream, first)
            self._accept_message(stream, parked.message, parked.data)
        for later in list(self._continued_by.get(stream.key, [])):
            if later.next == 0 and 0 in later.parked:
                self._fold_parked(later)

    def _accept_snapshot(self, snapshot: Snapshot, data: bytes, sender: str | None) -> tuple[Receipt, Stream]:
        message = snapshot.message
        stream = self.stream(message.vehicle, message.epoch)
        if message.last < stream.next:
            stream.duplicates += 1
            return Receipt.DUPLICATE, stream
        believed = not snapshot.maker or sender is None
        digest, heartbeat = stream.announced.get(message.last, (b"", b""))
        believed = believed or digest == snapshot.prefix_digest
        later = any(s.next > 0 for s in self._continued_by.get(stream.key, []))
        if not believed or later or not stream.takes(message.last):
            stream.refused += 1
            return Receipt.REFUSED, stream
        if self._full(stream.vehicle, len(data)):
            return Receipt.DROPPED, stream
        parked = Parked(message, data, snapshot.prefix_digest, heartbeat if snapshot.maker else b"")
        if not self._may_begin(stream, message):
            if 0 in stream.parked:
                return Receipt.DUPLICATE, stream
            return self._park(stream, parked), stream
        if not self._replace_prefix(stream, parked):
            return Receipt.REFUSED, stream
        self._fold_parked(stream)
        return Receipt.FOLDED, stream

    def _replace_prefix(self, stream: Stream, snapshot: Parked) -> bool:
        """Put a snapshot in the place of a shorter prefix; False, with nothing changed, where it breaks the rules:
        whoever made it, what is held already counts for more."""
        chain = self._chain(stream, snapshot.message)
        logs = {s.key: list(s.log) for s in chain}
        self._refold(chain, {**logs, stream.key: [snapshot.data]})
        if stream.fault is not None:
            self._refold(chain, logs)
            stream.refused += 1
            return False
        self._changes.append(self._delete(stream, 0))
        self._changes.append(Put(records.message_key(*stream.key, 0), snapshot.data))
        if snapshot.voucher:
            stream.voucher = snapshot.voucher
            self._changes.append(Put(records.stream_key(records.VOUCHER, *stream.key), snapshot.voucher))
        return True

    def _delete(self, stream: Stream, first: int) -> Delete:
        """The change that forgets a stream's messages from a number on."""
        return Delete(
            records.message_key(*stream.key, first), records.stream_key(records.MESSAGE, *stream.key) + b"\xff" * 9
        )

    def _chain(self, stream: Stream, message: DeltaMessage | None = None) -> list[Stream]:
        """The streams of a life up to this one, and those after it. message: its first, where it has none yet."""
        chain = [stream]
        hello = stream.hello if message is None else stream.hello or message.hello
        while hello is not None and hello.continues is not None and len(chain) <= EPOCHS_MAX:
            chain.insert(0, self.streams[stream.vehicle, hello.continues.epoch])
            hello = chain[0].hello
        while later := [s for s in self._continued_by.get(chain[-1].key, []) if s.next > 0 and s not in chain]:
            chain.append(later[0])
        return chain

    def _refold(self, chain: list[Stream], logs: dict[tuple[str, Epoch], list[bytes]]) -> None:
        """Make a life anew from the logs of its streams, each as far as it counts."""
        for each in chain:
            each.forget_folded()
        self._count_bytes(chain[0].vehicle)
        for each in chain:
            for data in logs[each.key]:
                parked = _parked_of(data)
                if not each.takes(parked.message.last) or not self._may_begin(each, parked.message):
                    break
                self._fold(each, parked, keep=False)

    def _convict(self, a: bytes, b: bytes, stop: Stop) -> None:
        """Take two messages that contradict each other; of several proofs the one about the earliest message counts."""
        first, second = sorted((a, b), key=body_digest)
        identity = hashlib.blake2b(body_digest(first) + body_digest(second), digest_size=32).digest()
        stream = self.stream(stop.vehicle, stop.epoch)
        sequence = stop.sequence
        if stream.stop is not None and (stream.stop, stream.evidence_id) <= (sequence, identity):
            return
        stream.stop, stream.evidence_id = sequence, identity
        stream.evidence = encode_evidence(Evidence(first=first, second=second))
        self._changes.append(Put(records.stream_key(records.EVIDENCE, *stream.key), stream.evidence))
        for parked in [p for p in stream.parked.values() if p.message.last >= sequence]:
            self._unpark(stream, parked.message.first)
        chain = self._chain(stream)
        if stream.next > sequence or chain[-1] is not stream:
            self._refold(chain, {s.key: list(s.log) for s in chain})
            self._changes.extend(self._delete(s, s.next) for s in chain)
        for each in chain:
            self._keep_verdict(each)

    def _keep_verdict(self, stream: Stream) -> None:
        key = records.stream_key(records.QUARANTINE, *stream.key)
        if stream.quarantine:
            self._changes.append(Put(key, stream.quarantine.encode()))
        else:
            self._changes.append(Delete(key, key + b"\0"))

    def is_continued(self, stream: Stream) -> bool:
        """Whether an epoch that continues this one has begun."""
        return any(later.next > 0 for later in self._continued_by.get(stream.key, []))

    def verdict(self, stream: Stream) -> str:
        """Why nothing more of a stream counts: its quarantine, or that of an epoch that it continues; "" for none."""
        for _ in range(EPOCHS_MAX):
            if stream.quarantine:
                return stream.quarantine
            hello = stream.hello or (stream.parked[0].message.hello if 0 in stream.parked else None)
            before = self.streams.get((stream.vehicle, hello.continues.epoch)) if hello and hello.continues else None
            if before is None:
                return ""
            stream = before
        return "continues more epochs than are taken"

    def keep_witness(self, stream: Stream, checked: int, heartbeat: bytes) -> None:
        """Keep the heartbeat with which a vehicle announced a check point that this node has reached too."""
        if not stream.witness or decode_heartbeat(stream.witness).checked < checked:
            stream.witness = heartbeat
            self._changes.append(Put(records.stream_key(records.WITNESS, *stream.key), heartbeat))

    def replace(self, stream: Stream, changes: Sequence[Change]) -> None:
        """Take over what compacting a stream has changed."""
        self._count_bytes(stream.vehicle)
        self._changes.extend(changes)

    def accept_evidence(self, data: bytes) -> bool:
        """Take the proof that another node has; False where it is known. Raises WireError where it proves nothing."""
        evidence = decode_evidence(data)
        a, b = decode_message(evidence.first), decode_message(evidence.second)
        for message, content in ((a, evidence.first), (b, evidence.second)):
            self._check_origin(message, a.vehicle)
            if not self._restoring:
                authenticate(content, self._keys, Role.VEHICLE, message.vehicle)
        stop = contradiction(a, b)
        if stop is None or body_digest(evidence.first) == body_digest(evidence.second):
            raise WireError("evidence: the two messages do not contradict each other")
        known = self.stream(stop.vehicle, stop.epoch).evidence_id
        self._convict(evidence.first, evidence.second, stop)
        return self.stream(stop.vehicle, stop.epoch).evidence_id != known

    def accept_event(self, data: bytes, *, own: bool = False) -> bool:
        """Take the decision of an operator; False where it is known. Raises WireError."""
        event = decode_event(data)
        if event.fleet != self.fleet:
            raise WireError(f"event of fleet {event.fleet!r}, this is fleet {self.fleet!r}")
        if not own:
            authenticate(data, self._keys, Role.OPERATOR, event.operator)
        key = (event.number, event.operator)
        held = self.events.get(key)
        if held is not None and body_digest(held) <= body_digest(data):
            return False  # of two that claim one id the smaller digest counts, on every node
        if held is None and len(self.events) >= EVENTS_MAX:
            raise WireError(f"event {key}: at most {EVENTS_MAX} are kept")
        self.events[key] = data
        self.decisions = decide(decode_event(each) for each in self.events.values())
        self._changes.append(Put(records.event_key(*key), data))
        return True

    def events_digest(self) -> bytes:
        """32 bytes that identify the decisions held, zeros for none."""
        if not self.events:
            return bytes(32)
        digests = b"".join(body_digest(self.events[key]) for key in sorted(self.events))
        return hashlib.blake2b(digests, digest_size=32).digest()

    def issue(
        self,
        operator: str,
        action: Action,
        *,
        landmarks: tuple[LandmarkName, LandmarkName] | None = None,
        vehicle: str = "",
        signer: Signer | None = None,
    ) -> bytes:
        """Take a new decision of an operator of this node; returns its bytes."""
        number = 1 + max((number for number, _ in self.events), default=0)
        event = OperatorEvent(
            fleet=self.fleet, number=number, operator=operator, action=action, landmarks=landmarks, vehicle=vehicle
        )
        data = encode_event(event, signer)
        self.accept_event(data)
        return data

    def placed(self) -> list[Stream]:
        """The lives that maps are made from, each by its first epoch, in canonical order."""
        lives = [
            s
            for s in self.streams.values()
            if s.life is not None and s.hello is not None and s.hello.placed and s.hello.continues is None
            and s.life.checked.frames and s.life.checked.healthy and s.vehicle not in self.decisions.retracted
        ]  # fmt: skip
        first: dict[tuple[str, int], Stream] = {}
        for stream in sorted(lives, key=lambda s: (s.vehicle, s.number, s.epoch)):
            first.setdefault((stream.vehicle, stream.number), stream)
        return list(first.values())

    def lives(self, *, live: bool = False) -> tuple[Life, ...]:
        """What the placed lives have contributed, in canonical order: as checked, or `live` up to the last message."""
        stuck = {id(s.life) for s in self.streams.values() if s.quarantine}
        return tuple(_contribution(stream, live and id(stream.life) not in stuck) for stream in self.placed())

    def classes(self, lives: Sequence[Life]) -> Classes:
        """Which landmarks are the same, by signatures, aliases and what operators have decided."""
        return landmark_classes(lives, self.decisions.forced, self.decisions.forbidden)

    def ledger_digest(self) -> bytes:
        """32 bytes that identify all that has been folded, and the decisions of operators."""
        digest = hashlib.blake2b(digest_size=32)
        for vehicle, epoch in sorted(self.streams):
            stream = self.streams[vehicle, epoch]
            if stream.next > 0:
                text = f"{vehicle} {epoch.counter} {epoch.nonce} {stream.next} "
                digest.update(text.encode() + stream.prefix_digest)
        digest.update(self.events_digest())
        return digest.digest()

    def map_digest(self, classes: Classes | None = None) -> bytes:
        """32 bytes that identify what the canonical map is assembled from; see `digest_of`.

        Args:
            classes: with all merges (see fusion.merges); by default those that need no solution, which are all there
                are where every landmark carries a signature.
        """
        lives = self.lives()
        return digest_of(lives, self.classes(lives) if classes is None else classes)


def digest_of(lives: Sequence[Life], classes: Classes) -> bytes:
    """32 bytes that identify what a map is assembled from; no epoch's nonce enters."""
    digest = hashlib.blake2b(digest_size=32)
    for life in lives:
        digest.update(f"{life.vehicle} {life.life} ".encode())
        digest.update(life.start_pose.tobytes() + life.start_pose_cov.tobytes())
        for frame, total in enumerate(life.frames):
            if len(total.variables):
                digest.update(frame.to_bytes(8, "little") + delta_digest(total))
    digest.update(repr([[tuple(name) for name in group] for group in classes]).encode())
    return digest.digest()


def _hello_of(stream: Stream) -> bytes | None:
    """The first message of a stream, folded or parked."""
    if stream.log:
        return stream.log[0]
    return stream.parked[0].data if 0 in stream.parked else None


def _parked_of(data: bytes) -> Parked:
    if kind_of(data) == KIND_SNAPSHOT:
        snapshot = decode_snapshot(data)
        return Parked(snapshot.message, data, snapshot.prefix_digest)
    return Parked(decode_message(data), data)


def _contribution(stream: Stream, live: bool) -> Life:
    life = stream.life
    assert life is not None
    assert life.hello is not None
    held = life.newest if live else life.checked
    return Life(
        vehicle=stream.vehicle,
        life=stream.number,
        start_pose=np.asarray(life.hello.start_pose),
        start_pose_cov=np.asarray(life.hello.start_pose_cov),
        frames=tuple(held.frames[number] for number in sorted(held.frames)),
        signatures=tuple(life.signatures[: held.names]),
        aliases=held.aliases,
        consistent=held.consistent,
    )
