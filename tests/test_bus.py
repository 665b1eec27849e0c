"""The bus on real Zenoh: what the processes rely on.

Run as a program (`python -m tests.test_bus NAME LISTEN|- [CONNECT...]`) this is a process that tests may kill
or freeze: see `serve`.
"""

import contextlib
import logging
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np
import pytest

from fleet_seif.bus import CONNECT_MS, Bus, Priority, ZenohBus, check_endpoints, is_loopback, open_bus
from fleet_seif.errors import RunError
from tests.conftest import Network

PATIENCE_S = 10.0
LOOK_S = 0.02
ANY_PORT = "tcp/127.0.0.1:0"


def serve(name: str, listen: str, *connect: str) -> None:
    """A router (or a client where listen is -) that hears floods, answers queries and shows itself, until killed."""
    with open_bus(listen=[] if listen == "-" else [listen], connect=connect) as bus:
        bus.subscribe("flood", lambda key, data: None)
        bus.answer("ledger/*", lambda key, data: [f"{name} {key}".encode()])
        bus.announce(f"node/{name}")
        print("-" if listen == "-" else bus.endpoints()[0], flush=True)
        sys.stdin.read()


@dataclass
class Process:
    """A process that runs `serve`."""

    popen: "subprocess.Popen[str]"
    endpoint: str

    def kill(self) -> None:
        """As a crash does: no goodbye."""
        self.popen.kill()
        self.popen.wait()


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    """Start processes that run `serve`; they are killed at the end."""
    with contextlib.ExitStack() as stack:

        def start_one(*arguments: str) -> Process:
            popen = subprocess.Popen(
                [sys.executable, "-m", "tests.test_bus", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            stack.enter_context(popen)
            stack.callback(popen.kill)
            assert popen.stdout is not None
            return Process(popen, popen.stdout.readline().strip())

        yield start_one


def ask(bus: Bus, key: str) -> list[bytes]:
    """All replies to one query."""
    replies: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    bus.ask(key, b"", replies.put, lambda: replies.put(None))
    return list(iter(lambda: replies.get(timeout=PATIENCE_S), None))


def until(condition: Callable[[], bool], patience_s: float = PATIENCE_S) -> float:
    """How long it took until a condition held, s."""
    begin_s = time.monotonic()
    while not condition():
        assert time.monotonic() < begin_s + patience_s, "still not so"
        time.sleep(LOOK_S)
    return time.monotonic() - begin_s


def arrives(sender: Bus, key: str, got: "queue.SimpleQueue[bytes]") -> Callable[[], bool]:
    """Whether what is put now reaches a subscriber: a condition for `until`."""

    def look() -> bool:
        sender.put(key, b"x")
        with contextlib.suppress(queue.Empty):
            return bool(got.get(timeout=LOOK_S))
        return False

    return look


def drain(got: "queue.SimpleQueue[bytes]") -> None:
    with contextlib.suppress(queue.Empty):
        while True:
            got.get_nowait()


def test_what_a_client_puts_arrives_at_the_router_and_at_other_clients(network: Network) -> None:
    got: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
    network.bus.subscribe("t/*", lambda key, data: got.put((key, data)))
    with open_bus(connect=[network.endpoint]) as a, open_bus(connect=[network.endpoint]) as b:
        heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        answered: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        b.subscribe("t/*", lambda key, data: heard.put(data))
        b.answer("ready", lambda key, data: [b"yes"])
        while True:  # declarations travel: ask until b answers, then its subscription is known too
            done: queue.SimpleQueue[None] = queue.SimpleQueue()
            a.ask("ready", b"", answered.put, lambda done=done: done.put(None))  # type: ignore[misc]
            done.get(timeout=PATIENCE_S)
            if not answered.empty():
                break
        a.put("t/x", b"payload")
        assert heard.get(timeout=PATIENCE_S) == b"payload"
        assert got.get(timeout=PATIENCE_S) == ("t/x", b"payload")


def test_a_query_gets_every_reply_and_an_end(network: Network) -> None:
    network.bus.answer("q", lambda key, data: [data + bytes([i]) for i in range(250)])
    replies: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    with open_bus(connect=[network.endpoint]) as client:
        client.ask("q", b"x", replies.put, lambda: replies.put(None))
        got = list(iter(lambda: replies.get(timeout=PATIENCE_S), None))
    assert sorted(got) == [b"x" + bytes([i]) for i in range(250)]


def test_a_query_that_nobody_answers_just_ends(network: Network) -> None:
    ended: queue.SimpleQueue[None] = queue.SimpleQueue()
    with open_bus(connect=[network.endpoint]) as client:
        client.ask("nobody", b"", lambda data: pytest.fail("a reply from nobody"), lambda: ended.put(None))
        ended.get(timeout=PATIENCE_S)


def test_a_wildcard_answers_under_the_key_that_was_asked_for(network: Network) -> None:
    network.bus.answer("vehicle/*/ledger", lambda key, data: [key.encode()])
    with open_bus(connect=[network.endpoint]) as client:
        assert ask(client, "vehicle/v1/ledger") == [b"vehicle/v1/ledger"]
        assert ask(client, "vehicle/v2/ledger") == [b"vehicle/v2/ledger"]
        assert ask(client, "vehicle/v1/outbox") == []


def test_everybody_who_answers_is_heard_and_the_end_comes_once(network: Network) -> None:
    with open_bus(connect=[network.endpoint]) as client, open_bus(connect=[network.endpoint]) as other:
        network.bus.answer("vehicle/*/ledger", lambda key, data: [b"a1", b"a2"])
        other.answer("vehicle/*/ledger", lambda key, data: [b"b1", b"b2"])
        until(lambda: len(ask(client, "vehicle/v/ledger")) == 4)
        replies: list[bytes] = []
        ends: queue.SimpleQueue[int] = queue.SimpleQueue()
        client.ask("vehicle/v/ledger", b"", replies.append, lambda: ends.put(len(replies)))
        assert ends.get(timeout=PATIENCE_S) == 4  # the end comes last
    assert sorted(replies) == [b"a1", b"a2", b"b1", b"b2"]
    assert ends.empty()


@pytest.mark.parametrize("priority", get_args(Priority))
def test_messages_of_every_priority_arrive(network: Network, priority: Priority) -> None:
    got: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    network.bus.subscribe("p", lambda key, data: got.put(data))
    with open_bus(connect=[network.endpoint]) as client:
        client.put("p", priority.encode(), priority)
        assert got.get(timeout=PATIENCE_S) == priority.encode()


def test_a_handler_that_raises_is_logged_and_called_again(network: Network, caplog: pytest.LogCaptureFixture) -> None:
    called: queue.SimpleQueue[str] = queue.SimpleQueue()

    def fail(where: str) -> None:
        called.put(where)
        raise ZeroDivisionError(where)

    def answer(key: str, data: bytes) -> list[bytes]:
        fail("answer")
        return []

    with caplog.at_level(logging.ERROR), open_bus(connect=[network.endpoint]) as client:
        network.bus.subscribe("k", lambda key, data: fail("subscribe"))
        network.bus.watch("alive/*", lambda key, alive: fail("watch"))
        network.bus.answer("q", answer)
        network.bus.answer("fine", lambda key, data: [b"1"])
        for name in ("1", "2"):
            client.put("k", b"")
            client.announce(f"alive/{name}")
            assert ask(client, "q") == []
            client.ask("fine", b"", lambda data: fail("reply"), lambda: fail("done"))
        heard = [called.get(timeout=PATIENCE_S) for _ in range(10)]
        until(lambda: len(caplog.records) == 10)
    assert sorted(heard) == sorted(["subscribe", "watch", "answer", "reply", "done"] * 2)
    assert {record.message.split()[0] for record in caplog.records} == {"handler_failed"}


def test_vehicles_are_seen_to_come_and_go(network: Network) -> None:
    seen: queue.SimpleQueue[tuple[str, bool]] = queue.SimpleQueue()
    network.bus.watch("alive/*", lambda key, alive: seen.put((key, alive)))
    with open_bus(connect=[network.endpoint]) as client:
        client.announce("alive/v1")
        assert seen.get(timeout=PATIENCE_S) == ("alive/v1", True)
    assert seen.get(timeout=PATIENCE_S) == ("alive/v1", False)


def test_a_taken_port_is_a_clear_error(network: Network) -> None:
    with pytest.raises(RunError, match="port taken"), open_bus(listen=[network.endpoint]):
        pass


def test_a_client_that_finds_nobody_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fleet_seif.bus.CONNECT_MS", 100)
    begin_s = time.monotonic()
    with (
        pytest.raises(RunError, match=r"cannot reach a fusion node at tcp/127.0.0.1:9, tcp/127.0.0.1:10"),
        open_bus(connect=["tcp/127.0.0.1:9", "tcp/127.0.0.1:10"]),
    ):
        pass
    assert time.monotonic() < begin_s + CONNECT_MS / 1000


def test_a_client_uses_the_first_endpoint_that_answers(network: Network) -> None:
    network.bus.answer("q", lambda key, data: [b"here"])
    with open_bus(connect=["tcp/127.0.0.1:9", network.endpoint]) as client:
        assert ask(client, "q") == [b"here"]


def test_a_router_starts_before_the_router_it_links_to(start: Callable[..., Process]) -> None:
    later = start("later", ANY_PORT)
    later.kill()  # its port stays known
    with open_bus(listen=[ANY_PORT], connect=[later.endpoint]) as router:
        assert ask(router, "ledger/v") == []
        start("later", later.endpoint)
        until(lambda: ask(router, "ledger/v") == [b"later ledger/v"])


@contextlib.contextmanager
def _declared(endpoints: list[str]) -> Iterator[tuple[ZenohBus, "queue.SimpleQueue[bytes]"]]:
    """A client that has declared one of everything, and what it hears."""
    got: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with open_bus(connect=endpoints) as client:
        client.subscribe("to/client", lambda key, data: got.put(data))
        client.answer("client/*", lambda key, data: [key.encode()])
        client.announce("alive/client")
        yield client, got


def _all_is_well(client: Bus, got: "queue.SimpleQueue[bytes]", other: Bus) -> None:
    """Wait until samples, queries and liveliness pass between a client made by `_declared` and another one."""
    heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    seen: queue.SimpleQueue[tuple[str, bool]] = queue.SimpleQueue()
    drain(got)
    until(arrives(other, "to/client", got))
    until(lambda: ask(other, "client/1") == [b"client/1"])
    other.subscribe("from/client", lambda key, data: heard.put(data))
    until(arrives(client, "from/client", heard))
    other.watch("alive/*", lambda key, alive: seen.put((key, alive)))
    assert seen.get(timeout=PATIENCE_S) == ("alive/client", True)


def test_killing_one_of_two_linked_routers_cuts_nobody_off(start: Callable[..., Process]) -> None:
    first = start("first", ANY_PORT)
    second = start("second", ANY_PORT, first.endpoint)
    both = [first.endpoint, second.endpoint]
    with _declared(both) as (client, got), open_bus(connect=both[::-1]) as other:
        until(lambda: len(ask(client, "ledger/v")) == 2)  # the link is up
        _all_is_well(client, got, other)
        first.kill()
        begin_s = time.monotonic()
        _all_is_well(client, got, other)
        assert time.monotonic() - begin_s < 2.0  # measured: 0.05 s
        assert ask(client, "ledger/v") == [b"second ledger/v"]
        start("first again", first.endpoint)
        until(lambda: len(ask(client, "ledger/v")) == 2)  # and the routers link again
        second.kill()  # the one that made the link
        _all_is_well(client, got, other)
        assert ask(other, "ledger/v") == [b"first again ledger/v"]


def test_a_router_that_restarts_on_its_port_gets_its_clients_back(start: Callable[..., Process]) -> None:
    router = start("one", ANY_PORT)
    with _declared([router.endpoint]) as (client, got), open_bus(connect=[router.endpoint]) as other:
        _all_is_well(client, got, other)
        router.kill()
        client.put("from/client", b"lost")  # nobody to reach: dropped, no error
        assert ask(client, "ledger/v") == []
        assert start("two", router.endpoint).endpoint == router.endpoint
        _all_is_well(client, got, other)
        until(lambda: ask(client, "ledger/v") == [b"two ledger/v"])


def _p99_ms(sender: Bus, key: str, latencies_s: "list[float]", seconds: float) -> float:
    latencies_s.clear()
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        sender.put(key, repr(time.monotonic()).encode(), "control")
        time.sleep(0.005)
    return float(np.quantile(latencies_s, 0.99)) * 1e3


@pytest.mark.slow
@pytest.mark.alone
def test_a_frozen_subscriber_of_a_flood_does_not_delay_others(start: Callable[..., Process]) -> None:
    router = start("router", ANY_PORT)
    victim = start("victim", "-", router.endpoint)
    latencies_s: list[float] = []
    over = threading.Event()
    with open_bus(connect=[router.endpoint]) as sender, open_bus(connect=[router.endpoint]) as hearer:
        hearer.subscribe("probe", lambda key, data: latencies_s.append(time.monotonic() - float(data)))
        until(lambda: len(ask(sender, "ledger/v")) == 2)

        def flood() -> None:
            """5 MB/s, over the link that the probes take too."""
            while not over.wait(0.01):
                sender.put("flood", bytes(50_000), "bulk")

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            before_ms = _p99_ms(sender, "probe", latencies_s, 1.0)
            victim.popen.send_signal(signal.SIGSTOP)
            after_ms = _p99_ms(sender, "probe", latencies_s, 3.0)  # longer than it takes to give it up
        finally:
            over.set()
            thread.join()
    assert after_ms < 2 * before_ms + 10.0, (before_ms, after_ms)
    assert len(latencies_s) > 300


@pytest.mark.parametrize(
    ("endpoint", "loopback"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/localhost:1", True),
        ("tcp/[::1]:1", True),
        ("unixsock-stream//tmp/x", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/192.0.2.1:7447", False),
        ("tcp/example.org:7447", False),
    ],
)
def test_endpoints_on_this_machine_are_told_from_others(endpoint: str, loopback: bool) -> None:
    assert is_loopback(endpoint) is loopback


def test_leaving_the_machine_needs_encryption_or_consent() -> None:
    with pytest.raises(RunError, match="--insecure"):
        check_endpoints(["tcp/0.0.0.0:7447"], insecure=False)
    check_endpoints(["tcp/0.0.0.0:7447"], insecure=True)
    check_endpoints(["tls/192.0.2.1:7447"], insecure=False)
    with pytest.raises(RunError, match="PROTOCOL/ADDRESS"):
        check_endpoints(["7447"], insecure=False)


if __name__ == "__main__":
    serve(*sys.argv[1:])
