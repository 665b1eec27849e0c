"""Covariances of differences, and of parts left out, against dense matrices."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_seif.joint import landmark_classes, marginal_covariances, solve
from fleet_seif.joint_covariance import JointCovariance, diagonal_blocks, halved
from fleet_seif.left_out import left_out
from fleet_seif.records import Floats, Ints
from tests.strategies import finite, settled
from tests.test_joint import Case, cases


def difference_of(n: int, pairs: Ints, rows: int) -> Floats:
    """The matrix that takes a joint state to stacked differences."""
    C = np.zeros((2 * len(pairs), rows))
    for k, (a, b) in enumerate(pairs.tolist()):
        for axis in range(2):
            C[2 * k + axis, 2 * a + axis] += 1.0
            C[2 * k + axis, 2 * b + axis] -= 1.0
    return C


@given(cases(), st.data())
@settings(settled, max_examples=40)
def test_the_joint_covariance_of_differences_is_that_of_the_dense_inverse(case: Case, data: st.DataObject) -> None:
    solution = solve(case.lives, landmark_classes(case.lives))
    n = len(solution.classes)
    index = st.integers(0, n - 1)
    drawn = data.draw(st.lists(st.tuples(index, index), min_size=1, max_size=6))
    pairs = np.array(drawn, np.int64)
    P = np.linalg.inv(solution.H.toarray())
    C = difference_of(n, pairs, len(P))
    covariance = JointCovariance(solution)
    S = covariance.differences(pairs)
    np.testing.assert_allclose(S, C @ P @ C.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(covariance.difference_blocks(pairs), diagonal_blocks(C @ P @ C.T), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(covariance.landmarks(), marginal_covariances(solution)[0], rtol=1e-9, atol=1e-12)


@given(cases(frames_max=1, given=True), st.data())
@settings(settled, max_examples=40)
def test_a_part_left_out_is_where_it_would_be_without_its_merge(case: Case, data: st.DataObject) -> None:
    """In the linear case to rounding: against a solution in which that part is a landmark of its own."""
    classes = landmark_classes(case.lives)
    several = [names for names in classes if len({name[:2] for name in names}) == len(names) > 1]
    assume(several)
    parts = tuple((name,) for names in classes for name in names)
    solution = solve(case.lives, classes)
    found = left_out(solution, parts, JointCovariance(solution))
    i = data.draw(st.integers(0, len(found.part) - 1))
    (name,) = parts[found.part[i]]
    assume(classes[found.landmark[i]] in several)
    rest = tuple(other for other in classes[found.landmark[i]] if other != name)
    apart = tuple(sorted([*(c for k, c in enumerate(classes) if k != found.landmark[i]), (name,), rest]))
    without = solve(case.lives, apart)
    a, b = apart.index((name,)), apart.index(rest)
    P = np.linalg.inv(without.H.toarray())
    C = difference_of(len(apart), np.array([[a, b]]), len(P))
    d, S = C @ without.mean, C @ P @ C.T
    np.testing.assert_allclose(found.S[i], S, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(found.moved[i], d, rtol=1e-4, atol=1e-6 * float(np.sqrt(S.max())))
    np.testing.assert_allclose(found.d2[i], d @ np.linalg.solve(S, d), rtol=1e-4, atol=1e-6)


@given(arrays(np.float64, st.tuples(st.integers(0, 40), st.just(2)), elements=finite(5.0)), st.integers(1, 7))
@settled
def test_points_are_halved_until_each_group_is_small_and_each_point_is_in_one(points: Floats, most: int) -> None:
    groups = list(halved(points, most))
    assert sorted(i for group in groups for i in group.tolist()) == list(range(len(points)))
    assert all(1 <= len(group) <= most for group in groups)
