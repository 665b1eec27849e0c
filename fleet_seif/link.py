"""A bad link on purpose: delay, jitter, loss, duplication, corruption, reordering, cuts; a seeded generator decides.

`LinkModel` decides, without I/O, so that simulated runs and real ones suffer alike. `FaultyBus` applies it above the
transport, which never shows duplicates or reordering itself.
"""

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fleet_seif.bus import Bus, OnPut, OnQuery, Priority
from fleet_seif.config import NotNegative, Positive, Probability, Settings


class Cut(Settings):
    """Nothing gets through from `from_s` for `for_s` seconds of the run. who: the processes cut off; none: all."""

    from_s: NotNegative
    for_s: Positive
    who: tuple[str, ...] = ()


class LinkSettings(Settings):
    """How a link misbehaves. A message takes delay_s plus a uniform share of jitter_s; `reorder` lets it overtake.

    loss, duplication, corruption: shares of messages. cuts: times at which nothing gets through.
    """

    delay_s: NotNegative = 0.0
    jitter_s: NotNegative = 0.0
    loss: Probability = 0.0
    duplication: Probability = 0.0
    corruption: Probability = 0.0
    reorder: bool = True
    cuts: tuple[Cut, ...] = ()

    @property
    def perfect(self) -> bool:
        return not (self.delay_s or self.jitter_s or self.loss or self.duplication or self.corruption or self.cuts)


class Arrival(NamedTuple):
    """A copy of a message: when it arrives, s, and with what bytes."""

    at_s: float
    data: bytes


class LinkModel:
    """Decides what becomes of each message on one direction of the link of a process."""

    def __init__(self, settings: LinkSettings, rng: np.random.Generator, who: str = "") -> None:
        self._settings = settings
        self._rng = rng
        self._cuts = [cut for cut in settings.cuts if not cut.who or who in cut.who]
        self._latest_s = 0.0

    def is_cut(self, run_s: float) -> bool:
        """Whether nothing gets through, `run_s` after the run began."""
        return any(cut.from_s <= run_s < cut.from_s + cut.for_s for cut in self._cuts)

    def arrivals(self, now_s: float, data: bytes, run_s: float | None = None) -> list[Arrival]:
        """The copies of a message sent now: none, one or two. run_s: now, since the run began; `now_s` by default."""
        if self.is_cut(now_s if run_s is None else run_s):
            return []
        settings = self._settings
        lost, doubled, *shares = self._rng.random(6)
        if lost < settings.loss:
            return []
        copies = 2 if doubled < settings.duplication else 1
        times = [now_s + settings.delay_s + settings.jitter_s * share for share in shares[:copies]]
        if not settings.reorder:
            times = [max(t, self._latest_s) for t in sorted(times)]
            self._latest_s = times[-1]
        damaged = [share < settings.corruption for share in shares[2:]]
        return [Arrival(t, self._damage(data) if hurt else data) for t, hurt in zip(times, damaged, strict=False)]

    def _damage(self, data: bytes) -> bytes:
        """One byte changed, or the end missing."""
        if not data:
            return data
        at = int(self._rng.integers(len(data)))
        if self._rng.random() < 0.5:
            return data[:at]
        return data[:at] + bytes([data[at] ^ int(self._rng.integers(1, 256))]) + data[at + 1 :]


class FaultyBus:
    """A bus whose puts, queries and answers go through a LinkModel. Closing it drops what is under way.

    run_s: seconds since the run began, for cuts; by default since now.
    """

    def __init__(
        self, bus: Bus, settings: LinkSettings, seed: int, who: str = "", run_s: Callable[[], float] | None = None
    ) -> None:
        self._bus = bus
        self._model = LinkModel(settings, np.random.default_rng(seed), who)
        begin_s = time.monotonic()
        self._run_s = run_s or (lambda: time.monotonic() - begin_s)
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._wake = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._deliver, name="faulty-link", daemon=True)
        self._thread.start()

    def _send(self, data: bytes, deliver: Callable[[bytes], None]) -> None:
        now_s = time.monotonic()
        with self._wake:
            for at_s, copy in self._model.arrivals(now_s, data, self._run_s()):
                heapq.heappush(self._due, (at_s, next(self._order), lambda copy=copy: deliver(copy)))  # type: ignore[misc]
            self._wake.notify()

    def _cut(self) -> bool:
        return self._model.is_cut(self._run_s())

    def _deliver(self) -> None:
        while True:
            with self._wake:
                while self._open and (not self._due or self._due[0][0] > time.monotonic()):
                    self._wake.wait(self._due[0][0] - time.monotonic() if self._due else None)
                if not self._open:
                    return
                deliver = heapq.heappop(self._due)[2]
            deliver()

    def put(self, key: str, payload: bytes, priority: Priority = "data") -> None:
        self._send(payload, lambda data: self._bus.put(key, data, priority))

    def subscribe(self, key: str, handler: OnPut) -> None:
        def receive(name: str, data: bytes) -> None:
            if not self._cut():
                handler(name, data)

        self._bus.subscribe(key, receive)

    def answer(self, key: str, handler: OnQuery) -> None:
        def lossy(asked: str, payload: bytes) -> list[bytes]:
            """A reply has to come within its query: it can be lost, doubled or damaged, not delayed."""
            if self._cut():
                return []
            replies = handler(asked, payload)  # not under the lock: handlers take locks of their own
            with self._wake:
                run_s = self._run_s()
                return [copy for reply in replies for _, copy in self._model.arrivals(0.0, reply, run_s)]

        self._bus.answer(key, lossy)

    def ask(self, key: str, payload: bytes, on_reply: Callable[[bytes], None], on_done: Callable[[], None]) -> None:
        def receive(data: bytes) -> None:
            if not self._cut():
                on_reply(data)

        if self._cut():
            on_done()
        else:
            self._bus.ask(key, payload, receive, on_done)

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
