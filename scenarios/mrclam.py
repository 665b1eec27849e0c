"""Recordings from the UTIAS multi-robot data sets (MR.CLAM): five ground robots among 15 barcoded landmarks.

Source: Leung, Halpern, Barfoot, Liu, "The UTIAS multi-robot cooperative localization and mapping dataset",
IJRR 30(8), 2011. A folder holds text files, blank separated, `#` comments; <r> is 1..5:

    Barcodes.dat               subject, barcode                      subjects 1..5 are robots, the others landmarks
    Landmark_Groundtruth.dat   subject, x m, y m, std x m, std y m
    Robot<r>_Odometry.dat      time s, forward velocity m/s, angular velocity rad/s
    Robot<r>_Measurement.dat   time s, barcode, range m, bearing rad
    Robot<r>_Groundtruth.dat   time s, x m, y m, heading rad

1. Times are seconds after the earliest first odometry row of the robots that are used.
2. A velocity holds from `odometry_delay_s` after its row to as long after the next later row, also through gaps
   (1.4 s at most in these data; there the last velocity is nearer the truth than the next one or none). Before
   the first one the robot stands. Rows are sorted by time; of rows with equal times the last counts.
3. A vehicle has a pose at its first and last odometry row, wherever it sees something, and between as often as
   `step_s` asks. Stamps at most 1.5 ms apart (the files round to 1 ms) are one instant, that of the first.
4. No sighting is left out silently: `Recording.skipped` counts them by reason.
5. A robot without odometry or without measurements is left out; one without ground truth is an error.
"""

import logging
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from fleet_seif.config import NotNegative, Positive, Settings
from fleet_seif.records import Floats, Ints
from scenarios.mrclam_files import BARCODES, GROUNDTRUTH, LANDMARKS, MEASUREMENT, ODOMETRY, DatasetError, Format, read
from scenarios.recording import Log, Recording

ROBOTS = range(1, 6)
SAME_INSTANT_S = 0.0015
TRUTH_GAP_S = 0.1
STEPS_MAX = 1_000_000
STEP_VARIANCE_FLOOR = 1e-8  # m^2 and rad^2, added to every increment: positive definite even at a standstill
SWAPPED_FOLDER = "MRCLAM_Dataset1"  # only this set's table has the two barcodes the wrong way round
SWAPPED_BARCODES = (18, 61)

logger = logging.getLogger(__name__)

Finite = Annotated[float, Field(allow_inf_nan=False)]


class DatasetSettings(Settings):
    """Where a data set is, how its readings are corrected, and the noise they are declared to have.

    path: folder of the unpacked data set. step_s: longest step. duration_s: use only the first so many seconds.

    Odometry (commands rather than measurements): takes effect odometry_delay_s late; the forward speed is
    |v| - forward_lost_m_per_rad |w|, not below 0. The variances of the forward, sideways and turn errors grow with
    time (s), distance (m) and turn (rad), so a bend driven in small steps adds up to the same as in one.

    Sightings: measured range = true + range_bias_m + range_bias_per_m true + noise of standard deviation
    sqrt(range_std_m^2 + (range_std_per_m true)^2); measured bearing = true + bearing_bias_rad + noise of standard
    deviation bearing_std_rad. The biases are taken out. range_max_m: farther sightings are left out.

    Start: the true pose, declared with start_std_m and start_std_rad (0: given).

    The defaults fit data sets 2 and 6: mean square of normalised errors against truth, outliers aside, 0.4 to 1.05 per
    degree of freedom over 0.25 .. 10 s of odometry, 0.9 for ranges, 0.4 to 0.7 for bearings. Range and bearing errors
    of one landmark are far from white there (correlation 0.95 after 0.25 s, 0.6 after 4 s; 0.6 and 0.5): a filter that
    takes every sighting for independent believes its map too much.
    """

    kind: Literal["mrclam"]
    path: Path | None = None
    step_s: Annotated[float, Field(ge=0.01, le=60)] = 0.2
    duration_s: Positive | None = None

    odometry_delay_s: NotNegative = 0.2
    forward_lost_m_per_rad: NotNegative = 0.05
    forward_var_m2_per_s: NotNegative = 1e-6
    forward_var_m2_per_m: NotNegative = 1.5e-3
    forward_var_m2_per_rad: NotNegative = 1e-3
    sideways_var_m2_per_s: NotNegative = 1e-6
    sideways_var_m2_per_m: NotNegative = 1e-4
    turn_var_rad2_per_s: NotNegative = 2e-5
    turn_var_rad2_per_m: NotNegative = 2e-3
    turn_var_rad2_per_rad: NotNegative = 1.2e-2

    range_bias_m: Finite = 0.03
    range_bias_per_m: Annotated[float, Field(gt=-0.5, lt=0.5)] = -0.02
    range_std_m: Positive = 0.05
    range_std_per_m: NotNegative = 0.045
    range_max_m: Positive | None = None
    bearing_bias_rad: Finite = -0.005
    bearing_std_rad: Positive = 0.02

    start_std_m: NotNegative = 0.0
    start_std_rad: NotNegative = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """What all robots share: the folder, the origin of time (Unix s), true landmarks (m, 2) and who bears a barcode.

    subject_of: barcode -> subject. index_of: subject -> row of `landmarks`.
    """

    folder: Path
    origin_s: float
    landmarks: Floats
    subject_of: dict[int, int]
    index_of: dict[int, int]


def robots(settings: DatasetSettings) -> tuple[str, ...]:
    """Names of the vehicles whose files are there. Raises DatasetError where the folder is missing."""
    return tuple(f"robot{r}" for r, files in _missing(_folder(settings.path)).items() if not files)


def load(settings: DatasetSettings, only: str | None = None) -> Recording:
    """The recording in the folder `settings.path`, or the part of one vehicle.

    Args:
        only: vehicle name, "robot1" .. "robot5"; None loads all. Times do not depend on it.

    Raises:
        DatasetError: a folder, file, row or value is missing or wrong.
    """
    folder = _folder(settings.path)
    missing = _missing(folder)
    names = {f"robot{r}": r for r in ROBOTS if not missing[r]}
    if not names or (only is not None and only not in names):
        wanted = only or "a vehicle"
        gaps = "; ".join(f"robot{r} lacks {' and '.join(files)}" for r, files in missing.items() if files)
        raise DatasetError(f"{folder} cannot give {wanted}: usable are [{', '.join(names)}]; {gaps}")
    scene = _scene(folder, list(names.values()))
    skipped: Counter[str] = Counter()
    if only is not None:
        names = {only: names[only]}
    else:
        _count_left_out(folder, missing, skipped)
    logs = {name: _log(settings, scene, name, robot, skipped) for name, robot in names.items()}
    return Recording(landmarks=scene.landmarks, logs=logs, skipped=dict(skipped))


def increments(settings: DatasetSettings, odometry: Floats, times_s: Floats) -> tuple[Floats, Floats]:
    """Motion from each of the given times to the next, and its covariance.

    The velocities are constant between their rows, so that every piece is an arc of a circle, integrated exactly:
    chord = v dt sin(a) / a with a = w dt / 2, directed along the heading in the middle of the piece. A piece's
    noise (forward, sideways, turn; white) is carried to the end of the step, where its turn acts through the
    lever from the piece's start to the step's end:

        U = floor I + sum over pieces of L Q L',   L = [[R(heading), R(90 deg) lever], [0, 1]]

    Args:
        odometry: rows time s, forward velocity m/s, angular velocity rad/s, sorted by time, shape (n, 3).
        times_s: ascending, shape (T+1,).

    Returns:
        Increments in the frame of the pose they leave, shape (T, 3), m and rad; U, shape (T, 3, 3).
    """
    effective_s = odometry[:, 0] + settings.odometry_delay_s
    inside = (effective_s > times_s[0]) & (effective_s < times_s[-1])
    t = np.union1d(times_s, effective_s[inside])
    v, w = _velocities(settings, odometry, np.searchsorted(effective_s, t[:-1], side="right") - 1)
    dt = np.diff(t)

    heading = np.concatenate([[0.0], np.cumsum(w * dt)])
    middle = heading[:-1] + w * dt / 2
    chord = v * dt * np.sinc(w * dt / (2 * np.pi))
    steps_xy = chord[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(steps_xy, axis=0)])

    knot = np.searchsorted(t, times_s)
    step = np.repeat(np.arange(len(times_s) - 1), np.diff(knot))
    to_step = _rotations(-heading[knot[:-1]])
    moved = np.einsum("kij,kj->ki", to_step, np.diff(position[knot], axis=0))
    lever = np.einsum("kij,kj->ki", to_step[step], position[knot[step + 1]] - position[:-1])

    L = np.zeros((len(dt), 3, 3))
    L[:, :2, :2] = _rotations(middle - heading[knot[step]])
    L[:, 0, 2], L[:, 1, 2], L[:, 2, 2] = -lever[:, 1], lever[:, 0], 1.0
    pieces = np.einsum("kij,kj,klj->kil", L, _variances(settings, v, w, dt), L)
    U = np.add.reduceat(pieces, knot[:-1]) + STEP_VARIANCE_FLOOR * np.eye(3)
    return np.column_stack([moved, np.diff(heading[knot])]), U


def _velocities(settings: DatasetSettings, odometry: Floats, row: Ints) -> tuple[Floats, Floats]:
    """Forward (m/s) and angular (rad/s) velocity by row of the odometry, corrected; row -1 is a standstill."""
    v = np.where(row < 0, 0.0, odometry[row, 1])
    w = np.where(row < 0, 0.0, odometry[row, 2])
    return np.sign(v) * np.maximum(np.abs(v) - settings.forward_lost_m_per_rad * np.abs(w), 0.0), w


def _variances(settings: DatasetSettings, v: Floats, w: Floats, dt: Floats) -> Floats:
    """Variances (forward m^2, sideways m^2, turn rad^2) of pieces of motion, shape (n, 3)."""
    s = settings
    per_s = [s.forward_var_m2_per_s, s.sideways_var_m2_per_s, s.turn_var_rad2_per_s]
    per_m = [s.forward_var_m2_per_m, s.sideways_var_m2_per_m, s.turn_var_rad2_per_m]
    per_rad = [s.forward_var_m2_per_rad, 0.0, s.turn_var_rad2_per_rad]
    grown = np.stack([dt, np.abs(v) * dt, np.abs(w) * dt], axis=1)
    variances: Floats = grown @ np.array([per_s, per_m, per_rad])
    return variances


def _rotations(angle: Floats) -> Floats:
    """Rotation matrices, shape (n, 2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c, -s, s, c], axis=1).reshape(-1, 2, 2)


def _log(settings: DatasetSettings, scene: Scene, name: str, robot: int, skipped: Counter[str]) -> Log:
    """Everything one robot's filter is fed; counts in `skipped` the sightings left out."""
    odometry = _timed(scene, robot, "Odometry", ODOMETRY)
    first_s, last_s = float(odometry[0, 0]), float(odometry[-1, 0])
    if settings.duration_s is not None:
        last_s = min(last_s, settings.duration_s)
    if not last_s > first_s:
        raise DatasetError(
            f"no motion of {name} in {scene.folder}: its odometry runs from {first_s:.3f} s to {odometry[-1, 0]:.3f} s "
            f"and duration_s is {settings.duration_s}; give a larger dataset.duration_s"
        )
    seen = _timed(scene, robot, "Measurement", MEASUREMENT)
    seen, subject = _usable(settings, scene, seen, (first_s, last_s), skipped)
    times_s, sighting_step = _pose_times(first_s, last_s, seen[:, 0], settings.step_s)
    truth = _truth_at(_timed(scene, robot, "Groundtruth", GROUNDTRUTH), times_s)
    if not np.isfinite(truth[0]).all():
        raise DatasetError(
            f"{_robot_file(scene.folder, robot, 'Groundtruth')} has no pose around the robot's first odometry row "
            f"({scene.origin_s + first_s:.3f} s), which is needed as its start pose; "
            "use a data set whose truth begins earlier"
        )
    moves, moves_cov = increments(settings, odometry, times_s)
    z, z_cov = _corrected(settings, seen)
    start_var = [settings.start_std_m**2, settings.start_std_m**2, settings.start_std_rad**2]
    return Log(
        vehicle=name,
        time_s=times_s,
        odometry=moves,
        odometry_cov=moves_cov,
        sighting_step=sighting_step,
        sighting_z=z,
        sighting_cov=z_cov,
        sighting_signature=seen[:, 1].astype(np.int64),
        sighting_truth=np.array([scene.index_of.get(s, -1) for s in subject], np.int64),
        start_pose=truth[0].copy(),
        start_pose_cov=np.diag(start_var),
        truth_pose=truth,
    )


def _usable(
    settings: DatasetSettings, scene: Scene, seen: Floats, span_s: tuple[float, float], skipped: Counter[str]
) -> tuple[Floats, list[int]]:
    """The measurement rows that can be used, and their subjects; the others are counted by the first reason met."""
    subject = np.array([scene.subject_of.get(int(b), 0) for b in seen[:, 1]], np.int64)
    time_s, true_range = seen[:, 0], _true_range(settings, seen[:, 2])
    cut_short = settings.duration_s is not None and span_s[1] >= settings.duration_s
    reasons = {
        "barcode not in the table": subject == 0,
        "other robots": (subject > 0) & (subject <= ROBOTS[-1]),
        "before the first odometry": time_s < span_s[0],
        "after duration_s" if cut_short else "after the last odometry": time_s > span_s[1],
        "range not positive": true_range <= 0,
        "beyond range_max_m": true_range > (settings.range_max_m or np.inf),
    }
    use = np.ones(len(seen), bool)
    for reason, hit in reasons.items():
        if (use & hit).any():
            skipped[reason] += int((use & hit).sum())
        use &= ~hit
    return seen[use], subject[use].tolist()


def _true_range(settings: DatasetSettings, measured_m: Floats) -> Floats:
    """The range (m) that the bias turns into the measured one."""
    return (measured_m - settings.range_bias_m) / (1.0 + settings.range_bias_per_m)


def _corrected(settings: DatasetSettings, seen: Floats) -> tuple[Floats, Floats]:
    """Sightings without bias, shape (S, 2), and their covariances, shape (S, 2, 2)."""
    r = _true_range(settings, seen[:, 2])
    cov = np.zeros((len(seen), 2, 2))
    cov[:, 0, 0] = settings.range_std_m**2 + (settings.range_std_per_m * r) ** 2
    cov[:, 1, 1] = settings.bearing_std_rad**2
    return np.column_stack([r, seen[:, 3] - settings.bearing_bias_rad]), cov


def _pose_times(first_s: float, last_s: float, seen_s: Floats, step_s: float) -> tuple[Floats, Ints]:
    """Times of the poses, shape (T+1,), and the pose each sighting was made from, shape (S,)."""
    stamps = np.concatenate([[first_s], seen_s, [last_s]])
    begins = np.concatenate([[True], np.diff(stamps) > SAME_INSTANT_S])
    anchor_s = stamps[begins]
    anchor = np.cumsum(begins) - 1
    pieces = np.ceil(np.diff(anchor_s) / step_s)
    if pieces.sum() > STEPS_MAX or len(anchor_s) < 2:
        raise DatasetError(
            f"{pieces.sum():.0f} steps of at most {step_s} s between {first_s} s and {last_s} s; from 1 to "
            f"{STEPS_MAX} are possible: give another dataset.step_s or dataset.duration_s, or mend the time stamps"
        )
    pose = np.concatenate([[0], np.cumsum(pieces).astype(np.int64)])
    times_s = np.interp(np.arange(pose[-1] + 1), pose, anchor_s)
    return times_s, pose[anchor[1:-1]]


def _truth_at(track: Floats, times_s: Floats) -> Floats:
    """True poses at the given times, shape (T+1, 3); NaN outside the track and in its gaps. Headings do not wrap."""
    if len(track) < 2:
        return np.full((len(times_s), 3), np.nan)
    t = track[:, 0]
    columns = [track[:, 1], track[:, 2], np.unwrap(track[:, 3])]
    poses = np.stack([np.interp(times_s, t, column) for column in columns], axis=1)
    after = np.clip(np.searchsorted(t, times_s), 1, len(t) - 1)
    known = (t[after] - t[after - 1] <= TRUTH_GAP_S) & (times_s >= t[0]) & (times_s <= t[-1])
    poses[~known] = np.nan
    return poses


def _folder(path: Path | None) -> Path:
    """The data set's folder, checked to be there."""
    contents = "Barcodes.dat, Landmark_Groundtruth.dat and Robot<r>_{Odometry,Measurement,Groundtruth}.dat, r = 1..5"
    if path is None:
        raise DatasetError(f"no data set given: say --set dataset.path=DIR, where DIR contains {contents}")
    if not path.is_dir():
        raise DatasetError(f"no folder {path}: --set dataset.path=DIR must name a folder that contains {contents}")
    return path


def _robot_file(folder: Path, robot: int, what: str) -> Path:
    return folder / f"Robot{robot}_{what}.dat"


def _needed(folder: Path, robot: int) -> list[Path]:
    """Files without which a robot is left out."""
    return [_robot_file(folder, robot, what) for what in ("Odometry", "Measurement")]


def _missing(folder: Path) -> dict[int, list[str]]:
    return {r: [f.name for f in _needed(folder, r) if not f.is_file()] for r in ROBOTS}


def _count_left_out(folder: Path, missing: dict[int, list[str]], skipped: Counter[str]) -> None:
    """Say which robots are left out for want of one file, and count their sightings; those with neither are no news."""
    for robot, files in missing.items():
        if len(files) != 1:
            continue
        logger.warning("robot_left_out vehicle=robot%d missing=%s", robot, files[0])
        seen = _robot_file(folder, robot, "Measurement")
        if seen.is_file():
            skipped[f"no {files[0]}"] += len(read(seen, MEASUREMENT))


def _scene(folder: Path, robots: list[int]) -> Scene:
    """What all robots share."""
    first_rows = [read(_robot_file(folder, r, "Odometry"), ODOMETRY, max_rows=1) for r in robots]
    table = read(folder / "Barcodes.dat", BARCODES).astype(np.int64)
    landmarks = read(folder / "Landmark_Groundtruth.dat", LANDMARKS)
    landmarks = landmarks[np.argsort(landmarks[:, 0])]
    for what, values in (("barcode", table[:, 1]), ("subject", table[:, 0]), ("landmark", landmarks[:, 0])):
        if len(set(values)) < len(values):
            raise DatasetError(f"{folder}: a {what} stands twice in its table ({sorted(values)}); each must be unique")
    subject_of = {int(barcode): int(subject) for subject, barcode in table}
    if folder.resolve().name == SWAPPED_FOLDER:
        a, b = SWAPPED_BARCODES
        subject_of[a], subject_of[b] = subject_of[b], subject_of[a]
    return Scene(
        folder=folder,
        origin_s=min(float(row[0, 0]) for row in first_rows),
        landmarks=landmarks[:, 1:3].copy(),
        subject_of=subject_of,
        index_of={int(subject): i for i, subject in enumerate(landmarks[:, 0])},
    )


def _timed(scene: Scene, robot: int, what: str, form: Format) -> Floats:
    """A robot's file with times from the origin, sorted by time (rows of equal times stay in order)."""
    rows = read(_robot_file(scene.folder, robot, what), form)
    rows[:, 0] -= scene.origin_s
    return rows[np.argsort(rows[:, 0], kind="stable")]
