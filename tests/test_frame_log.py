"""The readings of a frame: what sightings are taken for once it is known, against all there is; names; its state."""

import math
from typing import NamedTuple

import msgpack
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.frame_log import AGAIN_GATE, AGAIN_MARGIN, NONE, FrameLog, squared_residuals
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats, Ints
from fleet_seif.seif import Taken
from tests import reference
from tests.strategies import finite, poses, settled, spd, vectors

MODELS = st.sampled_from([RANGE_BEARING, COMPASS_XY])
NOISE = np.diag([0.01, 0.01])


def taken(z: Floats, Z: Floats, names: Ints, u: Floats | None = None) -> Taken:
    return (np.zeros(3) if u is None else u), 1e-4 * np.eye(3), z, Z, names


class Case(NamedTuple):
    """A log; where its poses and landmarks are found to be; names of the landmarks."""

    model: int
    log: FrameLog
    poses: Floats
    names: Ints
    landmarks: Floats


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Two to four poses, up to four landmarks, some of them close to each other; sightings of any of them, or none."""
    model, count, n = draw(MODELS), draw(st.integers(1, 3)), draw(st.integers(1, 4))
    at = np.array([draw(poses()) for _ in range(count)])
    places = np.array([draw(vectors(2, 10.0)) for _ in range(n)])
    for j in range(1, n):
        if draw(st.booleans()):
            places[j] = places[j - 1] + draw(vectors(2, 0.6))
    names = np.array(draw(st.permutations(range(2, 2 + n))), np.int64)
    log = FrameLog()
    for k in range(count + 1):
        pose, m = (np.zeros(3) if k == 0 else at[k - 1]), draw(st.integers(0, 4))
        of = [draw(st.integers(0, n - 1)) for _ in range(m)]
        z = np.array([reference.expected(model, pose, places[j]) + draw(vectors(2, 0.5)) for j in of]).reshape(m, 2)
        Z = np.array([0.02 * draw(spd(2)) for _ in of]).reshape(m, 2, 2)
        was = np.array(draw(st.lists(st.integers(-4, 6), min_size=m, max_size=m)), np.int64)
        log.add(k > 0, taken(z, Z, was), pose)
    return Case(model, log, at, names, places)


def residual(model: int, x: Floats, y: Floats, z: Floats, Z: Floats) -> float:
    r = reference.difference(model, z, reference.expected(model, x, y))
    return float(r @ np.linalg.inv(Z) @ r)


def decided(case: Case) -> tuple[list[list[int]], bool]:
    """What each sighting is of by the rule itself; and whether any number is so near a limit that rounding decides."""
    found, close = [], False
    for step, was, z, Z in case.log.sightings:
        pose = np.zeros(3) if step == 0 else case.poses[step - 1]
        d2 = [[residual(case.model, pose, y, *each) for y in case.landmarks] for each in zip(z, Z)]
        best = [min(row) for row in d2]
        whose = [row.index(min(row)) for row in d2]
        kept = []
        for i, row in enumerate(d2):
            second = min((d for j, d in enumerate(row) if j != whose[i]), default=math.inf)
            rival = min((best[k] for k in range(len(d2)) if k != i and whose[k] == whose[i]), default=math.inf)
            margins = (AGAIN_GATE - best[i], second - best[i] - AGAIN_MARGIN, rival - best[i] - AGAIN_MARGIN)
            close |= min(abs(margin) for margin in margins) < 1e-6
            fits = all(margin >= 0.0 for margin in margins)
            kept.append(int(case.names[whose[i]]) if fits else min(int(was[i]), NONE))
        found.append(kept)
    return found, close


@given(cases())
@settled
def test_a_sighting_is_decided_again_by_the_residuals_of_all_landmarks(case: Case) -> None:
    before = [names.tolist() for _, names, _, _ in case.log.sightings]
    expected, close = decided(case)
    changed = case.log.decided_again(case.model, case.poses, case.names, case.landmarks)
    after = [names.tolist() for _, names, _, _ in case.log.sightings]
    assert close or after == expected
    assert changed == (after != before)
    again = case.log.decided_again(case.model, case.poses, case.names, case.landmarks)
    assert not again


@given(cases())
@settled
def test_no_landmark_is_sighted_twice_from_a_pose_and_a_provisional_name_stays_where_nothing_fits(case: Case) -> None:
    before = [names.tolist() for _, names, _, _ in case.log.sightings]
    case.log.decided_again(case.model, case.poses, case.names, case.landmarks)
    for was, (_, names, _, _) in zip(before, case.log.sightings):
        told = names[names >= 0].tolist()
        assert len(told) == len(set(told))
        for old, new in zip(was, names.tolist()):
            assert new in case.names or new == min(old, NONE)


def test_where_no_landmark_is_known_nothing_is_decided() -> None:
    log = FrameLog()
    log.add(False, taken(np.array([[1.0, 0.0]]), NOISE[None], np.array([4])), np.zeros(3))
    assert not log.decided_again(RANGE_BEARING, np.empty((0, 3)), np.empty(0, np.int64), np.empty((0, 2)))
    assert log.sightings[0][1].tolist() == [4]


@given(MODELS, poses(), vectors(2), st.lists(vectors(2), min_size=1, max_size=3), spd(2))
@settled
def test_squared_residuals_are_those_of_every_sighting_with_every_landmark(
    model: int, x: Floats, offset: Floats, landmarks: list[Floats], Z: Floats
) -> None:
    places = np.array(landmarks)
    z = np.array([reference.expected(model, x, y) + 0.1 * offset for y in landmarks])
    Zs = np.array([(k + 1.0) * Z for k in range(len(z))])
    d2 = squared_residuals(model, x, places, z, Zs)
    expected = np.array([[residual(model, x, y, *each) for y in places] for each in zip(z, Zs)])
    np.testing.assert_allclose(d2, expected, rtol=1e-6, atol=1e-9)


@given(cases(), st.sets(st.integers(0, 6)))
@settled
def test_guesses_are_known_landmarks_as_they_are_and_others_where_their_first_sighting_puts_them(
    case: Case, known: set[int]
) -> None:
    """Names in the order of what is known, then of the sightings."""
    given_names = sorted(known, reverse=True)
    places = np.array([[float(name), 0.5] for name in given_names]).reshape(-1, 2)
    names, guessed = case.log.guesses(case.model, np.array(given_names, np.int64), places)
    expected = dict(zip(given_names, places.tolist()))
    for step, seen, z, _ in case.log.sightings:
        pose = np.zeros(3) if step == 0 else case.poses[step - 1]
        for name, each in zip(seen.tolist(), z):
            if name >= 0 and name not in expected:
                expected[name] = reference.placed(case.model, pose, each).tolist()
    assert names.tolist() == list(expected)
    np.testing.assert_allclose(guessed, np.array(list(expected.values())).reshape(-1, 2), atol=1e-9)


@given(cases(), st.permutations(range(10)))
@settled
def test_landmarks_are_renamed_wherever_they_stand_and_nothing_else_is(case: Case, names: list[int]) -> None:
    before = [signature.tolist() for _, signature, _, _ in case.log.sightings]
    arrays = [signature for _, signature, _, _ in case.log.sightings]
    case.log.rename(np.array(names))
    after = [signature.tolist() for _, signature, _, _ in case.log.sightings]
    assert after == [[names[key] if key >= 0 else key for key in row] for row in before]
    assert all(a is b for a, (_, b, _, _) in zip(arrays, case.log.sightings))  # whoever shares them sees it


@given(cases(), st.integers(-4, -2), st.integers(0, 9), st.integers(1, 3), st.booleans())
@settled
def test_an_accepted_landmark_has_its_number_wherever_it_stands_and_none_where_it_stands_too_rarely(
    case: Case, old: int, new: int, least: int, restored: bool
) -> None:
    log = FrameLog.restored(msgpack.unpackb(msgpack.packb(case.log.state()), use_list=False)) if restored else case.log
    before = [signature.tolist() for _, signature, _, _ in log.sightings]
    arrays = [signature for _, signature, _, _ in log.sightings]
    log.accept(old, new, least)
    after = [signature.tolist() for _, signature, _, _ in log.sightings]
    name = new if sum(row.count(old) for row in before) >= least else NONE
    assert after == [[name if key == old else key for key in row] for row in before]
    assert all(a is b for a, (_, b, _, _) in zip(arrays, log.sightings))


@given(cases(), finite(1.0))
@settled
def test_a_restored_log_is_the_same_to_the_bit_and_can_be_written_to(case: Case, off: float) -> None:
    log = case.log
    log.heading_variance += abs(off)
    other = FrameLog.restored(msgpack.unpackb(msgpack.packb(log.state()), use_list=False))
    assert msgpack.packb(other.state()) == msgpack.packb(log.state())
    assert other.heading_variance == log.heading_variance
    for ours, theirs in zip(log.sightings, other.sightings, strict=True):
        assert all(reference.same(a, b) for a, b in zip(ours, theirs, strict=True))
    for one, another in zip(log.motions, other.motions, strict=True):
        assert all(reference.same(a, b) for a, b in zip(one, another, strict=True))
    arrays = [array for each in other.sightings for array in each[1:]] + [a for each in other.motions for a in each]
    assert all(isinstance(array, np.ndarray) and array.flags.writeable for array in arrays)
    assert other.decided_again(case.model, case.poses, case.names, case.landmarks) == log.decided_again(
        case.model, case.poses, case.names, case.landmarks
    )
    assert msgpack.packb(other.state()) == msgpack.packb(log.state())


def test_sightings_keep_the_number_of_motions_before_them_and_steps_without_any_are_not_kept() -> None:
    log, none = FrameLog(), np.empty(0, np.int64)
    nothing = taken(np.empty((0, 2)), np.empty((0, 2, 2)), none, np.array([0.1, 0.0, 0.2]))
    log.add(False, taken(np.array([[1.0, 0.0]]), NOISE[None], np.array([4])), np.zeros(3))
    for _ in range(3):
        log.add(True, nothing, np.ones(3))
    log.add(True, taken(np.array([[2.0, 0.0]]), NOISE[None], np.array([-3])), np.ones(3))
    assert [step for step, _, _, _ in log.sightings] == [0, 4]
    assert len(log.motions) == 4
    assert log.heading_variance == 4 * 1e-4


def test_a_sighting_of_nobody_has_no_part_in_the_batch() -> None:
    """The batch over a log whose provisional sightings are somewhere else entirely is the one without them."""
    rng, landmarks = np.random.default_rng(3), np.array([[1.0, 1.0], [2.0, -1.0], [3.0, 0.5]])
    logs = FrameLog(), FrameLog()
    pose = np.zeros(3)
    for k in range(6):
        if k:
            pose = reference.moved(RANGE_BEARING, pose, np.array([0.2, 0.0, 0.05]))
        z = np.array([reference.expected(RANGE_BEARING, pose, y) + 0.01 * rng.standard_normal(2) for y in landmarks])
        Z, names, u = np.tile(NOISE, (3, 1, 1)), np.array([5, 3, 9]), np.array([0.2, 0.0, 0.05])
        logs[0].add(k > 0, taken(z, Z, names.copy(), u), pose)
        wrong = np.array([[7.0, 2.0]])
        logs[1].add(k > 0, taken(np.vstack([wrong, z]), np.vstack([NOISE[None], Z]), np.array([-2, *names]), u), pose)
    batches = [log.solved(RANGE_BEARING, np.array([5, 3, 9]), landmarks, None) for log in logs]
    assert reference.same(batches[0].H, batches[1].H)
    assert reference.same(batches[0].mean, batches[1].mean)
