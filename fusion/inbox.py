"""Events that wait to be handled, fairly: who floods waits behind himself, not others behind him.

1. Every source has a queue of its own, and `take` goes round the queues.
2. Above `EACH_MAX` events or `EACH_BYTES_MAX` of a source, or `SOURCES_MAX` sources, events are dropped and counted;
   what a dropped event said is said again or asked for.
3. Any thread may put, one takes.
"""

import threading
from collections import deque
from typing import Final, Generic, TypeVar

EACH_MAX: Final = 4096
EACH_BYTES_MAX: Final = 64 * 2**20
SOURCES_MAX: Final = 1000

E = TypeVar("E")


class Inbox(Generic[E]):
    """See the rules above."""

    def __init__(self) -> None:
        self._queues: dict[str, deque[tuple[E, int]]] = {}
        self._bytes: dict[str, int] = {}
        self._turns: deque[str] = deque()
        self._some = threading.Condition()
        self.dropped = 0

    def put(self, source: str, event: E, size: int = 0) -> bool:
        """False where the event is dropped. size: bytes it holds on to."""
        with self._some:
            queue = self._queues.get(source)
            held = self._bytes.get(source, 0)
            if queue is None:
                if len(self._queues) >= SOURCES_MAX:
                    self.dropped += 1
                    return False
                queue = self._queues[source] = deque()
                self._turns.append(source)
            elif len(queue) >= EACH_MAX or held + size > EACH_BYTES_MAX:
                self.dropped += 1
                return False
            queue.append((event, size))
            self._bytes[source] = held + size
            self._some.notify()
            return True

    def take(self, count: int, timeout_s: float) -> list[E]:
        """Up to `count` events, one of each source in turn; none after the timeout."""
        taken: list[E] = []
        with self._some:
            if not self._turns:
                self._some.wait(timeout_s)
            while self._turns and len(taken) < count:
                source = self._turns.popleft()
                event, size = self._queues[source].popleft()
                taken.append(event)
                self._bytes[source] -= size
                if self._queues[source]:
                    self._turns.append(source)
                else:
                    del self._queues[source], self._bytes[source]
        return taken
