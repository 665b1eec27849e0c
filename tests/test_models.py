"""Motion and sighting models against their plain definitions."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fleet_seif.models import COMPASS_XY, RANGE_BEARING, innovation, move, place, sight
from fleet_seif.records import Floats
from tests import reference
from tests.strategies import finite, points, poses, settled

MODELS = st.sampled_from([RANGE_BEARING, COMPASS_XY])


def check_motion_jacobians(model: int, x: Floats, u: Floats) -> None:
    _, J_new_x, J_new_u = move(model, x, u)
    np.testing.assert_allclose(J_new_x, reference.numeric_jacobian(lambda v: move(model, v, u)[0], x), atol=1e-8)
    np.testing.assert_allclose(J_new_u, reference.numeric_jacobian(lambda v: move(model, x, v)[0], u), atol=1e-8)


def check_sighting_jacobians(model: int, x: Floats, y: Floats) -> None:
    h, J_z_x, J_z_y = sight(model, x, y)
    # Innovations, because a bearing may jump by a full turn between the two sides of the difference.
    J_x = reference.numeric_jacobian(lambda v: innovation(model, sight(model, v, y)[0], h), x)
    J_y = reference.numeric_jacobian(lambda v: innovation(model, sight(model, x, v)[0], h), y)
    np.testing.assert_allclose(J_z_x, J_x, atol=1e-7)
    np.testing.assert_allclose(J_z_y, J_y, atol=1e-7)


@given(MODELS, poses(), poses())
@settled
def test_motion_is_the_increment_in_the_frame_of_the_pose_it_leaves(model: int, x: Floats, u: Floats) -> None:
    np.testing.assert_allclose(move(model, x, u)[0], reference.moved(model, x, u), atol=1e-12)


@pytest.mark.parametrize("model", [RANGE_BEARING, COMPASS_XY])
@pytest.mark.parametrize("scale", [0.0, 1e-8, 1.0])
def test_motion_jacobians_predict_a_small_change_at_and_near_the_identity(model: int, scale: float) -> None:
    check_motion_jacobians(model, scale * np.array([1.0, -1.0, 1.0]), np.array([1.0, 0.5, -0.3]))
    check_motion_jacobians(model, np.array([1.0, 0.5, -0.3]), scale * np.array([1.0, -1.0, 1.0]))


@given(MODELS, poses(), poses())
@settled
def test_motion_jacobians_predict_a_small_change_anywhere(model: int, x: Floats, u: Floats) -> None:
    check_motion_jacobians(model, x, u)


@given(MODELS, poses(), points())
@settled
def test_a_sighting_is_what_trigonometry_says(model: int, x: Floats, y: Floats) -> None:
    assume(np.hypot(*(y - x[:2])) > 1e-3)
    h, _, _ = sight(model, x, y)
    np.testing.assert_allclose(reference.difference(model, h, reference.expected(model, x, y)), 0.0, atol=1e-12)


@given(MODELS, poses(), points())
@settled
def test_sighting_jacobians_predict_a_small_change(model: int, x: Floats, y: Floats) -> None:
    assume(np.hypot(*(y - x[:2])) > 0.1)
    check_sighting_jacobians(model, x, y)


@pytest.mark.parametrize("model", [RANGE_BEARING, COMPASS_XY])
@pytest.mark.parametrize("heading", [0.0, 1e-8, -1e-8, 3.0])
def test_sighting_jacobians_hold_straight_ahead_and_behind(model: int, heading: float) -> None:
    for y in ([1.0, 0.0], [1.0, 1e-8], [-1.0, 1e-8], [-1.0, -1e-8], [0.0, 1.0]):
        check_sighting_jacobians(model, np.array([1e-8, -1e-8, heading]), np.array(y))


@given(MODELS, poses(), st.floats(0.01, 50.0), st.floats(-3.1, 3.1))
@settled
def test_a_landmark_is_seen_where_its_sighting_placed_it(model: int, x: Floats, first: float, second: float) -> None:
    z = np.array([first, second])
    h, _, _ = sight(model, x, place(model, x, z))
    np.testing.assert_allclose(innovation(model, z, h), 0.0, atol=1e-11)


@given(MODELS, poses(), points())
@settled
def test_a_sighting_places_the_landmark_where_it_is(model: int, x: Floats, y: Floats) -> None:
    assume(np.hypot(*(y - x[:2])) > 1e-3)
    np.testing.assert_allclose(place(model, x, sight(model, x, y)[0]), y, atol=1e-12)


@given(finite(10.0), finite(3.1), finite(10.0), finite(3.1))
@settled
def test_innovations_wrap_bearings_and_nothing_else(z0: float, z1: float, h0: float, h1: float) -> None:
    z, h = np.array([z0, z1]), np.array([h0, h1])
    assert np.array_equal(innovation(COMPASS_XY, z, h), z - h)
    r = innovation(RANGE_BEARING, z, h)
    assert r[0] == z0 - h0
    assert abs(np.exp(1j * r[1]) - np.exp(1j * (z1 - h1))) < 1e-14
    assert abs(r[1]) <= np.pi + 1e-15


def test_an_innovation_leaves_its_arguments_alone() -> None:
    z, h = np.array([1.0, 3.0]), np.array([1.0, -3.0])
    innovation(RANGE_BEARING, z, h)
    assert z.tolist() == [1.0, 3.0]
    assert h.tolist() == [1.0, -3.0]
