"""Where other nodes decide merges otherwise.

1. Equal ledgers give equal frame totals on any machine, and equal merges on machines of one kind: tests on the solution
   may come out differently elsewhere (another library, another processor). That is told, and is no fault.
2. Nodes tell each other the digests of their newest map. Two canonical maps of equal ledgers with unequal digests
   differ; the other map is then fetched, once, to see in which landmarks.
3. What is known of a node stands until two maps of equal ledgers are compared again.
4. At most NODES_MAX nodes are heard. No I/O and no clock.
"""

from typing import Final

from fleet_seif.joint_records import Classes
from fleet_seif.merge_records import DIFFERING_MAX, Differing, MergeReport, Merges, kept_apart, nearest_apart
from fleet_seif.messages import JointMap

NODES_MAX: Final = 100


class Comparison:
    """See the rules above."""

    def __init__(self) -> None:
        self._own: JointMap | None = None
        self._merges = Merges(())
        self._heard: dict[str, MergeReport] = {}
        self._compared: dict[str, tuple[bytes, bytes]] = {}
        self._differing: dict[str, tuple[Differing, ...]] = {}

    @property
    def nodes(self) -> int:
        """How many nodes have another map of the same ledger."""
        return len(self._differing)

    @property
    def landmarks(self) -> int:
        """How many of this node's landmarks those nodes have merged otherwise, as far as it is known yet."""
        return len({each.ours for found in self._differing.values() for each in found})

    def serve(self, joint: JointMap, merges: Merges) -> None:
        """The newest map of this node, and the merges in it."""
        self._own, self._merges = joint, merges
        for node in self._heard:
            self._judge(node)

    def report(self) -> MergeReport | None:
        """What to tell of the newest map, None before the first."""
        own = self._own
        if own is None:
            return None
        differing = [each for _, found in sorted(self._differing.items()) for each in found]
        return MergeReport(
            fleet=own.fleet, node=own.node, version=own.version, canonical=own.canonical, map_digest=own.map_digest,
            ledger_digest=own.ledger_digest, kept_apart=kept_apart(self._merges), nearest=nearest_apart(self._merges),
            differing=tuple(differing[:DIFFERING_MAX]),
        )  # fmt: skip

    def hear(self, report: MergeReport) -> bool:
        """What another node tells; whether its map has to be fetched."""
        if report.node in self._heard or len(self._heard) < NODES_MAX:
            self._heard[report.node] = report
            return self._judge(report.node)
        return False

    def learn(self, joint: JointMap) -> bool:
        """Another node's map; whether it differs though all landmarks are the same, so that totals must differ."""
        own, heard = self._own, self._heard.get(joint.node)
        if own is None or heard is None or not _are_comparable(own, joint) or own.map_digest == joint.map_digest:
            return False
        self._compared[joint.node] = own.map_digest, joint.map_digest
        ours, theirs = own.names, joint.names
        self._differing[joint.node] = differing(joint.node, ours, theirs) or differing(joint.node, theirs, ours)
        return not self._differing[joint.node]

    def _judge(self, node: str) -> bool:
        own, heard = self._own, self._heard[node]
        if own is None or not _are_comparable(own, heard):
            return False
        if own.map_digest == heard.map_digest:
            self._differing.pop(node, None)
            self._compared.pop(node, None)
            return False
        self._differing.setdefault(node, ())
        return self._compared.get(node) != (own.map_digest, heard.map_digest)


def _are_comparable(own: JointMap, other: JointMap | MergeReport) -> bool:
    return own.canonical and other.canonical and own.ledger_digest == other.ledger_digest


def differing(node: str, ours: Classes, theirs: Classes) -> tuple[Differing, ...]:
    """Landmarks of ours that another node does not have so, ascending, each with what it has instead."""
    there = {name: names for names in theirs for name in names}
    return tuple(
        Differing(node, names, tuple(sorted({there[name] for name in names if name in there})))
        for names in sorted(set(ours) - set(theirs))
    )
