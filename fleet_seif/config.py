"""Settings shared by every process: frozen, keyword-only, unknown keys refused, units last in names."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]


class Settings(BaseModel):
    """Base of all settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False, validate_default=True)


class FilterSettings(Settings):
    """The sparse extended information filter of one vehicle.

    active_max: theta_x, the most landmarks that stay linked to the pose after a step.
    relax_others: landmarks outside the local block whose mean is relaxed each step.
    gate: squared normalised innovation (chi-square, 2 degrees of freedom) above which a sighting is refused.
    gate_patience: refusals of one landmark in a row after which its next sighting is believed.
    start_information: of the frame's first pose, per m^2 and rad^2.
    """

    active_max: Annotated[int, Field(ge=1, le=1000)] = 6
    relax_others: Annotated[int, Field(ge=0, le=10_000)] = 8
    gate: Positive = 30.0
    gate_patience: Annotated[int, Field(ge=1, le=1000)] = 3
    start_information: Annotated[float, Field(gt=0, le=1e9)] = 1e6


class PublishSettings(Settings):
    """How a vehicle publishes.

    window: messages that may be put past the last acknowledgement.
    outbox_max: messages kept until acknowledged; beyond it the unsent ones are coalesced.
    heartbeat_s: time between heartbeats.
    """

    window: Annotated[int, Field(ge=1, le=100_000)] = 256
    outbox_max: Annotated[int, Field(ge=16, le=1_000_000)] = 20_000
    heartbeat_s: Positive = 0.25


class FusionSettings(Settings):
    """How a fusion node works.

    parked_max: early messages kept for a vehicle; later ones are dropped and asked for again.
    repair_after_s: how long a gap may stand before it is asked for; doubled up to repair_max_s without progress.
    repair_batch: messages asked for at a time.
    ack_every: messages folded before an acknowledgement is sent at once; ack_s: otherwise after this time.
    map_s: least time between two served maps.
    stalled_s: silence after which a vehicle counts as stalled.
    covariance_landmarks_max: live maps above this size carry no covariances (the final one always does).
    """

    parked_max: Annotated[int, Field(ge=1, le=1_000_000)] = 4096
    repair_after_s: Positive = 0.1
    repair_max_s: Positive = 2.0
    repair_batch: Annotated[int, Field(ge=1, le=4096)] = 256
    ack_every: Annotated[int, Field(ge=1, le=4096)] = 32
    ack_s: Positive = 0.05
    map_s: Positive = 0.2
    stalled_s: Positive = 3.0
    covariance_landmarks_max: Annotated[int, Field(ge=0)] = 400
