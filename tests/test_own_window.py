"""The window of a vehicle's own map against the whole map: what is near is in it, it is never surer, it stays small."""

from functools import cache

import msgpack
import numpy as np
import pytest

from fleet_seif import own_map, own_window
from fleet_seif.errors import NumericalError
from fleet_seif.frame_deltas import quantised
from fleet_seif.geometry import act, compose
from fleet_seif.information import FrameDelta, to_information
from fleet_seif.local_map import LocalMap
from fleet_seif.own_map import OwnMap
from fleet_seif.own_window import RECENT, SEEN_IN, carried, chain, joined, nearby, starts, view
from fleet_seif.records import Floats, Ints
from tests import reference
from tests.refresh import Drive, fleet

FRAMES = 60
REACH_M = 1.2
MOST = 12


@cache
def driven() -> Drive:
    """Nearly three times over the same 100 square metres."""
    return fleet(100, 1, FRAMES, 0.15)[0]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_map, "WHOLE_FRAMES", 8)
    monkeypatch.setattr(own_window, "RECENT", 4)


def filled(frames: int) -> OwnMap:
    """After so many frames, looked around when each closed."""
    own = OwnMap()
    for k, delta in enumerate(driven().frames[:frames]):
        own.put(k, delta)
        own.around(MOST, REACH_M)
    return own


def both(frames: int) -> tuple[LocalMap, LocalMap, int]:
    """What is around by the window and by all frames, landmarks that are in both; how many frames are in the window."""
    own, whole = filled(frames), OwnMap()
    for k, delta in enumerate(driven().frames[:frames]):
        whole.put(k, delta)
    a, _ = own.around(MOST, REACH_M)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(own_map, "WHOLE_FRAMES", FRAMES)
        b, _ = whole.around(MOST, REACH_M)
    assert len(set(a.keys.tolist()) & set(b.keys.tolist())) >= MOST - 1
    shared = np.intersect1d(a.keys, b.keys)
    return part(a, shared), part(b, shared), len(own._numbers)


def part(local: LocalMap, keys: Ints) -> LocalMap:
    at = np.array([local.keys.tolist().index(key) for key in keys.tolist()])
    rows = (3 + 2 * at[:, None] + np.arange(2)).ravel()
    return LocalMap(local.mean[rows], local.P[np.ix_(rows, rows)], local.keys[at])


@pytest.mark.parametrize("frames", [25, 40, 60])
@pytest.mark.usefixtures("small")
def test_a_window_is_never_surer_than_the_whole_map_and_within_what_it_says_the_same(frames: int) -> None:
    """In no direction is its variance smaller, but for where the two are linearised."""
    window, whole, _ = both(frames)
    L = np.linalg.cholesky(whole.P)
    ratios = np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, window.P).T))
    assert ratios[0] > 0.99
    assert ratios[-1] > 1.05  # something is left out
    off = window.mean - whole.mean
    assert off @ np.linalg.solve(window.P, off) < 2.0 * len(off)


@pytest.mark.usefixtures("small")
def test_a_window_does_not_grow_with_the_way_driven() -> None:
    sizes = [both(frames)[2] for frames in (20, 40, 60)]
    assert max(sizes) < 20


def test_without_a_limit_it_is_the_whole_map_to_the_bit() -> None:
    own = filled(10)
    views = [view(delta) for delta in own.frames]
    deltas, numbers = chain(own.frames, views, np.ones(10), np.arange(10))
    assert deltas == own.frames
    assert numbers.tolist() == list(range(10))


@pytest.mark.usefixtures("small")
def test_it_goes_on_from_its_state_to_the_bit_though_old_frames_are_corrected_and_landmarks_joined() -> None:
    plain, again = OwnMap(), OwnMap()
    for k, delta in enumerate(driven().frames[:24]):
        restored = OwnMap()
        restored.restore(msgpack.unpackb(msgpack.packb(again.state()), use_list=False))
        again = restored
        for own in (plain, again):
            own.put(k, delta)
            if k > 12:
                own.put(k - 12, driven().frames[k - 12])  # the same numbers, as another object
        (near, travel_m), (other, other_travel_m) = plain.around(MOST, REACH_M), again.around(MOST, REACH_M)
        assert all(reference.same(*pair) for pair in ((near.mean, other.mean), (near.P, other.P)))
        assert (near.keys.tolist(), travel_m, plain.misfit) == (other.keys.tolist(), other_travel_m, again.misfit)
        if k == 15:
            for own in (plain, again):
                own.aliases.append((int(near.keys[0]), int(near.keys[1])))
        assert again.state() == plain.state()
    restored = OwnMap()
    restored.restore(plain.state())
    assert restored.misfit == plain.misfit > 0.0


@pytest.mark.usefixtures("small")
def test_a_frame_that_has_changed_is_in_the_window_however_old_it_is() -> None:
    own = filled(40)
    away = int(np.setdiff1d(np.arange(40), own._numbers)[0])
    own.put(away, driven().frames[away])
    own.around(MOST, REACH_M)
    assert away in own._numbers
    own.around(MOST, REACH_M)
    assert away not in own._numbers


@pytest.mark.usefixtures("small")
def test_the_map_until_a_frame_has_what_changed_before_it_in_its_window() -> None:
    """Where this map could not be solved since."""
    own = filled(30)
    away = int(np.setdiff1d(np.arange(30), own._numbers)[0])
    own.put(away, driven().frames[away])
    own.put(29, driven().frames[29])
    earlier = own.until(29, 0)
    earlier.around(MOST, REACH_M)
    assert away in earlier._numbers
    assert 29 not in earlier._numbers


@pytest.mark.usefixtures("small")
def test_around_the_start_of_a_frame_that_is_not_in_the_window_nothing_is_known() -> None:
    own = filled(40)
    gone = int(np.setdiff1d(np.arange(40), own._numbers)[0])
    with pytest.raises(NumericalError, match="no own map"):
        own.around_start(gone, MOST)
    assert len(own.around_start(39, MOST).keys) == MOST


def test_of_each_landmark_around_the_newest_frames_that_saw_it_are_in_the_window() -> None:
    frames = driven().frames
    views = [view(delta) for delta in frames]
    at = starts(np.empty((0, 3)), views)
    numbers = 1 + max(int(each.numbers.max()) for each in views)
    found = nearby(views, at, np.arange(numbers), MOST, {3}).tolist()
    assert {3, *range(FRAMES - RECENT, FRAMES)} <= set(found)
    where: dict[int, list[tuple[int, float]]] = {}
    for f, each in enumerate(views):
        for number, y in zip(each.numbers.tolist(), each.landmarks):
            away = float(np.hypot(*(act(at[f], y) - at[-1, :2])))
            where.setdefault(number, []).append((f, away))
    nearest = sorted(where, key=lambda number: min(away for _, away in where[number]))[:MOST]
    assert {f for number in nearest for f, _ in where[number][-SEEN_IN:]} <= set(found)


def test_joined_frames_are_their_ends_one_after_the_other() -> None:
    views = [view(delta) for delta in driven().frames[:7]]
    weights = np.array([1.0, 1.0, 0.5, 1.0, 0.1, 1.0, 1.0])
    whole = joined(views, weights)

    def end(ends: Floats) -> Floats:
        pose = ends[:3]
        for each in ends[3:].reshape(-1, 3):
            pose = compose(pose, each)
        return pose

    ends = np.concatenate([each.end for each in views])
    J = reference.numeric_jacobian(end, ends)
    parts = [J[:, 3 * k : 3 * k + 3] for k in range(len(views))]
    P = sum(part @ each.end_cov @ part.T / w for part, each, w in zip(parts, views, weights.tolist(), strict=True))
    info = to_information(whole)
    assert whole.variables.tolist() == [0]
    np.testing.assert_allclose(np.linalg.inv(info.H.toarray()), P, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(info.H.toarray(), info.b), end(ends), atol=1e-6)


def test_a_view_is_the_mean_and_the_marginal_of_the_end() -> None:
    delta = driven().frames[0]
    info, seen = to_information(delta), view(delta)
    P = np.linalg.inv(info.H.toarray())
    np.testing.assert_allclose(seen.end_cov, P[:3, :3], rtol=1e-7)
    np.testing.assert_allclose(np.concatenate([seen.end, seen.landmarks.ravel()]), P @ info.b, rtol=1e-7, atol=1e-9)
    assert seen.numbers.tolist() == (delta.variables[1:] - 1).tolist()


def test_a_frame_that_says_nothing_or_is_not_positive_definite_has_no_view() -> None:
    bad = quantised(np.zeros(1, np.int64), np.eye(3), np.zeros(3), np.zeros(3))
    bad = FrameDelta(variables=bad.variables, rows=bad.rows, cols=bad.cols, H=-bad.H, b=bad.b)
    for delta in (FrameDelta.nothing(), bad):
        with pytest.raises(NumericalError):
            view(delta)


def test_frames_that_are_left_out_move_with_both_ends_of_their_gap() -> None:
    rng = np.random.default_rng(3)
    old = rng.normal(size=(9, 3))
    numbers = np.array([2, 4, 8])
    assert reference.same(carried(old, numbers, old[numbers])[numbers], old[numbers])
    np.testing.assert_allclose(carried(old, numbers, old[numbers]), old, atol=1e-12)
    T = np.array([3.0, -1.0, 0.7])  # moved as one, they stay as they lie to each other

    def moved(pose: Floats) -> Floats:
        return compose(T, pose)

    new = np.array([moved(pose) for pose in old])
    np.testing.assert_allclose(carried(old, numbers, new[numbers])[2:], new[2:], atol=1e-12)
    assert np.array_equal(carried(old, numbers, new[numbers])[:2], old[:2])
    shifted = old[numbers] + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    found = carried(old, numbers, shifted)
    np.testing.assert_allclose(found[5:8, 0] - old[5:8, 0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found[3], old[3], atol=1e-12)
