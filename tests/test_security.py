"""Who may do what on the bus, over real TLS on loopback: everybody tries everything, and only what is granted arrives.

A refusal is silent, so each attempt ends with something that is granted: one link keeps the order, and once that has
arrived nothing that went before it can still come. Hence handlers run on Zenoh's own thread here (`indirect=False`):
otherwise each subscription has a thread, and one may overtake another.
"""

import contextlib
import json
import queue
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh

from fleet_seif import bus as bus_module
from fleet_seif.bus import Mode, ZenohBus, open_bus
from fleet_seif.errors import RunError
from fleet_seif.keys import Keys
from fleet_seif.signing import Role, load_key_ring, load_signer
from scenarios.access import Kind, Member
from scenarios.keys import Made, make_keys

PATIENCE_S = 10.0
FLEET = "demo"
KEYS = Keys(FLEET)
NODES = ("fusion", "fusion2")
VEHICLES = ("v1", "v2", "fusion")  # the last is named like a node, and is none
HERE = "tls/127.0.0.1:0"
NOW = datetime.now(UTC)
VEHICLE_KEYS = (KEYS.deltas, KEYS.heartbeats, KEYS.outbox, KEYS.alive, KEYS.acks, KEYS.ledger)
NODE_KEYS = (KEYS.node_alive, KEYS.status, KEYS.events, KEYS.map)
ALL_KEYS = [key(v) for key in VEHICLE_KEYS for v in VEHICLES] + [key(n) for key in NODE_KEYS for n in NODES]
ELSEWHERE = [KEYS.deltas("nobody"), KEYS.map("nobody"), Keys("other").deltas("v1"), "elsewhere"]
WILD = [key("*") for key in (*VEHICLE_KEYS, *NODE_KEYS)] + ["fleet_seif/2/demo/**", "**"]


def members(*vehicles: str) -> list[Member]:
    return [
        *(Member(kind=Kind.NODE, name=name, endpoint=HERE) for name in NODES),
        *(Member(kind=Kind.VEHICLE, name=name) for name in vehicles),
        Member(kind=Kind.VIEWER, name="screen"),
        Member(kind=Kind.OPERATOR, name="ops"),
    ]


def make(folder: Path, *some: Member, now: datetime = NOW, renew: bool = False) -> Made:
    return make_keys(folder, fleet=FLEET, members=some, now=now, renew=renew)


def read_config(path: Path) -> dict[str, Any]:
    config: dict[str, Any] = json.loads("".join(x for x in path.read_text().splitlines() if not x.startswith("//")))
    return config


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The keys of the fleet."""
    path = tmp_path_factory.mktemp("keys")
    make(path, *members(*VEHICLES))
    return path


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever is refused does not try again."""
    monkeypatch.setattr(bus_module, "CONNECT_MS", 0)


class Heard:
    """Keys, in the order of arrival."""

    def __init__(self) -> None:
        self._arrived: queue.SimpleQueue[str] = queue.SimpleQueue()

    def handler(self) -> Any:
        return zenoh.handlers.Callback(lambda sample: self._arrived.put(str(sample.key_expr)), indirect=False)

    def until(self, last: str, *, patience_s: float = PATIENCE_S) -> set[str]:
        """What arrived up to a key, that one included."""
        keys = set[str]()
        while last not in keys:
            keys.add(self._arrived.get(timeout=patience_s))
        return keys


class Session:
    """A bus, and whose it is."""

    def __init__(self, bus: ZenohBus, label: str) -> None:
        self.bus = bus
        self.label = label
        self._zenoh = bus._session
        self._declared: list[Any] = []

    def hear(self, *keys: str) -> Heard:
        """What is put under these key expressions."""
        heard = Heard()
        self._declared += [self._zenoh.declare_subscriber(key, heard.handler()) for key in keys]
        return heard

    def see(self, *keys: str) -> Heard:
        """Who is alive under these key expressions."""
        heard, declare = Heard(), self._zenoh.liveliness().declare_subscriber
        self._declared += [declare(key, heard.handler(), history=True) for key in keys]
        return heard

    def answer(self, *keys: str) -> None:
        for key in keys:
            self.bus.answer(key, lambda key, data: [self.label.encode()])

    def ask(self, key: str) -> set[str]:
        """Labels of those who answer."""
        replies: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self.bus.ask(key, b"", lambda data: replies.put(data.decode()), lambda: replies.put(None))
        return {str(label) for label in iter(lambda: replies.get(timeout=PATIENCE_S), None)}

    def ask_until(self, key: str, label: str) -> None:
        """Ask until somebody answers: then what that one declared before has arrived too."""
        for _ in range(10_000):
            if label in self.ask(key):
                return
        raise AssertionError(f"{label} never answered {key}")


class Network:
    """Fusion nodes and who connects to them."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path) -> None:
        self._stack = stack
        self._folder = folder

    def node(self, name: str = NODES[0], *, connect: str = "", config: Path | None = None) -> Session:
        config = config or self._folder / f"node-{name}.json5"
        links = [connect] if connect else []
        bus = self._stack.enter_context(open_bus(listen=[HERE], connect=links, config=config, mode="router"))
        return Session(bus, f"node-{name}")

    def join(self, label: str, node: Session, *, config: Path | None = None, mode: Mode = "client") -> Session:
        config = config or self._folder / f"{label}.json5"
        connect = node.bus.endpoints()
        return Session(self._stack.enter_context(open_bus(connect=connect, config=config, mode=mode)), label)


@pytest.fixture
def network(folder: Path) -> Iterator[Network]:
    with contextlib.ExitStack() as stack:
        yield Network(stack, folder)


def changed(path: Path, to: Path, **changes: Any) -> Path:
    """A copy of a configuration, with some parts replaced."""
    copy = to / f"changed-{path.name}"
    copy.write_text(json.dumps(read_config(path) | changes))
    return copy


def test_a_fleet_with_two_nodes_works_across_their_link(network: Network) -> None:
    near = network.node("fusion")
    far = network.node("fusion2", connect=near.bus.endpoints()[0])
    vehicle, screen = network.join("vehicle-v1", near), network.join("viewer-screen", far)
    deltas, alive = [node.hear(KEYS.deltas("*")) for node in (near, far)], far.see(KEYS.alive("*"))
    acks, maps, seen = vehicle.hear(KEYS.acks("v1")), screen.hear(KEYS.map("*")), screen.see(KEYS.node_alive("*"))
    statuses, maps_too = near.hear(KEYS.status("*")), vehicle.hear(KEYS.map("*"))
    vehicle.bus.announce(KEYS.alive("v1"))
    near.bus.announce(KEYS.node_alive("fusion"))
    near.answer(KEYS.map("fusion"), KEYS.ledger("*"), KEYS.events("fusion"))
    far.answer(KEYS.map("fusion2"))
    vehicle.answer(KEYS.outbox("v1"))

    alive.until(KEYS.alive("v1"))
    seen.until(KEYS.node_alive("fusion"))
    for node in (near, far):
        node.ask_until(KEYS.outbox("v1"), "vehicle-v1")
    far.ask_until(KEYS.events("fusion"), "node-fusion")
    far.ask_until(KEYS.ledger("v1"), "node-fusion")
    for reader in (screen, vehicle):
        for node in (near, far):
            reader.ask_until(KEYS.map("*"), node.label)
    vehicle.bus.put(KEYS.deltas("v1"), b"")
    for heard in deltas:
        heard.until(KEYS.deltas("v1"))
    far.bus.put(KEYS.acks("v1"), b"")
    acks.until(KEYS.acks("v1"))
    far.bus.put(KEYS.status("fusion2"), b"")
    statuses.until(KEYS.status("fusion2"))
    near.bus.put(KEYS.map("fusion"), b"")
    maps.until(KEYS.map("fusion"))
    maps_too.until(KEYS.map("fusion"))


def linked(attacker: Session, node: Session) -> None:
    """Wait until what the attacker does goes over the link at once."""
    node.answer(KEYS.map("fusion"))
    attacker.ask_until(KEYS.map("fusion"), node.label)


def try_puts(attacker: Session, node: Session, name: str) -> set[str]:
    """What arrives of puts under every key."""
    last = KEYS.heartbeats(name)
    heard = node.hear("**", "fleet_seif/2/demo/**")
    linked(attacker, node)
    for key in [*ALL_KEYS, *ELSEWHERE, *WILD]:
        if key != last:
            attacker.bus.put(key, b"forged")
    attacker.bus.put(last, b"")
    return heard.until(last)


def try_tokens(attacker: Session, node: Session, name: str) -> set[str]:
    """What tokens are seen after announcing every key."""
    last = KEYS.alive(name)
    seen = node.see("**")
    linked(attacker, node)
    for key in [*ALL_KEYS, *ELSEWHERE, *WILD]:
        if key != last:
            attacker.bus.announce(key)
    attacker.bus.announce(last)
    return seen.until(last)


def try_answers(attacker: Session, node: Session, name: str) -> set[str]:
    """Which queries are answered after offering to answer every key."""
    last = KEYS.outbox(name)
    linked(attacker, node)
    attacker.answer(*(key for key in [*ALL_KEYS, *ELSEWHERE] if key != last), last)
    node.ask_until(last, attacker.label)
    return {key for key in [*ALL_KEYS, *ELSEWHERE] if attacker.label in node.ask(key)}


Attempt = Callable[[Session, Session, str], set[str]]
ATTEMPTS = pytest.mark.parametrize("attempt", [try_puts, try_tokens, try_answers])
GRANTED: dict[Attempt, tuple[Callable[[str], str], ...]] = {
    try_puts: (KEYS.deltas, KEYS.heartbeats),
    try_tokens: (KEYS.alive,),
    try_answers: (KEYS.outbox,),
}


@ATTEMPTS
@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("mode", ["client", "router"])
def test_a_vehicle_writes_only_under_its_own_keys(
    network: Network, folder: Path, tmp_path: Path, attempt: Attempt, name: str, mode: Mode
) -> None:
    node = network.node()
    config = changed(folder / f"vehicle-{name}.json5", tmp_path, listen={"endpoints": []})
    attacker = network.join(f"vehicle-{name}", node, config=config, mode=mode)
    assert attempt(attacker, node, name) == {key(name) for key in GRANTED[attempt]}


@ATTEMPTS
@pytest.mark.parametrize("mode", ["client", "router"])
def test_without_access_control_the_same_attempts_succeed(
    network: Network, folder: Path, tmp_path: Path, attempt: Attempt, mode: Mode
) -> None:
    node = network.node(config=changed(folder / "node-fusion.json5", tmp_path, access_control={"enabled": False}))
    config = changed(folder / "vehicle-v1.json5", tmp_path, listen={"endpoints": []})
    attacker = network.join("vehicle-v1", node, config=config, mode=mode)
    everything = {*ALL_KEYS, *ELSEWHERE, *(WILD if attempt is not try_answers else [])}
    assert attempt(attacker, node, "v1") == everything


class Read(NamedTuple):
    """Keys: of puts that arrived, of tokens that were seen, and of queries that were answered."""

    heard: set[str]
    seen: set[str]
    answered: set[str]


def try_reading(network: Network, node: Session, reader: Session) -> Read:
    """What a member learns that listens and asks everywhere while the others are busy under every key."""
    names = [name for name in VEHICLES if f"vehicle-{name}" != reader.label]
    others = [network.join(f"vehicle-{name}", node) for name in names]
    for name, vehicle in zip(names, others):
        vehicle.bus.announce(KEYS.alive(name))
        vehicle.answer(KEYS.outbox(name))
        node.ask_until(KEYS.outbox(name), vehicle.label)
    node.answer(*(key(n) for key in (KEYS.events, KEYS.map) for n in NODES), *(KEYS.ledger(v) for v in VEHICLES))
    node.bus.announce(KEYS.node_alive("fusion"))
    arrived = node.hear(KEYS.deltas("*"))

    heard, seen = reader.hear(*ALL_KEYS, *WILD), reader.see(*ALL_KEYS, *WILD)
    reader.ask_until(KEYS.map("fusion"), node.label)
    for name, vehicle in zip(names, others):
        for _ in range(2):  # the second shows that the first has gone wherever it may go
            vehicle.bus.put(KEYS.deltas(name), b"secret")
        arrived.until(KEYS.deltas(name))
        arrived.until(KEYS.deltas(name))
    node.bus.announce(KEYS.node_alive("fusion2"))
    for key in ALL_KEYS:
        if key != KEYS.map("fusion2"):
            node.bus.put(key, b"secret")
    node.bus.put(KEYS.map("fusion2"), b"")
    answered = {key for key in [*ALL_KEYS, *WILD] if reader.ask(key)}
    return Read(heard.until(KEYS.map("fusion2")), seen.until(KEYS.node_alive("fusion2")), answered)


def each(key: Callable[[str], str], *names: str) -> set[str]:
    return {key(name) for name in names}


MAPS = each(KEYS.map, *NODES)
TOKENS = each(KEYS.node_alive, *NODES)
VIEWED = Read(MAPS, TOKENS | each(KEYS.alive, *VEHICLES), MAPS | {KEYS.map("*")})


@pytest.mark.parametrize(
    ("label", "granted"),
    [
        ("vehicle-v1", Read(MAPS | {KEYS.acks("v1")}, TOKENS, MAPS | {KEYS.map("*")})),
        ("vehicle-fusion", Read(MAPS | {KEYS.acks("fusion")}, TOKENS, MAPS | {KEYS.map("*")})),
        ("viewer-screen", VIEWED),
        (
            "operator-ops",
            VIEWED._replace(
                heard=VIEWED.heard | each(KEYS.status, *NODES),
                answered=VIEWED.answered | each(KEYS.events, *NODES, "*"),
            ),
        ),
    ],
)
def test_members_read_what_they_may_and_nothing_else(network: Network, label: str, granted: Read) -> None:
    node = network.node()
    assert try_reading(network, node, network.join(label, node)) == granted


def test_without_access_control_a_vehicle_reads_everything(network: Network, folder: Path, tmp_path: Path) -> None:
    node = network.node(config=changed(folder / "node-fusion.json5", tmp_path, access_control={"enabled": False}))
    read = try_reading(network, node, network.join("vehicle-v1", node))
    assert read.heard == set(ALL_KEYS)
    assert read.seen == TOKENS | each(KEYS.alive, "v2", "fusion")
    assert each(KEYS.outbox, "v2", "fusion") | each(KEYS.ledger, *VEHICLES) <= read.answered


def refused(config: Path, connect: list[str]) -> None:
    with pytest.raises(RunError, match="cannot reach"), open_bus(connect=connect, config=config):
        pass


@pytest.mark.usefixtures("at_once")
def test_strangers_are_refused(network: Network, folder: Path, tmp_path: Path) -> None:
    endpoints = network.node().bus.endpoints()
    with open_bus(connect=endpoints, config=folder / "vehicle-v1.json5"):
        pass
    tls = read_config(folder / "vehicle-v1.json5")["transport"]["link"]["tls"]

    only_authority = {"root_ca_certificate_base64": tls["root_ca_certificate_base64"]}
    for unknown in (only_authority, {}):
        link = {"link": {"tls": unknown}}
        refused(changed(folder / "vehicle-v1.json5", tmp_path, transport=link), endpoints)

    make(tmp_path / "foreign", *members("v1"))
    foreign = tmp_path / "foreign" / "vehicle-v1.json5"
    refused(foreign, endpoints)
    trusting = read_config(foreign)["transport"]
    trusting["link"]["tls"] |= only_authority
    refused(changed(foreign, tmp_path, transport=trusting), endpoints)

    open_tcp = changed(folder / "vehicle-v1.json5", tmp_path, transport={})
    refused(open_tcp, [endpoint.replace("tls/", "tcp/") for endpoint in endpoints])


@pytest.mark.usefixtures("at_once")
def test_an_expired_certificate_is_refused(tmp_path: Path) -> None:
    long_ago = NOW - timedelta(days=400)
    make(tmp_path, *members("v1"), now=long_ago)
    make(tmp_path, *members()[:2], renew=True)
    with contextlib.ExitStack() as stack:
        node = Network(stack, tmp_path).node()
        refused(tmp_path / "vehicle-v1.json5", node.bus.endpoints())
        make(tmp_path, Member(kind=Kind.VEHICLE, name="v1"), renew=True)
        Network(stack, tmp_path).join("vehicle-v1", node)


@pytest.mark.usefixtures("at_once")
def test_a_vehicle_trusts_only_a_node_of_its_fleet_at_its_own_address(
    network: Network, folder: Path, tmp_path: Path
) -> None:
    stolen = read_config(folder / "vehicle-v1.json5")["transport"]
    tls = stolen["link"]["tls"]
    tls |= {f"listen_{what}": tls[f"connect_{what}"] for what in ("certificate_base64", "private_key_base64")}
    posing = changed(folder / "vehicle-v1.json5", tmp_path, transport=stolen)
    refused(folder / "vehicle-v2.json5", network.node(config=posing).bus.endpoints())

    elsewhere = Member(kind=Kind.NODE, name="elsewhere", endpoint="tls/elsewhere.example:7447")
    make(tmp_path / "fleet", *members("v1"), elsewhere)
    other = network.node(config=tmp_path / "fleet" / "node-elsewhere.json5")
    refused(tmp_path / "fleet" / "vehicle-v1.json5", other.bus.endpoints())


@pytest.mark.usefixtures("at_once")
def test_nobody_takes_over_a_link_by_borrowing_an_id(network: Network, folder: Path, tmp_path: Path) -> None:
    node = network.node()
    victim = network.join("vehicle-v1", node)
    for lent in (victim, node):
        config = changed(folder / "vehicle-v2.json5", tmp_path, id=str(lent.bus._session.zid()))
        refused(config, node.bus.endpoints())
    heard = node.hear(KEYS.deltas("*"))
    victim.bus.put(KEYS.deltas("v1"), b"")
    heard.until(KEYS.deltas("v1"))


def test_a_member_that_is_taken_out_is_shut_out(tmp_path: Path) -> None:
    make(tmp_path, *members("v1", "v2"))
    path = tmp_path / "ca" / "fleet.json"
    state = json.loads(path.read_text())
    state["members"] = [member for member in state["members"] if member["name"] != "v1"]
    path.write_text(json.dumps(state))
    assert make(tmp_path).changed == ("node-fusion", "node-fusion2")
    assert load_key_ring(tmp_path / "fleet_keys.json").names(Role.VEHICLE) == ["v2"]
    control = read_config(tmp_path / "node-fusion.json5")["access_control"]
    fence = {"id": "fence", "permission": "allow", "flows": ["ingress"], "messages": ["put"], "key_exprs": ["fence"]}
    control["rules"].append(fence)
    control["subjects"].append({"id": "anybody"})
    control["policies"].append({"rules": ["fence"], "subjects": ["anybody"]})
    config = changed(tmp_path / "node-fusion.json5", tmp_path, access_control=control)
    with contextlib.ExitStack() as stack:
        network = Network(stack, tmp_path)
        node = network.node(config=config)
        heard = node.hear("**")
        for name, arrives in (("v1", set[str]()), ("v2", {KEYS.deltas("v2")})):
            vehicle = network.join(f"vehicle-{name}", node)
            vehicle.bus.put(KEYS.deltas(name), b"")
            vehicle.bus.put("fence", b"")
            assert heard.until("fence") == {"fence", *arrives}


def test_making_keys_again_keeps_them_and_adds_what_is_new(tmp_path: Path) -> None:
    make(tmp_path, *members("v1"))
    before = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.*"))}
    assert make(tmp_path, *members("v1")) == Made(new=(), changed=())
    assert {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.*"))} == before

    made = make(tmp_path, Member(kind=Kind.VEHICLE, name="v2"))
    assert made == Made(new=("vehicle-v2",), changed=("node-fusion", "node-fusion2"))
    touched = {path.name for path, data in before.items() if path.read_bytes() != data}
    assert touched == {"node-fusion.json5", "node-fusion2.json5", "fleet_keys.json", "fleet.json"}

    third = Member(kind=Kind.NODE, name="third", endpoint="tls/192.0.2.1:7447")
    assert "vehicle-v1" in make(tmp_path, third).changed
    assert read_config(tmp_path / "vehicle-v1.json5")["connect"]["endpoints"] == [HERE, HERE, third.endpoint]
    assert read_config(tmp_path / "node-third.json5")["connect"]["endpoints"] == [HERE, HERE]
    assert read_config(tmp_path / "node-fusion.json5")["connect"]["endpoints"] == []


def test_a_renewed_key_replaces_the_old_one(tmp_path: Path) -> None:
    make(tmp_path, *members("v1", "v2"))
    old = load_signer(tmp_path / "vehicle-v1.key.json")
    make(tmp_path, Member(kind=Kind.VEHICLE, name="v1"), renew=True)
    new, ring = load_signer(tmp_path / "vehicle-v1.key.json"), load_key_ring(tmp_path / "fleet_keys.json")
    assert ring.verify(Role.VEHICLE, "v1", b"data", new.sign(b"data"))
    assert not ring.verify(Role.VEHICLE, "v1", b"data", old.sign(b"data"))
    untouched = load_signer(tmp_path / "vehicle-v2.key.json")
    assert ring.verify(Role.VEHICLE, "v2", b"data", untouched.sign(b"data"))


def test_what_must_not_be_seen_is_readable_by_its_owner_only(folder: Path) -> None:
    public = {folder / "fleet_keys.json", folder / "ca" / "ca.pem", folder / "ca" / "fleet.json"}
    files = {path for path in folder.rglob("*") if path.is_file()}
    assert {path for path in files if path.stat().st_mode & 0o077} == public
    assert (folder / "ca").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(
    ("member", "reason"),
    [
        (Member(kind=Kind.VEHICLE, name="a/b"), "vehicle 'a/b'"),
        (Member(kind=Kind.VEHICLE, name="*"), "vehicle '\\*'"),
        (Member(kind=Kind.NODE, name="n", endpoint="tcp/127.0.0.1:7447"), "expected tls/HOST:PORT"),
        (Member(kind=Kind.NODE, name="n", endpoint="tls/[::1]:7447"), "IPv4"),
        (Member(kind=Kind.NODE, name="n", endpoint=HERE, hosts=("ä.example",)), "host 'ä"),
        (Member(kind=Kind.NODE, name="n"), "expected tls/HOST:PORT"),
        (Member(kind=Kind.NODE, name="fusion", endpoint="tls/192.0.2.1:1"), "--renew"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(tmp_path: Path, member: Member, reason: str) -> None:
    make(tmp_path, *members("v1"))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    with pytest.raises(RunError, match=reason):
        make(tmp_path, Member(kind=Kind.VEHICLE, name="v9"), member)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


def test_keys_are_never_lost_by_accident(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="needs a fusion node"):
        make(tmp_path, Member(kind=Kind.VEHICLE, name="v1"))
    make(tmp_path, *members("v1"))
    with pytest.raises(RunError, match="--fleet demo"):
        make_keys(tmp_path, fleet="other", members=members(), now=NOW)
    (tmp_path / "vehicle-v1.json5").unlink()
    with pytest.raises(RunError, match="vehicle-v1 has keys"):
        make(tmp_path, *members("v1"))
    (tmp_path / "vehicle-v2.key.json").write_text("somebody's")
    make(tmp_path, Member(kind=Kind.VEHICLE, name="v1"), renew=True)
    with pytest.raises(RunError, match="never overwritten"):
        make(tmp_path, Member(kind=Kind.VEHICLE, name="v2"))
    (tmp_path / "node-fusion.json5").write_text("{unquoted: 1}")
    with pytest.raises(RunError, match="plain JSON"):
        make(tmp_path, Member(kind=Kind.VEHICLE, name="v3"))
