"""Compiles or loads every kernel before a process says that it is ready."""

import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Literal

import numpy as np

from fleet_seif.config import AssociationSettings, FilterSettings
from fleet_seif.consistent import Candidates, grown
from fleet_seif.definite import is_positive_definite
from fleet_seif.frame_deltas import quantised
from fleet_seif.frames import FramedFilter
from fleet_seif.geometry import between
from fleet_seif.information import FrameDelta, FrameTotal, largest_growth, to_information
from fleet_seif.joint import Life, landmark_classes, marginal_covariances, solve
from fleet_seif.joint_tree import LEAF_PIECES_MAX
from fleet_seif.local_map import squared_distances_from
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus, Hello
from fleet_seif.models import RANGE_BEARING
from fleet_seif.own_window import joined, view
from fleet_seif.records import Reading, Sightings
from fleet_seif.seif import Seif
from fleet_seif.wire import decode_message, encode_message

PATIENCE_S = 2.0


SEEN = Sightings(
    z=np.array([[1.0, 0.1], [1.0, -1.0], [2.0, 1.0]]), cov=np.tile(1e-4 * np.eye(2), (3, 1, 1)), signature=np.arange(3)
)


def _tell_apart(frames: Literal["single", "adaptive"]) -> None:
    """What a vehicle runs besides where nothing says what it sees."""
    association = AssociationSettings(confirm_sightings=1)
    framed = FramedFilter(
        FilterSettings(
            frames=frames, frame_steps_max=1, close_lag_steps=1, identities="associated", association=association
        )
    )
    framed.start(SEEN)
    for k, seen in enumerate((SEEN, Sightings.none(), Sightings.none(), SEEN), start=1):
        framed.step(Reading(time_s=float(k), odometry=np.zeros(3), odometry_cov=1e-4 * np.eye(3), sightings=seen))
    if frames == "single":
        framed.filter.join([(0, 1)], FrameDelta.nothing())
    pairs = Candidates(np.zeros((1, 2)), np.eye(2), np.array([[0, 1]]), np.eye(2, dtype=bool), np.ones(1))
    grown(pairs, 0, 1.0)
    joined([view(quantised(np.zeros(1, np.int64), np.eye(3), np.zeros(3), np.zeros(3)))] * 2, np.ones(2))
    mean, which = np.array([0.0, 0.0, 0.0, 1.0, 0.0]), np.zeros(1, np.int64)
    squared_distances_from(RANGE_BEARING, np.zeros(3), mean, np.eye(5), which, SEEN.z, SEEN.cov)


def warm_up(
    say: Callable[[str], None] = lambda text: None,
    *,
    frames: Literal["single", "adaptive"] = "single",
    identities: Literal["signatures", "associated"] = "signatures",
) -> float:
    """Run everything that is compiled once, on a toy. Returns the seconds it took.

    frames, identities: as in FilterSettings; "single" does without the batch that closes a frame, "signatures" without
    what tells landmarks apart.
    say: told where it takes longer than PATIENCE_S, which it does on the first run after an installation.
    """
    begin = time.perf_counter()
    notice = threading.Timer(
        PATIENCE_S, say, ["compiling numerical kernels (first run after an installation, a minute or two) ..."]
    )
    notice.daemon = True
    notice.start()
    motion = Reading(time_s=1.0, odometry=np.zeros(3), odometry_cov=1e-4 * np.eye(3), sightings=SEEN)
    framed = FramedFilter(FilterSettings(active_max=1, frames=frames, frame_steps_max=1, close_lag_steps=1))
    backwards = dataclasses.replace(motion, sightings=dataclasses.replace(SEEN, signature=np.array([2, 1, 0])))
    total = FrameTotal()
    total.add(framed.start(SEEN)[0].delta)
    for _ in range(3):
        framed.step(backwards)
    for delta in framed.published():
        total.add(delta)
    between(framed.pose, np.zeros(3))
    FrameTotal().add(quantised(np.arange(9), np.eye(19) + 0.01, np.zeros(19), np.zeros(19)))  # its table grows
    to_information(total.delta())
    is_positive_definite(total.delta())
    largest_growth(total.delta())
    Seif(FilterSettings()).published()
    life = Life(
        vehicle="v", life=0, start_pose=np.zeros(3), start_pose_cov=np.eye(3), signatures=(0, 1, 2),
        frames=(total.delta(),) * (LEAF_PIECES_MAX + 1),
    )  # fmt: skip
    marginal_covariances(solve([life], landmark_classes([life])))
    part = FramePart(frame=0, status=FrameStatus.OPENED, delta=total.delta())
    hello = Hello(
        software="", life=0, placed=True, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)),
        start_information=1.0, step_information_max=1.0,
    )  # fmt: skip
    message = DeltaMessage(
        fleet="f", vehicle="v", epoch=Epoch(0, 0), first=0, last=0, step=0, time_s=0.0, parts=(part,), hello=hello
    )
    decode_message(encode_message(message))
    if identities == "associated":
        _tell_apart(frames)
    notice.cancel()
    return time.perf_counter() - begin
