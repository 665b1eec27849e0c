"""The readings of one frame, kept until it is closed, and what each of its sightings is of."""

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from fleet_seif.frame_batch import FrameReadings, FrameSolution, solve_frame
from fleet_seif.jit import kernel
from fleet_seif.local_map import LocalMap, squared_distances_from
from fleet_seif.models import innovation_numbers, place, sight_numbers
from fleet_seif.records import Floats, Ints, Sightings
from fleet_seif.seif import Taken

NONE: Final = -1
"""Signature of a sighting of which it is not known what it is of."""
AGAIN_GATE: Final = 11.0
"""Squared residual up to which a sighting is of a landmark when the frame is known (chi-square of two: 99.6 %)."""
AGAIN_MARGIN: Final = 6.0
"""By how much the next best landmark has to fit worse."""


@kernel
def squared_residuals(model: int, x: Floats, landmarks: Floats, z: Floats, Z: Floats) -> Floats:
    """r' Z^-1 r of every sighting with every landmark, shape (s, n)."""
    d2 = np.empty((len(z), len(landmarks)))
    for j in range(len(landmarks)):
        numbers = sight_numbers(model, x, landmarks[j, 0], landmarks[j, 1])
        for i in range(len(z)):
            r0, r1 = innovation_numbers(model, z[i, 0], z[i, 1], numbers[0], numbers[1])
            det = Z[i, 0, 0] * Z[i, 1, 1] - Z[i, 0, 1] * Z[i, 1, 0]
            d2[i, j] = (Z[i, 1, 1] * r0 * r0 - 2.0 * Z[i, 0, 1] * r0 * r1 + Z[i, 0, 0] * r1 * r1) / det
    return d2


def _best(d2: Floats) -> Ints:
    """Of each sighting the column that is its own, -1 for none, shape (s,)."""
    found, best = np.argmin(d2, axis=1), d2.min(axis=1)
    rest = d2.copy()
    rest[np.arange(len(d2)), found] = np.inf
    clear = (best <= AGAIN_GATE) & (rest.min(axis=1) - best >= AGAIN_MARGIN)
    for i in np.flatnonzero(clear).tolist():
        others = np.flatnonzero((found == found[i]) & (np.arange(len(d2)) != i))
        clear[i] = not len(others) or bool(best[others].min() >= best[i] + AGAIN_MARGIN)
    return np.where(clear, found, NONE)


def _read(data: bytes, *shape: int) -> Floats:
    """A copy: for arrays that are read only kernels would be compiled anew."""
    return np.frombuffer(data).reshape(shape).copy()


@dataclass
class FrameLog:
    """The readings of one frame, and the live estimate after each: what its batch is made from.

    motions: odometry, its covariance, and the pose after it. sightings: the number of motions before, signatures, z and
    their covariances. A signature below 0 is nobody's, or not yet. _provisional: of a signature below NONE, which
    of `sightings` brought it.
    """

    motions: list[tuple[Floats, Floats, Floats]] = field(default_factory=list)
    sightings: list[tuple[int, Ints, Floats, Floats]] = field(default_factory=list)
    heading_variance: float = 0.0
    _provisional: dict[int, list[int]] = field(default_factory=dict)

    def add(self, moves: bool, taken: Taken, pose: Floats) -> None:
        """One step: the motion (none before any), and what was seen. The arrays are kept."""
        u, cov, z, Z, signature = taken
        if moves:
            self.motions.append((u, cov, pose))
            self.heading_variance += float(cov[2, 2])
        if len(signature):
            self._keep(len(self.motions), signature, z, Z)

    def _keep(self, step: int, signature: Ints, z: Floats, Z: Floats) -> None:
        for name in signature[signature < NONE].tolist():
            self._provisional.setdefault(name, []).append(len(self.sightings))
        self.sightings.append((step, signature, z, Z))

    def accept(self, old: int, new: int, least: int = 1) -> None:
        """Sightings of a signature below NONE have another from now on; where there are fewer than `least`, none."""
        found = [self.sightings[i][1] for i in self._provisional.pop(old, [])]
        few = sum(int(np.count_nonzero(names == old)) for names in found) < least
        for names in found:
            names[names == old] = NONE if few else new

    def rename(self, names: Ints) -> None:
        """Sightings of landmark n are of names[n] from now on."""
        for _, signature, _, _ in self.sightings:
            known = signature >= 0
            signature[known] = names[signature[known]]

    def decided_again(self, model: int, poses: Floats, signatures: Ints, landmarks: Floats) -> bool:
        """Tell once more what sightings are of, now that the whole frame is known. Returns whether anything changed.

        A sighting is given to the landmark that fits it best, if no other fits nearly as well and no better sighting
        of it was made from the same pose; else to none.

        Args:
            poses (T, 3), signatures (n,), landmarks (n, 2): as the batch has found them.
        """
        if not len(signatures):
            return False
        whole, changed = np.concatenate([np.zeros((1, 3)), poses]), False
        for step, names, z, Z in self.sightings:
            found = _best(squared_residuals(model, whole[step], landmarks, z, Z))
            new = np.where(found >= 0, signatures[found], np.minimum(names, NONE))
            changed |= not np.array_equal(new, names)
            names[:] = new
        return changed

    def recovered(self, model: int, poses: Floats, local: LocalMap) -> bool:
        """Give sightings that are nobody's to landmarks that have been mapped since. Returns whether there are any.

        One is given to the landmark of least r' (Z + J_y P_yy J_y')^-1 r, by the same rules as in `decided_again`, if
        no other sighting from that pose is of it.

        Args:
            poses (T, 3): as the batch has found them. local: what lies around the frame's start.
        """
        whole, changed = np.concatenate([np.zeros((1, 3)), poses]), False
        for step, names, z, Z in self.sightings:
            open_ = np.flatnonzero(names == NONE)
            free = np.flatnonzero((local.keys >= 0) & ~np.isin(local.keys, names))
            if not len(open_) or not len(free):
                continue
            d2 = squared_distances_from(model, whole[step], local.mean, local.P, free, z[open_], Z[open_])
            found = _best(d2)
            told = np.flatnonzero(found >= 0)
            names[open_[told]] = local.keys[free[found[told]]]
            changed |= len(told) > 0
        return changed

    def state(self) -> tuple[Any, ...]:
        """Plain values for msgpack; `restored` takes them back."""
        seen = [
            (step, names.astype(np.int64).tobytes(), z.tobytes(), Z.tobytes()) for step, names, z, Z in self.sightings
        ]
        motions = [tuple(array.tobytes() for array in motion) for motion in self.motions]
        return motions, seen, self.heading_variance

    @staticmethod
    def restored(state: tuple[Any, ...]) -> "FrameLog":
        motions, seen, heading_variance = state
        log = FrameLog([(_read(u, 3), _read(cov, 3, 3), _read(pose, 3)) for u, cov, pose in motions])
        log.heading_variance = heading_variance
        for step, names, z, Z in seen:
            log._keep(step, np.frombuffer(names, np.int64).copy(), _read(z, -1, 2), _read(Z, -1, 2, 2))
        return log

    def guesses(self, model: int, signatures: Ints, landmarks: Floats) -> tuple[Ints, Floats]:
        """The landmarks that these sightings are of, (n,) and (n, 2) m: as estimated, or where the first puts it."""
        known = dict(zip(signatures.tolist(), landmarks, strict=True))
        poses = [np.zeros(3), *(pose for _, _, pose in self.motions)]
        for step, names, z, _ in self.sightings:
            for name, each in zip(names.tolist(), z, strict=True):
                if name >= 0 and name not in known:
                    known[name] = place(model, poses[step], each)
        return np.array(list(known), np.int64), np.array(list(known.values())).reshape(-1, 2)

    def solved(self, model: int, signatures: Ints, landmarks: Floats, huber: float | None) -> FrameSolution:
        """The batch over these readings, from the live estimates on; signatures of its landmarks (n,), m (n, 2).

        huber: see FilterSettings.frame_huber.

        Raises NumericalError.
        """
        none, order = Sightings.none(), np.argsort(signatures)
        step = np.concatenate([*(np.full(len(names), step) for step, names, _, _ in self.sightings), none.signature])
        seen = np.concatenate([*(names for _, names, _, _ in self.sightings), none.signature]).astype(np.int64)
        z = np.concatenate([*(z for _, _, z, _ in self.sightings), none.z])
        cov = np.concatenate([*(Z for _, _, _, Z in self.sightings), none.cov])
        told = seen >= 0
        readings = FrameReadings(
            model=model,
            odometry=np.array([u for u, _, _ in self.motions]).reshape(-1, 3),
            odometry_cov=np.array([cov for _, cov, _ in self.motions]).reshape(-1, 3, 3),
            step=step[told].astype(np.int64),
            landmark=order[np.searchsorted(signatures, seen[told], sorter=order)],
            z=z[told],
            cov=cov[told],
        )
        poses = np.array([pose for _, _, pose in self.motions]).reshape(-1, 3)
        return solve_frame(readings, poses, landmarks, bound=math.inf if huber is None else huber**2)
