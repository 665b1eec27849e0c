"""The dense EKF: the same filter as the dense information filter, in moments."""

from collections.abc import Callable

import numpy as np
import pytest

from fleet_seif.config import FilterSettings
from fleet_seif.ekf import Ekf, augmented, predicted
from fleet_seif.errors import NumericalError, ReadingRefused
from fleet_seif.filters import Filter
from fleet_seif.models import COMPASS_XY, RANGE_BEARING, place
from fleet_seif.records import Floats, Reading, Sightings
from tests import reference
from tests.drives import Drive, drive, reading, sighting, square

OPEN = FilterSettings(gate=1e300)
MODELS = pytest.mark.parametrize("model", [RANGE_BEARING, COMPASS_XY])


def run(log: Drive, settings: FilterSettings = OPEN, model: int = RANGE_BEARING) -> Ekf:
    ekf = Ekf(settings, model)
    ekf.start(log.start)
    for each in log.readings:
        ekf.step(each)
    return ekf


def whole(ekf: Ekf) -> Floats:
    return ekf.covariance_of(range(len(ekf.signatures)))


def state_of(ekf: Ekf) -> list[bytes]:
    """Every bit that the filter carries from step to step."""
    return [ekf._mu.tobytes(), ekf._P.tobytes(), repr(ekf._refusals).encode(), repr(ekf.signatures).encode()]


def joined(*parts: Sightings) -> Sightings:
    """What all of these saw, as one."""
    return Sightings(
        z=np.concatenate([part.z for part in parts]),
        cov=np.concatenate([part.cov for part in parts]),
        signature=np.concatenate([part.signature for part in parts]),
    )


def assert_same(ekf: Ekf, dense: reference.DenseEif) -> None:
    """The mean in units of sigma, the covariance as correlations."""
    P = reference.invert(dense.H).astype(float)
    sigma = np.sqrt(np.diag(P))
    assert np.max(np.abs(ekf.mean() - dense.mu) / sigma) < 1e-8
    assert np.max(np.abs(whole(ekf) - P) / np.outer(sigma, sigma)) < 1e-8


@MODELS
def test_it_is_the_dense_information_filter(model: int) -> None:
    log = drive(square(12, 4.0, 1), steps=300, seed=2, model=model)
    ekf: Ekf = Ekf(OPEN, model)
    dense = reference.DenseEif(model, OPEN.start_information)
    ekf.start(log.start)
    dense.see(log.start)
    for k, each in enumerate(log.readings, 1):
        ekf.step(each)
        dense.step(each)
        if k % 50 == 0:
            assert_same(ekf, dense)
    assert len(ekf.landmarks) == 12


@MODELS
def test_a_new_landmark_seen_twice_in_a_step_is_placed_by_one_sighting_and_corrected_by_the_other(model: int) -> None:
    twice = joined(
        sighting((1.0, 0.3), 7),
        sighting((1.2, -0.5), 8, std=(0.05, 0.01)),
        sighting((1.03, 0.27), 7, std=(0.02, 0.05)),
        sighting((0.4, 0.9), 9),
    )
    ekf, dense = Ekf(OPEN, model), reference.DenseEif(model, OPEN.start_information)
    ekf.start(sighting((1.1, 0.3), 8))
    dense.see(sighting((1.1, 0.3), 8))
    result = ekf.step(reading(0.1, twice))
    dense.step(reading(0.1, twice))
    assert_same(ekf, dense)
    assert (result.first_new, result.new, result.active) == (1, (7, 9), 3)


@MODELS
def test_its_jacobians_predict_what_a_small_change_does(model: int) -> None:
    """P after a motion and after a new landmark is J diag(...) J' with numeric Jacobians."""
    mu, u, z = np.array([0.3, -0.2, 1.1, 0.5, 0.9]), np.array([0.1, 0.02, 0.3]), np.array([0.8, -0.6])
    U, Z = np.diag([1e-4, 2e-4, 3e-4]), np.array([[2e-4, 5e-5], [5e-5, 1e-4]])
    root = np.random.default_rng(3).standard_normal((5, 5))
    P = 1e-3 * root @ root.T

    J_x = reference.numeric_jacobian(lambda x: reference.moved(model, x, u), mu[:3])
    J_u = reference.numeric_jacobian(lambda v: reference.moved(model, mu[:3], v), u)
    new_x, rows = predicted(P, mu, model, u, U)
    np.testing.assert_allclose(new_x, reference.moved(model, mu[:3], u), atol=1e-12)
    np.testing.assert_allclose(rows[:, :3], J_x @ P[:3, :3] @ J_x.T + J_u @ U @ J_u.T, atol=1e-10)
    np.testing.assert_allclose(rows[:, 3:], J_x @ P[:3, 3:], atol=1e-10)

    J_y = reference.numeric_jacobian(lambda x: place(model, x, z), mu[:3])
    J_z = reference.numeric_jacobian(lambda v: place(model, mu[:3], v), z)
    J = np.vstack([np.eye(5), np.hstack([J_y, np.zeros((2, 2))])])
    noise = np.zeros((7, 7))
    noise[5:, 5:] = J_z @ Z @ J_z.T
    grown, grown_mu = augmented(P, mu, model, z[None], Z[None])
    np.testing.assert_allclose(grown_mu[5:], place(model, mu[:3], z), atol=1e-12)
    np.testing.assert_allclose(grown, J @ P @ J.T + noise, atol=1e-10)


def test_the_covariance_of_some_landmarks_is_a_block_of_the_whole() -> None:
    ekf = run(drive(square(8, 3.0, 1), steps=60, seed=4))
    P = whole(ekf)
    rows = [0, 1, 2, 3 + 2 * 5, 4 + 2 * 5, 3 + 2 * 2, 4 + 2 * 2]
    np.testing.assert_array_equal(ekf.covariance_of([5, 2]), P[np.ix_(rows, rows)])
    np.testing.assert_array_equal(ekf.covariance_of([]), P[:3, :3])
    np.testing.assert_array_equal(P, P.T)
    for absent in (-1, len(ekf.signatures)):
        with pytest.raises(ValueError, match="landmark numbers"):
            ekf.covariance_of([absent])


def test_many_steps_leave_the_covariance_symmetric() -> None:
    ekf = run(drive(square(10, 4.0, 1), steps=3000, seed=5))
    sigma = np.sqrt(np.diag(ekf._P))
    assert np.max(np.abs(ekf._P - ekf._P.T) / np.outer(sigma, sigma)) < 1e-9


def gated(values: list[tuple[float, float]], patience: int) -> tuple[list[int], list[int], Ekf]:
    """Sightings of landmark 7 one step after the other: which steps refuse it, and in which it counts."""
    ekf = Ekf(FilterSettings(gate=9.0, gate_patience=patience))
    ekf.start(sighting((1.0, 0.0), 7))
    refused, counted = [], []
    for k, z in enumerate(values, 1):
        result = ekf.step(reading(0.1 * k, sighting(z, 7), u=(0.0, 0.0, 0.0)))
        refused.append(result.refused)
        counted.append(result.sightings)
        assert (result.innovation > 0.0) == (result.sightings > 0)
    return refused, counted, ekf


def test_an_outlier_is_refused_until_patience_runs_out() -> None:
    good, bad = (1.001, 0.001), (2.0, 0.0)
    refused, counted, _ = gated([bad, good, bad, bad, bad, good], patience=2)
    assert refused == [1, 0, 1, 1, 0, 1]
    assert counted == [0, 1, 0, 0, 0, 0]


def test_a_refused_sighting_leaves_only_the_motion() -> None:
    still, moved = Ekf(FilterSettings(gate=9.0)), Ekf(FilterSettings(gate=9.0))
    for ekf in (still, moved):
        ekf.start(sighting((1.0, 0.0), 7))
    assert still.step(reading(0.1, sighting((2.0, 0.0), 7))).refused == 1
    moved.step(reading(0.1, Sightings.none()))
    np.testing.assert_array_equal(still.mean(), moved.mean())
    np.testing.assert_array_equal(whole(still), whole(moved))


def test_one_of_two_sightings_may_be_refused() -> None:
    good, bad = sighting((1.001, 0.5), 8), sighting((2.0, 0.0), 7)
    mixed, alone = Ekf(FilterSettings(gate=9.0)), Ekf(FilterSettings(gate=9.0))
    for ekf in (mixed, alone):
        ekf.start(joined(sighting((1.0, 0.0), 7), sighting((1.0, 0.5), 8)))
    a = mixed.step(reading(0.1, joined(bad, good), u=(0.0, 0.0, 0.0)))
    b = alone.step(reading(0.1, good, u=(0.0, 0.0, 0.0)))
    assert (a.refused, a.sightings, b.refused, b.sightings) == (1, 1, 0, 1)
    np.testing.assert_allclose(mixed.mean(), alone.mean(), atol=1e-12)
    np.testing.assert_allclose(whole(mixed), whole(alone), atol=1e-12)


def _changed(field: str, change: Callable[[Floats], None]) -> Reading:
    """A reading with a new and a known landmark, one of its arrays spoilt."""
    good = reading(0.1, joined(sighting((1.0, 0.1), 7), sighting((1.0, 0.4), 99)))
    arrays = {
        "u": good.odometry.copy(),
        "U": good.odometry_cov.copy(),
        "z": good.sightings.z.copy(),
        "Z": good.sightings.cov.copy(),
    }
    change(arrays[field])
    seen = Sightings(z=arrays["z"], cov=arrays["Z"], signature=good.sightings.signature)
    return Reading(time_s=0.1, odometry=arrays["u"], odometry_cov=arrays["U"], sightings=seen)


@pytest.mark.parametrize(
    ("spoilt", "says"),
    [
        (_changed("u", lambda u: u.__setitem__(0, np.nan)), "not finite"),
        (_changed("Z", lambda Z: Z.__setitem__((1, 0, 0), np.inf)), "not finite"),
        (_changed("U", lambda U: U.__setitem__((1, 1), 0.0)), "odometry_cov"),
        (_changed("U", lambda U: U.__setitem__((0, 1), 1.0)), "odometry_cov"),
        (_changed("Z", lambda Z: Z.__setitem__((0, 0, 0), -1.0)), "covariance of a sighting"),
        (_changed("z", lambda z: z.__setitem__((1, 0), 0.0)), "range"),
        (reading(0.1, sighting((1.0, 0.0), -1)), "signature"),
        (reading(0.1, Sightings(z=np.zeros((2, 2)), cov=np.zeros((1, 2, 2)), signature=np.arange(1))), "expected"),
    ],
)
def test_a_refused_reading_leaves_the_filter_as_it_was(spoilt: Reading, says: str) -> None:
    ekf = run(drive(square(8, 3.0, 1), steps=5, seed=4))
    before = state_of(ekf)
    with pytest.raises(ReadingRefused, match=says):
        ekf.step(spoilt)
    assert state_of(ekf) == before


def test_a_covariance_that_broke_down_refuses_the_reading_and_leaves_the_filter_as_it_was() -> None:
    ekf = Ekf(OPEN)
    ekf.start(sighting((1.0, 0.1), 7))
    ekf._P[3:, 3:] *= -1e3
    before = state_of(ekf)
    with pytest.raises(NumericalError, match="reading refused"):
        ekf.step(reading(0.1, joined(sighting((1.0, 0.1), 7), sighting((1.0, 0.4), 99))))
    assert state_of(ekf) == before


def test_it_is_a_filter() -> None:
    ekf: Filter = Ekf(OPEN)
    result = ekf.start(sighting((1.0, 0.1), 7))
    assert len(result.delta.variables) == 0
    assert ekf.signatures == [7]
    np.testing.assert_array_equal(ekf.mean(), np.concatenate([ekf.pose, ekf.landmarks.ravel()]))
