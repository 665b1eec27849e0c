"""The vehicle core in its shell: the one class for a robot of your own and for the vehicle process.

1. With a bus or a store, a thread of its own commits, puts, sends heartbeats and takes acknowledgements.
2. Without a bus, everything else works; messages are kept (and coalesced) in the outbox.
3. `step` never waits for the network or the disk; `wait_for_room` does, for those who want to. Several steps may share
   one commit; nothing is put before it is committed.
4. Another thread solves the vehicle's own frames, for `pose` and `landmarks`; without a bus or a store `step` does.
5. A store that fails ends it: from then on every call raises what went wrong.
"""

import contextlib
import logging
import queue
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

from fleet_seif.bus import Bus
from fleet_seif.config import FilterSettings, PublishSettings
from fleet_seif.filters import StepResult
from fleet_seif.keys import Keys
from fleet_seif.messages import Epoch
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats, Ints, Reading, Sightings
from fleet_seif.signing import KeyRing, Signer
from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.store import Store
from vehicles import records
from vehicles.core import Counters, Identity, VehicleCore

log = logging.getLogger(__name__)
TICK_S = 0.05
ACKS_MAX = 10_000
CLOSE_S = 10.0


def symmetric(matrix: ArrayLike) -> Floats:
    """The symmetric part of a matrix, as a new array: rounding leaves covariances a little off."""
    A = np.array(matrix, float)
    return (A + A.T) / 2 if A.ndim == 2 else A


def open_store(path: Path | str) -> SqliteStore:
    """The file that a vehicle is kept in, made where there is none. Close it after the vehicle. Raises StoreError."""
    return SqliteStore.open(Path(path), records.KIND, records.SCHEMA)


class Vehicle:
    """One vehicle: `step` it with odometry and sightings, read `pose` and `landmarks`.

    Args:
        name, fleet: who it is; 1 to 32 of the characters A-Z a-z 0-9 _ -.
        start_pose: T_0 in the world, (x m, y m, theta rad).
        start_pose_cov: its covariance, (3, 3); None: the start pose is given.
        epoch: of this run; by default this machine's time in ms, so that a later run counts as later, and a nonce.
        bus: an open bus (fleet_seif.bus.open_bus), or None to map alone.
        store: where filter and outbox are kept, open; a vehicle that is made again with it goes on where the last
            committed step ended (see `time_s`), in a new epoch. None: in memory only.
        fresh: begin a new life, at `start_pose`, though the store knows an earlier one. life: number of the first one.
        required_acks: fusion nodes that must have acknowledged a message before it is forgotten; none: any one.
        signer, keys: private key of this vehicle and public keys of the fleet, where it signs its messages.

    Raises RunError where the store cannot be gone on with.
    """

    def __init__(
        self,
        name: str,
        *,
        fleet: str = "fleet",
        start_pose: ArrayLike = (0.0, 0.0, 0.0),
        start_pose_cov: ArrayLike | None = None,
        bus: Bus | None = None,
        settings: FilterSettings | None = None,
        publish: PublishSettings | None = None,
        model: int = RANGE_BEARING,
        epoch: Epoch | None = None,
        clock: Callable[[], float] = time.monotonic,
        store: Store | None = None,
        fresh: bool = False,
        life: int = 0,
        required_acks: Sequence[str] = (),
        signer: Signer | None = None,
        keys: KeyRing | None = None,
    ) -> None:
        identity = Identity(
            fleet=fleet,
            vehicle=name,
            epoch=epoch or Epoch(time.time_ns() // 1_000_000, secrets.randbits(64)),
            start_pose=np.asarray(start_pose, float),
            start_pose_cov=np.zeros((3, 3)) if start_pose_cov is None else symmetric(start_pose_cov),
            life=life,
        )
        self._core = VehicleCore(
            identity, settings or FilterSettings(), publish or PublishSettings(), model,
            required=tuple(required_acks), durable=store is not None, signer=signer, keys=keys,
        )  # fmt: skip
        self.resumed = store is not None and self._core.resume(store.load(), fresh=fresh)
        self._clock = clock
        self._bus = bus
        self._store = store
        self._keys = Keys(fleet)
        self._lock = threading.Lock()
        self._acknowledged = threading.Condition(self._lock)
        self._acks: queue.Queue[bytes | None] = queue.Queue(ACKS_MAX)
        self._threads: list[threading.Thread] = []
        self._moved = threading.Event()
        self._solving = threading.Lock()
        self._closing = False
        self._failure: Exception | None = None
        self.filter_s = 0.0
        self.publish_s = 0.0
        if bus is not None:
            bus.subscribe(self._keys.acks(name), lambda _, data: self._put_ack(data))
            bus.answer(self._keys.outbox(name), lambda _, data: self._on_range(data))
            bus.announce(self._keys.alive(name))
        if bus is not None or store is not None:
            self._threads = [
                threading.Thread(target=self._serve, name=f"vehicle-{name}", daemon=True),
                threading.Thread(target=self._localise_for_ever, name=f"localiser-{name}", daemon=True),
            ]
            for thread in self._threads:
                thread.start()

    def _put_ack(self, data: bytes) -> None:
        if not self._acks.full():  # a later acknowledgement says all that a dropped one said
            self._acks.put_nowait(data)

    def _on_range(self, data: bytes) -> list[bytes]:
        with self._lock:
            return self._core.on_range(data)

    def _serve(self) -> None:
        try:
            while self._serve_once():
                pass
        except Exception as error:  # kept for whoever calls next: a vehicle must not go on in silence
            log.error("vehicle_stopped vehicle=%s reason=%s", self._core.identity.vehicle, error)
            with self._lock:
                self._failure = error
                self._acknowledged.notify_all()

    def _serve_once(self) -> bool:
        """Handle an acknowledgement, if one is there, and what is due. False at the end."""
        try:
            data = self._acks.get(timeout=TICK_S)
        except queue.Empty:
            data = b""
        with self._lock:
            if data:
                self._core.on_ack(data)
                self._acknowledged.notify_all()
        self._commit()
        with self._lock:
            self._publish()
            heartbeats = self._core.tick(self._clock())
        if self._bus is not None:
            for heartbeat in heartbeats:
                self._bus.put(self._keys.heartbeats(self._core.identity.vehicle), heartbeat, "control")
        return data is not None

    def _localise_for_ever(self) -> None:
        while True:
            self._moved.wait()
            self._moved.clear()
            if self._closing:
                return
            self.localise()

    def localise(self) -> None:
        """Solve the vehicle's own frames if that is due, or wait for the thread that does; other steps may go on.

        Not needed by a robot that moves in its own time: the thread follows it.
        """
        with self._solving:  # without the lock of the core, so that steps go on
            framed = self._core.filter
            with self._lock:
                life = framed.own_life() if framed.is_localisation_due else None
            if life is not None:
                solution = framed.solve_own(life)
                with self._lock:
                    framed.take_solution(solution)

    def _commit(self) -> None:
        """Make durable what has changed; the caller does not hold the lock, so that steps go on meanwhile."""
        with self._lock:
            changes, mark = self._core.take_changes()
        if self._store is not None and changes:
            self._store.commit(changes)
        with self._lock:
            self._core.note_commit(mark)

    def _publish(self) -> None:
        """Put what may be put; the caller holds the lock, so that messages leave in order."""
        if self._bus is not None:
            for data in self._core.release():
                self._bus.put(self._keys.deltas(self._core.identity.vehicle), data)

    def _hand_over(self) -> None:
        """After a step, with the lock: put what it brought at once, or have it committed first."""
        if self._store is None:
            self._core.note_commit(self._core.take_changes()[1])
            self._publish()
        elif not self._acks.full():
            self._acks.put_nowait(b"")

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def start(self, sightings: Sightings | None = None, *, time_s: float | None = None) -> StepResult:
        """Say hello, with what is seen before any motion. `step` does it with nothing seen if you do not."""
        with self._lock:
            self._check()
            result = self._core.start(self._time(time_s), sightings or Sightings.none())
            self._hand_over()
            return result

    def step(
        self,
        odometry: ArrayLike,
        odometry_cov: ArrayLike,
        sightings: Sightings | None = None,
        *,
        time_s: float | None = None,
    ) -> StepResult:
        """Move, then look around.

        Args:
            odometry: pose increment (dx m, dy m, dtheta rad) in the frame of the pose it leaves.
            odometry_cov: its covariance, (3, 3), positive definite.
            sightings: what is seen from the new pose.
            time_s: the vehicle's own time, growing; None: this machine's monotonic clock.

        Raises:
            ReadingRefused: the reading is malformed or late; nothing has changed.
            NumericalError: the filter cannot take it; nothing has changed but the vehicle's health.
        """
        reading = Reading(
            time_s=self._time(time_s),
            odometry=np.ascontiguousarray(odometry, float),
            odometry_cov=np.ascontiguousarray(odometry_cov, float),
            sightings=sightings or Sightings.none(),
        )
        with self._lock:
            self._check()
            begin = time.perf_counter()
            if self._core.outbox.last < 0:
                self._core.start(np.nextafter(reading.time_s, -np.inf), Sightings.none())
            result = self._core.step(reading)
            middle = time.perf_counter()
            self._hand_over()
            self.filter_s, self.publish_s = middle - begin, time.perf_counter() - middle
            due = self._core.filter.is_localisation_due
        if due and self._threads:
            self._moved.set()
        elif due:
            self.localise()
        return result

    def _time(self, time_s: float | None) -> float:
        return self._clock() if time_s is None else float(time_s)

    def end(self) -> None:
        """End the stream; the map stays."""
        with self._lock:
            self._check()
            self._core.end()
            self._hand_over()
        self.localise()

    def wait_for_room(self, timeout_s: float | None = None) -> bool:
        """Wait until fewer than `publish.window` messages are unacknowledged. False after the timeout."""
        return self._wait_for(lambda: not self._core.crowded, timeout_s)

    def wait_until_acknowledged(self, timeout_s: float | None = None) -> bool:
        """Wait until the stream has ended and every required node holds all of it, or takes no more of it.

        False after the timeout.
        """
        return self._wait_for(lambda: self._core.done, timeout_s)

    def _wait_for(self, condition: Callable[[], bool], timeout_s: float | None) -> bool:
        with self._lock:
            met = self._acknowledged.wait_for(lambda: self._failure is not None or condition(), timeout_s)
            self._check()
            return met

    @property
    def fault(self) -> str:
        """Why a fusion node takes no more of this vehicle, "" where none has said so."""
        return "; ".join(f"{node}: {reason}" for node, reason in self._core.faults.items())

    @property
    def started(self) -> bool:
        """Whether there is anything yet; a resumed vehicle has started."""
        return self._core.outbox.last >= 0

    @property
    def ended(self) -> bool:
        return self._core.ended

    @property
    def steps(self) -> int:
        """Steps taken so far; after a restart those that were committed."""
        return self._core.steps

    @property
    def time_s(self) -> float:
        """Time of the last step, -inf before any. After a restart go on with the reading after that."""
        return self._core.time_s

    @property
    def pose(self) -> Floats:
        """Live estimate of the pose in the world (x m, y m, theta rad), shape (3,)."""
        with self._lock:
            return self._core.pose

    @property
    def landmarks(self) -> Floats:
        """Live estimates of the landmarks in the world, m, shape (n, 2); NaN for one that has turned out to be none."""
        with self._lock:
            return self._core.landmarks

    @property
    def signatures(self) -> list[int]:
        """The signature of each landmark, in the same order."""
        with self._lock:
            return list(self._core.filter.signatures)

    @property
    def assigned(self) -> Ints:
        """The number of the landmark that each sighting given so far is of, -1 none, shape (S,)."""
        with self._lock:
            return self._core.assigned

    @property
    def acknowledged(self) -> int:
        """Sequence number of the last message that a fusion node holds, -1 for none."""
        with self._lock:
            return self._core.outbox.last_acknowledged

    @property
    def counters(self) -> Counters:
        """What has been counted so far."""
        return self._core.counters

    def close(self) -> None:
        """Commit what is left and stop the thread. Bus and store are the caller's to close."""
        if self._threads:
            self._closing = True
            self._moved.set()
            with contextlib.suppress(queue.Full):
                self._acks.put(None, timeout=CLOSE_S)
            for thread in self._threads:
                thread.join(CLOSE_S)
            self._threads = []

    def __enter__(self) -> "Vehicle":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
