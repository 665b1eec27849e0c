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
from fleet_seif.frame_log import FrameLog
from fleet_seif.information import FrameDelta
from fleet_seif.local_map import nothing_known
from fleet_seif.own_map import OwnMap, first_names
from fleet_seif.records import Floats, Sightings


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
        _look_around(anew, own, known, most)
        for frame in frames:
            none = np.empty(0, np.int64)
            again.append(
                Closed(
                    frame=frame.frame,
                    due=frame.due,
                    log=FrameLog(),
                    landmarks=np.empty((0, 2)),
                    signatures=none,
                    numbers=none,
                    first_step=frame.first_step,
                    aliases=len(own.aliases),
                )
            )
            most = _tell(frame, again, anew, most)
            duplicates, found = join(again[-1], anew, own, settings, model, most, FrameDelta.nothing())
            if found is None:
                return None
            solved.append(found)
            unclear = duplicates.unclear
            _look_around(anew, own, known if frame is not frames[-1] else 0, most)
    except NumericalError:
        return None
    return ToldAnew(again, solved, own, anew, most, unclear)


def _look_around(associator: Associator, own: OwnMap, known: int, most: int) -> None:
    """Begin a frame. Of `most` landmarks those below `known` are barred, but for those that have been begun anew."""
    if not own.frames:
        associator.begin(nothing_known(), np.inf)
        return
    near, travel_max_m = own.around(associator.settings.local_landmarks_max, associator.reach_m)
    anew = first_names(own.aliases, most)[known:]
    barred = near.keys[~np.isin(near.keys, anew)].tolist()
    associator.begin(near, travel_max_m, barred)


def _tell(frame: Closed, again: Sequence[Closed], associator: Associator, known: int) -> int:
    """Tell what the sightings of a frame are of, into the last of `again`; how many landmarks have a number then."""
    log, none = again[-1].log, Sightings.none()
    seen = {step: (z, Z) for step, _, z, Z in frame.log.sightings}
    for k in range(0 if 0 in seen else 1, len(frame.log.motions) + 1):
        z, Z = seen.get(k, (none.z, none.cov))
        u, cov = frame.log.motions[k - 1][:2] if k else (np.zeros(3), np.eye(3))
        decision = associator.decide(frame.first_step + k, (u, cov) if k else None, z, Z, known)
        associator.take(decision, z)
        known += len(decision.accepted)
        log.add(k > 0, (u, cov, z, Z, decision.keys.copy()), decision.local.pose.copy())
        for key, number in decision.accepted.items():
            for each in again:
                each.log.accept(key, number, least=1 if each is again[-1] else 2)
    return known
