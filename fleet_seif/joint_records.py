"""What goes into the joint map and what comes out."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

from fleet_seif.information import FrameDelta
from fleet_seif.joint_assembly import Evaluation, assembled
from fleet_seif.joint_frames import Frames
from fleet_seif.joint_tree import Piece
from fleet_seif.messages import LandmarkName
from fleet_seif.records import Floats, Ints
from fleet_seif.robust import DOUBTFUL

Classes = tuple[tuple[LandmarkName, ...], ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Life:
    """What one life of a vehicle has contributed: cumulative deltas of frames 0, 1, ...; signatures by number.

    aliases: pairs of its own landmarks that are one. consistent: whether its sightings fit as well as it says; if not,
    its landmarks are not merged with others by their place.
    """

    vehicle: str
    life: int
    start_pose: Floats
    start_pose_cov: Floats
    frames: tuple[FrameDelta, ...]
    signatures: tuple[int, ...]
    aliases: tuple[tuple[int, int], ...] = ()
    consistent: bool = True


@dataclass(frozen=True, eq=False, kw_only=True)
class System:
    """What a solution was made from, by joint variables (fleet_seif.joint_frames).

    keys: (vehicle, life, frame) of each frame, None where there is none. at: what frames say at the mean. variable: the
    joint variables in the order of the solution's rows. size (v,): rows of each joint variable.
    """

    frames: Frames
    keys: tuple[tuple[str, int, int] | None, ...]
    pieces: tuple[Piece, ...]
    at: Evaluation
    variable: Ints
    size: Ints


@dataclass(frozen=True, eq=False, kw_only=True)
class JointSolution:
    """The solved joint system.

    mean (n,). classes: names of each landmark; poses: (vehicle, life, k) of each pose in row order, k the frame it
    starts, -1 the newest pose of that life. frames: (vehicle, life, frame) of each frame; weight (f,): what it was
    weighted with, 1 where it agrees with the others; chi_square (f,): its residual; dof (f,): its rows.
    """

    mean: Floats
    classes: Classes
    signatures: tuple[int, ...]
    poses: tuple[tuple[str, int, int], ...]
    frames: tuple[tuple[str, int, int], ...]
    weight: Floats
    chi_square: Floats
    dof: Ints
    system: System

    @cached_property
    def H(self) -> scipy.sparse.csr_array:
        """The joint information matrix (n, n), symmetric CSR, linearised at the mean, robust weights included."""
        system = self.system
        sizes = system.size[system.variable]
        rows = np.zeros(len(system.size), np.int64)
        rows[system.variable] = np.cumsum(sizes) - sizes
        pieces = np.array([piece[:3] for piece in system.pieces], np.int64)
        members = [piece.variables for piece in system.pieces]
        return assembled(system.frames, pieces, members, system.at, rows, system.size, len(self.mean))

    @cached_property
    def b(self) -> Floats:
        """H mean (n,)."""
        return np.asarray(self.H @ self.mean)

    @property
    def doubtful(self) -> Ints:
        """Frames that disagree with the others, ascending."""
        return np.flatnonzero(self.weight < DOUBTFUL)

    @property
    def landmark_mean(self) -> Floats:
        """Landmarks in the world, m, shape (n, 2)."""
        return self.mean[: 2 * len(self.classes)].reshape(-1, 2)

    @property
    def pose_mean(self) -> Floats:
        """Poses in the world (x m, y m, theta rad), shape (p, 3), in the order of `poses`."""
        return self.mean[2 * len(self.classes) :].reshape(-1, 3)

    def variables(self) -> list[str]:
        """A name for each row: landmark/<i>/x, pose/<vehicle>/theta, frame/<vehicle>/<life>/<f>/y."""
        rows = [f"landmark/{i}/{axis}" for i in range(len(self.classes)) for axis in "xy"]
        for vehicle, life, k in self.poses:
            stem = f"pose/{vehicle}" if k < 0 else f"frame/{vehicle}/{life}/{k}"
            rows += [f"{stem}/{axis}" for axis in ("x", "y", "theta")]
        return rows
