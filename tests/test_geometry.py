"""Laws of SE(2) and its Jacobians."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.geometry import (
    act,
    act_all,
    act_inverse,
    between,
    between_jacobians,
    compose,
    compose_jacobians,
    inverse,
    wrap,
)
from fleet_seif.records import Floats
from tests import reference
from tests.strategies import points, poses, settled

IDENTITY = np.zeros(3)
TINY = np.array([1e-8, -1e-8, 1e-8])


@given(st.floats(-1e6, 1e6))
@settled
def test_wrap_is_the_remainder_up_to_the_sign_of_pi(angle: float) -> None:
    error = abs(wrap(angle) - math.remainder(angle, math.tau))
    assert min(error, abs(error - math.tau)) <= 1e-15 * max(abs(angle), 4.0)


@given(st.floats(-1e6, 1e6))
@settled
def test_wrapped_angles_lie_within_pi(angle: float) -> None:
    assert abs(wrap(angle)) <= math.pi + 1e-15 * max(abs(angle), 4.0)


@given(st.floats(-math.pi, math.pi))
@settled
def test_wrap_leaves_an_angle_within_pi_as_it_is(angle: float) -> None:
    assert wrap(angle) == angle


@given(poses(), poses())
@settled
def test_composition_is_the_product_of_homogeneous_matrices(T_ab: Floats, T_bc: Floats) -> None:
    T_ac = compose(T_ab, T_bc)
    np.testing.assert_allclose(reference.matrix(T_ac), reference.matrix(T_ab) @ reference.matrix(T_bc), atol=1e-12)
    assert T_ac[2] == T_ab[2] + T_bc[2]


@given(poses(), poses(), poses())
@settled
def test_composition_is_associative(T_ab: Floats, T_bc: Floats, T_cd: Floats) -> None:
    np.testing.assert_allclose(compose(compose(T_ab, T_bc), T_cd), compose(T_ab, compose(T_bc, T_cd)), atol=1e-12)


@given(poses())
@settled
def test_the_identity_changes_nothing(T: Floats) -> None:
    assert np.array_equal(compose(IDENTITY, T), T)
    assert np.array_equal(compose(T, IDENTITY), T)


@given(poses())
@settled
def test_a_pose_composed_with_its_inverse_is_the_identity(T: Floats) -> None:
    np.testing.assert_allclose(compose(T, inverse(T)), IDENTITY, atol=1e-13)
    np.testing.assert_allclose(compose(inverse(T), T), IDENTITY, atol=1e-13)


@given(poses(), poses())
@settled
def test_between_is_the_inverse_composed_with_the_other(T_wa: Floats, T_wb: Floats) -> None:
    np.testing.assert_allclose(between(T_wa, T_wb), compose(inverse(T_wa), T_wb), atol=1e-12)


@given(poses(), poses())
@settled
def test_composition_undoes_between(T_wa: Floats, T_wb: Floats) -> None:
    np.testing.assert_allclose(compose(T_wa, between(T_wa, T_wb)), T_wb, atol=1e-12)


@given(poses(), poses(), points())
@settled
def test_acting_twice_is_acting_by_the_composition(T_ab: Floats, T_bc: Floats, p_c: Floats) -> None:
    np.testing.assert_allclose(act(T_ab, act(T_bc, p_c)), act(compose(T_ab, T_bc), p_c), atol=1e-12)


@given(poses(), points())
@settled
def test_act_inverse_undoes_act(T_ab: Floats, p_b: Floats) -> None:
    np.testing.assert_allclose(act_inverse(T_ab, act(T_ab, p_b)), p_b, atol=1e-12)


@given(poses(), st.lists(points(), max_size=4))
@settled
def test_act_all_acts_on_every_row(T_ab: Floats, p_b: list[Floats]) -> None:
    rows = np.array(p_b).reshape(-1, 2)
    assert act_all(T_ab, rows).shape == rows.shape
    for p_a, p in zip(act_all(T_ab, rows), rows, strict=True):
        np.testing.assert_allclose(p_a, act(T_ab, p), atol=1e-13)


def check_pose_jacobians(T: Floats, S: Floats) -> None:
    J_ac_ab, J_ac_bc = compose_jacobians(T, S)
    np.testing.assert_allclose(J_ac_ab, reference.numeric_jacobian(lambda t: compose(t, S), T), atol=1e-8)
    np.testing.assert_allclose(J_ac_bc, reference.numeric_jacobian(lambda s: compose(T, s), S), atol=1e-8)
    J_ab_wa, J_ab_wb = between_jacobians(T, S)
    np.testing.assert_allclose(J_ab_wa, reference.numeric_jacobian(lambda t: between(t, S), T), atol=1e-8)
    np.testing.assert_allclose(J_ab_wb, reference.numeric_jacobian(lambda s: between(T, s), S), atol=1e-8)


@pytest.mark.parametrize("T", [IDENTITY, TINY], ids=["identity", "tiny"])
@pytest.mark.parametrize("S", [IDENTITY, TINY, np.array([1.0, -2.0, 3.0])], ids=["identity", "tiny", "far"])
def test_jacobians_predict_a_small_change_at_and_near_the_identity(T: Floats, S: Floats) -> None:
    check_pose_jacobians(T, S)
    check_pose_jacobians(S, T)


@given(poses(), poses())
@settled
def test_jacobians_of_poses_predict_a_small_change_anywhere(T: Floats, S: Floats) -> None:
    check_pose_jacobians(T, S)
