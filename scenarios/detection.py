"""What sensors show of a world besides its landmarks, and what they do not show.

1. Sightings are missed, and clutter and moving objects are sighted, in a simulated world only; signatures can be
   hidden in recorded data too. The defaults leave a recording as it is.
2. Each of these draws from a stream of its own: what is added or dropped leaves the noise of the others alone.
3. Where signatures are hidden, the sightings of a step are shuffled, so that their order does not tell what they are.
   Their truth stays, for scoring.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fleet_seif.config import NotNegative, Probability, Settings
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints
from scenarios.recording import Log, Recording
from scenarios.world import NoiseSettings, WorldSettings, noisy_sightings, stream

STREAM_MOVERS, STREAM_MISSED, STREAM_CLUTTER, STREAM_MOVER_NOISE, STREAM_ORDER = 5, 6, 7, 8, 9
"""First part of the keys of random streams, after those of `world`."""
CLUTTER: Final = -1
"""Truth of what is no landmark."""
MOVER_TURN_STD_RAD: Final = 0.2
"""By how much the heading of a moving object changes from step to step."""


class DetectionSettings(Settings):
    """What vehicles sight and know of it.

    signatures: "known", each sighting says which landmark it is of, or "none".
    clutter_share: sightings of nothing, as a share of the landmarks that a vehicle has in range; they come at one rate
    from every pose (Poisson), uniformly from the ring that the sensor covers.
    missed_share: probability that something in range is not sighted.
    movers: moving objects, sighted as if they were landmarks; mover_step_m: how far each goes in a step.
    """

    signatures: Literal["known", "none"] = "known"
    clutter_share: Annotated[float, Field(ge=0, le=10)] = 0.0
    missed_share: Probability = 0.0
    movers: Annotated[int, Field(ge=0, le=1000)] = 0
    mover_step_m: NotNegative = 0.01

    @property
    def is_of_recorded_data(self) -> bool:
        """Whether all of it can be done to data that are there already."""
        return not (self.clutter_share or self.missed_share or self.movers)

    @model_validator(mode="after")
    def _nothing_has_a_signature_that_is_nobodys(self) -> Self:
        if self.signatures == "known" and (self.clutter_share or self.movers):
            raise ValueError(
                "clutter and movers have no signature and would be told from landmarks by that; "
                'remedy: signatures = "none"'
            )
        return self


def detected(
    recording: Recording, world: WorldSettings, noise: NoiseSettings, detection: DetectionSettings, seed: int
) -> Recording:
    """A simulated recording with what is missed left out, and clutter and moving objects added, without signature."""
    steps = max(log.steps for log in recording.logs.values())
    movers = walk(detection, world.square_side_m, steps, stream(seed, STREAM_MOVERS))
    logs = {}
    for i, (name, log) in enumerate(recording.logs.items()):
        seen = stream(seed, STREAM_MISSED, i).random(len(log.sighting_step)) >= detection.missed_share
        rate = detection.clutter_share * len(log.sighting_step) / len(log.time_s)
        added = [
            clutter(rate, len(log.time_s), world, stream(seed, STREAM_CLUTTER, i)),
            sighted_movers(log.truth_pose, movers, world, noise, detection, stream(seed, STREAM_MOVER_NOISE, i)),
        ]
        logs[name] = _with_added(log.chosen(np.flatnonzero(seen)), added, noise)
    return replace(recording, logs=logs)


def walk(detection: DetectionSettings, side_m: float, steps: int, rng: np.random.Generator) -> Floats:
    """Where the moving objects are, m, shape (steps + 1, movers, 2): each step mover_step_m ahead, then a small turn.

    They walk over the whole plane, which is then folded like a map into the square: walls reflect them.
    """
    count = detection.movers
    start, heading = rng.uniform(0.0, side_m, (count, 2)), rng.uniform(-math.pi, math.pi, count)
    turns = MOVER_TURN_STD_RAD * rng.standard_normal((steps, count))
    heading = heading + np.cumsum(turns, axis=0)
    moves = detection.mover_step_m * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    plane = start + np.concatenate([np.zeros((1, count, 2)), np.cumsum(moves, axis=0)])
    folded: Floats = side_m - np.abs(plane % (2.0 * side_m) - side_m)
    return folded


def clutter(rate: float, poses: int, world: WorldSettings, rng: np.random.Generator) -> tuple[Ints, Floats]:
    """Sightings of nothing, `rate` a pose on average: steps (S,), and range m and bearing rad, shape (S, 2)."""
    step = np.repeat(np.arange(poses), rng.poisson(rate, poses))
    range_m = np.sqrt(rng.uniform(world.range_min_m**2, world.range_max_m**2, len(step)))
    return step, np.column_stack([range_m, rng.uniform(-math.pi, math.pi, len(step))])


def sighted_movers(
    truth: Floats,
    movers: Floats,
    world: WorldSettings,
    noise: NoiseSettings,
    detection: DetectionSettings,
    rng: np.random.Generator,
) -> tuple[Ints, Floats]:
    """Sightings of movers (T+1, n, 2) from true poses (T+1, 3) like those of landmarks; the same form as clutter."""
    offset = movers - truth[:, None, :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    step, which = np.nonzero((distance >= world.range_min_m) & (distance <= world.range_max_m))
    z = noisy_sightings(truth[step], movers[step, which], noise, rng)
    seen = rng.random(len(step)) >= detection.missed_share
    return step[seen], z[seen]


def _with_added(log: Log, added: Sequence[tuple[Ints, Floats]], noise: NoiseSettings) -> Log:
    """The log with sightings of what is no landmark, in each step after those of landmarks."""
    step = np.concatenate([log.sighting_step, *(steps for steps, _ in added)])
    extra = len(step) - len(log.sighting_step)
    cov = np.tile(np.diag([noise.range_std_m**2, noise.bearing_std_rad**2]), (extra, 1, 1))
    whole = replace(
        log,
        sighting_step=step,
        sighting_z=np.concatenate([log.sighting_z, *(z for _, z in added)]),
        sighting_cov=np.concatenate([log.sighting_cov, cov]),
        sighting_signature=np.concatenate([log.sighting_signature, np.full(extra, UNKNOWN_SIGNATURE)]),
        sighting_truth=np.concatenate([log.sighting_truth, np.full(extra, CLUTTER)]),
    )
    return whole.chosen(np.argsort(step, kind="stable"))


def without_signatures(recording: Recording, vehicles: Sequence[str], seed: int) -> Recording:
    """A recording without any signature, each step's sightings shuffled. vehicles: the whole fleet, in order."""
    logs = {}
    for name, log in recording.logs.items():
        among = stream(seed, STREAM_ORDER, vehicles.index(name)).random(len(log.sighting_step))
        shuffled = log.chosen(np.lexsort((among, log.sighting_step)))
        logs[name] = replace(shuffled, sighting_signature=np.full(len(among), UNKNOWN_SIGNATURE))
    return replace(recording, logs=logs)
