"""What goes wrong on purpose: the [faults] table of a scenario."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from fleet_seif.config import NotNegative, Positive, Settings

FAULTS_MAX = 10_000

What = Literal["join", "kill", "wipe", "pause", "clock"]
Lie = Literal["indefinite", "absurd", "foreign", "equivocate", "garbage"]


class Fault(Settings):
    """One thing that happens to one process.

    at_s: when, in seconds after the run began. who: a vehicle or a fusion node.
    what: "join": it is started only then. "kill": ended at any instruction and started again after for_s; "wipe": the
    same, and what it had stored is gone. "pause": frozen for for_s. "clock": its clock jumps by by_s.
    """

    at_s: NotNegative
    what: What
    who: str
    for_s: Positive = 1.0
    by_s: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0


class Hostile(Settings):
    """A vehicle that lies from one of its steps on.

    lie: "indefinite", "absurd": its information is not positive definite, or more than it has declared; "foreign": it
    is about landmarks that it has not named; "equivocate": it sends two versions of every message; "garbage": its bytes
    are damaged, and nothing else.
    """

    who: str
    lie: Lie
    from_step: Annotated[int, Field(ge=1)] = 1


class FaultSettings(Settings):
    """events: what happens, in any order. hostile: who lies."""

    events: Annotated[tuple[Fault, ...], Field(max_length=FAULTS_MAX)] = ()
    hostile: tuple[Hostile, ...] = ()

    @model_validator(mode="after")
    def _one_start(self) -> "FaultSettings":
        joins = [fault.who for fault in self.events if fault.what == "join"]
        twice = sorted({who for who in joins if joins.count(who) > 1})
        if twice:
            raise ValueError(f"{', '.join(twice)} joins more than once: give one join, and kill for what follows")
        return self

    def joins_s(self, who: str) -> float:
        """When a process is started, s after the run began."""
        return next((fault.at_s for fault in self.events if fault.what == "join" and fault.who == who), 0.0)
