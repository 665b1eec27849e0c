"""A way back from doubt: the last frames' sightings are told anew (DESIGN D5, MATHS.md 19).

1. Readings stay, and so does where frames begin and end.
2. In these frames nothing is compared with landmarks that were known before. What is sighted begins anew, so no pair
   can tie the frames wrongly to the older map; landmarks begun twice are found when a frame ends, by the pattern of all
   of them, and are compared from then on.
3. Nothing given is changed: whether what comes out is better is for the caller to say.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fleet_seif.associator import Associator
from fleet_seif.closed_frames import Closed, join
from fleet_seif.config import FilterSettings
from fleet_seif.errors import NumericalError
from fleet_seif.information import FrameDelta
from fleet_seif.local_map import nothing_known
from fleet_seif.own_map import OwnMap
from fleet_seif.records import Floats, Ints, Sightings


@dataclass(frozen=True)
class ToldAnew:
    """frames: with what their sightings are of now. solved: what the batch over each says, and its end pose.
    known: landmarks that have a number. unclear: see Duplicates."""

    frames: list[Closed]
    solved: list[tuple[FrameDelta, Floats]]
    own_map: OwnMap
    associator: Associator
    known: int
    unclear: float


def told_anew(
    frames: Sequence[Closed], own_map: OwnMap, associator: Associator, settings: FilterSettings, model: int, known: int
) -> ToldAnew | None:
    """The last frames of a vehicle's life, the newest just ended; None where a batch over one of them fails.

    Args:
        own_map, associator: of all frames. known: landmarks that have a number.
    """
    own, anew, most = own_map.until(frames[0].frame, frames[0].aliases), associator.anew(), known
    again: list[Closed] = []
    solved: list[tuple[FrameDelta, Floats]] = []
    unclear = 0.0
    try:
        _look_around(anew, own, frames[0].first_step, known)
        for frame in frames:
            log, none = frame.log.untold(), np.empty(0, np.int64)
            closed = Closed(
                frame.frame, frame.due, log, np.empty((0, 2)), none, none, frame.first_step, len(own.aliases)
            )
            again.append(closed)
            most = _tell(closed, again, anew, most)
            duplicates, found = join(closed, anew, own, settings, model, FrameDelta.nothing())
            if found is None:
                return None
            solved.append(found)
            unclear = duplicates.unclear
            _look_around(anew, own, closed.first_step + len(log.motions), known)
    except NumericalError:
        return None
    anew.barred = frozenset()
    return ToldAnew(again, solved, own, anew, most, unclear)


def _look_around(associator: Associator, own: OwnMap, step: int, known: int) -> None:
    """Begin a frame after this step. Landmarks below `known` are barred, but for those that have been begun anew."""
    if not own.frames:
        associator.begin(step, nothing_known(), np.inf)
        return
    near, travel_max_m = own.around(associator.settings.local_landmarks_max, associator.reach_m)
    met = {one for one, other in own.aliases if other >= known}
    associator.barred = frozenset(key for key in near.keys.tolist() if key < known and key not in met)
    associator.begin(step, near, travel_max_m)


def _tell(closed: Closed, frames: Sequence[Closed], associator: Associator, known: int) -> int:
    """Tell what the sightings of a frame are of; landmarks that have a number then."""
    log, none = closed.log, Sightings.none()
    seen = {step: (names, z, Z) for step, names, z, Z in log.sightings}
    nothing: tuple[Ints, Floats, Floats] = none.signature, none.z, none.cov
    for k in range(0 if 0 in seen else 1, len(log.motions) + 1):
        names, z, Z = seen.get(k, nothing)
        step = closed.first_step + k
        decision = associator.decide(step, log.motions[k - 1][:2] if k else None, z, Z, known)
        associator.take(step, decision, z)
        known += len(decision.accepted)
        names[:] = decision.keys
        for key, number in decision.accepted.items():
            for frame in frames:
                frame.log.rename(key, number, least=1 if frame is closed else 2)
        if k:
            u, cov, _ = log.motions[k - 1]
            log.motions[k - 1] = u, cov, decision.local.pose.copy()
    return known
