"""The reference that our maps are set beside: one batch over every raw reading of every vehicle, by gtsam.

With all poses x (vehicle v, step k) and all landmarks y free, it minimises

    sum |x_k - g(x_k-1, u_k)|^2 in U_k  +  sum rho(|z - h(x_k, y)|^2 in Z)  +  priors of start poses

by Levenberg-Marquardt; rho is the square, or Huber's where asked. It knows which landmark is which by signature, and
where readings have none at all it is told the truth (`Recording.identified`): then it shows what association costs.

1. Keys: landmarks 0, 1, ... by ascending signature, then poses by vehicle and step. Rows of H are in that order, a
   pose's in its own tangent space. A given start pose is a constant and has no rows.
2. Increments and start poses err as plain numbers (x, y, theta), as they are declared. gtsam's own factors take the
   error's logarithm instead, which bends a forward error sideways: beyond the sideways noise of a vehicle that does
   not slip. So these factors are ours, called back from gtsam. With robust weights, which are for recorded data,
   gtsam's own do where the bend is below BEND_MAX: they call nothing back.
3. Dead reckoning is no first estimate: it is off by more than half a turn before a run ends, and Levenberg-Marquardt
   then stays where it starts. So iSAM2 (Kaess et al., IJRR 2012) takes all vehicles through their runs side by side,
   in strides short enough for dead reckoning. Whatever it ends at is where Levenberg-Marquardt begins.
4. Sightings without a signature are left out.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any, Final

import numpy as np
import scipy.sparse

from fleet_seif.errors import NumericalError, RunError
from fleet_seif.geometry import between, between_jacobians, compose, wrap
from fleet_seif.jit import one_thread
from fleet_seif.models import RANGE_BEARING, place
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats, Ints
from scenarios.recording import Log, Recording

HUBER: Final = 0.5
"""Standard deviations up to which a sighting counts in full (Huber's k).

On MR.CLAM 2 and 6 as good as any of Huber 0.2 to 1.3, Cauchy 0.3 to 4 and Geman-McClure 2, with or without rejection
of what is left beyond 3 to 8; and convex, so that it does not depend on the start."""
STRIDE_HEADING_STD_RAD: Final = 0.1
"""What dead reckoning within a stride of iSAM2 may add up to. At 0.15 one in 20 mild worlds ends in a wrong minimum."""
STRIDE_MAX: Final = 25
RELINEARIZE_RAD_OR_M: Final = 0.05
SETTLING_UPDATES: Final = 3
ITERATIONS_MAX: Final = 200
FILTERING: Final = "first estimate, %"
ITERATING: Final = "iterations"
STAGES: Final = {FILTERING: 100, ITERATING: ITERATIONS_MAX}
"""What `solve_batch` tells its progress of, with how much there is of each."""
BEND_MAX: Final = 0.5
"""Standard deviations that an error of one standard deviation forward and one in heading may be bent by."""
TOLERANCE: Final = 1e-9
REMEDY: Final = "remedy: robust weights (--robust), or another start"
POSE_KEYS: Final = 2**40
"""Keys from one vehicle to the next, above those of the landmarks."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Guess:
    """A first estimate: poses by vehicle (T+1, 3), m and rad; landmarks by signature (2,), m."""

    poses: Mapping[str, Floats]
    landmarks: Mapping[int, Floats]


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchSolution:
    """The minimum that was found.

    signatures (n,), of `Recording.identified`, ascending; landmark_mean (n, 2), m.
    poses: by vehicle (T+1, 3), headings wrapped.
    H: information, sparse CSR, rows as in rule 1; with robust weights in it where they were asked for.
    chi_square: twice the objective; degrees_of_freedom: of all residuals together, less the free variables.
    left_out: sightings without a signature.
    """

    signatures: Ints
    landmark_mean: Floats
    poses: dict[str, Floats]
    H: scipy.sparse.csr_array
    chi_square: float
    degrees_of_freedom: int
    iterations: int
    left_out: int


def _untold(stage: str, done: int, total: int) -> None:
    pass


@one_thread
def solve_batch(
    recording: Recording,
    *,
    robust: bool = False,
    start: Guess | None = None,
    progress: Callable[[str, int, int], None] = _untold,
) -> BatchSolution:
    """The batch over all readings of a recording.

    Args:
        robust: weigh sightings by Huber's function: for readings with outliers, such as misread barcodes.
        start: where to begin instead of at what iSAM2 finds; it must hold every pose and every landmark.
        progress: is called with one of STAGES, how far it is, and how far that goes at most.

    Raises:
        RunError: gtsam is not installed, there is nothing to solve, or `start` lacks something.
        NumericalError: no minimum was found.
    """
    problem = _Problem(_gtsam(), recording.identified(), robust, progress)
    try:
        return problem.minimised(problem.filtered() if start is None else problem.at(start))
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise NumericalError(f"gtsam cannot solve the batch: {reason}; {REMEDY}") from error


def _gtsam() -> ModuleType:
    try:
        return import_module("gtsam")
    except ImportError as error:
        raise RunError("the batch needs gtsam, not installed here; remedy: pip install 'fleet-seif[bench]'") from error


class _Problem:
    """The readings of a recording as factors of gtsam."""

    def __init__(
        self, gtsam: ModuleType, recording: Recording, robust: bool, progress: Callable[[str, int, int], None]
    ) -> None:
        self._gtsam = gtsam
        self._progress = progress
        self._logs = [_with_signatures(log) for log in recording.logs.values()]
        seen = [log.sighting_signature for log in self._logs]
        self._signatures: Ints = np.unique(np.concatenate(seen)) if seen else np.empty(0, np.int64)
        if not len(self._signatures):
            raise RunError("the batch has nothing to solve: no sighting in these readings has a signature or a truth")
        self._left_out = sum(len(log.sighting_signature) for log in recording.logs.values()) - sum(map(len, seen))
        self._kernel = gtsam.noiseModel.mEstimator.Huber.Create(HUBER) if robust else None

    def filtered(self) -> Any:
        """Values for all keys, from iSAM2 (rule 3)."""
        isam, known = self._isam(), set[int]()
        newest = [np.asarray(log.start_pose, float) for log in self._logs]
        strides = list(_strides(self._logs))
        for stride, spans in enumerate(strides):
            self._progress(FILTERING, 100 * stride // len(strides), 100)
            factors, values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
            for vehicle, (low, high) in enumerate(spans):
                pose, log = newest[vehicle], self._logs[vehicle]
                for step in range(low, high):
                    pose = pose if step == 0 else compose(pose, log.odometry[step - 1])
                    values.insert(_pose_key(vehicle, step), self._gtsam.Pose2(*pose))
                    factors.add(self._rough_factor(vehicle, step))
                    for i, key in self._sightings(vehicle, step):
                        factors.add(self._sighting_factor(vehicle, i, key))
                        if key not in known:
                            known.add(key)
                            values.insert(key, place(RANGE_BEARING, pose, log.sighting_z[i]))
            isam.update(factors, values)
            for vehicle, (low, high) in enumerate(spans):
                if low < high:
                    newest[vehicle] = _array(isam.calculateEstimatePose2(_pose_key(vehicle, high - 1)))
        self._progress(FILTERING, 100, 100)
        for _ in range(SETTLING_UPDATES):
            isam.update()
        return isam.calculateEstimate()

    def at(self, start: Guess) -> Any:
        """The values of a guess."""
        values = self._gtsam.Values()
        for vehicle, log in enumerate(self._logs):
            poses = start.poses.get(log.vehicle)
            if poses is None or poses.shape != (log.steps + 1, 3) or not np.isfinite(poses).all():
                raise RunError(f"the start of the batch needs {log.steps + 1} finite poses of {log.vehicle}")
            first = log.start_pose if _is_given(log) else poses[0]
            for step, pose in enumerate([first, *poses[1:]]):
                values.insert(_pose_key(vehicle, step), self._gtsam.Pose2(*pose))
        missing = [s for s in self._signatures.tolist() if s not in start.landmarks]
        if missing:
            raise RunError(f"the start of the batch lacks {len(missing)} landmarks, first signature {missing[0]}")
        for key, signature in enumerate(self._signatures.tolist()):
            values.insert(key, np.asarray(start.landmarks[signature], float))
        return values

    def minimised(self, values: Any) -> BatchSolution:
        """The minimum next to these values."""
        graph, whole = self._gtsam.NonlinearFactorGraph(), self._gtsam.NonlinearFactorGraph()
        for vehicle, log in enumerate(self._logs):
            (whole if _is_given(log) else graph).add(self._start_factor(vehicle))
            for step in range(1, log.steps + 1):
                own = self._kernel is not None and _bend(log.odometry_cov[step - 1]) <= BEND_MAX
                graph.add(self._rough_factor(vehicle, step) if own else self._motion_factor(vehicle, step))
            for i, key in enumerate(np.searchsorted(self._signatures, log.sighting_signature).tolist()):
                graph.add(self._sighting_factor(vehicle, i, key))
        whole.push_back(graph)
        parameters = self._gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(ITERATIONS_MAX)
        parameters.setRelativeErrorTol(TOLERANCE)
        parameters.setAbsoluteErrorTol(TOLERANCE)
        parameters.iterationHook = lambda done, before, after: self._progress(ITERATING, int(done), ITERATIONS_MAX)
        optimizer = self._gtsam.LevenbergMarquardtOptimizer(whole, values, parameters)
        found = optimizer.optimize()
        if optimizer.iterations() >= ITERATIONS_MAX:
            raise NumericalError(f"the batch did not converge in {ITERATIONS_MAX} iterations; {REMEDY}")
        H, residuals = self._information(graph, found)
        return BatchSolution(
            signatures=self._signatures,
            landmark_mean=np.array([found.atPoint2(key) for key in range(len(self._signatures))]).reshape(-1, 2),
            poses={
                log.vehicle: np.array([_array(found.atPose2(_pose_key(v, k))) for k in range(log.steps + 1)])
                for v, log in enumerate(self._logs)
            },
            H=H,
            chi_square=2.0 * optimizer.error(),
            degrees_of_freedom=residuals - H.shape[0],
            iterations=optimizer.iterations(),
            left_out=self._left_out,
        )

    def _information(self, graph: Any, values: Any) -> tuple[scipy.sparse.csr_array, int]:
        """H = J' J of whitened factors at these values, without columns of given start poses; and the rows of J."""
        i, j, v = graph.linearize(values).sparseJacobian_()
        at = 2 * len(self._signatures)
        columns = at + sum(3 * (log.steps + 1) for log in self._logs)
        J = scipy.sparse.csr_array(  # one column more: the right side
            (v, (i.astype(np.int64) - 1, j.astype(np.int64) - 1)), shape=(int(i.max()), columns + 1)
        )
        free = [np.arange(at)]
        for log in self._logs:
            free.append(np.arange(at + 3 * _is_given(log), at + 3 * (log.steps + 1)))
            at += 3 * (log.steps + 1)
        J = J[:, np.concatenate(free)]
        return scipy.sparse.csr_array(J.T @ J), J.shape[0]

    def _sightings(self, vehicle: int, step: int) -> list[tuple[int, int]]:
        """Index and landmark key of every sighting at a step."""
        log = self._logs[vehicle]
        low, high = np.searchsorted(log.sighting_step, [step, step + 1]).tolist()
        keys = np.searchsorted(self._signatures, log.sighting_signature[low:high]).tolist()
        return list(zip(range(low, high), keys, strict=True))

    def _start_factor(self, vehicle: int) -> Any:
        """The start pose: given, or e = x - start as plain numbers, as its covariance is declared."""
        gtsam, log, key = self._gtsam, self._logs[vehicle], _pose_key(vehicle, 0)
        start = np.asarray(log.start_pose, float)
        if _is_given(log):
            return gtsam.NonlinearEqualityPose2(key, gtsam.Pose2(*start))

        def error(factor: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
            x = _array(values.atPose2(key))
            if jacobians is not None:
                jacobians[0] = _tangent(x[2])
            e: Floats = x - start
            e[2] = wrap(e[2])
            return e

        return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(log.start_pose_cov), [key], error)

    def _motion_factor(self, vehicle: int, step: int) -> Any:
        """e = T_ab - u as plain numbers, as odometry is declared; see rule 2."""
        log, a, b = self._logs[vehicle], _pose_key(vehicle, step - 1), _pose_key(vehicle, step)
        u = np.asarray(log.odometry[step - 1], float)

        def error(factor: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
            T_wa, T_wb = _array(values.atPose2(a)), _array(values.atPose2(b))
            if jacobians is not None:
                J_ab_wa, J_ab_wb = between_jacobians(T_wa, T_wb)
                jacobians[0], jacobians[1] = J_ab_wa @ _tangent(T_wa[2]), J_ab_wb @ _tangent(T_wb[2])
            e: Floats = between(T_wa, T_wb) - u
            e[2] = wrap(e[2])
            return e

        noise = self._gtsam.noiseModel.Gaussian.Covariance(log.odometry_cov[step - 1])
        return self._gtsam.CustomFactor(noise, [a, b], error)

    def _rough_factor(self, vehicle: int, step: int) -> Any:
        """A factor of gtsam's own for the pose of a step: faster, and right where errors bend little.

        It measures in the frame of the pose that is reached, our covariance is in the frame of the one left.
        """
        gtsam, log, at = self._gtsam, self._logs[vehicle], _pose_key(vehicle, step)
        if step == 0 and _is_given(log):
            return self._start_factor(vehicle)
        if step == 0:
            noise = gtsam.noiseModel.Gaussian.Covariance(_turned_back(log.start_pose_cov, log.start_pose[2]))
            return gtsam.PriorFactorPose2(at, gtsam.Pose2(*log.start_pose), noise)
        u = log.odometry[step - 1]
        noise = gtsam.noiseModel.Gaussian.Covariance(_turned_back(log.odometry_cov[step - 1], u[2]))
        return gtsam.BetweenFactorPose2(_pose_key(vehicle, step - 1), at, gtsam.Pose2(*u), noise)

    def _sighting_factor(self, vehicle: int, i: int, landmark: int) -> Any:
        """gtsam measures (bearing, range), our sightings are (range, bearing)."""
        gtsam, log = self._gtsam, self._logs[vehicle]
        range_m, bearing_rad = log.sighting_z[i]
        noise = gtsam.noiseModel.Gaussian.Covariance(log.sighting_cov[i][::-1, ::-1])
        if self._kernel is not None:
            noise = gtsam.noiseModel.Robust.Create(self._kernel, noise)
        pose = _pose_key(vehicle, int(log.sighting_step[i]))
        return gtsam.BearingRangeFactor2D(pose, landmark, gtsam.Rot2(bearing_rad), range_m, noise)

    def _isam(self) -> Any:
        """With QR: Cholesky gives up on the stiff sideways noise of a vehicle that does not slip."""
        parameters = self._gtsam.ISAM2Params()
        parameters.setFactorization("QR")
        parameters.relinearizeSkip = 1
        parameters.setRelinearizeThreshold(RELINEARIZE_RAD_OR_M)
        return self._gtsam.ISAM2(parameters)


def _strides(logs: list[Log]) -> Iterator[list[tuple[int, int]]]:
    """Spans of steps (first, past the last), one for each log, that together are the whole runs, side by side.

    Logs of different lengths get as many spans each, so that a short one is spread over the others' whole runs.
    """
    count = 1
    for log in logs:
        variance = float(log.odometry_cov[:, 2, 2].sum())
        count = max(count, math.ceil(variance / STRIDE_HEADING_STD_RAD**2), math.ceil((log.steps + 1) / STRIDE_MAX))
    for n in range(count):
        yield [((log.steps + 1) * n // count, (log.steps + 1) * (n + 1) // count) for log in logs]


def _with_signatures(log: Log) -> Log:
    """The log without sightings that have none."""
    known = log.sighting_signature != UNKNOWN_SIGNATURE
    if known.all():
        return log
    return log.chosen(np.flatnonzero(known))


def _is_given(log: Log) -> bool:
    return not np.any(log.start_pose_cov)


def _pose_key(vehicle: int, step: int) -> int:
    return (vehicle + 1) * POSE_KEYS + step


def _bend(cov: Floats) -> float:
    """How far the logarithm moves an error of one standard deviation each way, in standard deviations.

    An error (x, y, theta) becomes (x + y theta / 2, y - x theta / 2, theta) to second order.
    """
    x, y, theta = np.sqrt(np.diag(cov)).tolist()
    return float(0.5 * theta * max(x / y, y / x))


def _turned_back(cov: Floats, angle_rad: float) -> Floats:
    """R' cov R on the position, with the rotation R by the angle, shape (3, 3)."""
    R = _tangent(angle_rad)
    turned: Floats = R.T @ cov @ R
    return turned


def _tangent(theta_rad: float) -> Floats:
    """How the plain numbers of a pose with this heading follow its tangent space, shape (3, 3)."""
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _array(pose: Any) -> Floats:
    return np.array([pose.x(), pose.y(), pose.theta()])
