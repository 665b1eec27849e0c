"""What a store in a file promises, whatever happens to the process, the disk or the file."""

import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.sqlite_store import CHECKPOINT_PAGES, SqliteStore
from fleet_seif.store import Change, Delete, Put, StoreError
from tests.strategies import settled
from tests.test_store import Model, applied


def opened(path: Path, *, read_only: bool = False) -> SqliteStore:
    return SqliteStore.open(path, "ledger", 3, read_only=read_only)


def content(path: Path) -> Model:
    with closing(opened(path)) as store:
        store.verify()
        return dict(store.load())


def test_each_commit_is_fsynced(tmp_path: Path) -> None:
    """Only a power cut would tell, so this asks SQLite: 2 is FULL."""
    with closing(opened(tmp_path / "ledger.db")) as store:
        assert store._connection.execute("PRAGMA synchronous").fetchone() == (2,)


def test_one_store_writes_a_file_while_others_read_it(tmp_path: Path) -> None:
    path = tmp_path / "ledger.db"
    with closing(opened(path)) as writer:
        writer.commit([Put(b"a", b"1"), Put(b"b", b"2")])
        with pytest.raises(StoreError, match=r"ledger\.db: has a writer already.* stop"):
            opened(path)
        with closing(opened(path, read_only=True)) as reader:
            with pytest.raises(ValueError, match="read-only"):
                reader.commit([Put(b"c", b"3")])
            pairs = reader.load()
            assert next(pairs) == (b"a", b"1")
            writer.commit([Put(b"b", b"changed")])
            assert list(pairs) == [(b"b", b"2")], "a load is of one moment"
            assert dict(reader.load()) == {b"a": b"1", b"b": b"changed"}
    assert content(path) == {b"a": b"1", b"b": b"changed"}
    with closing(opened(path, read_only=True)) as reader:
        assert len(list(reader.load())) == 2


def test_a_closed_store_is_not_used(tmp_path: Path) -> None:
    store = opened(tmp_path / "ledger.db")
    store.close()
    with pytest.raises(ValueError, match="closed"):
        store.commit([Put(b"a", b"1")])
    with pytest.raises(ValueError, match="closed"):
        next(store.load())


def test_deleted_space_is_given_back_and_the_log_stays_small(tmp_path: Path) -> None:
    path = tmp_path / "ledger.db"
    largest = 0
    with closing(opened(path)) as store:
        for i in range(60):
            store.commit([Put(bytes([j % 10, i, j]), bytes(1300)) for j in range(200)])
            largest = max(largest, (tmp_path / "ledger.db-wal").stat().st_size)
        assert largest < 4200 * CHECKPOINT_PAGES + 2 * 200 * 1300
        full = store.bytes_used()
        store.commit([Delete(bytes([1]), bytes([10]))])
        store.shrink()
        assert len(list(store.load())) == 60 * 20
        assert store.bytes_used() < 0.2 * full
        store.verify()


# Files that are not what they should be.


def a_store(path: Path, commits: int = 30) -> None:
    with closing(opened(path)) as store:
        for i in range(commits):
            store.commit([Put(bytes([i]), bytes([i]) * 3000)])


def overwritten(path: Path, at: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


def truncated(path: Path, size: int) -> None:
    a_store(path)
    assert path.stat().st_size > size
    with path.open("r+b") as file:
        file.truncate(size)


def alien(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE entry (key, value)")


def without_its_file(path: Path) -> None:
    path.with_name(path.name + "-wal").write_bytes(b"commits")


def header_damaged(path: Path) -> None:
    a_store(path)
    overwritten(path, 0, b"?")


def schema_damaged(path: Path) -> None:
    a_store(path)
    overwritten(path, 100, bytes(3996))


@pytest.mark.parametrize(
    ("spoil", "remedy"),
    [
        (lambda path: path.write_bytes(b"hello" * 1000), "start fresh"),
        (lambda path: path.write_bytes(b""), "start fresh"),
        (lambda path: truncated(path, 50), "start fresh"),
        (lambda path: truncated(path, 511), "start fresh"),
        (lambda path: truncated(path, 512), "start fresh"),
        (lambda path: truncated(path, 5000), "start fresh"),
        (lambda path: truncated(path, 40_960), "start fresh"),
        (header_damaged, "start fresh"),
        (schema_damaged, "start fresh"),
        (alien, "another file"),
        (without_its_file, "move the file back"),
        (lambda path: path.mkdir(), "another file"),
        (lambda path: path.with_name("store.db.lock").mkdir(), "check that"),
    ],
)
def test_a_file_that_is_no_sound_store_is_refused_with_a_remedy(
    tmp_path: Path, spoil: Callable[[Path], object], remedy: str
) -> None:
    path = tmp_path / "store.db"
    spoil(path)
    with pytest.raises(StoreError, match=rf"store\.db.*{remedy}"):
        opened(path)


def test_a_file_of_another_kind_or_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    a_store(path)
    with pytest.raises(StoreError, match=r"store\.db.*'ledger'.*'outbox'"):
        SqliteStore.open(path, "outbox", 3)
    with pytest.raises(StoreError, match=r"store\.db.*version 3.*4.*start fresh"):
        SqliteStore.open(path, "ledger", 4)
    assert len(content(path)) == 30


def test_a_missing_folder_or_a_missing_file_to_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"store\.db.*create the folder"):
        opened(tmp_path / "missing" / "store.db")
    with pytest.raises(StoreError, match=r"store\.db.*no such file"):
        opened(tmp_path / "store.db", read_only=True)


def test_a_store_that_was_half_made_is_made_again(tmp_path: Path) -> None:
    (tmp_path / "store.db.new").write_bytes(b"half")
    (tmp_path / "store.db.new-wal").write_bytes(b"half")
    assert content(tmp_path / "store.db") == {}


def test_damage_within_a_file_is_found_and_stops_commits(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    a_store(path)
    overwritten(path, 5 * 4096, b"\xff" * 20 * 4096)
    with closing(opened(path)) as store:
        with pytest.raises(StoreError, match=r"store\.db.*damaged.*start fresh"):
            store.verify()
        with pytest.raises(StoreError, match="damaged"):
            list(store.load())
        with pytest.raises(StoreError, match="damaged"):
            store.commit([Put(b"a", b"1")])


# Disks that are full.


@contextmanager
def files_limited_to(size: int) -> Iterator[None]:
    """The system refuses to write beyond `size` bytes of a file, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("room", [0, 1, 23, 24, 4119, 4120, 10_000, 30_000])
def test_a_commit_that_finds_the_disk_full_leaves_nothing_and_is_the_last(tmp_path: Path, room: int) -> None:
    path = tmp_path / "store.db"
    a_store(path)
    with closing(opened(path)) as store:
        store.commit([Put(b"a", b"before")])
        before = dict(store.load())
        with (
            files_limited_to(store.bytes_used() - path.stat().st_size + room),
            pytest.raises(StoreError, match=r"store\.db: commit failed.* check that the disk"),
        ):
            store.commit([Delete(b"a", b"b")] + [Put(bytes([200, i]), bytes(3000)) for i in range(20)])
        with pytest.raises(StoreError, match="earlier"):
            store.commit([Put(b"b", b"after")])
        assert dict(store.load()) == before
    assert content(path) == before


# Processes that are killed and logs that are torn.

WRITER = """
import os, sys
from pathlib import Path
from fleet_seif.sqlite_store import SqliteStore
from tests.test_sqlite_store import numbered

path, count = Path(sys.argv[1]), int(sys.argv[2])
store = SqliteStore.open(path, "ledger", 3)
start = sum(1 for _ in store.load(b"n"))
for i in range(start, start + count):
    store.commit(numbered(i))
    print(i, os.path.getsize(f"{path}-wal"), flush=True)
os.kill(os.getpid(), 9)
"""
PAIRS = 12


def numbered(i: int) -> list[Change]:
    """Commit number i: PAIRS pairs under its number, those of commit i - 5 gone, and a row that counts it."""
    puts: list[Change] = [Put(b"d%06d%02d" % (i, j), bytes([i % 256]) * 1300) for j in range(PAIRS)]
    return [*puts, Delete(b"d", b"d%06d" % max(0, i - 4)), Put(b"n%06d" % i, b"")]


def after(n: int) -> Model:
    """The model after the first n numbered commits."""
    model = {b"n%06d" % i: b"" for i in range(n)}
    for i in range(max(0, n - 5), n):
        model = applied(model, numbered(i)[:PAIRS])
    return model


def writing(path: Path, commits: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), str(commits)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parent.parent,
    )


def test_what_was_committed_survives_kill_9_and_each_commit_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "store.db"
    for lines in (1, 30, 170):
        with writing(path, 100_000) as process:
            assert process.stdout is not None
            reported = [process.stdout.readline() for _ in range(lines)]
            with pytest.raises(StoreError, match="writer"):
                opened(path)
            process.send_signal(signal.SIGKILL)
            reported += process.stdout.readlines()
        complete = [line for line in reported if line.endswith("\n")]
        last = int(complete[-1].split()[0])
        found = content(path)
        assert found in (after(last + 1), after(last + 2))


@dataclass(frozen=True)
class Crashed:
    """The files of a writer that was killed, and where in the log each of its commits ended."""

    path: Path
    wal: bytes
    ends: list[int]


@pytest.fixture(scope="module")
def crashed(tmp_path_factory: pytest.TempPathFactory) -> Crashed:
    path = tmp_path_factory.mktemp("crashed") / "store.db"
    with writing(path, 12) as process:
        assert process.stdout is not None
        ends = [int(line.split()[1]) for line in process.stdout]
    return Crashed(path, path.with_name("store.db-wal").read_bytes(), ends)


@given(data=st.data())
@settled
def test_a_torn_log_gives_exactly_the_commits_before_the_tear(crashed: Crashed, data: st.DataObject) -> None:
    wal = crashed.wal
    at = data.draw(st.integers(0, len(wal) - 1), "tear")
    flip = data.draw(st.integers(1, 255), "flip")
    rest = (
        wal[at + 1 :] if data.draw(st.booleans(), "the rest is there") else data.draw(st.binary(max_size=99), "noise")
    )
    torn = data.draw(st.sampled_from([wal[:at], wal[:at] + bytes([wal[at] ^ flip]) + rest]))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "store.db"
        shutil.copyfile(crashed.path, path)
        path.with_name("store.db-wal").write_bytes(torn)
        assert content(path) == after(bisect_right(crashed.ends, at))
