"""What a vehicle does, without I/O: readings and bytes from the bus in, bytes for the bus out.

1. One reading is one message; sequence 0 is the hello with what is seen before any motion.
2. Time is the vehicle's own and grows from reading to reading; others are refused and change nothing.
3. Nothing of the joint map ever enters the filter (DESIGN D4).
4. Once the filter has refused a reading for numerical reasons the vehicle says that it is not healthy.
"""

import math
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np

from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.errors import NumericalError, ReadingRefused, WireError
from fleet_seif.geometry import act_all, compose
from fleet_seif.information import FrameDelta
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus, Hello, check_name
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats, Reading, Sightings
from fleet_seif.seif import Seif, StepResult
from fleet_seif.wire import decode_ack, decode_range, encode_heartbeat, is_start_covariance
from vehicles.outbox import Outbox

SIGHTINGS_MAX = 1024


@dataclass(frozen=True, eq=False, kw_only=True)
class Identity:
    """Who a vehicle is and where it starts; see fleet_seif.messages.Hello for the start pose."""

    fleet: str
    vehicle: str
    epoch: Epoch
    start_pose: Floats
    start_pose_cov: Floats
    life: int = 0
    sighting_information_max: float = 1e12


@dataclass
class Counters:
    """What a vehicle counts."""

    readings_refused: int = 0
    sightings_refused: int = 0
    acks_refused: int = 0
    messages: int = 0
    bytes_put: int = 0


def _check_start(identity: Identity) -> None:
    pose, cov = identity.start_pose, identity.start_pose_cov
    if pose.shape != (3,) or not np.all(np.isfinite(pose)):
        raise ValueError(f"start_pose {pose.tolist()}: expected three finite numbers, x m, y m, theta rad")
    if cov.shape != (3, 3) or not (np.array_equal(cov, np.zeros((3, 3))) or is_start_covariance(cov)):
        raise ValueError(
            f"start_pose_cov {cov.tolist()}: expected zeros (given) or a symmetric positive definite (3, 3) matrix"
        )


class VehicleCore:
    """See the rules above."""

    def __init__(
        self, identity: Identity, settings: FilterSettings, publish: PublishSettings, model: int = RANGE_BEARING
    ) -> None:
        check_name(identity.fleet, "fleet")
        check_name(identity.vehicle, "vehicle")
        _check_start(identity)
        self.identity = identity
        self.filter = Seif(settings, model)
        self.outbox = Outbox(publish)
        self.counters = Counters()
        self.steps = 0
        self.ended = False
        self.healthy = True
        self._time_s = -math.inf
        self._publish = publish
        self._heartbeat_at_s = -math.inf

    @property
    def pose(self) -> Floats:
        """Live estimate of the pose in the world, from this vehicle's own readings: (x m, y m, theta rad)."""
        return compose(self.identity.start_pose, self.filter.pose)

    @property
    def landmarks(self) -> Floats:
        """Live estimates of the landmarks in the world, m, shape (n, 2), by number."""
        return act_all(self.identity.start_pose, self.filter.landmarks)

    def start(self, time_s: float, sightings: Sightings) -> StepResult:
        """Sequence 0: the hello, and what is seen before any motion."""
        self._check(time_s, sightings)
        if self.outbox.last >= 0:
            raise ReadingRefused("this vehicle has already started")
        result = self.filter.start(sightings)
        identity = self.identity
        hello = Hello(
            software=f"fleet-seif {version('fleet-seif')}",
            life=identity.life,
            placed=True,
            start_pose=np.asarray(identity.start_pose, float),
            start_pose_cov=np.asarray(identity.start_pose_cov, float),
            sighting_information_max=identity.sighting_information_max,
            sightings_max=SIGHTINGS_MAX,
        )
        self._append(time_s, result, FrameStatus.OPENED, hello)
        return result

    def step(self, reading: Reading) -> StepResult:
        """One reading, one message. Raises ReadingRefused or NumericalError; the filter is then as it was."""
        self._check(reading.time_s, reading.sightings)
        if self.outbox.last < 0:
            raise ReadingRefused("the vehicle has not started: give what it sees before any motion to `start` first")
        try:
            result = self.filter.step(reading)
        except ReadingRefused:
            self.counters.readings_refused += 1
            raise
        except NumericalError:
            self.counters.readings_refused += 1
            self.healthy = False
            raise
        self.steps += 1
        self._append(reading.time_s, result, FrameStatus.CONTINUED, None)
        return result

    def _check(self, time_s: float, sightings: Sightings) -> None:
        fault = None
        if self.ended:
            fault = "the stream has ended"
        elif not math.isfinite(time_s):
            fault = f"its time {time_s} is not finite"
        elif time_s <= self._time_s:
            fault = (
                f"its time {time_s:.6f} s is not after that of the last reading, {self._time_s:.6f} s; "
                "give readings in the order of their time, each once"
            )
        elif len(sightings.z) > SIGHTINGS_MAX:
            fault = f"it holds {len(sightings.z)} sightings, at most {SIGHTINGS_MAX} are taken"
        if fault:
            self.counters.readings_refused += 1
            raise ReadingRefused(f"reading refused: {fault}")

    def _append(self, time_s: float, result: StepResult, status: FrameStatus, hello: Hello | None) -> None:
        self._time_s = time_s
        self.counters.sightings_refused += result.refused
        self._send(
            time_s=time_s,
            parts=(FramePart(frame=0, status=status, delta=result.delta),),
            landmarks=tuple((result.first_new + i, signature) for i, signature in enumerate(result.new)),
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
        part = FramePart(frame=0, status=FrameStatus.ENDED, delta=FrameDelta.nothing(), end_pose=self.filter.pose)
        self._send(time_s=self._time_s, parts=(part,), end=True)

    def _send(self, **fields: object) -> None:
        identity = self.identity
        number = self.outbox.last + 1
        self.counters.messages += 1
        self.outbox.append(
            DeltaMessage(
                fleet=identity.fleet, vehicle=identity.vehicle, epoch=identity.epoch, first=number, last=number,
                step=self.steps, healthy=self.healthy, **fields,  # type: ignore[arg-type]
            )
        )  # fmt: skip

    def release(self) -> list[bytes]:
        """Messages to put now, in order."""
        released = self.outbox.release()
        self.counters.bytes_put += sum(len(data) for data in released)
        return released

    def on_ack(self, data: bytes) -> None:
        """An acknowledgement from a fusion node; what is not for this epoch is left alone."""
        try:
            ack = decode_ack(data)
        except WireError:
            self.counters.acks_refused += 1
            return
        if ack.vehicle != self.identity.vehicle or ack.epoch != self.identity.epoch:
            return
        if not self.outbox.acknowledge(ack.last, ack.prefix_digest):
            self.counters.acks_refused += 1

    def on_range(self, data: bytes) -> list[bytes]:
        """Answer to a range query: messages of the outbox, or nothing."""
        try:
            request = decode_range(data)
        except WireError:
            return []
        if request.epoch != self.identity.epoch:
            return []
        return self.outbox.answer(
            request, lambda: self.outbox.snapshot(self.filter.published(), self.filter.signatures)
        )

    def tick(self, now_s: float) -> bytes | None:
        """A heartbeat when one is due; now_s is monotonic."""
        if now_s < self._heartbeat_at_s or self.outbox.last_put < 0:
            return None
        self._heartbeat_at_s = now_s + self._publish.heartbeat_s
        return encode_heartbeat(self.outbox.heartbeat(self.identity.vehicle, self.identity.epoch, self.ended))

    @property
    def done(self) -> bool:
        """Whether the stream has ended and all of it is acknowledged."""
        return self.ended and self.outbox.last_acknowledged == self.outbox.last
