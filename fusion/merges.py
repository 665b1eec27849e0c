"""The merges of a ledger: what fleet_seif.merging makes of its lives and decisions, and the digest of a run.

The ledger itself solves nothing. What its messages and events say exactly (signatures, aliases, decisions) are
`Ledger.classes`; what only a solution can say is found here, outside of it, from what it holds and nothing else: equal
ledgers give equal merges.
"""

from collections.abc import Sequence

import numpy as np

from fleet_seif.joint_records import Life
from fleet_seif.merging import Merges, merged
from fusion.events import Decisions
from fusion.ledger import Ledger


class Merger:
    """Merges, computed anew from nothing where anything has changed, and otherwise remembered."""

    def __init__(self) -> None:
        self._lives: tuple[Life, ...] = ()
        self._decisions: Decisions | None = None
        self._merges = Merges(())

    def knows(self, lives: Sequence[Life], decisions: Decisions) -> bool:
        """Whether these are the lives and decisions of the last call."""
        same = self._decisions == decisions and len(lives) == len(self._lives)
        return same and all(map(_are_same, lives, self._lives))

    def of(self, lives: Sequence[Life], decisions: Decisions) -> Merges:
        """The merges of these lives: a function of them and of the decisions alone."""
        if not self.knows(lives, decisions):
            self._merges = merged(lives, decisions.forced, decisions.forbidden)
            self._lives, self._decisions = tuple(lives), decisions
        return self._merges


def _are_same(a: Life, b: Life) -> bool:
    """Whether two lives hold the very same arrays."""
    one = (a.vehicle, a.life, a.signatures, a.aliases, a.consistent)
    other = (b.vehicle, b.life, b.signatures, b.aliases, b.consistent)
    same = one == other and len(a.frames) == len(b.frames) and all(x is y for x, y in zip(a.frames, b.frames))
    starts = ((a.start_pose, b.start_pose), (a.start_pose_cov, b.start_pose_cov))
    return same and all(np.array_equal(x, y) for x, y in starts)


def merges_of(ledger: Ledger) -> Merges:
    """The merges of what a ledger has checked."""
    return Merger().of(ledger.lives(), ledger.decisions)


def run_digest(ledger: Ledger) -> bytes:
    """`map_digest` with all merges: that of the canonical map, and of a run."""
    return ledger.map_digest(merges_of(ledger).classes)
