"""Frames that have ended: their readings, and what a batch over them finds (DESIGN D5)."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fleet_seif.associator import Associator
from fleet_seif.config import FilterSettings
from fleet_seif.errors import NumericalError
from fleet_seif.frame_deltas import quantised
from fleet_seif.frame_log import FrameLog
from fleet_seif.information import FrameDelta
from fleet_seif.own_duplicates import Duplicates
from fleet_seif.own_map import OwnMap, first_names
from fleet_seif.records import Floats, Ints


@dataclass
class Closed:
    """A frame that has ended and is to be corrected at step `due`.

    landmarks (n, 2): as estimated last; signatures, numbers (n,): theirs, and how they are called in the life.
    first_step: steps before its first motion. aliases: how many pairs of landmarks were one before it closed.
    poses (T, 3): as its batch has found them; none before.
    """

    frame: int
    due: int
    log: FrameLog
    landmarks: Floats
    signatures: Ints
    numbers: Ints
    first_step: int
    aliases: int
    poses: Floats = field(default_factory=lambda: np.empty((0, 3)))

    def state(self) -> tuple[Any, ...]:
        """Plain values for msgpack; `restored` takes them back."""
        arrays = (self.landmarks, self.signatures, self.numbers, self.poses)
        arrays_bytes = (array.tobytes() for array in arrays)
        return (self.frame, self.due, self.first_step, self.aliases, self.log.state(), *arrays_bytes)

    @staticmethod
    def restored(state: tuple[Any, ...]) -> "Closed":
        frame, due, first_step, aliases, log, landmarks, signatures, numbers, poses = state
        return Closed(
            frame, due, FrameLog.restored(log), np.frombuffer(landmarks).reshape(-1, 2),
            np.frombuffer(signatures, np.int64), np.frombuffer(numbers, np.int64), first_step, aliases,
            np.frombuffer(poses).reshape(-1, 3),
        )  # fmt: skip

    def solved(self, settings: FilterSettings, model: int) -> tuple[FrameDelta, Floats] | None:
        """The batch over its readings as one cumulative delta, and its end pose; None where it fails.

        Where sightings are associated, what they are of is told once more when the whole frame is known.
        """
        if not self.log.motions:
            return None
        associated = settings.identities == "associated"
        signatures, landmarks, numbers = self.signatures, self.landmarks, self.numbers
        if associated:
            signatures, landmarks = self.log.guesses(model, signatures, landmarks)
            numbers = signatures
        try:
            batch = self.log.solved(model, signatures, landmarks, settings.frame_huber)
            if associated:
                known = signatures[batch.seen], batch.mean[3:].reshape(-1, 2)[batch.seen]
                if self.log.decided_again(model, batch.poses, *known):
                    batch = self.log.solved(model, signatures, landmarks, settings.frame_huber)
            self.poses = batch.poses
            order = np.argsort(numbers)
            order = order[batch.seen[order]]
            rows = np.concatenate([np.arange(3), (3 + 2 * order[:, None] + np.arange(2)).ravel()])
            variables = np.concatenate([[0], 1 + numbers[order]]).astype(np.int64)
            H, b, mean = batch.H[np.ix_(rows, rows)], batch.b[rows], batch.mean[rows]
            return quantised(variables, H, b, mean), batch.mean[:3]
        except NumericalError:
            return None


def join(
    closed: Closed,
    associator: Associator,
    own_map: OwnMap,
    settings: FilterSettings,
    model: int,
    known: int,
    total: FrameDelta,
) -> tuple[Duplicates, tuple[FrameDelta, Floats] | None]:
    """Put a frame that has just ended into the own map; landmarks that were begun twice are one from now on.

    Returns those landmarks, and what the batch over the frame has found.

    Args:
        known: landmarks that have a number. total: what the frame says where its batch fails.
    """
    duplicates = associator.duplicates()
    own_map.join(duplicates.pairs)
    closed.log.rename(first_names(own_map.aliases, known))
    solved = closed.solved(settings, model)
    own_map.put(closed.frame, total if solved is None else solved[0])
    return duplicates, solved
