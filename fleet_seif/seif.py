"""The sparse extended information filter of one vehicle, in the coordinates of one frame.

1. The frame starts at pose (0, 0, 0) with `start_information`; nothing of the world or of other vehicles enters.
2. Landmarks are numbered 0, 1, ... in the order they are first seen; a signature names one landmark.
3. A step that is refused leaves the filter as it was.
4. `delta` of a step telescopes: the sum of all is the filter's (H, b) in quanta.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from fleet_seif import seif_step as kernels
from fleet_seif.config import FilterSettings
from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.information import QUANTA_MAX, FrameDelta, quanta
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats, Ints, Reading, Sightings

_FAULTS = {
    kernels.NOT_FINITE: "a number is not finite",
    kernels.BAD_RANGE: "the range of a sighting is not positive",
    kernels.BAD_ODOMETRY_COV: "odometry_cov is not symmetric and positive definite "
    "(give the sideways noise a floor, e.g. 1e-8 m^2)",
    kernels.BAD_SIGHTING_COV: "the covariance of a sighting is not symmetric and positive definite",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class StepResult:
    """What a step changed.

    delta: change of the frame's (H, b). new: signatures of the landmarks numbered from `first_new` on.
    innovation: sum of squared normalised innovations; sightings: how many it comes from (two degrees of freedom each).
    refused: sightings beyond the gate.
    """

    delta: FrameDelta
    first_new: int
    new: tuple[int, ...]
    innovation: float
    sightings: int
    refused: int


class Seif:
    """See the rules above. `model` is one of fleet_seif.models."""

    def __init__(self, settings: FilterSettings, model: int = RANGE_BEARING) -> None:
        self.settings = settings
        self.model = model
        self.signatures: list[int] = []
        self._number: dict[int, int] = {}
        active = settings.active_max + 64
        self._s = _allocate(landmarks=64, neighbours=16, links=512, active=active)
        self._s.H_xx[:] = settings.start_information * np.eye(3)

    @property
    def pose(self) -> Floats:
        """Mean pose in the frame, (x m, y m, theta rad), shape (3,)."""
        return self._s.mu_x.copy()

    @property
    def landmarks(self) -> Floats:
        """Mean landmarks in the frame, m, shape (n, 2), by number."""
        return self._s.mu_y[: self._s.counts[kernels.LANDMARKS]].copy()

    @property
    def active(self) -> Ints:
        """Numbers of the landmarks linked to the pose, ascending."""
        return self._s.active[: self._s.counts[kernels.ACTIVE]].copy()

    def start(self, sightings: Sightings) -> StepResult:
        """What is seen before any motion. The delta includes the start information."""
        return self._step(False, np.zeros(3), np.eye(3), sightings)

    def step(self, reading: Reading) -> StepResult:
        """One reading: motion, sightings, sparsification, mean recovery.

        Raises:
            ReadingRefused: the reading is malformed, or a sum would outgrow the fixed point.
            NumericalError: the filter's matrix would not stay positive definite.
        """
        return self._step(True, reading.odometry, reading.odometry_cov, reading.sightings)

    def _step(self, moves: bool, u: Floats, cov: Floats, seen: Sightings) -> StepResult:
        # fresh copies: another layout or a read-only array would make numba compile the step once more
        u, cov, z, Z = (np.array(array, np.float64, order="C") for array in (u, cov, seen.z, seen.cov))
        signature = np.asarray(seen.signature)
        if signature.ndim != 1 or (len(signature) and not np.issubdtype(signature.dtype, np.integer)):
            raise ReadingRefused("reading refused: signatures must be a flat array of integers")
        count = len(signature)
        shapes = (u.shape, cov.shape, z.shape, Z.shape)
        if shapes != ((3,), (3, 3), (count, 2), (count, 2, 2)):
            raise ReadingRefused(
                f"reading refused: odometry {shapes[0]}, its covariance {shapes[1]}, sightings z {shapes[2]}, their"
                f" covariances {shapes[3]} for {count} signatures; expected (3,), (3, 3), (s, 2), (s, 2, 2)"
            )
        first_new = int(self._s.counts[kernels.LANDMARKS])
        numbers, new = self._numbers(signature, first_new)
        self._reserve(len(new), len(numbers))
        settings = self.settings
        most = quanta(settings.step_information_max) + (0 if moves else quanta(settings.start_information))
        code, statistics, *delta = kernels.seif_step(
            self._s, self.model, moves, u, cov, numbers, z, Z,
            settings.active_max, settings.relax_others, settings.gate, settings.gate_patience, most,
        )  # fmt: skip
        if code in _FAULTS:
            raise ReadingRefused(f"reading refused: {_FAULTS[code]}; u={u.tolist()} z={seen.z.tolist()}")
        if code == kernels.NOT_POSITIVE_DEFINITE:
            raise NumericalError("the filter's local information matrix is not positive definite: reading refused")
        if code == kernels.ABSURD:
            raise ReadingRefused(
                "reading refused: it claims more information than step_information_max, "
                f"{settings.step_information_max:g} per m^2 or rad^2: its sightings are too sharp or too close; "
                "raise the limit in [filter] if they are not"
            )
        if code == kernels.TOO_LARGE:
            raise ReadingRefused(
                f"reading refused: a sum would exceed {QUANTA_MAX // 2} quanta (H 2^-28, b 2^-24); a sighting claims"
                " too much information, or a landmark has been seen too often with too small a covariance"
            )
        self.signatures.extend(new)
        self._number.update({signature: first_new + i for i, signature in enumerate(new)})
        variables, rows, cols, H, b = delta
        return StepResult(
            delta=FrameDelta(variables=variables, rows=rows, cols=cols, H=H, b=b),
            first_new=first_new,
            new=tuple(new),
            innovation=float(statistics[0]),
            sightings=int(statistics[1]),
            refused=int(statistics[2]),
        )

    def _numbers(self, signatures: Ints, first_new: int) -> tuple[Ints, list[int]]:
        """Landmark number of each sighting, and the signatures that are new."""
        new: dict[int, int] = {}
        numbers = []
        for signature in signatures.tolist():
            if signature < 0:
                raise ReadingRefused(
                    f"reading refused: a sighting has signature {signature}; landmarks without signature (data"
                    " association) are not supported yet, give each sighting a signature of at least 0"
                )
            number = self._number.get(signature)
            if number is None:
                number = new.setdefault(signature, first_new + len(new))
            numbers.append(number)
        return np.array(numbers, np.int64), list(new)

    def _reserve(self, new: int, sighted: int) -> None:
        """Grow the arrays, by doubling, so that a step with so many sightings fits whatever it links."""
        s = self._s
        m = int(s.counts[kernels.ACTIVE]) + sighted
        needs = {
            "landmarks": (len(s.degree), int(s.counts[kernels.LANDMARKS]) + new),
            "neighbours": (s.neighbour.shape[1], int(s.counts[kernels.DEGREE_MAX]) + m),
            "links": (len(s.H_link), int(s.counts[kernels.LINKS]) + m * m // 2),
            "active": (len(s.active), m),
        }
        if all(need <= have for have, need in needs.values()):
            return
        sizes = {name: have if need <= have else max(need, 2 * have) for name, (have, need) in needs.items()}
        grown = _allocate(**sizes)
        for old, array in zip(s, grown, strict=True):
            array[tuple(slice(k) for k in old.shape)] = old
        self._s = grown

    def published(self) -> FrameDelta:
        """The sum of all deltas so far, as one."""
        variables, rows, cols, H, b = kernels.published_total(self._s)
        return FrameDelta(variables=variables, rows=rows, cols=cols, H=H, b=b)

    def state(self) -> dict[str, Any]:
        """All that the filter knows, as plain values for msgpack; `restore` takes it back."""
        arrays = {name: (array.shape, array.tobytes()) for name, array in self._s._asdict().items()}
        return {"arrays": arrays, "signatures": self.signatures}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken, to the bit. Raises ValueError where it is not the state of a filter."""
        empty = _allocate(landmarks=1, neighbours=1, links=1, active=1)
        arrays = {}
        for name, like in empty._asdict().items():
            shape, data = state["arrays"][name]
            arrays[name] = np.frombuffer(data, like.dtype).reshape(shape).copy()
        self._s = kernels.SeifArrays(**arrays)
        self.signatures = list(state["signatures"])
        self._number = {signature: number for number, signature in enumerate(self.signatures)}

    def information(self) -> tuple[scipy.sparse.csr_array, Floats]:
        """The filter's own H (n, n) and b (n,): pose first, then landmarks by number. For tests and inspection."""
        s, n = self._s, int(self._s.counts[kernels.LANDMARKS])
        H = scipy.sparse.lil_array((3 + 2 * n, 3 + 2 * n))
        H[:3, :3] = s.H_xx
        for a in range(s.counts[kernels.ACTIVE]):
            at = 3 + 2 * s.active[a]
            H[:3, at : at + 2], H[at : at + 2, :3] = s.H_xa[a], s.H_xa[a].T
        for y in range(n):
            at = 3 + 2 * y
            H[at : at + 2, at : at + 2] = s.H_yy[y]
            for other, e in zip(s.neighbour[y, : s.degree[y]], s.link[y, : s.degree[y]], strict=True):
                block = s.H_link[e] if y < other else s.H_link[e].T
                H[at : at + 2, 3 + 2 * other : 5 + 2 * other] = block
        return H.tocsr(), np.concatenate([s.b_x, s.b_y[:n].ravel()])


def _allocate(*, landmarks: int, neighbours: int, links: int, active: int) -> kernels.SeifArrays:
    integer = np.int64
    return kernels.SeifArrays(
        counts=np.zeros(5, integer),
        mu_x=np.zeros(3),
        b_x=np.zeros(3),
        H_xx=np.zeros((3, 3)),
        active=np.zeros(active, integer),
        H_xa=np.zeros((active, 3, 2)),
        mu_y=np.zeros((landmarks, 2)),
        b_y=np.zeros((landmarks, 2)),
        H_yy=np.zeros((landmarks, 2, 2)),
        degree=np.zeros(landmarks, integer),
        neighbour=np.zeros((landmarks, neighbours), integer),
        link=np.zeros((landmarks, neighbours), integer),
        H_link=np.zeros((links, 2, 2)),
        q_b_x=np.zeros(3, integer),
        q_xx=np.zeros((3, 3), integer),
        q_xa=np.zeros((active, 3, 2), integer),
        q_b_y=np.zeros((landmarks, 2), integer),
        q_yy=np.zeros((landmarks, 2, 2), integer),
        q_link=np.zeros((links, 2, 2), integer),
        refusals=np.zeros(landmarks, integer),
        local=np.full(landmarks, -1, integer),
    )
