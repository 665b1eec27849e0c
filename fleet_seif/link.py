"""A bad link on purpose: delay, jitter, loss, duplication and reordering, decided by a seeded generator.

`LinkModel` decides, without I/O, so that simulated runs and real ones suffer alike. `FaultyBus` applies it above the
transport, which never shows duplicates or reordering itself.
"""

import heapq
import itertools
import threading
import time
from collections.abc import Callable

import numpy as np

from fleet_seif.bus import Bus, OnPut, OnQuery
from fleet_seif.config import NotNegative, Probability, Settings


class LinkSettings(Settings):
    """How a link misbehaves. A message takes delay_s plus a uniform share of jitter_s; `reorder` lets it overtake."""

    delay_s: NotNegative = 0.0
    jitter_s: NotNegative = 0.0
    loss: Probability = 0.0
    duplication: Probability = 0.0
    reorder: bool = True

    @property
    def perfect(self) -> bool:
        return not (self.delay_s or self.jitter_s or self.loss or self.duplication)


class LinkModel:
    """Decides what becomes of each message on one direction of a link."""

    def __init__(self, settings: LinkSettings, rng: np.random.Generator) -> None:
        self._settings = settings
        self._rng = rng
        self._latest_s = 0.0

    def arrivals(self, now_s: float) -> list[float]:
        """When the copies of a message sent now arrive, s: none, one or two."""
        settings = self._settings
        lost, doubled, *shares = self._rng.random(4)
        if lost < settings.loss:
            return []
        copies = 2 if doubled < settings.duplication else 1
        times = [now_s + settings.delay_s + settings.jitter_s * share for share in shares[:copies]]
        if not settings.reorder:
            times = [max(t, self._latest_s) for t in sorted(times)]
            self._latest_s = times[-1]
        return times


class FaultyBus:
    """A bus whose puts and answers go through a LinkModel. Closing it drops what is under way."""

    def __init__(self, bus: Bus, settings: LinkSettings, seed: int) -> None:
        self._bus = bus
        self._model = LinkModel(settings, np.random.default_rng(seed))
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._wake = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._deliver, name="faulty-link", daemon=True)
        self._thread.start()

    def _send(self, deliver: Callable[[], None]) -> None:
        with self._wake:
            for at_s in self._model.arrivals(time.monotonic()):
                heapq.heappush(self._due, (at_s, next(self._order), deliver))
            self._wake.notify()

    def _deliver(self) -> None:
        while True:
            with self._wake:
                while self._open and (not self._due or self._due[0][0] > time.monotonic()):
                    self._wake.wait(self._due[0][0] - time.monotonic() if self._due else None)
                if not self._open:
                    return
                deliver = heapq.heappop(self._due)[2]
            deliver()

    def put(self, key: str, payload: bytes) -> None:
        self._send(lambda: self._bus.put(key, payload))

    def subscribe(self, key: str, handler: OnPut) -> None:
        self._bus.subscribe(key, handler)

    def answer(self, key: str, handler: OnQuery) -> None:
        def lossy(asked: str, payload: bytes) -> list[bytes]:
            """A reply has to come within its query: it can be lost or doubled, not delayed."""
            replies = handler(asked, payload)  # not under the lock: handlers take locks of their own
            with self._wake:
                return [reply for reply in replies for _ in self._model.arrivals(0.0)]

        self._bus.answer(key, lossy)

    def ask(self, key: str, payload: bytes, on_reply: Callable[[bytes], None], on_done: Callable[[], None]) -> None:
        self._bus.ask(key, payload, on_reply, on_done)

    def announce(self, key: str) -> None:
        self._bus.announce(key)

    def watch(self, key: str, handler: Callable[[str, bool], None]) -> None:
        self._bus.watch(key, handler)

    def stop(self) -> None:
        """Drop what is under way and stop delivering; the bus below stays open."""
        with self._wake:
            self._open = False
            self._wake.notify()
        self._thread.join()

    def close(self) -> None:
        self.stop()
        self._bus.close()
