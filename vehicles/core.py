"""What a vehicle does, without I/O: readings and bytes from the bus in, bytes for the bus and the store out.

1. One reading is one message; sequence 0 is the hello with what is seen before any motion.
2. Time is the vehicle's own and grows from reading to reading; others are refused and change nothing.
3. Nothing of the joint map ever enters the filter (DESIGN D4).
4. Once the filter has refused a reading for numerical reasons the vehicle says that it is not healthy, and so it does
   while its map is doubtful (fleet_seif.frames).
5. What has been committed outlives the process: `resume` goes on, in a new epoch that continues the last one, exactly
   where the last committed step ended, or begins a fresh life. The earlier epochs stay open for repair.
6. Nothing is put before it is committed: `take_changes`, commit, `note_commit`, `release`.
"""

import contextlib
import dataclasses
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version

import msgpack
import numpy as np

from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.envelope import authenticate
from fleet_seif.errors import NumericalError, ReadingRefused, RunError, WireError
from fleet_seif.filters import StepResult
from fleet_seif.frames import FramedFilter
from fleet_seif.geometry import act_all, compose
from fleet_seif.messages import Ack, Continues, DeltaMessage, Epoch, FramePart, Hello, check_name
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints, Reading, Sightings
from fleet_seif.signing import KeyRing, Role, Signer
from fleet_seif.store import Change, Delete, Put
from fleet_seif.wire import POSE_MAX, decode_ack, decode_range, encode_heartbeat, is_start_covariance
from vehicles import records
from vehicles.outbox import Outbox
from vehicles.records import EpochRecord, Trimmed

log = logging.getLogger(__name__)
SIGHTINGS_MAX = 1024
EPOCHS_KEPT = 64
STATE_BYTES_LEAST = 64 * 1024
"""Readings are kept until they take as much as the filter's state, and at least this much; then the state is."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Identity:
    """Who a vehicle is and where it starts; see fleet_seif.messages.Hello for the start pose.

    epoch: of this run of the process; its counter grows from run to run where a store keeps it. life: of a first run.
    """

    fleet: str
    vehicle: str
    epoch: Epoch
    start_pose: Floats
    start_pose_cov: Floats
    life: int = 0


@dataclass
class Counters:
    """What a vehicle counts."""

    readings_refused: int = 0
    sightings_refused: int = 0
    steps_beyond_active_max: int = 0
    acks_refused: int = 0
    messages: int = 0
    bytes_put: int = 0


def _check_start(identity: Identity) -> None:
    pose, cov = identity.start_pose, identity.start_pose_cov
    if pose.shape != (3,) or not np.all(np.abs(pose) <= POSE_MAX):
        raise ValueError(
            f"start_pose {pose.tolist()}: expected three finite numbers, x m, y m, theta rad, none beyond {POSE_MAX:g}"
        )
    if cov.shape != (3, 3) or not (np.array_equal(cov, np.zeros((3, 3))) or is_start_covariance(cov)):
        raise ValueError(
            f"start_pose_cov {cov.tolist()}: expected zeros (given) or a symmetric positive definite (3, 3) matrix"
        )


class VehicleCore:
    """See the rules above.

    Args:
        required: the nodes that must acknowledge; none: any. durable: there is a store that keeps what changes.
        signer, keys: of a fleet that signs its messages.
    """

    def __init__(
        self,
        identity: Identity,
        settings: FilterSettings,
        publish: PublishSettings,
        model: int = RANGE_BEARING,
        *,
        required: tuple[str, ...] = (),
        durable: bool = False,
        signer: Signer | None = None,
        keys: KeyRing | None = None,
    ) -> None:
        check_name(identity.fleet, "fleet")
        check_name(identity.vehicle, "vehicle")
        _check_start(identity)
        self.identity = identity
        self.filter = FramedFilter(settings, model)
        self.counters = Counters()
        self.steps = 0
        self.ended = False
        self.healthy = True
        self.faults: dict[str, str] = {}
        self.time_s = -math.inf
        self._publish = publish
        self._required, self._signer, self._keys = required, signer, keys
        self._durable = durable
        self._heartbeat_at_s = -math.inf
        self._given: list[int] = []
        self._reading_bytes = 0
        self._state_bytes = STATE_BYTES_LEAST
        self._kept: list[Change] = []
        self._outboxes: list[Outbox] = []
        self._open(identity.life)

    @property
    def outbox(self) -> Outbox:
        """The outbox of the newest epoch."""
        return self._outboxes[-1]

    def _open(self, life: int) -> None:
        """Begin an epoch of a life: everything that follows belongs to it."""
        ordinal = self._outboxes[-1].ordinal + 1 if self._outboxes else 0
        record = EpochRecord(
            epoch=self.identity.epoch, life=life, base=self.filter.published(), ended=len(self.filter.ends),
            names=len(self.filter.signatures),
        )  # fmt: skip
        self._outboxes.append(
            Outbox(self._publish, record, ordinal=ordinal, required=self._required, signer=self._signer)
        )
        settings = self.filter.settings.model_dump_json()
        about = msgpack.packb((self.identity.fleet, self.identity.vehicle, self.filter.model, settings))
        self._kept += [
            Put(records.COUNTER, self.identity.epoch.counter.to_bytes(8, "big")),
            Put(records.IDENTITY, about),
            Put(records.numbered(records.EPOCH, ordinal), record.pack()),
        ]
        while len(self._outboxes) > EPOCHS_KEPT and self._outboxes[0].done:
            gone = self._outboxes.pop(0).ordinal
            tables = (records.EPOCH, records.ENDS, records.MESSAGE, records.TRIMMED)
            self._kept += [Delete(records.numbered(t, gone), records.numbered(t, gone + 1)) for t in tables]

    def resume(self, stored: Iterable[tuple[bytes, bytes]], *, fresh: bool = False) -> bool:
        """Go on from what a store has kept, or (`fresh`) begin a new life beside it. False where it is empty.

        Raises RunError where the store is another vehicle's, or its readings do not give the same filter any more.
        """
        kept = dict(stored)
        if not kept:
            return False
        try:
            self._resume(kept, fresh)
        except (
            WireError,
            ValueError,
            KeyError,
            TypeError,
            IndexError,
            ArithmeticError,
            msgpack.UnpackException,
        ) as error:
            raise RunError(
                f"the store is damaged, or not that of a vehicle ({type(error).__name__}: {error}): move it away and"
                " start fresh, as another life"
            ) from None
        return True

    def _resume(self, kept: dict[bytes, bytes], fresh: bool) -> None:
        same = self._check_store(kept[records.IDENTITY], fresh)
        counter = 1 + int.from_bytes(kept[records.COUNTER], "big")
        epoch = Epoch(max(counter, self.identity.epoch.counter), self.identity.epoch.nonce)
        self.identity = dataclasses.replace(self.identity, epoch=epoch)
        self._kept.clear()
        self._outboxes = [self._restored(key, kept) for key in sorted(kept) if key[:1] == records.EPOCH]
        if fresh:
            with contextlib.suppress(RunError):  # then the earlier life has no snapshot, only the messages it holds
                if same:
                    self._replay(kept)
                    self.outbox.close(self.filter.published(), self.filter.signatures)
            self._forget_filter()
            self._open(self.outbox.record.life + 1)
            return
        self._replay(kept)
        last = self.outbox
        if last.last < 0:  # it had not got as far as its hello
            self._open(last.record.life)
        elif last.ended:
            self.ended = True
        else:
            last.close(self.filter.published(), self.filter.signatures)
            continues = Continues(epoch=last.record.epoch, last=last.last, prefix_digest=last.digest_of_all())
            self._open(last.record.life)
            self._send(time_s=self.time_s, parts=(), hello=self._hello(continues))

    def _check_store(self, about: bytes, fresh: bool) -> bool:
        """Whether the store was written with this filter. Raises RunError where nothing can be done with it."""
        fleet, vehicle, model, settings = msgpack.unpackb(about)
        mine = self.identity
        if (fleet, vehicle) != (mine.fleet, mine.vehicle):
            raise RunError(
                f"the store is that of vehicle {vehicle!r} of fleet {fleet!r}, this is {mine.vehicle!r} of "
                f"{mine.fleet!r}: give each vehicle a store of its own"
            )
        same = bool((model, settings) == (self.filter.model, self.filter.settings.model_dump_json()))
        if not same and not fresh:
            raise RunError(
                f"the store was written with other filter settings ({settings}, model {model}): give the same, or begin"
                " a fresh life"
            )
        return same

    def _restored(self, key: bytes, kept: dict[bytes, bytes]) -> Outbox:
        ordinal = int.from_bytes(key[1:], "big")
        record = EpochRecord.read(kept[key])
        outbox = Outbox(self._publish, record, ordinal=ordinal, required=self._required, signer=self._signer)
        trimmed = kept.get(records.numbered(records.TRIMMED, ordinal))
        stem = records.numbered(records.MESSAGE, ordinal)
        messages = [kept[name] for name in sorted(kept) if name.startswith(stem)]
        stem = records.numbered(records.ENDS, ordinal)
        ends = {
            int.from_bytes(name[9:], "big"): np.frombuffer(pose) for name, pose in kept.items() if name.startswith(stem)
        }
        outbox.restore(None if trimmed is None else Trimmed.read(trimmed), ends, messages)
        return outbox

    def _replay(self, kept: dict[bytes, bytes]) -> None:
        """The filter as it was: its last state, and the readings since."""
        if records.STATE in kept:
            state = msgpack.unpackb(kept[records.STATE], use_list=False)
            self.filter.restore(state["filter"])
            self.steps, self.time_s, self.healthy = state["steps"], state["time_s"], state["healthy"]
            self._given = list(state["given"])
        for key in sorted(name for name in kept if name[:1] == records.READING):
            reading, mark = records.read_reading(kept[key])
            step = int.from_bytes(key[1:], "big")
            result, _ = self.filter.step(reading) if step else self.filter.start(reading.sightings)
            if records.fingerprint(result.delta) != mark:
                raise RunError(
                    f"step {step} gives another result than when the store was written, by another version or on"
                    " another kind of machine: begin a fresh life"
                )
            self.steps, self.time_s = step, reading.time_s
            self._given.append(len(reading.sightings.z))
            self._reading_bytes += len(kept[key])
        self.filter.take_aliases(), self.filter.take_begun()  # they have been published
        newest = self.outbox.newest
        if newest is not None:
            self.healthy = self.healthy and (newest.healthy or self.filter.doubtful)
        if self.outbox.ended:
            self.filter.end()  # what it published then has been published

    def _forget_filter(self) -> None:
        self.filter = FramedFilter(self.filter.settings, self.filter.model)
        self.steps, self.time_s, self.healthy = 0, -math.inf, True
        self._given = []
        self._kept += [Delete(table, records.after(table)) for table in (records.READING, records.STATE)]

    @property
    def pose(self) -> Floats:
        """Live estimate of the pose in the world, from this vehicle's own readings: (x m, y m, theta rad)."""
        return compose(self.identity.start_pose, self.filter.pose)

    @property
    def landmarks(self) -> Floats:
        """Live estimates of the landmarks in the world, m, shape (n, 2), by number."""
        return act_all(self.identity.start_pose, self.filter.landmarks)

    @property
    def assigned(self) -> Ints:
        """The number of the landmark that each sighting given so far is of, -1 none (of a refused reading), (S,)."""
        taken, at, found = self.filter.assigned, 0, [np.empty(0, np.int64)]
        for count in self._given:
            found.append(taken[at : at + count] if count > 0 else np.full(-count, UNKNOWN_SIGNATURE))
            at += max(count, 0)
        return np.concatenate(found)

    def start(self, time_s: float, sightings: Sightings) -> StepResult:
        """Sequence 0: the hello, and what is seen before any motion."""
        self._check(time_s, sightings)
        if self.outbox.last >= 0:
            raise ReadingRefused("this vehicle has already started")
        result, parts = self.filter.start(sightings)
        self._given.append(len(sightings.z))
        self._keep(Reading(time_s=time_s, odometry=np.zeros(3), odometry_cov=np.eye(3), sightings=sightings), result)
        self._append(time_s, result, parts, self._hello(None))
        return result

    def _hello(self, continues: Continues | None) -> Hello:
        identity, settings = self.identity, self.filter.settings
        return Hello(
            software=f"fleet-seif {version('fleet-seif')}",
            life=self.outbox.record.life,
            placed=True,
            start_pose=np.asarray(identity.start_pose, float),
            start_pose_cov=np.asarray(identity.start_pose_cov, float),
            start_information=settings.start_information,
            step_information_max=settings.step_information_max,
            continues=continues,
        )

    def _keep(self, reading: Reading, result: StepResult) -> None:
        """Have the store keep a reading, and now and then the filter's whole state instead of all readings so far."""
        if not self._durable:
            return
        if self._reading_bytes > self._state_bytes:
            state = {
                "filter": self.filter.state(),
                "steps": self.steps,
                "time_s": reading.time_s,
                "healthy": self.healthy,
                "given": self._given,
            }
            data = msgpack.packb(state)
            self._reading_bytes, self._state_bytes = 0, max(len(data), STATE_BYTES_LEAST)
            self._kept += [Delete(records.READING, records.after(records.READING)), Put(records.STATE, data)]
            return
        data = records.pack_reading(reading, result.delta)
        self._reading_bytes += len(data)
        self._kept.append(Put(records.numbered(records.READING, self.steps), data))

    def step(self, reading: Reading) -> StepResult:
        """One reading, one message. Raises ReadingRefused or NumericalError; the filter is then as it was."""
        self._check(reading.time_s, reading.sightings)
        if self.outbox.last < 0:
            raise ReadingRefused("the vehicle has not started: give what it sees before any motion to `start` first")
        try:
            result, parts = self.filter.step(reading)
        except ReadingRefused:
            self._count_refused(reading.sightings)
            raise
        except NumericalError:
            self._count_refused(reading.sightings)
            if self.healthy:
                self.healthy, self._state_bytes = False, -1  # the next step keeps the state, which says so
            raise
        self.steps += 1
        self._given.append(len(reading.sightings.z))
        self._keep(reading, result)
        self._append(reading.time_s, result, parts, None)
        return result

    def _check(self, time_s: float, sightings: Sightings) -> None:
        fault = None
        if self.ended:
            fault = "the stream has ended"
        elif not math.isfinite(time_s):
            fault = f"its time {time_s} is not finite"
        elif time_s <= self.time_s:
            fault = (
                f"its time {time_s:.6f} s is not after that of the last reading, {self.time_s:.6f} s; "
                "give readings in the order of their time, each once"
            )
        elif len(sightings.z) > SIGHTINGS_MAX:
            fault = f"it holds {len(sightings.z)} sightings, at most {SIGHTINGS_MAX} are taken"
        if fault:
            self._count_refused(sightings)
            raise ReadingRefused(f"reading refused: {fault}")

    def _count_refused(self, sightings: Sightings) -> None:
        self.counters.readings_refused += 1
        self._given.append(-len(sightings.z))

    def _append(self, time_s: float, result: StepResult, parts: tuple[FramePart, ...], hello: Hello | None) -> None:
        self.time_s = time_s
        self.counters.sightings_refused += result.refused
        if self.filter.settings.kind != "eif" and result.active > self.filter.settings.active_max:
            self.counters.steps_beyond_active_max += 1
            if self.counters.steps_beyond_active_max == 1:
                log.warning("bound_yields step=%d active=%d", self.steps, result.active)
        self._send(
            time_s=time_s,
            parts=parts,
            landmarks=(
                *((result.first_new + i, signature) for i, signature in enumerate(result.new)),
                *self.filter.take_begun(),
            ),
            aliases=self.filter.take_aliases(),
            innovation=result.innovation,
            innovation_dof=2 * result.sightings,
            refused=result.refused,
            hello=hello,
        )

    def end(self) -> None:
        """The last message: ends the open frame."""
        if self.ended:
            return
        if self.outbox.last < 0:
            raise ReadingRefused("the vehicle has not started: there is nothing to end")
        self.ended = True
        parts = self.filter.end()
        self._send(
            time_s=self.time_s,
            parts=parts,
            landmarks=self.filter.take_begun(),
            aliases=self.filter.take_aliases(),
            end=True,
        )

    def _send(self, **fields: object) -> None:
        identity = self.identity
        number = self.outbox.last + 1
        self.counters.messages += 1
        self.outbox.append(
            DeltaMessage(
                fleet=identity.fleet, vehicle=identity.vehicle, epoch=identity.epoch, first=number, last=number,
                step=self.steps, healthy=self.healthy and not self.filter.doubtful, **fields,  # type: ignore[arg-type]
            )
        )  # fmt: skip

    def take_changes(self) -> tuple[list[Change], list[int]]:
        """What the store must keep, and a mark for `note_commit` once it does."""
        changes, self._kept = self._kept, []
        for outbox in self._outboxes:
            changes += outbox.take_changes()
        return changes, [outbox.commits for outbox in self._outboxes]

    def note_commit(self, mark: list[int]) -> None:
        """What `take_changes` gave with this mark is durable."""
        for outbox, number in zip(self._outboxes, mark, strict=False):
            outbox.note_commit(number)

    def release(self) -> list[bytes]:
        """Messages to put now, in order."""
        released = [data for outbox in self._outboxes if not outbox.done for data in outbox.release()]
        self.counters.bytes_put += sum(len(data) for data in released)
        return released

    def on_ack(self, data: bytes) -> None:
        """An acknowledgement from a fusion node; what is not for this vehicle is left alone."""
        try:
            ack = decode_ack(data)
            authenticate(data, self._keys, Role.NODE, ack.node)
        except WireError:
            self.counters.acks_refused += 1
            return
        if (ack.fleet, ack.vehicle) == (self.identity.fleet, self.identity.vehicle):
            for outbox in self._outboxes:
                if outbox.record.epoch == ack.epoch:
                    self._acknowledge(outbox, ack)

    def _acknowledge(self, outbox: Outbox, ack: Ack) -> None:
        if ack.fault and len(self.faults) < self._publish.nodes_max:
            self.faults[ack.node] = ack.fault
        if not outbox.acknowledge(ack.node, ack.last, ack.prefix_digest):
            self.counters.acks_refused += 1

    def on_range(self, data: bytes) -> list[bytes]:
        """Answer to a range query: messages of an outbox, or nothing."""
        try:
            request = decode_range(data)
        except WireError:
            return []
        for outbox in self._outboxes:
            if outbox.record.epoch == request.epoch:
                published = self.filter.published if outbox is self.outbox else None
                return outbox.answer(request, published, self.filter.signatures)
        return []

    def tick(self, now_s: float) -> list[bytes]:
        """Heartbeats when they are due: of the newest epoch and of those that are not acknowledged yet; now_s is
        monotonic."""
        if now_s < self._heartbeat_at_s:
            return []
        due = [box for box in self._outboxes if box.last_put >= 0 and (box is self.outbox or not box.done)]
        if due:
            self._heartbeat_at_s = now_s + self._publish.heartbeat_s
        identity = self.identity
        return [encode_heartbeat(box.heartbeat(identity.fleet, identity.vehicle), self._signer) for box in due]

    @property
    def crowded(self) -> bool:
        """Whether a vehicle that can wait should wait for acknowledgements; for nodes that take no more it need not."""
        return self.outbox.full and not self.faults

    @property
    def done(self) -> bool:
        """Whether the stream has ended and every required node (none required: any) holds all or takes no more."""
        if not self.ended:
            return False
        if not self._required:
            return bool(self.faults) or all(outbox.done for outbox in self._outboxes)
        return all(node in self.faults or all(box.held_by(node) for box in self._outboxes) for node in self._required)
