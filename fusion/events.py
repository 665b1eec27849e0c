"""What the decisions of operators come to: of several on one subject the one with the largest id counts."""

from collections.abc import Iterable
from dataclasses import dataclass

from fleet_seif.messages import Action, LandmarkName, OperatorEvent

Pair = tuple[LandmarkName, LandmarkName]


@dataclass(frozen=True)
class Decisions:
    """forced, forbidden: pairs of landmarks that are one, and that are two, in the order of the deciding ids.
    retracted: vehicles whose lives, past and future, are left out of the map."""

    forced: tuple[Pair, ...] = ()
    forbidden: tuple[Pair, ...] = ()
    retracted: frozenset[str] = frozenset()


def decide(events: Iterable[OperatorEvent]) -> Decisions:
    """The net effect of a set of events, whatever order they come in."""
    latest: dict[object, OperatorEvent] = {}
    for event in sorted(events, key=lambda e: (e.number, e.operator)):
        latest[event.landmarks or event.vehicle] = event
    final = sorted(latest.values(), key=lambda e: (e.number, e.operator))

    def pairs(action: Action) -> tuple[Pair, ...]:
        return tuple(e.landmarks for e in final if e.action is action and e.landmarks is not None)

    retracted = frozenset(e.vehicle for e in final if e.action is Action.RETRACT)
    return Decisions(pairs(Action.FORCE), pairs(Action.FORBID), retracted)
