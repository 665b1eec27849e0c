"""What every store promises, tried on each of them against a plain dict."""

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from fleet_seif.sqlite_store import SqliteStore
from fleet_seif.store import KEY_BYTES_MAX, VALUE_BYTES_MAX, Change, Delete, MemoryStore, Put, Store
from tests.strategies import settled

Model = dict[bytes, bytes]

KEYS = st.lists(st.sampled_from([0, 1, 255]), max_size=3).map(bytes)
VALUES = st.binary(max_size=3) | st.just(bytes(9000))
BOUNDS = st.tuples(KEYS, KEYS).map(sorted)
DELETES: SearchStrategy[Change] = BOUNDS.map(lambda bounds: Delete(*bounds))
PUTS: SearchStrategy[Change] = st.builds(Put, KEYS, VALUES)
COMMITS = st.lists(PUTS | DELETES, max_size=8)


def applied(model: Model, changes: Sequence[Change]) -> Model:
    """The obvious reference: the model after the changes, in order."""
    for change in changes:
        if isinstance(change, Put):
            model = {**model, change.key: change.value}
        else:
            model = {key: value for key, value in model.items() if not change.low <= key < change.high}
    return model


class InMemory:
    def __init__(self, _: Path) -> None:
        self.store = MemoryStore()

    def open(self) -> Store:
        return self.store


class InFile:
    def __init__(self, folder: Path) -> None:
        self.path = folder / "a file?.db"

    def open(self) -> Store:
        return SqliteStore.open(self.path, "ledger", 1)


both = pytest.mark.parametrize("place", [InMemory, InFile])
Place = Callable[[Path], InMemory | InFile]


@both
@given(rounds=st.lists(st.tuples(COMMITS, BOUNDS, st.sampled_from(["go on", "reopen", "shrink"])), max_size=6))
@settled
def test_a_store_is_a_sorted_dict_that_survives_reopening(
    place: Place, rounds: list[tuple[list[Change], list[bytes], str]]
) -> None:
    with TemporaryDirectory() as folder:
        where = place(Path(folder))
        store, model = where.open(), Model()
        for changes, (low, high), then in rounds:
            store.commit(changes)
            if then == "reopen":
                store.close()
                store = where.open()
            elif then == "shrink":
                store.shrink()
            model = applied(model, changes)
            assert list(store.load()) == sorted(model.items())
            assert list(store.load(low)) == sorted(item for item in model.items() if item[0] >= low)
            assert list(store.load(low, high)) == sorted(item for item in model.items() if low <= item[0] < high)
            assert store.bytes_used() >= sum(len(key) + len(value) for key, value in model.items())
        store.close()
        store.close()


@both
def test_nothing_is_committed_during_a_load(place: Place, tmp_path: Path) -> None:
    with closing(place(tmp_path).open()) as store:
        store.commit([Put(b"a", b"1"), Put(b"b", b"2")])
        pairs = store.load()
        assert next(pairs) == (b"a", b"1")
        with pytest.raises(ValueError, match="load"):
            store.commit([Put(b"c", b"3")])
        assert list(pairs) == [(b"b", b"2")]
        store.commit([Put(b"c", b"3")])
        assert len(list(store.load())) == 3


@both
def test_a_store_keeps_nothing_of_the_list_it_was_given(place: Place, tmp_path: Path) -> None:
    with closing(place(tmp_path).open()) as store:
        changes: list[Change] = [Put(b"a", b"1")]
        store.commit(changes)
        changes.clear()
        assert list(store.load()) == [(b"a", b"1")]


def test_changes_that_could_change_later_or_are_too_large_are_refused() -> None:
    with pytest.raises(ValueError, match="bytearray"):
        Put(b"a", bytearray(b"1"))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=str(KEY_BYTES_MAX)):
        Put(bytes(KEY_BYTES_MAX + 1), b"")
    with pytest.raises(ValueError, match=str(VALUE_BYTES_MAX)):
        Put(b"a", bytes(VALUE_BYTES_MAX + 1))
    with pytest.raises(ValueError, match="before"):
        Delete(b"b", b"a")
