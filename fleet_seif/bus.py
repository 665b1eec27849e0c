"""The bus: the only module that knows Zenoh.

A `put` is best effort (congestion control DROP): what must not be lost is numbered, announced by heartbeats and asked
for again by whoever finds it missing. Handlers run on Zenoh's threads and must only hand on what they get.
"""

import contextlib
import ipaddress
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import zenoh

from fleet_seif.errors import RunError

OnPut = Callable[[str, bytes], None]
OnQuery = Callable[[str, bytes], list[bytes]]
CONNECT_MS = 5000
QUERY_MS = 2000
LEASE_MS = 2000
Mode = Literal["router", "client"]


class Bus(Protocol):
    """What the processes need of a bus."""

    def put(self, key: str, payload: bytes) -> None:
        """Send, best effort."""

    def subscribe(self, key: str, handler: OnPut) -> None:
        """Call handler(key, payload) for what is put under a key expression."""

    def answer(self, key: str, handler: OnQuery) -> None:
        """Answer queries for a key with any number of payloads."""

    def ask(self, key: str, payload: bytes, on_reply: Callable[[bytes], None], on_done: Callable[[], None]) -> None:
        """Query; replies arrive one by one, then on_done is called once, also after a timeout."""

    def announce(self, key: str) -> None:
        """Be seen alive under a key as long as the bus is open."""

    def watch(self, key: str, handler: Callable[[str, bool], None]) -> None:
        """Call handler(key, alive) as others appear and disappear."""

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


def _configuration(mode: str, listen: Sequence[str], connect: Sequence[str], file: Path | None) -> zenoh.Config:
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
        "queries_default_timeout": QUERY_MS,
        "connect/timeout_ms": CONNECT_MS,
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


class ZenohBus:
    """A Zenoh session. Keeps references to all it declared: they die when collected."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self._declared: list[Any] = []

    def put(self, key: str, payload: bytes) -> None:
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def subscribe(self, key: str, handler: OnPut) -> None:
        def receive(sample: Any) -> None:
            handler(str(sample.key_expr), sample.payload.to_bytes())

        self._declared.append(self._session.declare_subscriber(key, receive))

    def answer(self, key: str, handler: OnQuery) -> None:
        def receive(query: Any) -> None:
            with query:
                payload = query.payload.to_bytes() if query.payload is not None else b""
                for reply in handler(str(query.key_expr), payload):
                    query.reply(key, reply)

        self._declared.append(self._session.declare_queryable(key, receive))

    def ask(self, key: str, payload: bytes, on_reply: Callable[[bytes], None], on_done: Callable[[], None]) -> None:
        def receive(reply: Any) -> None:
            if reply.ok is not None:
                on_reply(reply.ok.payload.to_bytes())

        handler = zenoh.handlers.Callback(receive, drop=on_done)
        self._session.get(key, handler, payload=payload, consolidation=zenoh.ConsolidationMode.NONE)

    def announce(self, key: str) -> None:
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str, handler: Callable[[str, bool], None]) -> None:
        def receive(sample: Any) -> None:
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
        listen, connect: endpoints; where empty, those of the configuration file, if there is one.
        mode: by default a router where `listen` is given, a client otherwise.

    Raises RunError where an endpoint is malformed, taken, not reachable or not protected.
    """
    mode = mode or ("router" if listen else "client")
    check_endpoints([*listen, *connect], insecure)
    configuration = _configuration(mode, listen, connect, config)
    listen, connect = _endpoints_of(configuration, "listen"), _endpoints_of(configuration, "connect")
    check_endpoints([*listen, *connect], insecure)
    try:
        session = zenoh.open(configuration)
    except Exception as error:  # zenoh raises its own kind for anything that goes wrong here
        if listen:
            reason = f"cannot listen on {', '.join(listen)} (port taken, or address not of this machine?)"
        else:
            reason = f"cannot reach a fusion node at {', '.join(connect)}: start it first, or check the address"
        raise RunError(f"{reason}: {error}") from None
    bus = ZenohBus(session)
    try:
        yield bus
    finally:
        bus.close()
