"""The fusion core in its shell: one thread folds, another solves and serves, and neither waits for the other.

1. Zenoh's threads only put events into the inbox; above `INBOX_MAX` they are dropped, and repaired by query later.
2. The solver takes a copy of the totals and works on that; maps in between are skipped.
3. `run` returns when every expected vehicle has ended and is folded: the last map is solved and marked final, and
   acknowledgements are repeated until the vehicles have left, for at most `LINGER_S`.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fleet_seif.bus import Bus
from fleet_seif.config import FusionSettings
from fleet_seif.errors import NumericalError
from fleet_seif.keys import Keys, vehicle_of
from fleet_seif.map_wire import encode_map, map_pieces
from fleet_seif.messages import JointMap
from fusion.core import AskRange, Effect, FusionCore, PutAck
from fusion.mapping import empty_map, make_map, map_input

log = logging.getLogger(__name__)
INBOX_MAX = 50_000
BURST_MAX = 256
TICK_S = 0.02
PROGRESS_S = 0.2
LINGER_S = 30.0

Event = Callable[[], list[Effect]]


@dataclass
class Statistics:
    """What the service measures. behind_s: how old the first message missing from a map was when it was replaced."""

    maps: int = 0
    behind_s: list[float] = field(default_factory=list)
    solve_s: list[float] = field(default_factory=list)
    dropped: int = 0


class FusionService:
    """See the rules above.

    Args:
        bus: what vehicles are reached by. maps: what subscribers are reached by, where that is another.
        first_version: of its maps; one above those of an earlier node of this fleet lets subscribers go on.
    """

    def __init__(
        self,
        bus: Bus,
        core: FusionCore,
        settings: FusionSettings,
        clock: Callable[[], float] = time.monotonic,
        maps: Bus | None = None,
        first_version: int = 0,
    ) -> None:
        self._bus = bus
        self._maps = maps or bus
        self._core = core
        self._settings = settings
        self._clock = clock
        self._keys = Keys(core.ledger.fleet)
        self._inbox: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._over = threading.Event()
        self._alive: set[str] = set()
        self._changed_at_s: float | None = None
        self._served = b""
        self.newest: JointMap = empty_map(core.ledger.fleet, first_version - 1)
        self.statistics = Statistics()
        bus.subscribe(self._keys.deltas("*"), self._on_delta)
        bus.subscribe(self._keys.heartbeats("*"), self._on_heartbeat)
        bus.watch(self._keys.alive("*"), self._on_alive)
        self._maps.answer(self._keys.map(), lambda key, data: [self._served] if self._served else [])
        self._maps.announce(self._keys.node(core.node))

    def _post(self, event: Event) -> None:
        if self._inbox.qsize() < INBOX_MAX:
            self._inbox.put(event)
        else:
            self.statistics.dropped += 1

    def _on_delta(self, key: str, data: bytes) -> None:
        self._post(lambda: self._core.on_delta(vehicle_of(key), data, self._clock()))

    def _on_heartbeat(self, key: str, data: bytes) -> None:
        self._post(lambda: self._core.on_heartbeat(vehicle_of(key), data, self._clock()))

    def _on_alive(self, key: str, alive: bool) -> None:
        def note() -> list[Effect]:
            (self._alive.add if alive else self._alive.discard)(vehicle_of(key))
            return []

        self._post(note)

    def run(self, on_progress: Callable[[FusionCore], None] | None = None) -> JointMap:
        """Work until every expected vehicle has ended and is folded, or until `stop`."""
        solver = threading.Thread(target=self._solve_for_ever, name="joint-solver", daemon=True)
        solver.start()
        told_s = 0.0
        try:
            while not self._stop.is_set() and not self._core.complete:
                self._work()
                if on_progress is not None and self._clock() >= told_s + PROGRESS_S:
                    told_s = self._clock()
                    on_progress(self._core)
        finally:
            self._over.set()
            solver.join()
        if self._core.complete:
            for (vehicle, epoch), stream in self._core.ledger.streams.items():
                if stream.next > 0:
                    self._execute(self._core.ack_now(vehicle, epoch))
            self._serve(final=True)
            end_s = self._clock() + LINGER_S
            while self._alive and self._clock() < end_s and not self._stop.is_set():
                self._work()
            self._publish()  # once more: pieces of the only final map may have been dropped
        return self.newest

    def stop(self) -> None:
        """Make `run` return."""
        self._stop.set()

    def _work(self) -> None:
        """Handle a part of what is in the inbox, and what is due."""
        effects: list[Effect] = []
        try:
            events = [self._inbox.get(timeout=TICK_S)]
        except queue.Empty:
            events = []
        while events and len(events) < BURST_MAX:
            try:
                events.append(self._inbox.get_nowait())
            except queue.Empty:
                break
        with self._lock:
            for event in events:
                effects += event()
            effects += self._core.tick(self._clock())
            if self._changed_at_s is None and self._core.changed:
                self._changed_at_s = self._clock()
        for effect in effects:
            self._execute(effect)

    def _execute(self, effect: Effect) -> None:
        match effect:
            case PutAck(vehicle=vehicle, data=data):
                self._bus.put(self._keys.acks(vehicle), data)
            case AskRange(vehicle=vehicle, epoch=epoch, data=data):
                self._bus.ask(
                    self._keys.outbox(vehicle),
                    data,
                    lambda reply: self._post(lambda: self._core.on_reply(vehicle, reply, self._clock())),
                    lambda: self._post(lambda: self._core.on_reply_done(vehicle, epoch, self._clock())),
                )

    def _solve_for_ever(self) -> None:
        """Serve a map when there is news: something folded, or a vehicle that fell silent or came back."""
        while not self._over.wait(self._settings.map_s):
            try:
                with self._lock:
                    stalled = [state.stalled for state in self._core.states(self._clock())]
                if self._core.changed or stalled != [state.stalled for state in self.newest.vehicles]:
                    self._serve(final=False)
            except NumericalError as error:
                log.error("map_not_solved reason=%s", error)
            except Exception:  # a fault of ours must not end the service of maps: the next one may be fine
                log.exception("map_not_served")

    def _serve(self, *, final: bool) -> None:
        """Solve and publish the newest map. Raises NumericalError, the last one served, where it cannot be solved."""
        with self._lock:
            taken = map_input(self._core, self._clock())
            self._core.changed = False
            changed_at_s, self._changed_at_s = self._changed_at_s, None
        begin = time.perf_counter()
        try:
            newest = make_map(taken, self.newest.version + 1, self._settings, final=final)
        except NumericalError:
            self._changed_at_s = changed_at_s
            raise
        self.statistics.solve_s.append(time.perf_counter() - begin)
        self.newest = newest
        self._served = encode_map(newest)
        self._publish()
        self.statistics.maps += 1
        if changed_at_s is not None:
            self.statistics.behind_s.append(self._clock() - changed_at_s)

    def _publish(self) -> None:
        for piece in map_pieces(self._served, self.newest.version):
            self._maps.put(self._keys.map(), piece)

    def behind_p99_s(self) -> float | None:
        """99th percentile of how far served maps were behind, s."""
        samples = self.statistics.behind_s
        return float(np.percentile(samples, 99)) if samples else None
