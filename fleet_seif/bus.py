"""The bus: the only module that knows Zenoh.

1. A `put` is best effort (congestion control DROP): what must not be lost is numbered, announced by heartbeats and
   asked for again by whoever finds it missing. While there is no router to reach, a `put` is dropped.
2. A client uses the first of its endpoints that answers. When its router dies it goes to the next one by itself, and
   all it has declared goes with it: at once after a crash, after LEASE_MS + OPEN_MS where nothing says that it is gone.
3. Routers link to the routers they `connect` to, and go on trying while those are not there.
4. Handlers run on Zenoh's threads and must only hand on what they get. One that raises is logged, and called again.
"""

import contextlib
import ipaddress
import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import zenoh

from fleet_seif.errors import RunError

log = logging.getLogger(__name__)

OnPut = Callable[[str, bytes], None]
OnQuery = Callable[[str, bytes], list[bytes]]
OnReply = Callable[[bytes], None]
OnDone = Callable[[], None]
OnAlive = Callable[[str, bool], None]
Mode = Literal["router", "client"]
Priority = Literal["control", "data", "bulk"]  # on a full link the first goes first, and is the last to be dropped

CONNECT_MS = 5000  # how long a client looks for a first router
QUERY_MS = 2000
LEASE_MS = 2000  # a link on which nothing arrives for so long is dead
OPEN_MS = 1000  # one attempt to connect; a lost SYN would otherwise be repeated after 1, 3, 7, 15, 31 s
RETRY_MS = (100, 250)  # between attempts, first and longest
SEND_BUFFER_BYTES = 1 << 16  # of a socket: more only queues where no priority helps, 0.9 s of it at 8 Mbit/s
PRIORITIES: dict[Priority, Any] = {
    "control": zenoh.Priority.INTERACTIVE_HIGH,
    "data": zenoh.Priority.DATA,
    "bulk": zenoh.Priority.DATA_LOW,
}


class Bus(Protocol):
    """What the processes need of a bus."""

    def put(self, key: str, payload: bytes, priority: Priority = "data") -> None:
        """Send, best effort. Messages of one priority stay in order; of different ones they may not."""

    def subscribe(self, key: str, handler: OnPut) -> None:
        """Call handler(key, payload) for what is put under a key expression."""

    def answer(self, key: str, handler: OnQuery) -> None:
        """Answer queries for a key with any number of payloads: handler(key asked for, payload).

        A key with `*` answers for every key it matches; the handler is told which one was asked for.
        """

    def ask(self, key: str, payload: bytes, on_reply: OnReply, on_done: OnDone) -> None:
        """Query everybody who answers for a key.

        Replies of all arrive one by one, then on_done is called once, after QUERY_MS at the latest.
        """

    def announce(self, key: str) -> None:
        """Be seen alive under a key as long as the bus is open."""

    def watch(self, key: str, handler: OnAlive) -> None:
        """Call handler(key, alive) as others appear and disappear, first for those who are there already."""

    def close(self) -> None: ...


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint such as tcp/127.0.0.1:7447 or unixsock-stream/PATH stays on this machine."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith("unixsock"):
        return True
    host = address.split("#")[0].split("?")[0].rsplit(":", 1)[0].strip("[]")
    if host == "localhost":
        return True
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


def check_endpoints(endpoints: Sequence[str], insecure: bool) -> None:
    """Raise RunError where an endpoint leaves this machine unprotected and nobody has said that this is meant."""
    for endpoint in endpoints:
        protocol, slash, address = endpoint.partition("/")
        if not slash or not address:
            raise RunError(f"endpoint {endpoint!r}: expected PROTOCOL/ADDRESS, for instance tcp/127.0.0.1:7447")
        if not (insecure or is_loopback(endpoint) or protocol in ("tls", "quic")):
            raise RunError(
                f"endpoint {endpoint!r} is not loopback and not encrypted: anybody there could write into the map. "
                "Use tls/HOST:PORT with certificates in a --config file, or --insecure if the network is yours"
            )


def _configuration(mode: Mode, listen: Sequence[str], connect: Sequence[str], file: Path | None) -> zenoh.Config:
    try:
        config = zenoh.Config.from_file(str(file)) if file else zenoh.Config()
    except Exception as error:  # zenoh raises its own kind for anything wrong in the file
        raise RunError(f"Zenoh configuration {file}: {error}") from None
    values: dict[str, object] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tcp/so_sndbuf": SEND_BUFFER_BYTES,
        "transport/link/tls/so_sndbuf": SEND_BUFFER_BYTES,
        "transport/unicast/open_timeout": OPEN_MS,
        "queries_default_timeout": QUERY_MS,
        # A router tries for ever and in the background. A client tries each endpoint once, and `_open` repeats that:
        # with a timeout Zenoh 1.10 would spend it all on the first endpoint.
        "connect/timeout_ms": -1 if mode == "router" else 0,
        "connect/exit_on_failure": mode == "client",
        "connect/retry": {
            "period_init_ms": RETRY_MS[0],
            "period_max_ms": RETRY_MS[1],
            "period_increase_factor": 2,
        },
        "adminspace/enabled": True,
    }
    if listen or mode == "client" or not file:
        values["listen/endpoints"] = list(listen)
    if connect or not file:
        values["connect/endpoints"] = list(connect)
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _endpoints_of(configuration: zenoh.Config, key: str) -> list[str]:
    found = json.loads(configuration.get_json(f"{key}/endpoints"))
    if isinstance(found, dict):  # one list for each mode
        found = [endpoint for endpoints in found.values() for endpoint in endpoints]
    return list(found)


def _open(configuration: zenoh.Config, mode: Mode) -> Any:
    """A session. A client looks for a router for CONNECT_MS; raises what Zenoh raises at the end of it."""
    end_s = time.monotonic() + CONNECT_MS / 1000
    while True:
        try:
            return zenoh.open(configuration)
        except Exception:  # zenoh raises its own kind for anything that goes wrong here
            if mode == "router" or time.monotonic() >= end_s:
                raise
        time.sleep(RETRY_MS[0] / 1000)


@contextlib.contextmanager
def _logged(what: str, key: str) -> Iterator[None]:
    """Log what a handler raises: Zenoh would swallow it."""
    try:
        yield
    except Exception:
        log.exception("handler_failed in=%s key=%s", what, key)


class ZenohBus:
    """A Zenoh session. Keeps references to all it declared: they die when collected."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self._declared: list[Any] = []

    def put(self, key: str, payload: bytes, priority: Priority = "data") -> None:
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP, priority=PRIORITIES[priority])

    def subscribe(self, key: str, handler: OnPut) -> None:
        def receive(sample: Any) -> None:
            with _logged("subscribe", key):
                handler(str(sample.key_expr), sample.payload.to_bytes())

        self._declared.append(self._session.declare_subscriber(key, receive))

    def answer(self, key: str, handler: OnQuery) -> None:
        def receive(query: Any) -> None:
            with _logged("answer", key), query:
                asked = str(query.key_expr)
                payload = query.payload.to_bytes() if query.payload is not None else b""
                for reply in handler(asked, payload):
                    query.reply(asked if "*" in key else key, reply)

        self._declared.append(self._session.declare_queryable(key, receive))

    def ask(self, key: str, payload: bytes, on_reply: OnReply, on_done: OnDone) -> None:
        def receive(reply: Any) -> None:
            if reply.ok is not None:
                with _logged("ask", key):
                    on_reply(reply.ok.payload.to_bytes())

        def done() -> None:
            with _logged("ask", key):
                on_done()

        self._session.get(
            key,
            zenoh.handlers.Callback(receive, drop=done),
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def announce(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str, handler: OnAlive) -> None:
        def receive(sample: Any) -> None:
            with _logged("watch", key):
                handler(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        subscriber = self._session.liveliness().declare_subscriber(key, receive, history=True)
        self._declared.append(subscriber)

    def endpoints(self) -> list[str]:
        """Where this session listens, with the ports the system chose."""
        reply = next(iter(self._session.get(f"@/{self._session.zid()}/router", timeout=2)))
        return [str(locator) for locator in json.loads(reply.ok.payload.to_string())["locators"]]

    def close(self) -> None:
        self._declared.clear()
        self._session.close()


@contextlib.contextmanager
def open_bus(
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    config: Path | None = None,
    insecure: bool = False,
    mode: Mode | None = None,
) -> Iterator[ZenohBus]:
    """A Zenoh session: a router that others connect to, or a client of one.

    Args:
        listen: where a router listens. connect: the routers a client may use, in order of preference, or those that a
            router links to, which need not be there yet. Where empty: those of the configuration file, if there is one.
        mode: by default a router where `listen` is given, a client otherwise.

    Raises RunError where an endpoint is malformed, taken, not reachable or not protected.
    """
    mode = mode or ("router" if listen else "client")
    check_endpoints([*listen, *connect], insecure)
    configuration = _configuration(mode, listen, connect, config)
    listen, connect = _endpoints_of(configuration, "listen"), _endpoints_of(configuration, "connect")
    check_endpoints([*listen, *connect], insecure)
    try:
        session = _open(configuration, mode)
    except Exception as error:
        if mode == "router":
            reason = f"cannot listen on {', '.join(listen)} (port taken, or address not of this machine?)"
        else:
            reason = f"cannot reach a fusion node at {', '.join(connect)}: start it first, or check the address"
            if any(endpoint.startswith(("tls/", "quic/")) for endpoint in connect):
                reason += "; a certificate that is refused looks the same"
        raise RunError(f"{reason}: {error}") from None
    bus = ZenohBus(session)
    try:
        yield bus
    finally:
        bus.close()
