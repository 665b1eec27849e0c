"""A Store in one SQLite file, next to which FILE-wal (the write-ahead log) and FILE-shm lie while it is open.

Writing. A commit appends to the log and fsyncs it (synchronous=FULL). The commit that fills the log to
CHECKPOINT_PAGES copies it into the file, and the next commit starts the log again from its beginning. So the log stays
near 4 MB plus one commit; one that a large commit or a long `load` elsewhere made larger is cut back to WAL_BYTES_MAX.

One writer. It holds an exclusive SQLite lock on the empty side file FILE.lock. The system drops that lock when the
process dies, however it dies; a forked child does not inherit it, as it would flock's; and it works wherever SQLite
does. The side file stays behind and means nothing without a holder.

Creating. A file is made under the name FILE.new and renamed when complete: an empty or half-made FILE is damage.

Damage. The log has checksums, the file has none: `verify` finds damaged structure, not a flipped bit within a value.
A log with a damaged frame loses that frame's commit and all later ones, as if they had never been.
"""

import itertools
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from operator import itemgetter
from pathlib import Path
from typing import Final, Self

from fleet_seif.store import Change, Put, StoreError, refuse_during_load

APPLICATION_ID: Final = int.from_bytes(b"SEIF", "big")
"""What SQLite files of ours have at byte 68, where file(1) looks."""
SQLITE_BYTES_MIN: Final = 512
CHECKPOINT_PAGES: Final = 1000
WAL_BYTES_MAX: Final = 2**23
SHRINK_PAGES: Final = 1000
"""Pages given back in one transaction, so that shrinking does not swell the log."""
BUSY_S: Final = 2.0
"""How long a call waits for another connection, s. Of a writer's calls only `shrink` ever does, for a `load`."""
LOCK_S: Final = 0.2
"""How long `open` waits for another writer, s: one that was just killed is gone by then."""

# With rowids a page holds three values of 1.3 kB; WITHOUT ROWID they overflow into pages of their own: 3 times slower.
_CREATE: Final = (
    "CREATE TABLE about (kind TEXT NOT NULL)",
    "CREATE TABLE entry (key BLOB PRIMARY KEY NOT NULL, value BLOB NOT NULL)",
)
_PUT: Final = "INSERT INTO entry VALUES (?, ?) ON CONFLICT (key) DO UPDATE SET value = excluded.value"
_DELETE: Final = "DELETE FROM entry WHERE key >= ? AND key < ?"
_LOAD: Final = "SELECT key, value FROM entry WHERE key >= ? ORDER BY key"
_LOAD_BELOW: Final = "SELECT key, value FROM entry WHERE key >= ? AND key < ? ORDER BY key"

_START_FRESH: Final = (
    "move it away together with its -wal and -shm files and start fresh; "
    "vehicles that still hold their outbox send it again"
)
_REPAIR: Final = "check that the disk is sound, has space and may be written by this user, then start again"


class SqliteStore:
    """See the rules above and those of `fleet_seif.store`. Made by `open`."""

    def __init__(self, path: Path, connection: sqlite3.Connection, lock: sqlite3.Connection | None) -> None:
        self._path = path
        self._connection = connection
        self._lock = lock
        self._loads = 0
        self._closed = False
        self._failure = ""

    @classmethod
    def open(cls, path: Path, kind: str, version: int, *, read_only: bool = False) -> Self:
        """Open the file; unless `read_only`, become its writer and create it if it is missing.

        Args:
            path: the file, in a folder that exists.
            kind: what the file holds, such as "ledger".
            version: of the layout of its keys and values, 1 to 2^31 - 1.
            read_only: read what a writer has committed so far, while it goes on.

        Raises:
            StoreError: it has a writer already; no such folder or file; no permission; damaged; not a store; of
                another kind or version.
        """
        if not 1 <= version < 2**31:
            raise ValueError(f"store: version {version}, not in 1 to 2^31 - 1")
        with _explained(path):
            path = path.resolve()
            if path.is_dir() or not path.parent.is_dir():
                raise StoreError(f"{path}: not a file in an existing folder; create the folder or name another file")
            lock = None if read_only else _locked(path)
            try:
                return cls(path, _opened(path, kind, version, read_only), lock)
            except BaseException:
                if lock is not None:
                    lock.close()
                raise

    def load(self, low: bytes = b"", high: bytes | None = None) -> Iterator[tuple[bytes, bytes]]:
        """As in Store. What another connection commits meanwhile is not seen, and stays in the log until the end."""
        self._refuse_if_closed()
        self._loads += 1
        try:
            with self._breaking("reading failed"):
                if high is None:
                    yield from self._connection.execute(_LOAD, (low,))
                else:
                    yield from self._connection.execute(_LOAD_BELOW, (low, high))
        finally:
            self._loads -= 1

    def commit(self, changes: Sequence[Change]) -> None:
        """As in Store.

        A commit that raised StoreError is not to be counted on: usually nothing of it is kept, but if the fsync
        itself failed all of it may be there when the file is opened again. Never a part.
        """
        self._refuse_if_not_writing()
        if not changes:
            return
        with self._breaking("commit failed and does not count"), _transaction(self._connection):
            for statement, run in itertools.groupby(map(_statement, changes), itemgetter(0)):
                self._connection.executemany(statement, (values for _, values in run))

    def bytes_used(self) -> int:
        """The file and its log, bytes."""
        return _size(self._path) + _size(_beside(self._path, "-wal"))

    def shrink(self) -> None:
        """As in Store. Waits up to BUSY_S for a `load` elsewhere; if it goes on, the file shrinks at a later commit."""
        self._refuse_if_not_writing()
        with self._breaking("shrinking failed"):
            (free,) = self._connection.execute("PRAGMA freelist_count").fetchone()
            for _ in range(0, free, SHRINK_PAGES):
                # SQLite gives back one page a step; of Python's calls only executescript steps to the end.
                self._connection.executescript(f"PRAGMA incremental_vacuum({SHRINK_PAGES})")
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()

    def verify(self) -> None:
        """Read the whole file and check its structure. Raises StoreError if it is damaged."""
        self._refuse_if_closed()
        with self._breaking("verifying failed"):
            (found,) = self._connection.execute("PRAGMA integrity_check(1)").fetchone()
            if found != "ok":
                raise sqlite3.DatabaseError(" ".join(found.split()))

    def close(self) -> None:
        """As in Store. The last one to close a sound file copies the log into it and removes the log."""
        self._closed = True
        self._connection.close()
        if self._lock is not None:
            self._lock.close()

    def _refuse_if_closed(self) -> None:
        if self._closed:
            raise ValueError(f"store: {self._path} is closed")

    def _refuse_if_not_writing(self) -> None:
        self._refuse_if_closed()
        if self._lock is None:
            raise ValueError(f"store: {self._path} was opened read-only")
        refuse_during_load(self._loads)
        if self._failure:
            raise StoreError(f"{self._failure} (an earlier failure; the store takes nothing since)")

    @contextmanager
    def _breaking(self, failed: str) -> Iterator[None]:
        """Rule 4: the failure is explained, and kept as the reason to refuse commits."""
        try:
            with _explained(self._path, failed):
                yield
        except StoreError as error:
            self._failure = str(error)
            raise


@contextmanager
def _explained(path: Path, failed: str = "opening failed") -> Iterator[None]:
    """Turn errors of SQLite and the system into StoreError with file and remedy."""
    try:
        yield
    except (OSError, sqlite3.OperationalError) as error:
        raise StoreError(f"{path}: {failed}: {error}; {_REPAIR}") from error
    except sqlite3.Error as error:
        raise StoreError(f"{path}: {failed}, not a store or damaged: {error}; {_START_FRESH}") from error


@contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):  # SQLite has already rolled back after some errors
            connection.execute("ROLLBACK")
        raise


def _statement(change: Change) -> tuple[str, tuple[bytes, bytes]]:
    if isinstance(change, Put):
        return _PUT, (change.key, change.value)
    return _DELETE, (change.low, change.high)


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _connected(path: Path, mode: str, wait_s: float = BUSY_S) -> sqlite3.Connection:
    """A connection whose transactions are ours to begin; mode: ro, rw or rwc (create)."""
    uri = f"{path.as_uri()}?mode={mode}"
    return sqlite3.connect(uri, uri=True, timeout=wait_s, isolation_level=None, check_same_thread=False)


def _locked(path: Path) -> sqlite3.Connection:
    """The writer's lock, held until this connection is closed."""
    lock = _connected(_beside(path, ".lock"), "rwc", LOCK_S)
    try:
        lock.execute("PRAGMA journal_mode = MEMORY")  # else a file FILE.lock-journal lies about
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.Error as error:
        lock.close()
        if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
            raise
        raise StoreError(f"{path}: has a writer already, in this or another process; stop that one first") from error
    return lock


def _opened(path: Path, kind: str, version: int, read_only: bool) -> sqlite3.Connection:
    """A connection to a file that is what it should be."""
    if not read_only and not path.exists():
        _create(path, kind, version)
    if not path.exists():
        raise StoreError(f"{path}: no such file; start what writes it first, or name another file")
    size = path.stat().st_size
    if size < SQLITE_BYTES_MIN:  # SQLite would take it for a new one and delete its log
        raise StoreError(f"{path}: of {size} bytes, so damaged; {_START_FRESH}")
    connection = _connected(path, "ro" if read_only else "rw")
    try:
        _check_content(path, connection, kind, version)
        if not read_only:
            _prepare(path, connection)
    except BaseException:
        connection.close()
        raise
    return connection


def _check_content(path: Path, connection: sqlite3.Connection, kind: str, version: int) -> None:
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    if application != APPLICATION_ID:
        raise StoreError(f"{path}: a SQLite file, but not a store of fleet_seif; name another file")
    (found_kind,) = connection.execute("SELECT kind FROM about").fetchone()
    if found_kind != kind:
        raise StoreError(f"{path}: a store of kind {found_kind!r}, expected {kind!r}; name another file")
    (found,) = connection.execute("PRAGMA user_version").fetchone()
    if found != version:
        raise StoreError(
            f"{path}: a {kind} of version {found}, expected {version}; use the release that wrote it, or {_START_FRESH}"
        )


def _prepare(path: Path, connection: sqlite3.Connection) -> None:
    """Set up writing; the empty transaction finds out now whether the file may be written."""
    (mode,) = connection.execute("PRAGMA journal_mode = WAL").fetchone()
    if mode != "wal":
        raise StoreError(f"{path}: no write-ahead log possible here, found {mode!r}; use a local disk")
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute(f"PRAGMA wal_autocheckpoint = {CHECKPOINT_PAGES}")
    connection.execute(f"PRAGMA journal_size_limit = {WAL_BYTES_MAX}")
    with _transaction(connection):
        pass


def _create(path: Path, kind: str, version: int) -> None:
    """Make an empty store. A log without its file holds commits that a new file must not swallow."""
    wal = _beside(path, "-wal")
    if _size(wal):
        raise StoreError(f"{path}: missing, but its log {wal} is there; move the file back or the log away too")
    new = _beside(path, ".new")
    for suffix in ("", "-wal", "-shm"):
        _beside(new, suffix).unlink(missing_ok=True)
    connection = _connected(new, "rwc")
    try:
        connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
        _prepare(new, connection)
        with _transaction(connection):
            for statement in _CREATE:
                connection.execute(statement)
            connection.execute("INSERT INTO about VALUES (?)", (kind,))
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {version}")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    finally:
        connection.close()
    new.replace(path)
