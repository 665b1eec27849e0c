"""Scores of association: cases that can be counted by hand, laws, and whole runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.joint import JointSolution, marginal_covariances, solve
from fleet_seif.records import Floats, Ints
from scenarios import output
from scenarios.association import Association, assigned_truth, associate, fleet_association
from scenarios.recording import Log, Recording
from scenarios.report import FinishedRun
from scenarios.report import evaluate as evaluate_run
from scenarios.score import MapScore, landmark_truths, score_map, score_vehicle
from tests.fleets import run_virtual
from vehicles import core
from vehicles.core import Counters
from vehicles.drive import NOT_KNOWN, Notes

SMALL = ("fleet.vehicles=2", "world.steps=60", "world.landmarks=15", "run.rate_hz=0")


def log_of(truth: list[int]) -> Log:
    """A log of which only the sightings' truth matters."""
    count = len(truth)
    return Log(
        vehicle="v1",
        time_s=np.zeros(1),
        odometry=np.empty((0, 3)),
        odometry_cov=np.empty((0, 3, 3)),
        sighting_step=np.zeros(count, np.int64),
        sighting_z=np.zeros((count, 2)),
        sighting_cov=np.zeros((count, 2, 2)),
        sighting_signature=np.full(count, -1),
        sighting_truth=np.array(truth, np.int64),
        start_pose=np.zeros(3),
        start_pose_cov=np.zeros((3, 3)),
        truth_pose=np.zeros((1, 3)),
    )


def counted(truth: list[int], assigned: list[int]) -> tuple[float | None, float | None, int, int]:
    """Precision, recall, duplicate and spurious landmarks."""
    found = associate(log_of(truth), np.array(assigned, np.int64))
    return found.precision, found.recall, found.duplicate_landmarks, found.spurious_landmarks


@pytest.mark.parametrize(
    ("truth", "assigned", "expected"),
    [
        # no sightings; everything clutter, left alone and taken for a landmark; nothing assigned
        ([], [], (None, None, 0, 0)),
        ([-1, -1], [-1, -1], (None, None, 0, 0)),
        ([-1, -1], [0, 0], (0.0, None, 0, 1)),
        ([4, 5], [-1, -1], (None, 0.0, 0, 0)),
        # all right, whatever the numbers are
        ([7, 7, 2, 2], [0, 0, 1, 1], (1.0, 1.0, 0, 0)),
        ([7, 7, 2, -1], [3, 3, 9, -1], (1.0, 1.0, 0, 0)),
        # one sighting of 7 given to the landmark that is 2
        ([7, 7, 7, 2, 2], [0, 0, 1, 1, 1], (4 / 5, 4 / 5, 0, 0)),
        # clutter given to a landmark costs precision, a true sighting left alone costs recall
        ([7, 7, -1], [0, 0, 0], (2 / 3, 1.0, 0, 0)),
        ([7, 7, 7, 2], [0, 0, -1, 1], (1.0, 3 / 4, 0, 0)),
        # two landmarks of truth 7: the smaller one is the duplicate; of equals the later one is
        ([7, 7, 7], [0, 1, 1], (1.0, 2 / 3, 1, 0)),
        ([7, 7, 7, 7], [1, 1, 0, 0], (1.0, 1 / 2, 1, 0)),
        ([7] * 6, [0, 1, 1, 2, 2, 2], (1.0, 1 / 2, 2, 0)),
        # a landmark that is mostly or half clutter is spurious; its true sighting is wrong there
        ([-1, -1, 7, 7], [0, 0, 0, 1], (1 / 4, 1 / 2, 0, 1)),
        ([-1, 7], [0, 0], (0.0, 0.0, 0, 1)),
        # of equally frequent truths the least counts
        ([9, 3], [0, 0], (1 / 2, 1 / 2, 0, 0)),
        # what is not known counts in neither
        ([7, 7, 2], [NOT_KNOWN, 0, NOT_KNOWN], (1.0, 1.0, 0, 0)),
        ([7, 7], [NOT_KNOWN, NOT_KNOWN], (None, None, 0, 0)),
    ],
)
def test_association_is_counted_as_by_hand(
    truth: list[int], assigned: list[int], expected: tuple[float | None, float | None, int, int]
) -> None:
    assert counted(truth, assigned) == expected


def test_truth_of_landmarks_is_by_number() -> None:
    log = log_of([5, 5, 8, -1, -1, 8, 5])
    assert assigned_truth(log, np.array([2, 2, 2, 0, -1, 7, NOT_KNOWN])) == {2: 5, 0: -1, 7: 8}


SIGHTINGS = st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 5)), max_size=30)


def slow(pairs: list[tuple[int, int]]) -> tuple[int, int, int, int, int, int]:
    """The definitions, literally."""
    of: dict[int, list[int]] = {}
    for truth, number in pairs:
        if number >= 0:
            of.setdefault(number, []).append(truth)
    truth_of = {n: min(set(t), key=lambda each: (-t.count(each), each)) for n, t in of.items()}
    best = {}
    for truth in set(truth_of.values()) - {-1}:
        best[truth] = min((n for n in of if truth_of[n] == truth), key=lambda n: (-len(of[n]), n))
    given = [(truth, number) for truth, number in pairs if number >= 0]
    return (
        len(given),
        sum(truth == truth_of[number] != -1 for truth, number in given),
        sum(truth >= 0 for truth, _ in pairs),
        sum(truth >= 0 and best.get(truth) == number for truth, number in given),
        sum(truth >= 0 for truth in truth_of.values()) - len(best),
        sum(truth < 0 for truth in truth_of.values()),
    )


@given(SIGHTINGS)
def test_association_is_what_the_definitions_say(pairs: list[tuple[int, int]]) -> None:
    found = associate(log_of([t for t, _ in pairs]), np.array([n for _, n in pairs], np.int64))
    assert tuple(vars(found).values()) == slow(pairs)


@given(st.lists(SIGHTINGS, max_size=4))
def test_a_fleets_counts_are_the_sums_of_its_vehicles(fleet: list[list[tuple[int, int]]]) -> None:
    logs = {f"v{i}": log_of([t for t, _ in pairs]) for i, pairs in enumerate(fleet)}
    assigned = {f"v{i}": np.array([n for _, n in pairs], np.int64) for i, pairs in enumerate(fleet)}
    whole = fleet_association(Recording(landmarks=np.zeros((5, 2)), logs=logs, skipped={}), assigned)
    each = [associate(log, assigned[name]) for name, log in logs.items()]
    for field in vars(Association()):
        assert getattr(whole, field) == sum(getattr(one, field) for one in each)


@pytest.fixture(scope="module")
def run() -> FinishedRun:
    return run_virtual("fleet", *SMALL)


def test_known_signatures_are_all_assigned_rightly(run: FinishedRun) -> None:
    report = evaluate_run(run).report
    perfect = {
        "association_precision": 1.0, "association_recall": 1.0, "duplicate_landmarks": 0, "spurious_landmarks": 0
    }  # fmt: skip
    for row in (report, *report["vehicles"].values()):
        assert {field: row[field] for field in perfect} == perfect
    assert report["doubtful_vehicles"] == []
    for name, log in run.recording.logs.items():
        drive = run.drives[name]
        np.testing.assert_array_equal(drive.signatures[drive.assigned], log.sighting_signature)


def test_scores_do_not_look_at_signatures(run: FinishedRun) -> None:
    logs = {
        name: replace(log, sighting_signature=np.full_like(log.sighting_signature, -1))
        for name, log in run.recording.logs.items()
    }
    hidden = replace(run, recording=replace(run.recording, logs=logs))
    assert evaluate_run(hidden).report == evaluate_run(run).report


def test_what_a_vehicle_process_hands_over_is_read_back(run: FinishedRun, tmp_path: Path) -> None:
    drive = run.drives["v2"]
    output.write_drive(tmp_path / "v2.npz", drive)
    for field, value in vars(output.read_drive(tmp_path / "v2.npz")).items():
        np.testing.assert_array_equal(value, getattr(drive, field))


@pytest.mark.parametrize("state_bytes", [500, 64 * 1024])
def test_a_vehicle_that_was_killed_knows_its_earlier_assignments(
    run: FinishedRun, state_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether all readings are kept, or the filter's state in the place of the earlier ones."""
    monkeypatch.setattr(core, "STATE_BYTES_LEAST", state_bytes)
    kills = ", ".join(f'{{at_s={at_s}, what="kill", who="v1", for_s=0.2}}' for at_s in (1.0, 4.5))
    killed = run_virtual("fleet", *SMALL, "run.rate_hz=10", f"faults.events=[{kills}]")
    assert killed.streams["v1"]["epochs"] == 3
    for name, drive in killed.drives.items():
        np.testing.assert_array_equal(drive.assigned, run.drives[name].assigned)


def test_assignments_that_do_not_fit_the_sightings_are_not_known() -> None:
    told: Ints = np.zeros(3, np.int64)
    for sightings, expected in ((3, [0, 0, 0]), (4, [NOT_KNOWN] * 4)):
        result = Notes(2, sightings).result(np.empty((0, 2)), [], told, Counters())
        assert result.assigned.tolist() == expected


def solved(run: FinishedRun) -> tuple[JointSolution, Floats]:
    lives = run.ledger.lives()
    solution = solve(lives, run.ledger.classes(lives))
    return solution, marginal_covariances(solution)[0]


def scored(run: FinishedRun, of_v2: dict[int, int]) -> MapScore:
    return score_map(*solved(run), run.recording, {**run.truths, "v2": of_v2})


def test_merges_are_judged_by_the_truth_of_each_landmark_and_not_by_signature(run: FinishedRun) -> None:
    plain, truths = scored(run, dict(run.truths["v2"])), run.truths["v2"]
    assert plain.merges > 0
    assert (plain.wrong_merges, plain.missed_merges) == (0, 0)
    of_v1, cyclic = set(run.truths["v1"].values()), sorted(truths.values())
    shared = [t for t in truths.values() if t in of_v1]
    one = next(number for number, truth in truths.items() if truth == shared[0])
    other = next(number for number, truth in truths.items() if truth == shared[1])
    swapped = scored(run, {**truths, one: truths[other], other: truths[one]})
    assert (swapped.wrong_merges, swapped.missed_merges) == (2, 2)
    spurious = scored(run, {**truths, one: -1})
    assert (spurious.wrong_merges, spurious.missed_merges) == (1, 0)
    unseen = next(t for t in range(1000) if t not in cyclic)
    assert scored(run, {**truths, one: unseen}).wrong_merges == 1


def test_a_landmark_that_is_none_has_no_truth_and_no_error(run: FinishedRun) -> None:
    solution, _ = solved(run)
    nothing = {name: dict.fromkeys(truths, -1) for name, truths in run.truths.items()}
    assert set(landmark_truths(solution, nothing).tolist()) == {-1}
    log, drive = run.recording.logs["v1"], run.drives["v1"]
    unknown = replace(drive, assigned=np.full_like(drive.assigned, NOT_KNOWN))
    assert score_vehicle(unknown, log, run.recording.landmarks)["landmark_rmse_m"] is None
    assert score_vehicle(drive, log, run.recording.landmarks)["landmark_rmse_m"] is not None


def test_a_vehicle_that_says_so_is_doubtful() -> None:
    run = run_virtual("fleet", *SMALL, "world.steps=30")
    life = next(stream.life for stream in run.ledger.streams.values() if stream.vehicle == "v2")
    assert life is not None
    life.healthy = False
    assert evaluate_run(run).report["doubtful_vehicles"] == ["v2"]
