"""Settings shared by every process: frozen, keyword-only, unknown keys refused, units last in names."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from fleet_seif.messages import NAME_MAX

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
InnerProbability = Annotated[float, Field(gt=0, lt=1)]


class Settings(BaseModel):
    """Base of all settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False, validate_default=True)


class AssociationSettings(Settings):
    """How a vehicle decides which landmark a sighting without identity belongs to.

    method: "joint_compatibility", all sightings of a step at once; "maximum_likelihood", the likeliest pair first;
    "nearest_neighbour", each sighting by itself.
    gate_probability: chance that a true pair passes the gate on its own innovation (2 degrees of freedom).
    joint_gate_probability: that the true hypothesis passes the gate on the innovation of all its pairs.
    cost_unpaired: of leaving a sighting unpaired, in squared sigmas; -2 log of how many sightings of no landmark in the
    map there are per 2 pi standard deviations of sensor noise in range times bearing.
    ambiguity_margin: a pair is doubtful where another candidate costs less than this more.
    rivals: what is compared: "free", candidates that no sighting is paired with, the rest staying as it is; "joint",
    also any other hypothesis about the whole step. The latter is of joint_compatibility; the others know "free" only.
    birth_gate_probability: chance that a landmark's own sighting is within the gate in which none is born beside it.
    nodes_max: partial hypotheses looked at after which the best so far is taken, and again for all rivals together.
    confirm_sightings, confirm_steps: a new landmark is provisional until it has been sighted so many times within so
    many steps in which it was within reach, the first included; else it is forgotten: clutter, or something that moves.
    unclear_max, misfit_max, unseen_max: a vehicle says that it is doubtful while a larger share of the landmarks around
    may be another one, while chi-square per row of its frames is larger, or while it does not see a larger share of the
    landmarks that should be in view.
    local_landmarks_max: landmarks around the start of a frame that sightings are compared with; where there are more, a
    frame closes before the vehicle leaves them behind.

    The last two, costs and the joint gate are of joint_compatibility; guards are of all methods.
    """

    method: Literal["nearest_neighbour", "maximum_likelihood", "joint_compatibility"] = "joint_compatibility"
    gate_probability: InnerProbability = 0.99
    joint_gate_probability: InnerProbability = 0.99
    cost_unpaired: Positive = 13.0
    ambiguity_margin: NotNegative = 5.0
    rivals: Literal["free", "joint"] = "joint"
    birth_gate_probability: InnerProbability = 0.99999
    nodes_max: Annotated[int, Field(ge=1, le=10_000_000)] = 500
    confirm_sightings: Annotated[int, Field(ge=1, le=100)] = 3
    confirm_steps: Annotated[int, Field(ge=1, le=1000)] = 8
    unclear_max: Probability = 0.2
    misfit_max: Positive = 2.0
    unseen_max: Probability = 0.2
    local_landmarks_max: Annotated[int, Field(ge=10, le=1000)] = 150


def _close_lag_steps(given: dict[str, Any]) -> int:
    """The default of FilterSettings.close_lag_steps, from the fields before it."""
    if given["identities"] == "signatures":
        return 2
    association: AssociationSettings = given["association"]
    return association.confirm_steps + association.confirm_steps // 2


class FilterSettings(Settings):
    """The filter of one vehicle.

    kind: "seif", sparsified as published; "eif", never sparsified; "eseif", exactly sparse: the pose is forgotten and
    found again where too many landmarks would be linked to it.
    active_max: theta_x, the most landmarks that stay linked to the pose after a step.
    strength: by what SEIF chooses the links to cut: "normalised", "raw" (as published) or "kl", the cost of the cut.
    soften: rho of soft sparsification; 1 cuts a link at once, less weakens it from step to step.
    relax_others: landmarks outside the local block whose mean is relaxed each step, where changes have reached them.
    mean: "amortised", or "exact" for a solution over the whole map after each step.
    gate: squared normalised innovation (chi-square, 2 degrees of freedom) above which a sighting is refused.
    gate_patience: refusals of one landmark in a row after which its next sighting is believed.
    start_information: of the frame's first pose, per m^2 and rad^2.
    step_information_max: the most that a diagonal entry of H may grow by in a step, per m^2 and rad^2; a reading that
    claims more is refused. The vehicle declares it, and fusion nodes hold it to it.
    frames: "single", one frame for the whole run, as published; "adaptive", a frame is closed before its linearisation
    goes wrong: after frame_steps_max steps, frame_landmarks_max landmarks, or once odometry has added up to a standard
    deviation of frame_heading_std_max_rad.
    frame_huber: standard deviations up to which a sighting counts in full when a frame is closed (Huber's k): for
    sensors whose errors have heavy tails; none: all that pass the gate do.
    close_lag_steps: steps after which the correction of a closed frame is published; 2 by default. With identities =
    "associated" it is one and a half times association.confirm_steps, so that what was seen in the frame of landmarks
    that are confirmed only after it enters its first correction (steps out of their reach do not count as confirming).
    localise_steps: steps after which a vehicle of several frames solves them as one system, for its live pose and
    map; in between the open frame's filter goes on alone. Enters nothing that is published.
    identities: "signatures", each sighting says which landmark it is; "associated", the vehicle finds out by where
    it is, as `association` says, and signatures are not looked at. In a single frame it then looks around anew every
    frame_steps_max steps.
    landmarks_max: landmarks of a frame, for which address space is reserved; a frame on the wire takes 32,767.
    neighbours_max: links of a landmark to others; where a step would make more, its sighting is refused. Not for "eif".
    """

    kind: Literal["seif", "eif", "eseif"] = "seif"
    active_max: Annotated[int, Field(ge=1, le=1000)] = 6
    strength: Literal["normalised", "raw", "kl"] = "normalised"
    soften: Annotated[float, Field(gt=0, le=1)] = 1.0
    relax_others: Annotated[int, Field(ge=0, le=10_000)] = 8
    mean: Literal["amortised", "exact"] = "amortised"
    gate: Positive = 30.0
    gate_patience: Annotated[int, Field(ge=1, le=1000)] = 3
    start_information: Annotated[float, Field(gt=0, le=1e9)] = 1e6
    step_information_max: Annotated[float, Field(gt=0, le=1e9)] = 1e9
    frames: Literal["single", "adaptive"] = "adaptive"
    frame_steps_max: Annotated[int, Field(ge=1, le=10_000)] = 25
    frame_landmarks_max: Annotated[int, Field(ge=2, le=1000)] = 60
    frame_heading_std_max_rad: Positive = 0.5
    frame_huber: Positive | None = None
    localise_steps: Annotated[int, Field(ge=1, le=10_000)] = 5
    identities: Literal["signatures", "associated"] = "signatures"
    association: AssociationSettings = AssociationSettings()
    close_lag_steps: int = Field(default_factory=_close_lag_steps, ge=1, le=10_000)
    landmarks_max: Annotated[int, Field(ge=1, le=10_000_000)] = 32_767
    neighbours_max: Annotated[int, Field(ge=1, le=10_000_000)] = 1000


class PublishSettings(Settings):
    """How a vehicle publishes.

    every_steps: steps that one message covers; less where a frame ends. More steps are fewer bytes and an older map.
    window: messages that may be put past the last acknowledgement.
    outbox_max: messages kept until acknowledged; beyond it the unsent ones are coalesced.
    heartbeat_s: time between heartbeats. nodes_max: fusion nodes whose acknowledgements are kept track of.
    """

    every_steps: Annotated[int, Field(ge=1, le=10_000)] = 1
    window: Annotated[int, Field(ge=1, le=100_000)] = 256
    outbox_max: Annotated[int, Field(ge=16, le=1_000_000)] = 20_000
    heartbeat_s: Positive = 0.25
    nodes_max: Annotated[int, Field(ge=1, le=1000)] = 32


class FusionSettings(Settings):
    """How a fusion node works.

    parked_max, parked_bytes_max: early messages of an epoch, and their bytes of a vehicle, that are kept;
    parked_bytes_all_max: of all vehicles; gap_max: numbers that an early message may be ahead. What goes beyond is
    dropped and asked for again.
    ledger_bytes_max, vehicle_bytes_max: bytes of messages a node keeps, in all and of a vehicle; at compact_bytes it
    starts to compact.
    required_acks: the fusion nodes that must have acknowledged a message before its vehicle forgets it; none: any one.
    repair_after_s: how long a gap may stand before it is asked for; doubled up to repair_max_s without progress.
    repair_batch: messages asked for at a time; queries_max: queries about a vehicle under way at a time.
    status_s: time between two reports to the other nodes.
    ack_every: messages folded before an acknowledgement is sent at once; ack_s: otherwise after this time.
    map_s: least time between two served maps.
    stalled_s: silence after which a vehicle counts as stalled.
    """

    parked_max: Annotated[int, Field(ge=1, le=1_000_000)] = 4096
    parked_bytes_max: Annotated[int, Field(ge=1)] = 64 * 2**20
    parked_bytes_all_max: Annotated[int, Field(ge=1)] = 512 * 2**20
    gap_max: Annotated[int, Field(ge=1)] = 1_000_000
    ledger_bytes_max: Annotated[int, Field(ge=1)] = 2**32
    vehicle_bytes_max: Annotated[int, Field(ge=1)] = 2**30
    compact_bytes: Annotated[int, Field(ge=1)] = 256 * 2**20
    required_acks: tuple[Annotated[str, Field(pattern=rf"^[A-Za-z0-9_-]{{1,{NAME_MAX}}}$")], ...] = ()
    repair_after_s: Positive = 0.1
    repair_max_s: Positive = 2.0
    repair_batch: Annotated[int, Field(ge=1, le=4096)] = 256
    queries_max: Annotated[int, Field(ge=1, le=10_000)] = 4
    status_s: Positive = 0.5
    ack_every: Annotated[int, Field(ge=1, le=4096)] = 32
    ack_s: Positive = 0.05
    map_s: Positive = 0.2
    stalled_s: Positive = 3.0
