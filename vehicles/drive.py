"""Drives a vehicle through a stream of readings and keeps what a report needs."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fleet_seif.errors import NumericalError, ReadingRefused, RunError
from fleet_seif.records import Floats, Ints, Reading, Sightings
from vehicles.core import Counters
from vehicles.vehicle import Vehicle

log = logging.getLogger(__name__)
SILENCE_S = 30.0
NOT_KNOWN: Final = -2
"""Assignment of a sighting of which the vehicle cannot tell any more what it took it for."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DriveResult:
    """What a vehicle has to say after its run.

    pose (T+1, 3): live estimate after each step. landmarks (n, 2), signatures (n,): its own live map at the end.
    assigned (S,): for each sighting that it was given, those of pose 0 first, the number of the landmark that it is of
    as far as the vehicle knows at the end, -1 none; all NOT_KNOWN where it cannot tell, because it was killed.
    filter_s, publish_s (T,): time spent on each step. bytes_put, messages: what it published.
    readings_refused, sightings_refused: what its filter would not take. steps_beyond_active_max: after which more
    landmarks were linked to the pose than the bound allows.
    """

    pose: Floats
    landmarks: Floats
    signatures: Ints
    assigned: Ints
    filter_s: Floats
    publish_s: Floats
    bytes_put: int
    messages: int
    readings_refused: int
    sightings_refused: int
    steps_beyond_active_max: int


class Notes:
    """Collects a DriveResult step by step; steps that another process has taken stay NaN."""

    def __init__(self, steps: int, sightings: int) -> None:
        self._sightings = sightings
        self.pose = np.full((steps + 1, 3), np.nan)
        self.filter_s: list[float] = []
        self.publish_s: list[float] = []

    def take(self, step: int, pose: Floats, filter_s: float | None = None) -> None:
        """The pose after a step, and how long it took; 0 is before any motion."""
        self.pose[step] = pose
        if filter_s is not None:
            self.filter_s.append(filter_s)

    def result(self, landmarks: Floats, signatures: list[int], assigned: Ints, counters: Counters) -> DriveResult:
        """All of it, with what the vehicle counted."""
        if len(assigned) != self._sightings:
            log.warning("assignments_not_known told=%d sightings=%d", len(assigned), self._sightings)
            assigned = np.full(self._sightings, NOT_KNOWN)
        return DriveResult(
            pose=self.pose,
            landmarks=landmarks,
            signatures=np.array(signatures, np.int64),
            assigned=assigned,
            filter_s=np.array(self.filter_s),
            publish_s=np.array(self.publish_s),
            bytes_put=counters.bytes_put,
            messages=counters.messages,
            readings_refused=counters.readings_refused,
            sightings_refused=counters.sightings_refused,
            steps_beyond_active_max=counters.steps_beyond_active_max,
        )


def drive(
    vehicle: Vehicle,
    first: Sightings,
    start_s: float,
    readings: Sequence[Reading],
    rate_hz: float,
    on_step: Callable[[int], None] = lambda step: None,
) -> DriveResult:
    """Feed every reading that the vehicle has not taken yet, end the stream and wait until it is acknowledged.

    rate_hz: readings a second; 0: as fast as acknowledgements allow. A resumed vehicle stood still while it was down,
    so its next reading is the one after its last committed step.

    Raises RunError where nothing is acknowledged for SILENCE_S.
    """
    notes = Notes(len(readings), sum(len(seen.z) for seen in (first, *(each.sightings for each in readings))))
    if not vehicle.started:
        vehicle.start(first, time_s=start_s)
        notes.take(0, vehicle.pose)
    begin = time.monotonic()
    done = sum(reading.time_s <= vehicle.time_s for reading in readings)
    for step, reading in enumerate(readings[done:], start=done + 1):
        if vehicle.ended:
            break
        if rate_hz:
            time.sleep(max(0.0, begin + (step - done) / rate_hz - time.monotonic()))
        else:
            if not vehicle.wait_for_room(SILENCE_S):
                raise _silence()
            vehicle.localise()
        try:
            vehicle.step(reading.odometry, reading.odometry_cov, reading.sightings, time_s=reading.time_s)
        except (ReadingRefused, NumericalError) as error:
            log.error("reading_refused step=%d reason=%s", step, error)
        notes.take(step, vehicle.pose, vehicle.filter_s)
        notes.publish_s.append(vehicle.publish_s)
        on_step(step)
    vehicle.end()
    acknowledged = vehicle.acknowledged
    while not vehicle.wait_until_acknowledged(SILENCE_S):
        if vehicle.acknowledged == acknowledged:
            raise _silence()
        acknowledged = vehicle.acknowledged
    return notes.result(vehicle.landmarks, vehicle.signatures, vehicle.assigned, vehicle.counters)


def _silence() -> RunError:
    return RunError(f"no acknowledgement for {SILENCE_S:.0f} s: is the fusion node running and reachable?")
