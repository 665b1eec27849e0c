"""The fusion core in its shell: one thread folds, another solves and serves, and neither waits for the other.

1. Zenoh's threads only put events into the inbox, where every vehicle has its share.
2. Changes are committed to the store before any effect of the same round is carried out: commit, then acknowledge. A
   store that fails ends the service.
3. The solver takes a copy of the totals and works on that; maps in between are skipped.
4. `run` returns when every expected vehicle has ended and is folded: the last map is solved and marked final, and
   acknowledgements are repeated until the vehicles have left and the other nodes have caught up, for at most
   `LINGER_S`.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fleet_seif.bus import Bus, OnPut
from fleet_seif.config import FusionSettings
from fleet_seif.errors import NumericalError, WireError
from fleet_seif.keys import Keys, node_of, vehicle_of
from fleet_seif.map_wire import encode_map, map_pieces
from fleet_seif.messages import Epoch, JointMap
from fleet_seif.signing import Signer
from fleet_seif.store import Change, Put, Store, StoreError
from fusion import records
from fusion.core import AskEvents, AskMap, AskRange, Effect, FusionCore, PutAck, PutMerges, PutStatus
from fusion.inbox import Inbox
from fusion.mapping import OF_MAPS, MapMaker, empty_map, map_input

log = logging.getLogger(__name__)
BURST_MAX = 256
BURST_S = 0.01  # nobody waits longer than this, and a stride, for effects of what came before
STRIDE = 16
TICK_S = 0.02
PROGRESS_S = 0.2
PAUSE_S = 0.02  # between two maps at least
LINGER_S = 30.0

Event = Callable[[], list[Effect]]


@dataclass
class Statistics:
    """What the service measures.

    behind_s: how old the first message missing from a live map was when it was replaced. final_s: how long the last
    map took, which is solved from nothing.
    """

    maps: int = 0
    behind_s: list[float] = field(default_factory=list)
    solve_s: list[float] = field(default_factory=list)
    final_s: float | None = None


def restore(core: FusionCore, store: Store, now_s: float) -> None:
    """Fold again what a store has kept, and note whose it is. Raises StoreError where it is not this node's."""
    mine = f"{core.ledger.fleet}/{core.node}".encode()
    stored = dict(store.load(records.IDENTITY, records.IDENTITY + b"\0")).get(records.IDENTITY, mine)
    if stored != mine:
        raise StoreError(
            f"the store is that of node {stored.decode()}, this is {mine.decode()}: give each node a store of its own"
        )
    try:
        core.restore(store.load(), now_s)
    except WireError as error:
        raise StoreError(
            f"the store holds what this node never put there: {error}. Move it away and start afresh: vehicles and"
            " other nodes send again what they hold"
        ) from None
    store.commit([Put(records.IDENTITY, mine)])


class FusionService:
    """See the rules above.

    Args:
        bus: what vehicles are reached by. maps: what subscribers are reached by, where that is another.
        store: where the ledger is kept, already restored into the core; None: in memory only. signer: signs maps.
        held: whether it must stay though it has everything, for a vehicle that was killed and starts again.
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
        store: Store | None = None,
        signer: Signer | None = None,
        held: Callable[[], bool] = lambda: False,
    ) -> None:
        self._bus = bus
        self._held = held
        self._maps = maps or bus
        self._core = core
        self._settings = settings
        self._clock = clock
        self._store = store
        self._signer = signer
        self._keys = Keys(core.ledger.fleet)
        self._inbox: Inbox[Event] = Inbox()
        self._lock = threading.Lock()
        self._commit_lock = threading.Lock()
        self._stop = threading.Event()
        self._over = threading.Event()
        self._alive: set[str] = set()
        self._changed_at_s: float | None = None
        self._served = self._told = b""
        self._maker = MapMaker()
        self._replayed = False
        self.newest: JointMap = empty_map(core.ledger.fleet, core.node, first_version - 1)
        self.statistics = Statistics()
        keys = self._keys
        bus.subscribe(keys.deltas("*"), self._post(self._core.on_delta, vehicle_of))
        bus.subscribe(keys.heartbeats("*"), self._post(self._core.on_heartbeat, vehicle_of))
        bus.subscribe(keys.status("*"), self._post(self._core.on_status, node_of))
        bus.subscribe(keys.merges("*"), self._post(lambda node, data, _: self._core.on_merges(node, data), node_of))
        bus.watch(keys.alive("*"), self._on_alive)
        bus.answer(keys.ledger("*"), self._on_range)
        bus.answer(keys.events(core.node), self._on_events_asked)
        bus.answer(keys.decisions(core.node), self._on_decision)
        self._maps.answer(keys.map(core.node), lambda key, data: [self._served] if self._served else [])
        self._maps.answer(keys.merges(core.node), lambda key, data: [self._told] if self._told else [])
        self._maps.announce(keys.node_alive(core.node))

    def _post(self, handle: Callable[[str, bytes, float], list[Effect]], name_of: Callable[[str], str]) -> OnPut:
        """A handler that hands what comes by a key to the core, in its turn."""

        def put(key: str, data: bytes) -> None:
            name = name_of(key)
            self._inbox.put(name, lambda: handle(name, data, self._clock()), len(data))

        return put

    def _on_alive(self, key: str, alive: bool) -> None:
        name = vehicle_of(key)

        def note() -> list[Effect]:
            (self._alive.add if alive else self._alive.discard)(name)
            (self._core.gone.discard if alive else self._core.gone.add)(name)
            return []

        self._inbox.put(name, note)

    def _on_range(self, key: str, data: bytes) -> list[bytes]:
        with self._lock:
            return self._core.answer_range(vehicle_of(key), data)

    def _on_events_asked(self, key: str, data: bytes) -> list[bytes]:
        with self._lock:
            return self._core.answer_events()

    def _on_decision(self, key: str, data: bytes) -> list[bytes]:
        """Answered only once it is on disk. What it changes is apart from what a round of `_work` commits."""
        with self._lock:
            said = self._core.on_decision(data)
            self._commit(self._core.ledger.take_changes())
        return [said.encode()]

    def _commit(self, changes: list[Change]) -> None:
        if self._store is not None and changes:
            with self._commit_lock:
                self._store.commit(changes)

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
            for stream in self._core.ledger.streams.values():
                if stream.next > 0:
                    self._execute(self._core.ack_now(stream))
            self._serve(final=True)
            end_s = self._clock() + LINGER_S
            while not self._stop.is_set() and self._clock() < end_s and self._needed():
                self._work()
            self._publish()  # once more: pieces of the only final map may have been dropped
        return self.newest

    @property
    def dropped(self) -> int:
        """Events that came faster than they could be handled, and were dropped."""
        return self._inbox.dropped

    def _needed(self) -> bool:
        """Whether a vehicle is still there (or may come back), or another node that lacks what this one holds."""
        return bool(self._alive) or self._held() or self._core.waited_for(self._clock())

    def stop(self) -> None:
        """Make `run` return."""
        self._stop.set()

    def _work(self) -> None:
        """Handle a part of what is in the inbox, and what is due. What is kept is committed before anybody is told."""
        effects: list[Effect] = []
        events, handled = self._inbox.take(STRIDE, TICK_S), 0
        end_s = time.perf_counter() + BURST_S
        with self._lock:
            while events:
                for event in events:
                    effects += event()
                handled += len(events)
                if handled >= BURST_MAX or time.perf_counter() >= end_s:
                    break
                events = self._inbox.take(STRIDE, 0.0)
            effects += self._core.tick(self._clock())
            changes = self._core.ledger.take_changes()
            if self._changed_at_s is None and self._core.changed:
                self._changed_at_s = self._clock()
        self._commit(changes)
        for effect in effects:
            self._execute(effect)

    def _execute(self, effect: Effect) -> None:
        core, keys = self._core, self._keys
        match effect:
            case PutAck(vehicle=vehicle, data=data):
                self._bus.put(keys.acks(vehicle), data, "control")
            case PutStatus(data=data):
                self._bus.put(keys.status(core.node), data, "control")
            case AskRange(vehicle=vehicle, epoch=epoch, data=data, nodes=nodes):
                key = keys.ledger(vehicle) if nodes else keys.outbox(vehicle)
                replies = self._post(core.on_reply, lambda _: vehicle)
                self._bus.ask(
                    key,
                    data,
                    lambda reply: replies("", reply),
                    lambda: self._done(vehicle, epoch),
                )
            case PutMerges(data=data):
                self._told = data
                self._maps.put(keys.merges(core.node), data, "control")
            case AskMap(node=node):
                maps = self._post(lambda who, reply, _: core.on_map(who, reply), lambda _: node)
                self._bus.ask(keys.map(node), b"", lambda reply: maps("", reply), lambda: None)
            case AskEvents(node=node):
                events = self._post(lambda who, reply, _: core.on_events(who, reply), lambda _: node)
                self._bus.ask(keys.events(node), b"", lambda reply: events("", reply), lambda: None)

    def _done(self, vehicle: str, epoch: Epoch) -> None:
        self._inbox.put(vehicle, lambda: self._core.on_reply_done(vehicle, epoch, self._clock()))

    def _solve_for_ever(self) -> None:
        """Serve a map when there is news: something folded, or a vehicle that fell silent or came back. Where there is
        none for as long as a solution from nothing takes, the last one is solved so and is canonical."""
        quiet_since_s = next_s = self._clock()
        while not self._over.wait(max(PAUSE_S, next_s - self._clock())):
            next_s = self._clock() + self._settings.map_s
            try:
                with self._lock:
                    stalled = [state.stalled for state in self._core.states(self._clock())]
                old = self.newest
                counted = {name: n for name, n in old.counters.items() if name not in OF_MAPS}
                news = stalled != [state.stalled for state in old.vehicles] or self._core.counters != counted
                if self._core.changed or news or not self._served:
                    self._serve(final=False)
                    if self._maker.look_for_merges():
                        self._serve(final=False)
                    quiet_since_s = self._clock()
                    if self._maker.are_covariances_due:
                        self._publish_map(self._maker.with_covariances(self.newest, self.newest.version + 1))
                elif not old.canonical and not self._replayed and self._clock() >= quiet_since_s + self._maker.replay_s:
                    self._serve(final=False, replay=True)
            except NumericalError as error:
                log.error("map_not_solved reason=%s", error)
            except Exception:  # a fault of ours must not end the service of maps: the next one may be fine
                log.exception("map_not_served")

    def _serve(self, *, final: bool, replay: bool = False) -> None:
        """Solve and publish the newest map; replay: from nothing, so that it is canonical.

        Raises NumericalError, the last one served, where it cannot be solved.
        """
        with self._lock:
            taken = map_input(self._core, self._clock())
            self._core.changed = False
            changed_at_s, self._changed_at_s = self._changed_at_s, None
        begin = time.perf_counter()
        try:
            newest = self._maker.make(taken, self.newest.version + 1, final=final, replay=replay)
        except NumericalError:
            self._changed_at_s = changed_at_s
            raise
        self.statistics.solve_s.append(time.perf_counter() - begin)
        if final:
            self.statistics.final_s = self.statistics.solve_s[-1]
        self._replayed = replay
        self._publish_map(newest)
        if changed_at_s is not None and not final:
            self.statistics.behind_s.append(self._clock() - changed_at_s)

    def _publish_map(self, newest: JointMap) -> None:
        """What is to be said of its merges first: who has the map has that too."""
        self.newest = newest
        with self._lock:
            effects = self._core.on_served(newest, self._maker.merges)
        for effect in effects:
            self._execute(effect)
        self._served = encode_map(newest, self._signer)
        self._publish()
        self.statistics.maps += 1

    def _publish(self) -> None:
        for piece in map_pieces(self._served, self._core.node, self.newest.version):
            self._maps.put(self._keys.map(self._core.node), piece, "bulk")

    def behind_p99_s(self) -> float | None:
        """99th percentile of how far served maps were behind, s."""
        samples = self.statistics.behind_s
        return float(np.percentile(samples, 99)) if samples else None
