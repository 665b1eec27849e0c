"""One epoch of one vehicle, as a fusion node holds it."""

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, field

from fleet_seif.envelope import KIND_SNAPSHOT, body_digest, kind_of
from fleet_seif.messages import DeltaMessage, Epoch, Hello
from fleet_seif.streams import EMPTY_PREFIX, extend_prefix
from fusion.life import LifeTotal

CHECK_DIGESTS_MAX = 10_000


@dataclass(frozen=True)
class Parked:
    """A message that waits for an earlier one. prefix_digest, voucher: of a snapshot."""

    message: DeltaMessage
    data: bytes
    prefix_digest: bytes | None = None
    voucher: bytes = b""


@dataclass(eq=False)
class Stream:
    """What is known of an epoch.

    log: the bytes folded, with the first number, the time and (at check points) the prefix digest of each.
    life: the sum that it is folded into; an epoch that continues another shares it. fault: why it is quarantined.
    stop, evidence: from which number on it contradicts itself, and the proof. witness: the heartbeat with which the
    vehicle announced a check point that this node has reached too, and up to which it may forget single messages.
    voucher: the same for the snapshot that is held. announced: digests by number, each with its heartbeat.
    """

    vehicle: str
    epoch: Epoch
    hello: Hello | None = None
    life: LifeTotal | None = None
    next: int = 0
    prefix_digest: bytes = EMPTY_PREFIX
    checked: int = -1
    check_digests: dict[int, bytes] = field(default_factory=dict)
    parked: dict[int, Parked] = field(default_factory=dict)
    parked_firsts: list[int] = field(default_factory=list)
    parked_bytes: int = 0
    log: list[bytes] = field(default_factory=list)
    log_bytes: int = 0
    firsts: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    step: int = 0
    ended: bool = False
    fault: str | None = None
    stop: int | None = None
    evidence: bytes = b""
    evidence_id: bytes = b""
    witness: bytes = b""
    voucher: bytes = b""
    announced: dict[int, tuple[bytes, bytes]] = field(default_factory=dict)
    duplicates: int = 0
    refused: int = 0

    @property
    def key(self) -> tuple[str, Epoch]:
        return self.vehicle, self.epoch

    @property
    def number(self) -> int:
        """Number of the life it belongs to."""
        return 0 if self.hello is None else self.hello.life

    @property
    def healthy(self) -> bool:
        return self.life is None or self.life.healthy

    @property
    def quarantine(self) -> str:
        """Why nothing more of it counts, "" where everything does."""
        if self.stop is not None:
            return f"it contradicts itself from message {self.stop} on"
        return self.fault or ""

    @property
    def over(self) -> bool:
        """Whether nothing more can be folded."""
        return self.ended or self.fault is not None or (self.stop is not None and self.next >= self.stop)

    def takes(self, last: int) -> bool:
        """Whether a message that ends with this number may still count."""
        return not self.over and (self.stop is None or last < self.stop)

    def bytes_at(self, sequence: int) -> bytes:
        """The folded message that covers a sequence number below `next`."""
        return self.log[self.index_of(sequence)]

    def index_of(self, sequence: int) -> int:
        """Where in the log it is."""
        return bisect_right(self.firsts, sequence) - 1

    @property
    def after_snapshot(self) -> int:
        """The first number that no snapshot stands for; 0 without a snapshot."""
        if not self.log or kind_of(self.log[0]) != KIND_SNAPSHOT:
            return 0
        return self.firsts[1] if len(self.firsts) > 1 else self.next

    def snapshot_covers(self, last: int) -> bool:
        """Whether a snapshot stands for all single messages up to this number."""
        return last < self.after_snapshot

    def park(self, parked: Parked) -> None:
        self.parked[parked.message.first] = parked
        insort(self.parked_firsts, parked.message.first)
        self.parked_bytes += len(parked.data)

    def overlapping(self, first: int, last: int) -> list[Parked]:
        """What is parked about some of these numbers; only a snapshot, parked as 0, may overlap others that are."""
        low, high = bisect_left(self.parked_firsts, first), bisect_right(self.parked_firsts, last)
        near = {0, *self.parked_firsts[max(low - 1, 0) : high]}
        found = [self.parked[each] for each in sorted(near) if each in self.parked]
        return [each for each in found if each.message.first <= last and first <= each.message.last]

    def unpark(self, first: int) -> Parked:
        parked = self.parked.pop(first)
        del self.parked_firsts[bisect_left(self.parked_firsts, first)]
        self.parked_bytes -= len(parked.data)
        return parked

    def note(self, message: DeltaMessage, data: bytes, prefix_digest: bytes | None) -> None:
        """Append to the log what has been folded, or what was refused for good as the next message."""
        self.prefix_digest = prefix_digest or extend_prefix(self.prefix_digest, body_digest(data))
        self.hello = message.hello or self.hello
        self.log.append(data)
        self.log_bytes += len(data)
        self.firsts.append(message.first)
        self.times_s.append(message.time_s)
        self.next = message.last + 1
        self.step = message.step
        self.ended = message.end

    def note_check(self) -> None:
        """The prefix up to here has been checked."""
        self.checked = self.next - 1
        self.check_digests[self.checked] = self.prefix_digest
        while len(self.check_digests) > CHECK_DIGESTS_MAX:
            del self.check_digests[next(iter(self.check_digests))]

    def forget_folded(self) -> list[bytes]:
        """Start over; returns the log. What is known from elsewhere (parked, evidence, counts) stays."""
        log = self.log
        self.life, self.next, self.prefix_digest, self.checked = None, 0, EMPTY_PREFIX, -1
        self.check_digests, self.log, self.log_bytes, self.firsts, self.times_s = {}, [], 0, [], []
        self.step, self.ended, self.fault = 0, False, None
        return log
