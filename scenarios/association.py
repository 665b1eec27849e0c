"""How well vehicles told which landmark each sighting is of.

`assigned` (S,) is what a vehicle says of its sightings, in order: the number of a landmark in its life, -1 none,
NOT_KNOWN. What a landmark is in truth, only its sightings say:

1. The truth of a landmark is that of most of its sightings, of equals the least; -1 (spurious) where that is clutter.
2. Precision is the share of the assigned sightings whose truth is their landmark's; with spurious ones none agrees.
3. Recall is the share of the sightings of true landmarks that are assigned to the landmark which is that truth. Of
   several (duplicates) only the one with most sightings is, of equals the first.
4. Sightings of which it is not known where they were assigned count in neither.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fleet_seif.records import Ints
from scenarios.recording import Log, Recording
from vehicles.drive import NOT_KNOWN

Truths = Mapping[str, Mapping[int, int]]
"""Truth of landmarks by vehicle and number, as `assigned_truth` of each vehicle."""


@dataclass(frozen=True, kw_only=True)
class Association:
    """Counts for one vehicle; sums of them for several.

    assigned: sightings that were given to a landmark; right: those of them whose truth is their landmark's.
    true: sightings of true landmarks; found: those of them given to the landmark that is it.
    duplicate_landmarks: beyond the first of the same truth; spurious_landmarks: of clutter.
    """

    assigned: int = 0
    right: int = 0
    true: int = 0
    found: int = 0
    duplicate_landmarks: int = 0
    spurious_landmarks: int = 0

    def __add__(self, other: "Association") -> "Association":
        return Association(**{name: value + getattr(other, name) for name, value in vars(self).items()})

    @property
    def precision(self) -> float | None:
        return self.right / self.assigned if self.assigned else None

    @property
    def recall(self) -> float | None:
        return self.found / self.true if self.true else None

    def fields(self) -> dict[str, float | None]:
        """As report.json has them."""
        return {
            "association_precision": self.precision,
            "association_recall": self.recall,
            "duplicate_landmarks": self.duplicate_landmarks,
            "spurious_landmarks": self.spurious_landmarks,
        }


def majority_truth(groups: Ints, truth: Ints) -> dict[int, int]:
    """The most frequent truth of each group of sightings, of equals the least. groups, truth: of each, (S,)."""
    pairs, counts = np.unique(np.column_stack([groups, truth]), axis=0, return_counts=True)
    pairs = pairs[np.lexsort((pairs[:, 1], -counts, pairs[:, 0]))]
    found, first = np.unique(pairs[:, 0], return_index=True)
    return dict(zip(found.tolist(), pairs[first, 1].tolist(), strict=True))


def assigned_truth(log: Log, assigned: Ints) -> dict[int, int]:
    """Truth of each landmark of a vehicle by number; -1 spurious."""
    given = assigned >= 0
    return majority_truth(assigned[given], log.sighting_truth[given])


def associate(log: Log, assigned: Ints) -> Association:
    """Counts for one vehicle."""
    given = assigned >= 0
    truths = assigned_truth(log, assigned)
    numbers, which, sizes = np.unique(assigned[given], return_inverse=True, return_counts=True)
    of_landmark = np.array([truths[number] for number in numbers.tolist()], np.int64)
    main: dict[int, int] = {}
    for row in np.argsort(-sizes, kind="stable").tolist():
        if of_landmark[row] >= 0:
            main.setdefault(int(of_landmark[row]), row)
    is_main = np.isin(np.arange(len(numbers)), list(main.values()))
    right = (of_landmark[which] == log.sighting_truth[given]) & (of_landmark[which] >= 0)
    return Association(
        assigned=len(which),
        right=int(np.count_nonzero(right)),
        true=int(np.count_nonzero((log.sighting_truth >= 0) & (assigned != NOT_KNOWN))),
        found=int(np.count_nonzero(right & is_main[which])),
        duplicate_landmarks=int(np.count_nonzero(of_landmark >= 0)) - len(main),
        spurious_landmarks=int(np.count_nonzero(of_landmark < 0)),
    )


def fleet_association(recording: Recording, assigned: Mapping[str, Ints]) -> Association:
    """Counts for all vehicles together. assigned: by vehicle."""
    return sum((associate(log, assigned[name]) for name, log in recording.logs.items()), Association())
