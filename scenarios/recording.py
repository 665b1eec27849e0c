"""What a world or a data set yields: every reading of every vehicle, and the truth to score it by."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints, Reading, Sightings


@dataclass(frozen=True, eq=False, kw_only=True)
class Log:
    """Everything one vehicle's filter is fed, in the form of `readings/<vehicle>.npz`.

    time_s (T+1,): the vehicle's own time at pose k.
    odometry (T, 3), odometry_cov (T, 3, 3): increment i leads from pose i to pose i+1, in the frame of pose i.
    sighting_step (S,), ascending: index of the pose a sighting was made from.
    sighting_z (S, 2): range m, bearing rad; sighting_cov (S, 2, 2).
    sighting_signature (S,): -1 unknown. sighting_truth (S,): index of the true landmark, -1 clutter; scoring only.
    start_pose (3,), start_pose_cov (3, 3): zeros mean that the start pose is given.
    truth_pose (T+1, 3): NaN where unknown.
    """

    vehicle: str
    time_s: Floats
    odometry: Floats
    odometry_cov: Floats
    sighting_step: Ints
    sighting_z: Floats
    sighting_cov: Floats
    sighting_signature: Ints
    sighting_truth: Ints
    start_pose: Floats
    start_pose_cov: Floats
    truth_pose: Floats

    @property
    def steps(self) -> int:
        return len(self.odometry)

    def chosen(self, sightings: Ints) -> "Log":
        """The log with these of its sightings, by index, in this order, in which steps must ascend."""
        names = ("sighting_step", "sighting_z", "sighting_cov", "sighting_signature", "sighting_truth")
        return replace(self, **{name: getattr(self, name)[sightings] for name in names})

    def sightings_at(self, step: int) -> Sightings:
        """What was seen from pose `step`."""
        low, high = np.searchsorted(self.sighting_step, [step, step + 1])
        return Sightings(
            z=self.sighting_z[low:high], cov=self.sighting_cov[low:high], signature=self.sighting_signature[low:high]
        )

    def readings(self) -> Iterator[Reading]:
        """Steps 1 .. T; what was seen from pose 0 is `sightings_at(0)`."""
        for k in range(1, self.steps + 1):
            yield Reading(
                time_s=float(self.time_s[k]),
                odometry=self.odometry[k - 1],
                odometry_cov=self.odometry_cov[k - 1],
                sightings=self.sightings_at(k),
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """One run's readings by vehicle (in fleet order), and the true landmarks (m, 2), which may be unknown (0, 2).

    skipped: sightings left out by the loader, by reason.
    """

    landmarks: Floats
    logs: dict[str, Log]
    skipped: dict[str, int]

    def identified(self) -> "Recording":
        """The recording; where none of its sightings has a signature, with true landmarks as signatures.

        For what is given the answer on purpose. What is no landmark has no signature then either.
        """
        if any(np.any(log.sighting_signature != UNKNOWN_SIGNATURE) for log in self.logs.values()):
            return self
        logs = {
            name: replace(
                log, sighting_signature=np.where(log.sighting_truth < 0, UNKNOWN_SIGNATURE, log.sighting_truth)
            )
            for name, log in self.logs.items()
        }
        return replace(self, logs=logs)
