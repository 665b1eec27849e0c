"""Compiles or loads every kernel before a process says that it is ready."""

import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Literal

import numpy as np

from fleet_seif.association import associate
from fleet_seif.config import AssociationSettings, FilterSettings
from fleet_seif.definite import is_positive_definite
from fleet_seif.frames import FramedFilter
from fleet_seif.information import FrameTotal, largest_growth, to_information
from fleet_seif.joint import Life, landmark_classes, marginal_covariances, solve
from fleet_seif.joint_tree import LEAF_PIECES_MAX
from fleet_seif.messages import DeltaMessage, Epoch, FramePart, FrameStatus, Hello
from fleet_seif.records import Reading, Sightings
from fleet_seif.seif import Seif
from fleet_seif.wire import decode_message, encode_message

PATIENCE_S = 2.0


def warm_up(
    say: Callable[[str], None] = lambda text: None, *, frames: Literal["single", "adaptive"] = "single"
) -> float:
    """Run everything that is compiled once, on a toy. Returns the seconds it took.

    frames: as in FilterSettings; "single" does without the batch that closes a frame.
    say: told where it takes longer than PATIENCE_S, which it does on the first run after an installation.
    """
    begin = time.perf_counter()
    notice = threading.Timer(
        PATIENCE_S, say, ["compiling numerical kernels (first run after an installation, a minute or two) ..."]
    )
    notice.daemon = True
    notice.start()
    seen = Sightings(
        z=np.array([[1.0, 0.1], [1.0, -1.0], [2.0, 1.0]]),
        cov=np.tile(1e-4 * np.eye(2), (3, 1, 1)),
        signature=np.arange(3),
    )
    motion = Reading(time_s=1.0, odometry=np.zeros(3), odometry_cov=1e-4 * np.eye(3), sightings=seen)
    framed = FramedFilter(FilterSettings(active_max=1, frames=frames, frame_steps_max=1, close_lag_steps=1))
    backwards = dataclasses.replace(motion, sightings=dataclasses.replace(seen, signature=np.array([2, 1, 0])))
    total = FrameTotal()
    total.add(framed.start(seen)[0].delta)
    for _ in range(3):
        framed.step(backwards)
    for delta in framed.published():
        total.add(delta)
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
    associate(seen.z, seen.cov, seen.z, 1e-4 * np.eye(6), AssociationSettings())
    notice.cancel()
    return time.perf_counter() - begin
