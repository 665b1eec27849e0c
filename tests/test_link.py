"""A bad link on purpose: what it may do to messages, and what it may not."""

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from fleet_seif.bus import OnPut, OnQuery, Priority
from fleet_seif.link import Cut, FaultyBus, LinkModel, LinkSettings
from tests.strategies import settled

SECONDS = st.floats(0.0, 5.0)
SHARES = st.floats(0.0, 1.0)
LINKS = st.builds(
    LinkSettings, delay_s=SECONDS, jitter_s=SECONDS, loss=SHARES, duplication=SHARES, reorder=st.booleans()
)
DATA = bytes(range(20))
SENT = st.lists(SECONDS, max_size=30).map(sorted)


def sent_through(settings: LinkSettings, seed: int, times: list[float]) -> list[list[float]]:
    model = LinkModel(settings, np.random.default_rng(seed))
    return [[at_s for at_s, data in model.arrivals(t, DATA) if data == DATA] for t in times]


@given(LINKS, st.integers(0, 99), SENT)
@settled
def test_copies_arrive_within_delay_and_jitter(settings: LinkSettings, seed: int, times: list[float]) -> None:
    for t, arrivals in zip(times, sent_through(settings, seed, times), strict=True):
        assert len(arrivals) <= 2
        for at in arrivals:
            assert t + settings.delay_s <= at <= t + settings.delay_s + settings.jitter_s + 1e-12


@given(LINKS, st.integers(0, 99), SENT)
@settled
def test_a_link_that_does_not_reorder_delivers_in_order(settings: LinkSettings, seed: int, times: list[float]) -> None:
    ordered = settings.model_copy(update={"reorder": False})
    arrivals = [at for each in sent_through(ordered, seed, times) for at in each]
    assert arrivals == sorted(arrivals)


@given(LINKS, st.integers(0, 99), SENT)
@settled
def test_the_same_seed_gives_the_same_faults(settings: LinkSettings, seed: int, times: list[float]) -> None:
    assert sent_through(settings, seed, times) == sent_through(settings, seed, times)


@given(st.integers(0, 99), SENT)
@settled
def test_a_perfect_link_changes_nothing(seed: int, times: list[float]) -> None:
    assert LinkSettings().perfect
    assert sent_through(LinkSettings(), seed, times) == [[t] for t in times]


@given(LINKS)
@settled
def test_only_a_link_without_any_fault_is_perfect(settings: LinkSettings) -> None:
    faults = (settings.delay_s, settings.jitter_s, settings.loss, settings.duplication)
    assert settings.perfect == (faults == (0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("loss", "duplication"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.4), (0.2, 0.5), (1.0, 0.5), (0.0, 1.0)]
)
def test_losses_and_copies_come_as_often_as_asked(loss: float, duplication: float) -> None:
    n = 4000
    model = LinkModel(LinkSettings(loss=loss, duplication=duplication), np.random.default_rng(1))
    copies = np.array([len(model.arrivals(0.0, DATA)) for _ in range(n)])
    for count, expected in ((copies == 0, loss), (copies == 2, (1.0 - loss) * duplication)):
        assert abs(np.mean(count) - expected) <= 5.0 * np.sqrt(expected * (1.0 - expected) / n)


def test_jitter_alone_makes_messages_overtake() -> None:
    model = LinkModel(LinkSettings(jitter_s=1.0), np.random.default_rng(1))
    arrivals = [at for k in range(50) for at, _ in model.arrivals(0.01 * k, DATA)]
    assert arrivals != sorted(arrivals)


@pytest.mark.parametrize(
    "field", [{"loss": 1.1}, {"loss": -0.1}, {"delay_s": -1.0}, {"jitter_s": float("nan")}, {"drop": 0.1}]
)
def test_settings_that_mean_nothing_are_refused(field: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        LinkSettings.model_validate(field)


CUTS = LinkSettings(cuts=(Cut(from_s=1.0, for_s=2.0), Cut(from_s=5.0, for_s=1.0, who=("v1",))))


@pytest.mark.parametrize(("who", "cut"), [("v1", [1.0, 2.9, 5.0, 5.9]), ("v2", [1.0, 2.9])])
def test_a_cut_lets_nothing_through_of_those_whom_it_names_while_it_lasts(who: str, cut: list[float]) -> None:
    model = LinkModel(CUTS, np.random.default_rng(1), who)
    times = [0.0, 0.9, 1.0, 2.9, 3.0, 5.0, 5.9, 6.0]
    assert [t for t in times if model.is_cut(t)] == cut
    assert [t for t in times if not model.arrivals(t, DATA)] == cut
    assert [t for t in times if not model.arrivals(99.0, DATA, run_s=t)] == cut
    assert not CUTS.perfect


@given(st.binary(max_size=200), st.integers(0, 99))
@settled
def test_damage_changes_a_byte_or_takes_the_end_away(data: bytes, seed: int) -> None:
    (arrival,) = LinkModel(LinkSettings(corruption=1.0), np.random.default_rng(seed)).arrivals(0.0, data)
    damaged = arrival.data
    if len(damaged) == len(data):
        assert sum(a != b for a, b in zip(damaged, data, strict=True)) == min(1, len(data))
    else:
        assert data.startswith(damaged)
        assert len(damaged) < len(data)


def test_damage_comes_as_often_as_asked_and_hits_copies_one_by_one() -> None:
    n = 2000
    model = LinkModel(LinkSettings(corruption=0.3, duplication=1.0), np.random.default_rng(1))
    hurt = [[copy.data != DATA for copy in model.arrivals(0.0, DATA)] for _ in range(n)]
    assert abs(np.mean(hurt) - 0.3) < 5.0 * np.sqrt(0.21 / (2 * n))
    assert {tuple(pair) for pair in hurt} == {(a, b) for a in (False, True) for b in (False, True)}


def test_a_bus_that_is_cut_neither_puts_nor_hears_nor_asks_nor_answers() -> None:
    recorder, now_s = Recorder(), [1.5]
    heard: list[object] = []
    bus = FaultyBus(recorder, CUTS, seed=3, run_s=lambda: now_s[0])
    bus.subscribe("s", lambda key, payload: heard.append(payload))
    bus.answer("q", lambda key, payload: [payload])
    for cut in (True, False):
        now_s[0] = 1.5 if cut else 4.0
        bus.put("k", b"x")
        recorder.subscribed("s", b"x")
        bus.ask("q", b"x", heard.append, lambda: heard.append("done"))
        assert recorder.handlers["q"]("q", b"x") == ([] if cut else [b"x"])
        assert heard == (["done"] if cut else ["done", b"x", b"x", "done"])
    assert recorder.wait_for(1) == [("k", b"x")]
    bus.close()


class Recorder:
    """A bus that notes what it is asked to do."""

    def __init__(self) -> None:
        self.puts: list[tuple[str, bytes]] = []
        self.arrived = threading.Condition()
        self.handlers: dict[str, OnQuery] = {}
        self.calls: list[str] = []
        self.subscribed: OnPut = lambda key, payload: None

    def put(self, key: str, payload: bytes, priority: Priority = "data") -> None:
        with self.arrived:
            self.puts.append((key, payload))
            self.arrived.notify()

    def wait_for(self, count: int) -> list[tuple[str, bytes]]:
        with self.arrived:
            assert self.arrived.wait_for(lambda: len(self.puts) >= count, timeout=10.0)
            return list(self.puts)

    def subscribe(self, key: str, handler: OnPut) -> None:
        self.calls.append(f"subscribe {key}")
        self.subscribed = handler

    def answer(self, key: str, handler: OnQuery) -> None:
        self.handlers[key] = handler

    def ask(self, key: str, payload: bytes, on_reply: Callable[[bytes], None], on_done: Callable[[], None]) -> None:
        on_reply(payload)
        on_done()

    def announce(self, key: str) -> None:
        self.calls.append(f"announce {key}")

    def watch(self, key: str, handler: Callable[[str, bool], None]) -> None:
        self.calls.append(f"watch {key}")

    def close(self) -> None:
        self.calls.append("close")


PUTS = [(f"k{i % 3}", bytes([i])) for i in range(40)]


def through(settings: LinkSettings, expected: int) -> list[tuple[str, bytes]]:
    recorder = Recorder()
    bus = FaultyBus(recorder, settings, seed=3)
    for key, payload in PUTS:
        bus.put(key, payload)
    recorder.wait_for(expected)
    while bus._due:  # what should have been lost would still be here
        time.sleep(0.001)
    got = recorder.wait_for(expected)
    bus.close()
    return got


def test_a_bus_with_a_perfect_link_delivers_every_put_in_order() -> None:
    assert through(LinkSettings(), len(PUTS)) == PUTS


def test_a_bus_that_only_doubles_delivers_every_put_twice() -> None:
    assert sorted(through(LinkSettings(duplication=1.0), 2 * len(PUTS))) == sorted(PUTS * 2)


def test_a_bus_that_delays_delivers_every_put_in_some_order() -> None:
    got = through(LinkSettings(jitter_s=0.03), len(PUTS))
    assert sorted(got) == sorted(PUTS)
    assert got != PUTS


def test_a_bus_that_loses_everything_delivers_nothing() -> None:
    assert through(LinkSettings(loss=1.0), 0) == []


def test_closing_drops_what_is_under_way_and_closes_the_bus_below() -> None:
    recorder = Recorder()
    bus = FaultyBus(recorder, LinkSettings(delay_s=60.0), seed=3)
    bus.put("k", b"late")
    bus.close()
    assert recorder.puts == []
    assert recorder.calls == ["close"]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (LinkSettings(), [b"1", b"2"]),
        (LinkSettings(duplication=1.0), [b"1", b"1", b"2", b"2"]),
        (LinkSettings(loss=1.0), []),
        (LinkSettings(delay_s=60.0), [b"1", b"2"]),
    ],
)
def test_answers_are_lost_and_doubled_but_never_late(settings: LinkSettings, expected: list[bytes]) -> None:
    recorder = Recorder()
    bus = FaultyBus(recorder, settings, seed=3)
    bus.answer("key", lambda key, payload: [b"1", b"2"])
    assert recorder.handlers["key"]("key", b"") == expected
    bus.close()


def test_what_is_not_a_message_passes_untouched() -> None:
    recorder = Recorder()
    bus = FaultyBus(recorder, LinkSettings(loss=1.0), seed=3)
    heard: list[object] = []
    bus.subscribe("s", lambda key, payload: None)
    bus.announce("a")
    bus.watch("w", lambda key, alive: None)
    bus.ask("q", b"x", heard.append, lambda: heard.append("done"))
    bus.close()
    assert recorder.calls == ["subscribe s", "announce a", "watch w", "close"]
    assert heard == [b"x", "done"]
