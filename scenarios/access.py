"""Who may do what on the bus, and Zenoh's access control for it. Fusion nodes enforce it: all links end at one."""

from collections.abc import Sequence
from enum import StrEnum
from typing import Any, Final, NamedTuple

from fleet_seif.config import Settings
from fleet_seif.keys import ROOT, Keys

DECLARATIONS: Final = ("declare_subscriber", "declare_queryable")
READS: Final = ("query", "declare_liveliness_subscriber", "liveliness_query")
WRITES: Final = ("put", "delete", "reply", "liveliness_token")
Flow = tuple[str, tuple[str, ...], tuple[str, ...]]


class Kind(StrEnum):
    NODE = "node"
    VEHICLE = "vehicle"
    OPERATOR = "operator"
    VIEWER = "viewer"


class Member(Settings):
    """A process of the fleet. Nodes: `endpoint`, where others reach it; `hosts`, further names and addresses of it."""

    kind: Kind
    name: str
    endpoint: str = ""
    hosts: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The common name in its certificate, and the stem of its files: a vehicle named like a node is no node."""
        return f"{self.kind}-{self.name}"


class Access(NamedTuple):
    """What a process may do at a fusion node, each under some key expressions."""

    puts: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    announces: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()
    watches: tuple[str, ...] = ()


def access_of(fleet: str, member: Member) -> Access:
    """What a member that is no node may do."""
    keys, name = Keys(fleet), member.name
    maps, nodes, vehicles = (keys.map("*"), keys.merges("*")), keys.node_alive("*"), keys.alive("*")
    if member.kind is Kind.VEHICLE:
        return Access(
            puts=(keys.deltas(name), keys.heartbeats(name)),
            answers=(keys.outbox(name),),
            announces=(keys.alive(name),),
            subscribes=(keys.acks(name), *maps),
            asks=maps,
            watches=(nodes,),
        )
    if member.kind is Kind.OPERATOR:
        asks = (*maps, keys.events("*"), keys.decisions("*"))
        return Access(subscribes=(*maps, keys.status("*")), asks=asks, watches=(nodes, vehicles))
    return Access(subscribes=maps, asks=maps, watches=(nodes, vehicles))


def access_control(fleet: str, members: Sequence[Member]) -> dict[str, Any]:
    """Zenoh's access control for a fusion node: whoever is not named, and whatever is not granted, is refused."""
    rules, policies = [], []
    for member in members:
        own = [
            {"id": f"{member.label} {i}", "permission": "allow", "flows": [flow], "messages": what, "key_exprs": where}
            for i, (flow, what, where) in enumerate(_flows(fleet, member))
            if where
        ]
        rules += own
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [member.label]})
    subjects = [{"id": member.label, "cert_common_names": [member.label]} for member in members]
    control = {"enabled": True, "default_permission": "deny"}
    return control | {"rules": rules, "subjects": subjects, "policies": policies}


def _flows(fleet: str, member: Member) -> list[Flow]:
    """What may come from a member (ingress) and go to it (egress): messages, and under which keys.

    Nodes pass on what vehicles send, so they may do all. That somebody subscribes or answers is no secret.
    """
    everything = (f"{ROOT}/{fleet}/**",)
    if member.kind is Kind.NODE:
        return [(flow, (*DECLARATIONS, *READS, *WRITES), everything) for flow in ("ingress", "egress")]
    access = access_of(fleet, member)
    return [
        ("ingress", ("put",), access.puts),
        ("ingress", ("declare_queryable", "reply"), access.answers),
        ("ingress", ("liveliness_token",), access.announces),
        ("ingress", ("declare_subscriber",), access.subscribes),
        ("ingress", ("query",), access.asks),
        ("ingress", ("declare_liveliness_subscriber", "liveliness_query"), access.watches),
        ("egress", ("put",), access.subscribes),
        ("egress", ("reply",), access.asks),
        ("egress", ("query",), access.answers),
        ("egress", ("liveliness_token",), access.watches),
        ("egress", DECLARATIONS, everything),
    ]
