"""What is said about merges: the rules, what became of each pair and why, and the outcome."""

import math
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal, NamedTuple

from fleet_seif.joint import Pair
from fleet_seif.joint_records import Classes
from fleet_seif.messages import LandmarkName

NEAREST_MAX: Final = 8
"""Pairs kept apart for one reason that a report names."""
DIFFERING_MAX: Final = 32
"""Landmarks that another node has merged otherwise, in a report."""


@dataclass(frozen=True, kw_only=True)
class MergeRules:
    """When landmarks are merged. All nodes of a fleet must use the same.

    gate: squared distance (chi-square, 2 degrees of freedom) beyond which a pair is none. margin: by how much the
    squared distance to any other landmark must be larger. set_min: pairs that must agree. set_gain, pair_gain: least
    gain (see fleet_seif.consistent) of a set, and of a pair given all others. rival_share: share of a set's pairs from
    which on another alignment makes it ambiguous. repeat: squared distance within which a pattern must not repeat.
    group_max: candidates that are searched together. by: how sets are found.
    """

    gate: float = 13.8
    margin: float = 6.0
    set_min: int = 4
    set_gain: float = 8.0
    pair_gain: float = 2.0
    inflation: float = 2.0
    rival_share: float = 0.5
    repeat: float = 36.0
    group_max: int = 128
    by: Literal["joint", "clique"] = "joint"


class Reason(StrEnum):
    """What became of a pair, and why."""

    MERGED = "merged"
    AMBIGUOUS = "another landmark, or another alignment, fits as well"
    REPEATS = "the pattern repeats within the uncertainty of its place"
    FEW = "too few others agree"
    CROWDED = "landmarks lie too close for how uncertain they are"
    CONTRADICTED = "given all other merges they are not one"
    UNSOLVED = "with them the map has no solution"


class Considered(NamedTuple):
    """A pair of landmarks, by first names, that was or might have been merged; its squared distance given the rest."""

    a: LandmarkName
    b: LandmarkName
    d2: float
    reason: Reason


@dataclass(frozen=True)
class Merges:
    """classes: the landmarks. pairs: what was joined beyond signatures, aliases and decisions. considered: all pairs
    that came near each other, merged or not."""

    classes: Classes
    pairs: tuple[Pair, ...] = ()
    considered: tuple[Considered, ...] = ()

    @property
    def refused(self) -> tuple[Considered, ...]:
        """Pairs that lie within the gate of each other and were not merged."""
        return tuple(each for each in self.considered if each.reason is not Reason.MERGED)


class KeptApart(NamedTuple):
    """A pair of landmarks that was not merged, and why. d2: its squared distance, None where it has no solution."""

    a: LandmarkName
    b: LandmarkName
    reason: Reason
    d2: float | None


class Differing(NamedTuple):
    """A landmark of a node that another one, with the same ledger, has merged otherwise: all those there that have one
    of its names."""

    node: str
    ours: tuple[LandmarkName, ...]
    theirs: Classes


@dataclass(frozen=True, kw_only=True)
class MergeReport:
    """What a fusion node says of the merges in a map of its: bounded, whatever the size of the map.

    version, canonical, map_digest, ledger_digest: those of the map. kept_apart: how many pairs that came near each
    other were not merged, by reason. nearest: at most NEAREST_MAX of them for each reason, of least squared distance.
    differing: at most DIFFERING_MAX landmarks that other nodes with an equal ledger have merged otherwise.
    """

    fleet: str
    node: str
    version: int
    canonical: bool
    map_digest: bytes
    ledger_digest: bytes
    kept_apart: tuple[tuple[Reason, int], ...]
    nearest: tuple[KeptApart, ...]
    differing: tuple[Differing, ...] = ()


def kept_apart(merges: Merges) -> tuple[tuple[Reason, int], ...]:
    """How many pairs were kept apart for each reason, in the order of reasons."""
    counts = Counter(each.reason for each in merges.refused)
    return tuple((reason, counts[reason]) for reason in Reason if counts[reason])


def nearest_apart(merges: Merges) -> tuple[KeptApart, ...]:
    """The NEAREST_MAX pairs of least squared distance that were kept apart for each reason."""
    found: list[KeptApart] = []
    for reason, _ in kept_apart(merges):
        mine = sorted((each.d2, each.a, each.b) for each in merges.refused if each.reason is reason)
        found += (KeptApart(a, b, reason, d2 if math.isfinite(d2) else None) for d2, a, b in mine[:NEAREST_MAX])
    return tuple(found)
