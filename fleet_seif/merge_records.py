"""What is said about merges: the rules, what became of each pair and why, and the outcome."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, NamedTuple

from fleet_seif.joint import Pair
from fleet_seif.joint_records import Classes
from fleet_seif.messages import LandmarkName


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
