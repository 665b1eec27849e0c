"""The local map against a textbook EKF with numeric Jacobians, and its laws."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fleet_seif.config import FilterSettings
from fleet_seif.ekf import Ekf
from fleet_seif.errors import NumericalError
from fleet_seif.local_map import (
    LocalMap,
    begun_at,
    expected,
    from_pose_std,
    in_reach,
    in_view,
    kept,
    moved,
    nothing_known,
    seen_from,
    sighted,
    with_new,
)
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats, Ints
from tests import reference
from tests.drives import drive, square
from tests.strategies import finite, poses, settled, spd, vectors

MODELS = st.sampled_from([RANGE_BEARING, COMPASS_XY])


class Case(NamedTuple):
    """A local map, some of its landmarks, and sightings of them."""

    model: int
    local: LocalMap
    which: Ints
    z: Floats
    Z: Floats


@st.composite
def cases(draw: st.DrawFn, least: int = 0) -> Case:
    """Landmarks all around the pose, 0.5 m away at least, everything correlated with everything."""
    model, pose, k = draw(MODELS), draw(poses()), draw(st.integers(least, 3))
    away, angle = (draw(st.lists(each, min_size=k, max_size=k)) for each in (st.floats(0.5, 9.0), finite(3.2)))
    landmarks = pose[:2] + np.array([[r * np.cos(a), r * np.sin(a)] for r, a in zip(away, angle)]).reshape(k, 2)
    P = 0.01 * draw(spd(3 + 2 * k, least=0.01))
    local = LocalMap(np.concatenate([pose, landmarks.ravel()]), (P + P.T) / 2, 7 + np.arange(k))
    chosen = draw(st.permutations(range(k)))[: draw(st.integers(least, k))]
    which = np.array(chosen, np.int64)
    z = np.array([reference.expected(model, pose, landmarks[i]) + 0.1 * draw(vectors(2, 1.0)) for i in chosen])
    Z = np.array([0.01 * draw(spd(2)) for _ in chosen])
    return Case(model, local, which, z.reshape(-1, 2), Z.reshape(-1, 2, 2))


def bits(*arrays: Floats | Ints | LocalMap) -> list[bytes]:
    found: list[bytes] = []
    for each in arrays:
        found += bits(each.mean, each.P, each.keys) if isinstance(each, LocalMap) else [each.tobytes()]
    return found


def close(a: Floats, b: Floats) -> None:
    np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7 * (1.0 + float(np.max(np.abs(b), initial=0.0))))


def assert_covariance(P: Floats) -> None:
    np.testing.assert_allclose(P, P.T, atol=1e-12 * float(np.max(np.abs(P))))
    assert np.linalg.eigvalsh((P + P.T) / 2)[0] >= -1e-9 * float(np.max(np.abs(P)))


def sightings(case: Case) -> tuple[Floats, Floats]:
    """What is expected, and J (2 m, n), by differences; bearings are taken from there on, so that none wraps."""
    mean = case.local.mean

    def h(state: Floats, i: int) -> Floats:
        return reference.expected(case.model, state[:3], state[3 + 2 * i : 5 + 2 * i])

    at = np.array([h(mean, i) for i in case.which.tolist()]).reshape(-1, 2)

    def off(state: Floats) -> Floats:
        return np.concatenate(
            [np.empty(0), *(reference.difference(case.model, h(state, i), at[m]) for m, i in enumerate(case.which))]
        )

    return at, reference.numeric_jacobian(off, mean).reshape(2 * len(at), len(mean))


def test_at_the_start_of_a_frame_the_pose_is_exactly_the_origin() -> None:
    local = nothing_known()
    assert not np.any(local.mean)
    assert not np.any(local.P)
    assert local.landmarks.shape == (0, 2)


@given(cases(), vectors(3, 1.0), spd(3))
@settled
def test_a_motion_is_the_textbook_prediction(case: Case, u: Floats, cov: Floats) -> None:
    cov = 0.01 * (cov + cov.T)
    before = bits(case.local, u, cov)
    after = moved(case.model, case.local, u, cov)

    def g(s: Floats) -> Floats:
        return np.concatenate([reference.moved(case.model, s[:3], s[-3:]), s[3:-3]])

    J = reference.numeric_jacobian(g, np.concatenate([case.local.mean, u]))
    n = len(case.local.mean)
    close(after.mean, g(np.concatenate([case.local.mean, u])))
    close(after.P, J[:, :n] @ case.local.P @ J[:, :n].T + J[:, n:] @ cov @ J[:, n:].T)
    assert_covariance(after.P)
    assert bits(case.local, u, cov) == before


@given(cases())
@settled
def test_sightings_are_the_textbook_update(case: Case) -> None:
    local, before = case.local, bits(*case[1:])
    after, squared = sighted(case.model, local, case.which, case.z, case.Z)
    h, J = sightings(case)
    S = J @ local.P @ J.T
    for i, Z in enumerate(case.Z):
        S[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += Z
    r = np.array([reference.difference(case.model, *pair) for pair in zip(case.z, h)]).ravel()
    gain = local.P @ J.T @ np.linalg.inv(S)
    close(after.mean, local.mean + gain @ r)
    close(after.P, local.P - gain @ S @ gain.T)
    assert squared == pytest.approx(float(r @ np.linalg.inv(S) @ r), rel=1e-6, abs=1e-9)
    assert_covariance(after.P)
    assert np.array_equal(after.keys, local.keys)
    assert bits(*case[1:]) == before


@given(cases(least=1))
@settled
def test_what_is_expected_has_the_covariance_of_its_linear_prediction(case: Case) -> None:
    before = bits(case.local, case.which)
    h, C = expected(case.model, case.local.mean, case.local.P, case.which)
    at, J = sightings(case)
    close(h, at)
    close(C, J @ case.local.P @ J.T)
    assert_covariance(C)
    assert bits(case.local, case.which) == before


@given(cases(least=1))
@settled
def test_a_new_landmark_is_where_the_sighting_puts_it_with_all_its_correlations(case: Case) -> None:
    local, z, Z = case.local, case.z[0], case.Z[0]
    assume(case.model == COMPASS_XY or z[0] > 0.1)
    before = bits(*case[1:])
    after = with_new(case.model, local, -5, z, Z)
    n = len(local.mean)

    def f(s: Floats) -> Floats:
        return np.concatenate([s[:n], reference.placed(case.model, s[:3], s[n:])])

    J = reference.numeric_jacobian(f, np.concatenate([local.mean, z]))
    close(after.mean, f(np.concatenate([local.mean, z])))
    close(after.P, J[:, :n] @ local.P @ J[:, :n].T + J[:, n:] @ Z @ J[:, n:].T)
    assert_covariance(after.P)
    assert after.keys.tolist() == [*local.keys.tolist(), -5]
    assert bits(*case[1:]) == before


def assert_transformed(after: LocalMap, f: Callable[[Floats], Floats], mean: Floats, P: Floats) -> None:
    """after: f of a Gaussian, its pose the origin, known exactly."""
    J = reference.numeric_jacobian(f, mean).reshape(-1, len(mean))
    assert not np.any(after.mean[:3])
    assert not np.any(after.P[:3])
    close(after.mean[3:], f(mean))
    close(after.P[3:, 3:], J @ P @ J.T)
    assert_covariance(after.P)


def from_first(s: Floats) -> Floats:
    """Landmarks as seen from the pose before them."""
    views = [reference.seen_from(s[:3], y) for y in s[3:].reshape(-1, 2)]
    return np.array(views).ravel()


@given(cases())
@settled
def test_seen_from_a_pose_landmarks_have_the_covariance_of_pose_and_landmarks_together(case: Case) -> None:
    local, before = case.local, bits(case.local)
    after = seen_from(local.pose, local.landmarks, local.P, local.keys)
    assert_transformed(after, from_first, local.mean, local.P)
    assert bits(local) == before


@given(cases())
@settled
def test_a_map_begun_at_its_pose_is_the_map_as_seen_from_there(case: Case) -> None:
    local, before = case.local, bits(case.local)
    after = begun_at(local)
    assert_transformed(after, from_first, local.mean, local.P)
    assert np.array_equal(after.keys, local.keys)
    assert bits(local) == before


def test_the_covariance_seen_from_a_pose_is_that_of_samples() -> None:
    rng = np.random.default_rng(4)
    A = 0.01 * rng.standard_normal((7, 7))
    start, landmarks = np.array([1.0, -2.0, 2.5]), np.array([[3.0, 1.0], [-1.0, 0.5]])
    mean = np.concatenate([start, landmarks.ravel()])
    after = seen_from(start, landmarks, A @ A.T, np.arange(2))
    samples = np.array([from_first(mean + A @ rng.standard_normal(7)) for _ in range(20_000)])
    sigma = np.sqrt(np.diag(after.P)[3:])
    assert np.max(np.abs(np.cov(samples.T) - after.P[3:, 3:]) / np.outer(sigma, sigma)) < 0.05


@given(cases(), st.data())
@settled
def test_what_is_kept_is_the_marginal_in_the_order_asked_for(case: Case, data: st.DataObject) -> None:
    local, before = case.local, bits(case.local)
    chosen = data.draw(st.permutations(range(len(local.keys))))[: data.draw(st.integers(0, len(local.keys)))]
    after = kept(local, np.array(chosen, np.int64))
    assert np.array_equal(after.keys, local.keys[chosen])
    assert np.array_equal(after.landmarks, local.landmarks[chosen])
    rows = [0, 1, 2, *(3 + 2 * i + axis for i in chosen for axis in (0, 1))]
    assert np.array_equal(after.P, np.array([[local.P[i, j] for j in rows] for i in rows]))
    assert bits(local) == before


def from_pose(local: LocalMap, i: int) -> Floats:
    """Covariance of where landmark i is from the pose, along the axes of the map, by matrices."""
    G = np.zeros((2, len(local.mean)))
    G[:, :2], G[:, 3 + 2 * i : 5 + 2 * i] = -np.eye(2), np.eye(2)
    return np.asarray(G @ local.P @ G.T)


@given(cases(), st.floats(0.0, 10.0), st.floats(0.0, 5.0))
@settled
def test_in_reach_is_what_may_be_nearer_given_how_uncertain_it_is(case: Case, reach: float, sigmas: float) -> None:
    local = case.local
    found = in_reach(local.mean, local.P, reach, sigmas).tolist()
    distance = np.hypot(*(local.landmarks - local.pose[:2]).T)
    most = [reach + sigmas * np.sqrt(np.trace(from_pose(local, i))) for i in range(len(distance))]
    assume(all(abs(d - m) > 1e-9 for d, m in zip(distance, most)))
    assert found == [i for i in range(len(distance)) if distance[i] <= most[i]]
    for i in range(len(distance)):
        if distance[i] <= reach + sigmas * from_pose_std(local.P, i):  # none that could be is left out
            assert i in found


@given(cases(least=1))
@settled
def test_from_pose_std_is_the_longest_axis_of_the_ellipse(case: Case) -> None:
    for i in range(len(case.local.keys)):
        worst = np.sqrt(np.linalg.eigvalsh(from_pose(case.local, i))[-1])
        assert from_pose_std(case.local.P, i) == pytest.approx(worst, rel=1e-6)


@pytest.mark.parametrize("model", [RANGE_BEARING, COMPASS_XY])
def test_over_a_whole_drive_it_is_the_dense_ekf(model: int) -> None:
    """Where new landmarks enter before the others are looked at, as there."""
    log = drive(square(12, 4.0, 1), steps=100, seed=2, model=model)
    settings = FilterSettings(gate=1e300)
    ekf = Ekf(settings, model)
    local = LocalMap(np.zeros(3), np.eye(3) / settings.start_information, np.empty(0, np.int64))
    for k in range(len(log.readings) + 1):
        seen = log.start if k == 0 else log.readings[k - 1].sightings
        if k == 0:
            ekf.start(seen)
        else:
            ekf.step(log.readings[k - 1])
            local = moved(model, local, log.readings[k - 1].odometry, log.readings[k - 1].odometry_cov)
        known = np.isin(seen.signature, local.keys)
        for i in np.flatnonzero(~known).tolist():
            local = with_new(model, local, int(seen.signature[i]), seen.z[i], seen.cov[i])
        which = np.array([local.keys.tolist().index(key) for key in seen.signature[known].tolist()], np.int64)
        local, _ = sighted(model, local, which, seen.z[known], seen.cov[known])
    P = ekf.covariance_of(range(12))
    sigma = np.sqrt(np.diag(P))
    assert local.keys.tolist() == ekf.signatures
    assert np.max(np.abs(local.mean - ekf.mean()) / sigma) < 1e-6
    assert np.max(np.abs(local.P - P) / np.outer(sigma, sigma)) < 1e-6
    assert_covariance(local.P)


def test_no_sightings_change_nothing() -> None:
    local = LocalMap(np.arange(5.0), np.eye(5), np.array([3]))
    assert sighted(RANGE_BEARING, local, np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2))) == (local, 0.0)


def test_a_covariance_that_is_none_is_a_numerical_error() -> None:
    local = LocalMap(np.array([0.0, 0.0, 0.0, 1.0, 0.0]), np.eye(5), np.array([3]))
    with pytest.raises(NumericalError, match="positive definite"):
        sighted(RANGE_BEARING, local, np.zeros(1, np.int64), np.array([[1.0, 0.0]]), -9.0 * np.eye(2)[None])


@given(
    st.integers(0, 2**32 - 1), st.floats(0.1, 3.0), st.floats(0.0, np.pi), st.sampled_from([RANGE_BEARING, COMPASS_XY])
)
@settled
def test_in_view_is_what_lies_near_and_ahead(seed: int, reach_m: float, bearing: float, model: int) -> None:
    mean = np.random.default_rng(seed).uniform(-3.0, 3.0, 23)
    d = mean[3:].reshape(-1, 2) - mean[:2]
    angle = np.angle(np.exp(1j * (np.arctan2(d[:, 1], d[:, 0]) - mean[2])))
    inside = (np.hypot(*d.T) <= reach_m) & ((np.abs(angle) <= bearing) | (model == COMPASS_XY))
    assert in_view(model, mean, reach_m, bearing).tolist() == np.flatnonzero(inside).tolist()
