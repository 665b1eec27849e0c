"""The textbook extended Kalman filter of one vehicle: dense, for experiments and as a yardstick.

1. The state is the pose, then the landmarks by number; P is its whole covariance, so a step costs O(n^2).
2. All sightings of a step enter in one update, linearised at the predicted mean.
3. A new landmark enters before that update, at the predicted pose, with its full cross covariance; its first sighting
   is used up by that. This is the same estimate as that of an information filter which linearises every sighting of
   the step, first ones included, at the predicted mean: on one linearisation the order of updates makes no difference.
4. A step that is refused leaves the filter as it was.

P is one contiguous array of just its size, so that BLAS updates it in place; it is copied when landmarks are added.
Symbols as in DESIGN.md section 5; n = 3 + 2 N rows for N landmarks, s sightings.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import blas

from fleet_seif import seif_step as kernels
from fleet_seif.config import FilterSettings
from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.filters import Names, StepResult, checked_reading
from fleet_seif.information import FrameDelta
from fleet_seif.jit import kernel
from fleet_seif.models import RANGE_BEARING, innovation, move, place, sight
from fleet_seif.records import Floats, Ints, Reading, Sightings
from fleet_seif.seif import FAULTS


@kernel
def stacked(model: int, mu: Floats, at: Ints, z: Floats) -> tuple[Floats, Floats]:
    """The sightings z (s, 2) of the landmarks whose rows start at `at` (s,), as one measurement.

    Returns: J (2 s, 3 + 2 s) with respect to the pose and then the landmark of each sighting; r (2 s,).
    """
    count = len(at)
    J, r = np.zeros((2 * count, 3 + 2 * count)), np.empty(2 * count)
    for k in range(count):
        h, J_z_x, J_z_y = sight(model, mu[:3], mu[at[k] : at[k] + 2])
        r[2 * k : 2 * k + 2] = innovation(model, z[k], h)
        J[2 * k : 2 * k + 2, :3] = J_z_x
        J[2 * k : 2 * k + 2, 3 + 2 * k : 5 + 2 * k] = J_z_y
    return J, r


@kernel
def squared_innovations(S: Floats, r: Floats) -> Floats:
    """r_k' S_kk^-1 r_k of each sighting, from the joint S (2 s, 2 s) and r (2 s,); shape (s,)."""
    values = np.empty(len(r) // 2)
    for k in range(len(values)):
        i, j = 2 * k, 2 * k + 1
        adjugate = r[i] * r[i] * S[j, j] - r[i] * r[j] * (S[i, j] + S[j, i]) + r[j] * r[j] * S[i, i]
        values[k] = adjugate / (S[i, i] * S[j, j] - S[i, j] * S[j, i])
    return values


def write_pose_rows(P: Floats, rows: Floats) -> None:
    """Put the pose's rows (3, n) into symmetric P (n, n)."""
    P[:3] = rows
    P[:, :3] = rows.T


def predicted(P: Floats, mu: Floats, model: int, u: Floats, cov: Floats) -> tuple[Floats, Floats]:
    """The pose after increment u with covariance cov, and its rows of the covariance.

        mu_x' = g(mu_x, u),   P_x:' = J_x P_x:,   P_xx' = J_x P_xx J_x' + J_u cov J_u'

    Returns: mu_x' (3,), P_x:' (3, n).
    """
    new_x, J_new_x, J_new_u = move(model, mu[:3].copy(), u)
    rows: Floats = J_new_x @ P[:3]
    P_xx = rows[:, :3] @ J_new_x.T + J_new_u @ cov @ J_new_u.T
    rows[:, :3] = 0.5 * (P_xx + P_xx.T)
    return new_x, rows


def augmented(P: Floats, mu: Floats, model: int, z: Floats, Z: Floats) -> tuple[Floats, Floats]:
    """P and mu with the new landmarks that z (m, 2), of covariance Z (m, 2, 2), puts on the map.

        y = place(x, z),   J_y_x = -J_z_y^-1 J_z_x,   J_y_z = J_z_y^-1    at (x, y)
        P_y: = J_y_x P_x:,   P_yy = J_y_x P_xx J_y_x' + J_y_z Z J_y_z'

    Raises LinAlgError where a sighting cannot be inverted.
    """
    n, m = len(mu), len(z)
    grown, grown_mu = np.empty((n + 2 * m, n + 2 * m)), np.empty(n + 2 * m)
    grown[:n, :n], grown_mu[:n] = P, mu
    J_y_x, noise = np.empty((2 * m, 3)), np.zeros((2 * m, 2 * m))
    for k in range(m):
        y, rows = place(model, mu[:3], z[k]), slice(2 * k, 2 * k + 2)
        _, J_z_x, J_z_y = sight(model, mu[:3], y)
        inverted = np.linalg.solve(J_z_y, np.hstack([-J_z_x, np.eye(2)]))
        grown_mu[n + 2 * k : n + 2 * k + 2] = y
        J_y_x[rows] = inverted[:, :3]
        noise[rows, rows] = inverted[:, 3:] @ Z[k] @ inverted[:, 3:].T
    grown[n:, :n] = J_y_x @ P[:3]
    grown[:n, n:] = grown[n:, :n].T
    P_yy = grown[n:, :3] @ J_y_x.T + noise
    grown[n:, n:] = 0.5 * (P_yy + P_yy.T)
    return grown, grown_mu


def update_into(P: Floats, mu: Floats, JP: Floats, S: Floats, r: Floats) -> Floats:
    """The Kalman update of P, in place; returns the new mean and leaves `mu`. JP (k, n), S (k, k), r (k,).

        S = L L',   V = L^-1 J P,   mu' = mu + V' L^-1 r,   P' = P - V' V

    Raises LinAlgError, with P untouched, where S is not positive definite or the mean would not be finite.
    """
    L = np.linalg.cholesky(S)
    V = blas.dtrsm(1.0, L, np.column_stack([JP, r]).T, side=1, lower=1, trans_a=1)
    new_mu: Floats = mu + V[:-1] @ V[-1]
    if not np.all(np.isfinite(new_mu)):
        raise np.linalg.LinAlgError("the mean would not be finite")
    W = np.asfortranarray(V[:-1])
    blas.dgemm(-1.0, W, W, beta=1.0, c=P.T, trans_b=1, overwrite_c=1)
    return new_mu


class Gated(NamedTuple):
    """What the innovation gate says about the sightings of a step that are not the first of their landmark.

    accepted: positions of those that enter. innovation: sum of the squared normalised innovations within the gate;
    used: how many. refusals: of each landmark in a row, now.
    """

    accepted: list[int]
    innovation: float
    used: int
    refusals: dict[int, int]


class Ekf:
    """See the rules above. `model` is one of fleet_seif.models.

    Of the settings it uses start_information, gate and gate_patience: nothing is sparse, and nothing is published.
    """

    def __init__(self, settings: FilterSettings, model: int = RANGE_BEARING) -> None:
        self.settings = settings
        self.model = model
        self._names = Names()
        self.signatures = self._names.signatures
        self._mu = np.zeros(3)
        self._P = np.eye(3) / settings.start_information
        self._refusals: dict[int, int] = {}

    @property
    def pose(self) -> Floats:
        """Mean pose in the frame, (x m, y m, theta rad), shape (3,)."""
        return self._mu[:3].copy()

    @property
    def landmarks(self) -> Floats:
        """Mean landmarks in the frame, m, shape (N, 2), by number."""
        return self._mu[3:].reshape(-1, 2).copy()

    def mean(self) -> Floats:
        """Pose, then landmarks by number, shape (n,)."""
        return self._mu.copy()

    def covariance_of(self, numbers: Sequence[int]) -> Floats:
        """Joint covariance of the pose and these landmarks in this order, shape (3 + 2 k, 3 + 2 k), m and rad."""
        known = len(self.signatures)
        if any(not 0 <= number < known for number in numbers):
            raise ValueError(f"landmark numbers {list(numbers)}: expected 0 .. {known - 1}")
        rows = _rows_of(np.array(numbers, np.int64))
        block = self._P[np.ix_(rows, rows)]
        return 0.5 * (block + block.T)

    def bytes_used(self) -> int:
        """Bytes of the mean and the covariance."""
        return self._mu.nbytes + self._P.nbytes

    def start(self, sightings: Sightings) -> StepResult:
        """What is seen before any motion."""
        return self._step(False, np.zeros(3), np.eye(3), sightings)

    def step(self, reading: Reading) -> StepResult:
        """One reading: motion, then sightings.

        Raises:
            ReadingRefused: the reading is malformed.
            NumericalError: the covariance of the innovation is not positive definite.
        """
        return self._step(True, reading.odometry, reading.odometry_cov, reading.sightings)

    def _step(self, moves: bool, u: Floats, cov: Floats, seen: Sightings) -> StepResult:
        u, cov, z, Z, signature = checked_reading(u, cov, seen)
        code = kernels.check_reading(self.model, u, cov, z, Z)
        if code in FAULTS:
            raise ReadingRefused(f"reading refused: {FAULTS[code]}; u={u.tolist()} z={z.tolist()}")
        numbers, new = self._names.numbers(signature)
        before = self._P[:3].copy()
        try:
            gated = self._move_and_see(moves, u, cov, numbers, z, Z)
        except np.linalg.LinAlgError as error:
            write_pose_rows(self._P, before)
            raise NumericalError(f"the filter's covariance is not usable: reading refused ({error})") from error
        first_new = len(self.signatures)
        self._names.add(new)
        return StepResult(
            delta=FrameDelta.nothing(),
            first_new=first_new,
            new=tuple(new),
            innovation=gated.innovation,
            sightings=gated.used,
            refused=len(numbers) - len(new) - len(gated.accepted),
            active=len(self.signatures),
        )

    def _move_and_see(self, moves: bool, u: Floats, cov: Floats, numbers: Ints, z: Floats, Z: Floats) -> Gated:
        """The step itself. On LinAlgError only the pose's rows of P may have changed."""
        known = len(self.signatures)
        mu, P = self._mu.copy(), self._P
        if moves:
            mu[:3], rows = predicted(P, mu, self.model, u, cov)
            write_pose_rows(P, rows)
        firsts, others = _first_sightings(numbers.tolist(), known)
        if firsts:
            P, mu = augmented(P, mu, self.model, z[firsts], Z[firsts])
            numbers, z, Z = numbers[others], z[others], Z[others]
        gated = Gated([], 0.0, 0, self._refusals)
        if others:
            seen = _rows_of(numbers)
            J, r = stacked(self.model, mu, seen[3::2], z)
            JP = J @ P[seen]
            S = JP[:, seen] @ J.T
            S.reshape(len(Z), 2, len(Z), 2)[range(len(Z)), :, range(len(Z)), :] += Z
            gated = self._gated(numbers.tolist(), known, squared_innovations(S, r))
            if len(gated.accepted) < len(others):
                keep = _rows_of(np.array(gated.accepted, np.int64))[3:] - 3
                JP, S, r = JP[keep], S[np.ix_(keep, keep)], r[keep]
            if gated.accepted:
                mu = update_into(P, mu, JP, S, r)
        self._mu, self._P, self._refusals = mu, P, gated.refusals
        return gated

    def _gated(self, numbers: list[int], known: int, values: Floats) -> Gated:
        """Which sightings enter, given the squared normalised innovation of each.

        A sighting of a known landmark enters if that is at most `gate`, or if the landmark was refused
        `gate_patience` times in a row: then the map is wrong, not the sighting.
        """
        refusals = self._refusals
        accepted, total, used = [], 0.0, 0
        for k, (number, value) in enumerate(zip(numbers, values.tolist(), strict=True)):
            if number < known:
                times = refusals.get(number, 0)
                if value <= self.settings.gate:
                    total += value
                    used += 1
                elif times < self.settings.gate_patience:
                    refusals = {**refusals, number: times + 1}
                    continue
                if times:
                    refusals = {other: n for other, n in refusals.items() if other != number}
            accepted.append(k)
        return Gated(accepted, total, used, refusals)


def _first_sightings(numbers: list[int], known: int) -> tuple[list[int], list[int]]:
    """Positions of the sightings that put a new landmark on the map, and of all others."""
    firsts: list[int] = []
    others = []
    for k, number in enumerate(numbers):
        if number == known + len(firsts):
            firsts.append(k)
        else:
            others.append(k)
    return firsts, others


def _rows_of(numbers: Ints) -> Ints:
    """Rows of the pose and of these landmarks, shape (3 + 2 k,)."""
    rows = np.empty(3 + 2 * len(numbers), np.int64)
    rows[:3] = 0, 1, 2
    rows[3::2] = 2 * numbers + 3
    rows[4::2] = 2 * numbers + 4
    return rows
