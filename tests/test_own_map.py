"""A vehicle's own map: what lies around, against all there is; and that it goes on to the bit."""

import msgpack
import numpy as np
import pytest

from fleet_seif.joint import Life, landmark_classes, solve
from fleet_seif.local_map import LocalMap
from fleet_seif.own_map import TRAVEL_LEAST, OwnMap, first_names
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats
from tests import reference
from tests.refresh import Drive, fleet

FRAMES = 6
DRIVE: Drive = fleet(50, 1, FRAMES, 0.3)[0]
REACH_M = 1.2


def filled(frames: int = FRAMES) -> OwnMap:
    """After so many frames, each solved when it closed."""
    own = OwnMap()
    for k, frame in enumerate(DRIVE.frames[:frames]):
        own.put(k, frame)
        own.around(20, REACH_M)
    return own


def whole(own: OwnMap) -> tuple[Floats, Floats, dict[int, Floats]]:
    """The map solved from nothing: its newest pose, the dense covariance of everything, landmarks by number."""
    life = Life(
        vehicle="", life=0, start_pose=np.zeros(3), start_pose_cov=np.zeros((3, 3)), frames=tuple(own.frames),
        signatures=(UNKNOWN_SIGNATURE,) * len(DRIVE.shown), aliases=tuple(own.aliases),
    )  # fmt: skip
    solution = solve([life], landmark_classes([life]))
    landmarks = {n[0].number: y for n, y in zip(solution.classes, solution.landmark_mean, strict=True)}
    return solution.pose_mean[-1], np.linalg.inv(solution.H.toarray()), landmarks


@pytest.mark.parametrize("most", [3, 10, 1000])
def test_what_is_around_is_the_nearest_as_seen_from_the_end_of_the_last_frame(most: int) -> None:
    own = filled()
    near, travel_m = own.around(most, REACH_M)
    pose, P, landmarks = whole(own)
    away = {n: float(np.hypot(*(y - pose[:2]))) for n, y in landmarks.items()}
    nearest = sorted(away, key=lambda n: away[n])
    assert near.keys.tolist() == sorted(nearest[:most])
    place = {n: 2 * i for i, n in enumerate(landmarks)}
    rows = [len(P) - 3, len(P) - 2, len(P) - 1, *(place[n] + axis for n in near.keys.tolist() for axis in (0, 1))]
    mean = np.concatenate([pose, *(landmarks[n] for n in near.keys.tolist())])

    def view(s: Floats) -> Floats:
        return np.array([reference.seen_from(s[:3], y) for y in s[3:].reshape(-1, 2)]).ravel()

    J = reference.numeric_jacobian(view, mean)
    expected = J @ P[np.ix_(rows, rows)] @ J.T
    sigma = np.sqrt(np.diag(expected))
    assert np.max(np.abs(near.mean[3:] - view(mean)) / sigma) < 1e-2
    assert np.max(np.abs(near.P[3:, 3:] - expected) / np.outer(sigma, sigma)) < 1e-3
    assert not np.any(near.P[:3])
    if most >= len(landmarks):
        assert travel_m == np.inf
    else:
        assert travel_m == pytest.approx(max(away[nearest[most]] - REACH_M, TRAVEL_LEAST * REACH_M), abs=1e-2)


def test_within_the_way_it_may_travel_nothing_is_in_reach_that_is_not_around() -> None:
    own, tried = filled(), 0
    pose, _, landmarks = whole(own)
    for most in range(8, 40):
        near, travel_m = own.around(most, REACH_M)
        if travel_m <= TRAVEL_LEAST * REACH_M:  # more than the map could hold
            continue
        for angle in np.linspace(0.0, 6.0, 7):
            at = pose[:2] + 0.999 * travel_m * np.array([np.cos(angle), np.sin(angle)])
            within = {n for n, y in landmarks.items() if np.hypot(*(y - at)) < REACH_M - 1e-2}
            assert within <= set(near.keys.tolist())
            tried += 1
    assert tried > 50


def same(a: LocalMap, b: LocalMap) -> bool:
    return all(reference.same(*pair) for pair in ((a.mean, b.mean), (a.P, b.P), (a.keys, b.keys)))


def test_it_goes_on_from_its_state_to_the_bit_though_frames_are_corrected_and_landmarks_joined() -> None:
    plain, again = OwnMap(), OwnMap()
    for k, frame in enumerate(DRIVE.frames):
        restored = OwnMap()
        restored.restore(msgpack.unpackb(msgpack.packb(again.state()), use_list=False))
        again = restored
        for own in (plain, again):
            own.put(k, frame)
            if k > 2:
                own.put(k - 2, DRIVE.frames[k - 2])  # the same numbers, as another object
        (near, travel_m), (other, other_travel_m) = plain.around(20, REACH_M), again.around(20, REACH_M)
        assert same(near, other)
        assert travel_m == other_travel_m
        if k == 3:
            pair = sorted(near.keys.tolist())[:2]
            for own in (plain, again):
                own.aliases.append((pair[0], pair[1]))
        assert again.state() == plain.state()


def test_landmarks_that_are_one_are_around_once_under_the_least_number() -> None:
    own = filled(3)
    keys = own.around(1000, REACH_M)[0].keys.tolist()
    a, b, c = keys[0], keys[4], keys[9]
    own.aliases += [(b, c), (a, c)]
    assert set(own.around(1000, REACH_M)[0].keys.tolist()) == set(keys) - {b, c}


def test_the_first_name_is_the_least_of_all_that_are_one_in_whatever_order_they_were_joined() -> None:
    assert first_names([], 3).tolist() == [0, 1, 2]
    assert first_names([(1, 2), (0, 2), (4, 5)], 6).tolist() == [0, 0, 0, 3, 4, 4]
    assert first_names([(3, 5), (1, 4), (4, 5)], 6).tolist() == [0, 1, 2, 1, 1, 1]
