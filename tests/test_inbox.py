"""The inbox: in order for each source, fair between them, bounded."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion.inbox import Inbox
from tests.strategies import settled

PUTS = st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 99)), max_size=40)


def everything(inbox: Inbox[tuple[str, int]], count: int) -> list[tuple[str, int]]:
    taken: list[tuple[str, int]] = []
    while some := inbox.take(count, 0.0):
        assert len(some) <= count
        taken += some
    return taken


@given(PUTS, st.integers(1, 10))
@settled
def test_every_event_comes_out_once_and_in_the_order_of_its_source(puts: list[tuple[str, int]], count: int) -> None:
    inbox: Inbox[tuple[str, int]] = Inbox()
    assert all(inbox.put(source, (source, i)) for i, (source, _) in enumerate(puts))
    taken = everything(inbox, count)
    for name in "abc":
        assert [e for e in taken if e[0] == name] == [(s, i) for i, (s, _) in enumerate(puts) if s == name]
    assert inbox.dropped == 0


@given(PUTS)
@settled
def test_a_source_waits_behind_at_most_one_event_of_every_other(puts: list[tuple[str, int]]) -> None:
    """Between two events of one source, no other source has two."""
    inbox: Inbox[tuple[str, int]] = Inbox()
    for i, (source, _) in enumerate(puts):
        inbox.put(source, (source, i))
    taken = [source for source, _ in everything(inbox, 7)]
    for name in set(taken):
        places = [i for i, source in enumerate(taken) if source == name]
        for low, high in zip([-1, *places], places, strict=False):
            between = taken[low + 1 : high]
            assert len(between) == len(set(between))


def test_a_flood_of_one_source_does_not_keep_another_waiting() -> None:
    inbox: Inbox[str] = Inbox()
    for k in range(1000):
        inbox.put("loud", f"loud {k}")
    inbox.put("quiet", "quiet")
    assert "quiet" in inbox.take(2, 0.0)


def test_what_a_source_has_beyond_a_limit_is_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.inbox.EACH_MAX", 3)
    inbox: Inbox[int] = Inbox()
    assert [inbox.put("a", k) for k in range(5)] == [True, True, True, False, False]
    assert inbox.put("b", 9)
    assert inbox.dropped == 2
    assert sorted(inbox.take(10, 0.0)) == [0, 1, 2, 9]
    assert inbox.put("a", 5)


def test_bytes_count_as_long_as_an_event_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.inbox.EACH_BYTES_MAX", 100)
    inbox: Inbox[int] = Inbox()
    assert [inbox.put("a", k, size=60) for k in range(2)] == [True, False]
    assert inbox.put("a", 2, size=40)
    assert inbox.put("b", 3, size=100)
    assert inbox.take(1, 0.0) == [0]
    assert inbox.put("a", 4, size=60)
    assert not inbox.put("a", 5, size=1)


def test_sources_have_a_limit_and_make_room_when_they_have_nothing_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion.inbox.SOURCES_MAX", 2)
    inbox: Inbox[str] = Inbox()
    assert [inbox.put(name, name) for name in "abc"] == [True, True, False]
    inbox.take(1, 0.0)
    assert inbox.put("c", "c")


def test_who_takes_waits_for_the_first_event() -> None:
    inbox: Inbox[str] = Inbox()
    assert inbox.take(5, 0.01) == []
    taken: list[str] = []
    taker = threading.Thread(target=lambda: taken.extend(inbox.take(5, 60.0)))
    taker.start()
    inbox.put("a", "late")
    taker.join(10.0)
    assert taken == ["late"]


def test_events_of_many_threads_all_arrive() -> None:
    inbox: Inbox[int] = Inbox()
    threads = [threading.Thread(target=lambda i=i: [inbox.put(f"t{i}", k) for k in range(200)]) for i in range(5)]
    for thread in threads:
        thread.start()
    taken: list[int] = []
    while len(taken) < 1000 and (some := inbox.take(64, 5.0)):
        taken += some
    for thread in threads:
        thread.join()
    assert len(taken) == 1000
