"""The joint map as it was at chosen times: the ledger's messages folded again, up to each time, and solved."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fleet_seif.envelope import KIND_SNAPSHOT, kind_of
from fleet_seif.errors import NumericalError
from fleet_seif.joint import JointSolution, JointSolver, marginal_covariances
from fleet_seif.merging import Merges
from fleet_seif.messages import FrameStatus
from fleet_seif.records import Floats
from fleet_seif.wire import decode_message
from fusion.ledger import Ledger
from fusion.merges import Merger
from scenarios.recording import Log, Recording


@dataclass(frozen=True, eq=False, kw_only=True)
class Moment:
    """The joint map at one time, s.

    landmark_cov (n, 2, 2) m^2. merges: what became of each pair of landmarks. doubtful: vehicles that say so of
    themselves, and are not fused.
    """

    time_s: float
    solution: JointSolution
    landmark_cov: Floats
    merges: Merges
    doubtful: frozenset[str]

    @property
    def uncertainty_m2(self) -> float:
        """Sum of the traces of all landmarks' covariances."""
        return float(np.trace(self.landmark_cov, axis1=1, axis2=2).sum())


def uncertainty_of(moment: Moment, earlier: Moment) -> float:
    """Sum of the covariance traces of those landmarks that were in the map at an earlier moment, m^2."""
    known = {names[0] for names in earlier.solution.classes}
    kept = np.array([not known.isdisjoint(names) for names in moment.solution.classes])
    return float(np.trace(moment.landmark_cov[kept], axis1=1, axis2=2).sum())


def replay(ledger: Ledger, times_s: Sequence[float]) -> Iterable[Moment]:
    """The joint map at ascending times: the cut of all messages up to then. Times without a map are left out."""
    again = Ledger(ledger.fleet)
    for event in ledger.events.values():
        again.accept_event(event, own=True)
    waiting = sorted(
        (
            (t, i, data)
            for s in ledger.streams.values()
            for i, (t, data) in enumerate(zip(s.times_s, s.log, strict=True))
        ),
        key=lambda item: item[:2],
    )
    at, solver, merger = 0, JointSolver(), Merger()
    for time_s in times_s:
        while at < len(waiting) and waiting[at][0] <= time_s:
            again.accept(waiting[at][2])
            at += 1
        lives = again.lives(live=True)
        merges = merger.of(lives, again.decisions)
        if not merges.classes:
            continue
        try:
            solution = solver.update(lives, merges.classes)
        except NumericalError:
            continue
        doubtful = {s.vehicle for s in again.streams.values() if not s.healthy} - {life.vehicle for life in lives}
        yield Moment(
            time_s=time_s,
            solution=solution,
            landmark_cov=marginal_covariances(solution)[0],
            merges=merges,
            doubtful=frozenset(doubtful),
        )


def pose_times(ledger: Ledger, poses: Sequence[tuple[str, int, int]]) -> Floats:
    """When each pose of a joint solution was, by its vehicle's own time, s, shape (p,).

    Pose k of a life is where its frame k-1 has ended, the newest where the last has. NaN where no message says so any
    more (a snapshot has taken its place) or yet.

    Args:
        poses: (vehicle, life, k), k -1 for the newest, as `JointSolution.poses`.
    """
    at: dict[tuple[str, int, int], float] = {}
    for stream in ledger.streams.values():
        for message in (decode_message(data) for data in stream.log if kind_of(data) != KIND_SNAPSHOT):
            if message.hello is not None and message.hello.continues is None:
                at.setdefault((stream.vehicle, stream.number, 0), message.time_s)
            for part in message.parts:
                if part.status is FrameStatus.ENDED:
                    at.setdefault((stream.vehicle, stream.number, part.frame + 1), message.time_s)
    last: dict[tuple[str, int], int] = {}
    for vehicle, life, k in poses:
        last[vehicle, life] = max(last.get((vehicle, life), 0), k)
    keys = [(vehicle, life, k if k >= 0 else last[vehicle, life] + 1) for vehicle, life, k in poses]
    return np.array([at.get(key, np.nan) for key in keys])


def shared_since(a: Log, b: Log) -> float | None:
    """The first time at which two vehicles have seen one landmark (by truth), s; None if they never have."""
    first_a, first_b = _first_seen(a), _first_seen(b)
    times = [max(first_a[truth], first_b[truth]) for truth in first_a.keys() & first_b.keys()]
    return min(times) if times else None


def _first_seen(log: Log) -> dict[int, float]:
    known = log.sighting_truth >= 0
    truths, at = np.unique(log.sighting_truth[known], return_index=True)
    times = log.time_s[log.sighting_step[known][at]]
    return dict(zip(truths.tolist(), times.tolist(), strict=True))


def meetings(recording: Recording) -> list[tuple[str, str, float]]:
    """Pairs of vehicles that share landmarks, and since when, s; earliest first."""
    logs = list(recording.logs.values())
    found = [(a.vehicle, b.vehicle, shared_since(a, b)) for i, a in enumerate(logs) for b in logs[i + 1 :]]
    return sorted(((a, b, t) for a, b, t in found if t is not None), key=lambda item: item[2])
