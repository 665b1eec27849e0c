"""The bus on real Zenoh: what the processes rely on."""

import queue

import pytest

from fleet_seif.bus import check_endpoints, is_loopback, open_bus
from fleet_seif.errors import RunError
from tests.conftest import Network

PATIENCE_S = 10.0


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
