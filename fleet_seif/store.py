"""A small durable ordered key-value store: the fusion ledger and a vehicle's outbox are each kept in one.

1. Keys are ordered as bytes. One `commit` is a list of changes applied in order: all of them are kept or none.
2. When `commit` has returned, its changes survive kill -9 and a power cut. Many changes a commit share one fsync.
3. One store writes a file at a time; any number of others read it meanwhile, each `load` from one snapshot.
4. After a failure of the disk the store is broken: every further commit is refused; what was committed stays.
5. Nothing is committed during a `load`. The caller serialises calls; the thread may differ from call to call.
"""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from fleet_seif.errors import RunError

KEY_BYTES_MAX: Final = 512
VALUE_BYTES_MAX: Final = 2**26


class StoreError(RunError):
    """A store that cannot be opened, read or written: says what, which file and the remedy."""


@dataclass(frozen=True, slots=True)
class Put:
    """Key `key` has `value` from now on. Raises ValueError if one is not bytes or is above its limit."""

    key: bytes
    value: bytes

    def __post_init__(self) -> None:
        _check("key", self.key, KEY_BYTES_MAX)
        _check("value", self.value, VALUE_BYTES_MAX)


@dataclass(frozen=True, slots=True)
class Delete:
    """All keys low <= key < high are gone. Raises ValueError if the bounds are not bytes, too long or out of order."""

    low: bytes
    high: bytes

    def __post_init__(self) -> None:
        _check("low", self.low, KEY_BYTES_MAX)
        _check("high", self.high, KEY_BYTES_MAX)
        if self.low > self.high:
            raise ValueError(f"store: Delete from {self.low!r} to {self.high!r}, which is before it")


def _check(name: str, value: bytes, limit: int) -> None:
    if not isinstance(value, bytes):
        raise ValueError(f"store: {name} is {type(value).__name__}, not bytes")
    if len(value) > limit:
        raise ValueError(f"store: {name} of {len(value)} bytes, at most {limit}")


Change = Put | Delete


class Store(Protocol):
    """See the rules above. `MemoryStore` and `SqliteStore` pass the same tests."""

    def load(self, low: bytes = b"", high: bytes | None = None) -> Iterator[tuple[bytes, bytes]]:
        """The pairs with low <= key < high (None: to the end) by ascending key, as they are at the first `next`.

        Raises StoreError if the file is damaged, which also breaks the store.
        """

    def commit(self, changes: Sequence[Change]) -> None:
        """Apply the changes in order, all or nothing; they are durable on return.

        Raises:
            ValueError: during a `load`, or the store is closed or read-only.
            StoreError: the disk did not take them, now or at an earlier commit.
        """

    def bytes_used(self) -> int:
        """What the store takes, bytes. A file keeps deleted space for reuse until `shrink`."""

    def shrink(self) -> None:
        """Give back the space that deletions left. Changes no pair; raises what `commit` raises."""

    def close(self) -> None:
        """Release the file. A second call does nothing."""


def refuse_during_load(loads: int) -> None:
    """Rule 5. Raises ValueError if `loads`, the number of loads under way, is not zero."""
    if loads:
        raise ValueError("store: changed during a load; exhaust or close the iterator first")


class MemoryStore:
    """A store without a disk, for tests and simulated fleets. Like a file it outlives `close`: use it again."""

    def __init__(self) -> None:
        self._keys: list[bytes] = []
        self._values: dict[bytes, bytes] = {}
        self._bytes = 0
        self._loads = 0

    def load(self, low: bytes = b"", high: bytes | None = None) -> Iterator[tuple[bytes, bytes]]:
        self._loads += 1
        try:
            for key in self._keys[self._between(low, high)]:
                yield key, self._values[key]
        finally:
            self._loads -= 1

    def commit(self, changes: Sequence[Change]) -> None:
        refuse_during_load(self._loads)
        for change in changes:
            if isinstance(change, Put):
                self._put(change)
            else:
                self._delete(self._between(change.low, change.high))

    def bytes_used(self) -> int:
        """Keys and values, bytes."""
        return self._bytes

    def shrink(self) -> None:
        refuse_during_load(self._loads)

    def close(self) -> None:
        pass

    def _between(self, low: bytes, high: bytes | None) -> slice:
        end = len(self._keys) if high is None else bisect_left(self._keys, high)
        return slice(bisect_left(self._keys, low), end)

    def _put(self, put: Put) -> None:
        old = self._values.get(put.key)
        if old is None:
            self._keys.insert(bisect_left(self._keys, put.key), put.key)
            self._bytes += len(put.key) + len(put.value)
        else:
            self._bytes += len(put.value) - len(old)
        self._values[put.key] = put.value

    def _delete(self, which: slice) -> None:
        for key in self._keys[which]:
            self._bytes -= len(key) + len(self._values.pop(key))
        del self._keys[which]
