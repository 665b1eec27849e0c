"""The sparse extended information filter of one vehicle, in the coordinates of one frame; also EIF and ESEIF.

1. The rules of fleet_seif.filters hold; the frame starts with `start_information`.
2. `delta` of a step telescopes: the sum of all is the filter's (H, b) in quanta.
3. The mean of what a step touches is solved for in the step; the rest follows by relaxation, a few landmarks a step,
   or at once by `recover`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from fleet_seif import seif_arrays
from fleet_seif import seif_step as kernels
from fleet_seif.config import FilterSettings
from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.filters import Names, StepResult, checked_reading
from fleet_seif.frame_deltas import renumbered
from fleet_seif.information import H_QUANTUM, QUANTA_MAX, FrameDelta, FrameTotal, largest_growth, quanta
from fleet_seif.local_updates import KL, NORMALISED, RAW
from fleet_seif.models import RANGE_BEARING
from fleet_seif.records import Floats, Ints, Reading, Sightings
from fleet_seif.seif_arrays import ACTIVE, LANDMARKS, LINKS, LINKS_EACH
from fleet_seif.seif_join import seif_join

FAULTS = {
    kernels.NOT_FINITE: "a number is not finite",
    kernels.BAD_RANGE: "the range of a sighting is not positive",
    kernels.BAD_ODOMETRY_COV: "odometry_cov is not symmetric and positive definite "
    "(give the sideways noise a floor, e.g. 1e-8 m^2)",
    kernels.BAD_SIGHTING_COV: "the covariance of a sighting is not symmetric and positive definite",
}
_KINDS = {"seif": kernels.SEIF, "eif": kernels.EIF, "eseif": kernels.ESEIF}
_STRENGTHS = {"normalised": NORMALISED, "raw": RAW, "kl": KL}

Taken = tuple[Floats, Floats, Floats, Floats, Ints]
"""Odometry and its covariance, sightings and theirs, signatures."""


class Seif:
    """See the rules above.

    Args:
        model: one of fleet_seif.models. life: numbers of landmarks in what is published, where they are not the
            filter's own; they, `first_new` and `new` are then those of the life.

    called (n,): those numbers. taken: copies of what the last step was given.
    """

    def __init__(self, settings: FilterSettings, model: int = RANGE_BEARING, life: Names | None = None) -> None:
        self.settings = settings
        self.model = model
        self._names = Names()
        self._life = life
        self.called = np.empty(0, np.int64)
        self.taken: Taken = (np.zeros(3), np.eye(3), np.empty((0, 2)), np.empty((0, 2, 2)), self.called)
        self._options = (
            _KINDS[settings.kind], settings.active_max, _STRENGTHS[settings.strength], settings.soften,
            settings.relax_others, settings.gate, settings.gate_patience, settings.neighbours_max,
        )  # fmt: skip
        self._growth_max = quanta(settings.step_information_max)
        self._reserve(LINKS_EACH * settings.landmarks_max)
        self._s.H_xx[:] = settings.start_information * np.eye(3)

    @property
    def signatures(self) -> list[int]:
        """Signatures by landmark number."""
        return self._names.signatures

    @property
    def pose(self) -> Floats:
        """Mean pose in the frame, (x m, y m, theta rad), shape (3,)."""
        return self._s.mu_x.copy()

    @property
    def landmarks(self) -> Floats:
        """Mean landmarks in the frame, m, shape (n, 2), by number."""
        return self._s.mu_y[: self._s.counts[LANDMARKS]].copy()

    @property
    def active(self) -> Ints:
        """Numbers of the landmarks linked to the pose, ascending."""
        return self._s.active[: self._s.counts[ACTIVE]].copy()

    @property
    def waiting(self) -> int:
        """Landmarks whose mean waits to be relaxed; many after a loop has closed."""
        return int(self._s.counts[seif_arrays.QUEUED])

    def bytes_used(self) -> int:
        """Memory of all that is known about pose, landmarks and links; what is only reserved does not count."""
        return sum(int(part.nbytes) for part in seif_arrays.used(self._s).values()) + 8 * len(self.signatures)

    def numbers_of(self, seen: Sightings) -> Ints:
        """Landmark numbers of sightings that have been taken."""
        return self._names.numbers(np.asarray(seen.signature))[0]

    def mean(self) -> Floats:
        """Pose, then landmarks by number, shape (3 + 2 n,)."""
        return np.concatenate([self.pose, self.landmarks.ravel()])

    def start(self, sightings: Sightings) -> StepResult:
        """What is seen before any motion. The delta includes the start information."""
        return self._step(False, np.zeros(3), np.eye(3), sightings)

    def step(self, reading: Reading) -> StepResult:
        """One reading: motion, sightings, mean recovery, sparsification.

        Raises:
            ReadingRefused: the reading is malformed, or a sum would outgrow the fixed point, or the map its limit.
            NumericalError: the filter's matrix would not stay positive definite.
        """
        return self._step(True, reading.odometry, reading.odometry_cov, reading.sightings)

    def _step(self, moves: bool, odometry: Floats, odometry_cov: Floats, seen: Sightings) -> StepResult:
        u, cov, z, Z, signature = checked_reading(odometry, odometry_cov, seen)
        numbers, new = self._names.numbers(signature)
        counts = self._s.counts
        first_new, most = int(counts[LANDMARKS]), self._growth_max
        if first_new + len(new) > self.settings.landmarks_max:
            raise ReadingRefused(
                f"reading refused: it would make {first_new + len(new)} landmarks, landmarks_max in [filter] is"
                f" {self.settings.landmarks_max}: raise it, or leave landmarks out"
            )
        block = int(counts[ACTIVE]) + len(numbers)
        if counts[LINKS] + block * block // 2 > len(self._s.H_link):
            self._grow(2 * len(self._s.H_link) + block * block)
        if not moves:
            most += quanta(self.settings.start_information)
        called, unknown = self.called, new
        if self._life is not None:
            first_new = len(self._life.signatures)
            if new:
                more, unknown = self._life.numbers(np.array(new))
                called = np.concatenate([called, more])
        code, statistics, variables, rows, cols, H, b = kernels.seif_step(
            self._floats, self._ints, self.model, moves, u, cov, numbers, z, Z, *self._options, most, called
        )
        if code != kernels.OK:
            self._refuse(code, u, z)
        if new:
            self._names.add(new)
            if self._life is not None:
                self._life.add(unknown)
                self.called = called
        if self.settings.mean == "exact":
            self.recover()
        self.taken = u, cov, z, Z, signature
        innovation, used, refused = statistics.tolist()
        return StepResult(
            FrameDelta(variables=variables, rows=rows, cols=cols, H=H, b=b),
            first_new, tuple(unknown), innovation, int(used), int(refused), int(self._s.counts[ACTIVE]),
        )  # fmt: skip

    def join(self, pairs: Sequence[tuple[int, int]], step: FrameDelta) -> FrameDelta:
        """Hold pairs of landmarks that are one together (seif_join), after a step with this delta; both deltas in one.

        As certain as a frame's start, but no more than the step may still add (step_information_max).
        Raises NumericalError where it cannot be done; nothing has changed then.
        """
        most = self._growth_max - largest_growth(step)
        if not pairs or most <= 0:
            return step
        W = min(self.settings.start_information, 0.5 * most * H_QUANTUM / len(pairs))
        if self._s.counts[LINKS] + len(pairs) > len(self._s.H_link):
            self._grow(2 * len(self._s.H_link) + len(pairs))
        own = np.array(pairs, np.int64).reshape(-1, 2)
        code, variables, rows, cols, H, b = seif_join(
            self._floats, self._ints, own, W, self.settings.relax_others, self.called
        )
        if code != kernels.OK:
            raise NumericalError("landmarks cannot be joined: the filter's matrix would not stay positive definite")
        if self.settings.mean == "exact":
            self.recover()
        total = FrameTotal()
        total.add(step)
        total.add(FrameDelta(variables=variables, rows=rows, cols=cols, H=H, b=b))
        return total.delta()

    def _refuse(self, code: int, u: Floats, z: Floats) -> None:
        if code in FAULTS:
            raise ReadingRefused(f"reading refused: {FAULTS[code]}; u={u.tolist()} z={z.tolist()}")
        if code == kernels.ABSURD:
            raise ReadingRefused(
                "reading refused: it claims more information than step_information_max, "
                f"{self.settings.step_information_max:g} per m^2 or rad^2: its sightings are too sharp or too close; "
                "raise the limit in [filter] if they are not"
            )
        if code == kernels.TOO_LARGE:
            raise ReadingRefused(
                f"reading refused: a sum would exceed {QUANTA_MAX // 2} quanta (H 2^-28, b 2^-24); a sighting claims"
                " too much information, or a landmark has been seen too often with too small a covariance"
            )
        raise NumericalError("the filter's local information matrix is not positive definite: reading refused")

    def _reserve(self, links: int) -> None:
        """Space for so many links, and nothing in it."""
        self._floats, self._ints = seif_arrays.reserve(self.settings.landmarks_max, links)
        self._s = seif_arrays.arrays(self._floats, self._ints)

    def _grow(self, links: int) -> None:
        parts = seif_arrays.used(self._s)
        self._reserve(links)
        seif_arrays.put_back(self._s, parts)

    def published(self) -> FrameDelta:
        """The sum of all deltas so far, as one."""
        variables, rows, cols, H, b = kernels.published_total(self._s)
        delta = FrameDelta(variables=variables, rows=rows, cols=cols, H=H, b=b)
        return delta if self._life is None else renumbered(delta, self.called)

    def state(self) -> dict[str, Any]:
        """All that the filter knows, as plain values for msgpack; `restore` takes it back."""
        parts = seif_arrays.used(self._s)
        return {"arrays": {name: part.tobytes() for name, part in parts.items()}, "signatures": self.signatures}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken, to the bit. Raises ValueError where it is not the state of a filter."""
        links = len(state["arrays"]["ends"]) // 16
        self._names = Names()
        self._reserve(max(links, LINKS_EACH * self.settings.landmarks_max))
        parts = {
            name: np.frombuffer(state["arrays"][name], array.dtype).reshape(-1, *array.shape[1:])
            for name, array in self._s._asdict().items()
            if name != "local"
        }
        seif_arrays.put_back(self._s, parts)
        self._names.add(list(state["signatures"]))
        if self._life is not None:
            self.called = self._life.numbers(np.array(self.signatures, np.int64))[0]

    def information(self) -> tuple[scipy.sparse.csc_array, Floats]:
        """The filter's own H (n, n) and b (n,): pose first, then landmarks by number."""
        s = self._s
        n, links, active = (int(s.counts[k]) for k in (LANDMARKS, LINKS, ACTIVE))
        at = 3 + 2 * np.arange(n)
        lower, higher = 3 + 2 * s.ends[:links, 0], 3 + 2 * s.ends[:links, 1]
        pose, off = np.zeros(active, np.int64), 3 + 2 * s.active[:active]
        upper = [(pose, off, s.H_xa[:active]), (lower, higher, s.H_link[:links])]
        blocks = [(np.zeros(1, np.int64), np.zeros(1, np.int64), s.H_xx[None]), (at, at, s.H_yy[:n])]
        blocks += upper + [(cols, rows, H.transpose(0, 2, 1)) for rows, cols, H in upper]
        i = [(r[:, None, None] + np.arange(H.shape[1])[:, None] + 0 * H.astype(int)).ravel() for r, _, H in blocks]
        j = [(c[:, None, None] + np.arange(H.shape[2]) + 0 * H.astype(int)).ravel() for _, c, H in blocks]
        values = np.concatenate([H.ravel() for _, _, H in blocks])
        H = scipy.sparse.coo_array((values, (np.concatenate(i), np.concatenate(j))), shape=(3 + 2 * n, 3 + 2 * n))
        return H.tocsc(), np.concatenate([s.b_x, s.b_y[:n].ravel()])

    def recover(self) -> None:
        """Solve H mu = b for the whole map; takes as long as a sparse factorisation. Nothing waits afterwards."""
        H, b = self.information()
        mean = scipy.sparse.linalg.splu(H).solve(b)
        self._s.mu_x[:], self._s.mu_y[: len(self.signatures)] = mean[:3], mean[3:].reshape(-1, 2)
        self._s.queue[: len(self.signatures)] = 0
        self._s.counts[seif_arrays.QUEUED] = 0

    def covariance_of(self, numbers: Sequence[int]) -> Floats:
        """Joint covariance of the pose and these landmarks, shape (3 + 2 k, 3 + 2 k): columns of the whole inverse."""
        H, _ = self.information()
        rows = np.array([0, 1, 2, *(3 + 2 * y + axis for y in numbers for axis in (0, 1))])
        unit = np.zeros((H.shape[0], len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        return np.asarray(scipy.sparse.linalg.splu(H).solve(unit)[rows])

    def blanket_covariance(self, numbers: Sequence[int]) -> Floats:
        """Joint covariance of the pose and these landmarks from their neighbourhood alone, shape (3 + 2 k, 3 + 2 k).

        SEIF paper eq. (54), (55), for several landmarks:  P = S (H_BB)^-1 S',  S taking pose and landmarks out of B

        B, the combined Markov blanket: the pose, the active landmarks, these landmarks and their neighbours; where a
        landmark and its neighbours do not meet the others, the landmarks of a shortest path to them belong to it too.
        The rest of the map is conditioned on, not marginalised out, so the result is at most the exact one. Its cost
        follows B, not the map. Raises NumericalError where H is not positive definite there.
        """
        ids = kernels.blanket(self._s, np.array(numbers, np.int64))
        H, _, _, _, _ = kernels.gather(self._s, ids)
        at = np.searchsorted(ids, numbers)
        rows = np.concatenate([np.arange(3), (3 + 2 * at[:, None] + np.arange(2)).ravel()])
        try:
            P = scipy.linalg.cho_solve(scipy.linalg.cho_factor(H, lower=True), np.eye(len(H))[:, rows])[rows]
        except np.linalg.LinAlgError as error:
            raise NumericalError("the information matrix of a neighbourhood is not positive definite") from error
        return np.asarray((P + P.T) / 2)
