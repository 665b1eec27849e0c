"""The joint map against a dense Gauss-Newton over the same frames."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_seif.errors import NumericalError
from fleet_seif.information import FrameDelta
from fleet_seif.joint import (
    JointSolution,
    Life,
    Pair,
    landmark_chi_square,
    landmark_classes,
    marginal_covariances,
    solve,
)
from fleet_seif.messages import LandmarkName
from fleet_seif.records import UNKNOWN_SIGNATURE, Floats
from tests import reference
from tests.strategies import finite, points, poses, settled, spd, vectors

GIVEN = np.zeros((3, 3))
INFORMATION = 1e4


@dataclass(frozen=True, eq=False)
class Case:
    """Lives with the truth that they were made from: landmarks (m, 2), and the poses of each life."""

    lives: list[Life]
    landmarks: Floats
    poses: list[list[Floats]]
    shown: list[list[int]]
    """Which landmark each number of a life is."""


@st.composite
def cases(draw: st.DrawFn, frames_max: int = 3, given: bool | None = None) -> Case:
    """One to three lives of up to three frames; every H is positive definite, every b a little off the truth."""
    landmarks = np.array(draw(st.lists(points(), min_size=2, max_size=4)))
    lives, trails, shown = [], [], []
    for i in range(draw(st.integers(1, 3))):
        count = draw(st.integers(1, frames_max))
        trail = [draw(poses()) for _ in range(count + 1)]
        numbers = draw(st.permutations(range(len(landmarks))))
        cov = GIVEN if (draw(st.booleans()) if given is None else given) else draw(spd(3)) * 1e-4
        cov = (cov + cov.T) / 2
        unknown = draw(st.sets(st.sampled_from(numbers), max_size=1))
        frames = []
        for k in range(count):
            names = sorted(draw(st.sets(st.integers(0, len(numbers) - 1), min_size=1)))
            seen = landmarks[[numbers[n] for n in names]]
            z = reference.frame_view(trail[k], trail[k + 1], seen).real
            H = INFORMATION * draw(spd(len(z), least=1.0))
            H = (H + H.T) / 2
            b = H @ (z + 1e-3 * draw(vectors(len(z), 3.0)))
            frames.append(reference.quantised(H, b, [0, *(n + 1 for n in names)]))
        offset = 1e-3 * draw(vectors(3, 3.0)) if np.any(cov) else np.zeros(3)
        lives.append(
            Life(
                vehicle=f"v{i}", life=0, start_pose=trail[0] + offset, start_pose_cov=cov, frames=tuple(frames),
                signatures=tuple(UNKNOWN_SIGNATURE if j in unknown else 70 - j for j in numbers),
            )
        )  # fmt: skip
        trails.append(trail)
        shown.append(list(numbers))
    return Case(lives, landmarks, trails, shown)


def rows_of(case: Case, classes: tuple[tuple[LandmarkName, ...], ...]) -> tuple[dict[tuple[int, int], int], Floats]:
    """First row of each pose (life, k) that is unknown, and the truth as a joint state."""
    at: dict[tuple[int, int], int] = {}
    lives = [life.vehicle for life in case.lives]
    truth = [case.landmarks[case.shown[lives.index(names[0].vehicle)][names[0].number]] for names in classes]
    n = 2 * len(classes)
    for i, life in enumerate(case.lives):
        for k in range(len(life.frames) + 1):
            if k > 0 or np.any(life.start_pose_cov):
                at[i, k] = n
                truth.append(case.poses[i][k])
                n += 3
    return at, np.concatenate(truth)


def dense_solution(case: Case, classes: tuple[tuple[LandmarkName, ...], ...]) -> tuple[Floats, Floats]:
    """The reference's mean and H, in the order of rows that the module's docstring states."""
    at, truth = rows_of(case, classes)
    column = {name: 2 * c for c, names in enumerate(classes) for name in names}
    frames, priors = [], []
    for i, life in enumerate(case.lives):
        if np.any(life.start_pose_cov):
            priors.append((at[i, 0], life.start_pose, life.start_pose_cov))
        for k, delta in enumerate(life.frames):
            names = [LandmarkName(life.vehicle, life.life, v - 1) for v in delta.variables.tolist()[1:]]
            H, b = reference.dense(*reference.blocks_of(delta), delta.variables.tolist())

            def view(
                x: reference.Long, i: int = i, k: int = k, names: list[LandmarkName] = names, life: Life = life
            ) -> reference.Long:
                start = x[at[i, k] : at[i, k] + 3] if (i, k) in at else life.start_pose.astype(complex)
                seen = np.array([x[column[name] : column[name] + 2] for name in names])
                return reference.frame_view(start, x[at[i, k + 1] : at[i, k + 1] + 3], seen)

            frames.append((H, b, view))
    return reference.joint_solution(frames, priors, truth)


def check(case: Case, tolerance: float) -> JointSolution:
    classes = landmark_classes(case.lives)
    solution = solve(case.lives, classes)
    mean, H = dense_solution(case, classes)
    sigma = np.sqrt(np.diag(np.linalg.inv(H)))
    scale = np.sqrt(np.diag(H))
    assert np.max(np.abs(solution.mean - mean) / sigma) <= tolerance
    assert np.max(np.abs(solution.H.toarray() - H) / np.outer(scale, scale)) <= max(tolerance, 1e-7)
    return solution


@given(cases(frames_max=1, given=True))
@settings(settled, max_examples=50)
def test_single_frames_with_given_start_poses_are_one_linear_system(case: Case) -> None:
    """To rounding; start poses are rotated by anything."""
    check(case, 1e-7)


@given(cases())
@settings(settled, max_examples=60)
def test_frames_and_uncertain_start_poses_are_solved_like_dense_gauss_newton(case: Case) -> None:
    check(case, 1e-5 * 30)


@given(cases())
@settings(settled, max_examples=30)
def test_a_solution_is_symmetric_positive_definite_and_consistent(case: Case) -> None:
    solution = solve(case.lives, landmark_classes(case.lives))
    H = solution.H.toarray()
    assert np.array_equal(H, H.T)
    assert np.linalg.eigvalsh(H)[0] > 0.0
    np.testing.assert_allclose(np.linalg.solve(H, solution.b), solution.mean, atol=1e-8)
    assert len(solution.variables()) == len(solution.mean) == len(set(solution.variables()))
    assert solution.landmark_mean.shape == (len(solution.classes), 2)
    assert solution.pose_mean.shape == (len(solution.poses), 3)


@given(cases())
@settings(settled, max_examples=30)
def test_landmarks_are_the_same_if_and_only_if_their_signatures_are_known_and_equal(case: Case) -> None:
    classes = landmark_classes(case.lives)
    names = [name for group in classes for name in group]
    present = {
        LandmarkName(life.vehicle, life.life, v - 1)
        for life in case.lives
        for delta in life.frames
        for v in delta.variables.tolist()
        if v > 0
    }
    assert set(names) == present
    assert len(names) == len(present)
    signature = {life.vehicle: life.signatures for life in case.lives}
    for group in classes:
        known = {signature[name.vehicle][name.number] for name in group}
        assert len(known) == 1
        assert len(group) == 1 or known != {UNKNOWN_SIGNATURE}
    joined = [signature[g[0].vehicle][g[0].number] for g in classes]
    certain = [s for s in joined if s != UNKNOWN_SIGNATURE]
    assert len(certain) == len(set(certain))


@given(cases(), st.data())
@settings(settled, max_examples=30)
def test_the_order_of_lives_changes_neither_classes_nor_the_map(case: Case, data: st.DataObject) -> None:
    shuffled = data.draw(st.permutations(case.lives))
    classes = landmark_classes(case.lives)
    assert landmark_classes(shuffled) == classes
    a, b = solve(case.lives, classes), solve(shuffled, classes)
    assert a.signatures == b.signatures
    sigma = np.sqrt(np.diagonal(marginal_covariances(a)[0], axis1=1, axis2=2))
    assert np.max(np.abs(a.landmark_mean - b.landmark_mean) / sigma) < 1e-3
    assert sorted(a.poses) == sorted(b.poses)


def names_in(case: Case) -> list[LandmarkName]:
    return [name for group in landmark_classes(case.lives) for name in group]


@st.composite
def decided(draw: st.DrawFn) -> tuple[Case, list[Pair], list[Pair]]:
    """Lives, and pairs of their landmarks (and of one that nobody has) that operators have joined and parted."""
    case = draw(cases())
    names = [*names_in(case), LandmarkName("nobody", 0, 0)]
    pair = st.lists(st.sampled_from(names), min_size=2, max_size=2, unique=True).map(sorted).map(lambda p: (p[0], p[1]))
    return case, draw(st.lists(pair, max_size=4)), draw(st.lists(pair, max_size=4))


@given(decided())
@settled
def test_decided_classes_are_a_partition_in_canonical_order_that_parts_what_is_forbidden(
    decisions: tuple[Case, list[Pair], list[Pair]],
) -> None:
    case, forced, forbidden = decisions
    classes = landmark_classes(case.lives, forced, forbidden)
    assert sorted(name for group in classes for name in group) == sorted(names_in(case))
    assert list(classes) == sorted(tuple(sorted(group)) for group in classes)
    for a, b in forbidden:
        assert not any(a in group and b in group for group in classes)


@given(decided())
@settled
def test_decided_classes_are_those_of_joining_one_pair_after_the_other_where_that_is_allowed(
    decisions: tuple[Case, list[Pair], list[Pair]],
) -> None:
    """Against the slow way: forced pairs in their order, then equal signatures; every class is looked at each time."""
    case, forced, forbidden = decisions
    plain = landmark_classes(case.lives)
    equal = sorted((group[0], other) for group in plain for other in group[1:])
    groups = [{name} for name in names_in(case)]
    for a, b in [*forced, *equal]:
        found = [group for group in groups if a in group or b in group]
        known = any(a in group for group in found) and any(b in group for group in found)
        if len(found) == 2 and known and not any(x in (found[0] | found[1]) and y in (found[0] | found[1])
                                                  for x, y in forbidden):  # fmt: skip
            groups = [group for group in groups if group not in found] + [found[0] | found[1]]
    assert set(landmark_classes(case.lives, forced, forbidden)) == {tuple(sorted(group)) for group in groups}


@given(decided(), st.data())
@settled
def test_decisions_do_not_depend_on_the_order_of_lives(
    decisions: tuple[Case, list[Pair], list[Pair]], data: st.DataObject
) -> None:
    case, forced, forbidden = decisions
    shuffled = data.draw(st.permutations(case.lives))
    assert landmark_classes(shuffled, forced, forbidden) == landmark_classes(case.lives, forced, forbidden)


def test_classes_are_in_the_order_of_their_first_names() -> None:
    lives = [life("b", (5, 6, -1)), life("a", (6, 7, -1)), life("a", (5, 5, 9), number=1)]
    assert landmark_classes(lives) == (
        (LandmarkName("a", 0, 0), LandmarkName("b", 0, 1)),
        (LandmarkName("a", 0, 1),),
        (LandmarkName("a", 0, 2),),
        (LandmarkName("a", 1, 0), LandmarkName("a", 1, 1), LandmarkName("b", 0, 0)),
        (LandmarkName("a", 1, 2),),
        (LandmarkName("b", 0, 2),),
    )


def life(
    vehicle: str, signatures: tuple[int, ...], *, number: int = 0, H: Floats | None = None, named: int | None = None
) -> Life:
    """A life of one frame over its pose and the first `named` of its landmarks."""
    count = len(signatures) if named is None else named
    n = 3 + 2 * count
    frame = reference.quantised(4.0 * np.eye(n) if H is None else H, np.arange(float(n)), list(range(count + 1)))
    return Life(
        vehicle=vehicle,
        life=number,
        start_pose=np.zeros(3),
        start_pose_cov=GIVEN,
        frames=(frame,),
        signatures=signatures,
    )


def test_a_landmark_without_information_is_none() -> None:
    assert landmark_classes([life("a", (5, 6), named=1)]) == ((LandmarkName("a", 0, 0),),)


def test_aliases_hold_through_a_landmark_without_information() -> None:
    """Its sightings may have gone to the others since."""
    chain = dataclasses.replace(life("a", (-1, -1, -1), named=2), aliases=((0, 2), (1, 2)))
    assert landmark_classes([chain]) == ((LandmarkName("a", 0, 0), LandmarkName("a", 0, 1)),)
    alone = dataclasses.replace(life("a", (-1, -1, -1), named=1), aliases=((1, 2),))
    assert landmark_classes([alone]) == ((LandmarkName("a", 0, 0),),)


def test_two_equal_vehicles_add_their_information() -> None:
    one, two = ([life(v, (5,)) for v in vehicles] for vehicles in (["a"], ["a", "b"]))
    single, double = (solve(lives, landmark_classes(lives)) for lives in (one, two))
    np.testing.assert_allclose(double.H.toarray()[:2, :2], 2.0 * single.H.toarray()[:2, :2])
    np.testing.assert_allclose(double.landmark_mean, single.landmark_mean)


def test_rows_are_named_by_what_they_hold() -> None:
    first = life("a", (5,))
    uncertain = Life(
        vehicle="b", life=2, start_pose=np.zeros(3), start_pose_cov=np.eye(3), frames=first.frames * 2, signatures=(5,)
    )
    solution = solve([first, uncertain], landmark_classes([first, uncertain]))
    assert solution.poses == (("a", 0, -1), ("b", 2, 0), ("b", 2, 1), ("b", 2, -1))
    stems = [row.rsplit("/", 1)[0] for row in solution.variables()]
    assert stems == [
        *["landmark/0"] * 2, *["pose/a"] * 3, *["frame/b/2/0"] * 3, *["frame/b/2/1"] * 3, *["pose/b"] * 3,
    ]  # fmt: skip


@given(st.integers(0, 4), finite(0.5))
@settled
def test_an_indefinite_system_is_refused(direction: int, tilt: float) -> None:
    H = 4.0 * np.eye(5) + tilt
    values, axes = np.linalg.eigh(H)
    values[direction] *= -1.0
    lives = [life("a", (5,), H=(axes * values) @ axes.T)]
    with pytest.raises(NumericalError):
        solve(lives, landmark_classes(lives))


def test_an_indefinite_frame_is_refused_also_where_the_sum_with_others_is_definite() -> None:
    """Every frame is a posterior of its own (DESIGN D2): the others must not hide that one is not."""
    H = np.diag([4.0, 4.0, 4.0, -1.0, 4.0])
    lives = [life("a", (5,), H=H), life("b", (5,))]
    with pytest.raises(NumericalError):
        solve(lives, landmark_classes(lives))


@pytest.mark.parametrize("rows", [[3, 4], [0, 1, 2]])
def test_a_singular_system_is_refused(rows: list[int]) -> None:
    H = 4.0 * np.eye(5)
    H[rows, rows] = 0.0
    H[rows[0], rows[1]] = H[rows[1], rows[0]] = 4.0 * (rows == [3, 4])
    lives = [life("a", (5,), H=H)]
    with pytest.raises(NumericalError):
        solve(lives, landmark_classes(lives))


@pytest.mark.parametrize("frames", [(), (FrameDelta.nothing(),)])
def test_nothing_to_solve_is_refused(frames: tuple[FrameDelta, ...]) -> None:
    lives = [Life(vehicle="a", life=0, start_pose=np.zeros(3), start_pose_cov=GIVEN, frames=frames, signatures=())]
    with pytest.raises(NumericalError):
        solve(lives, landmark_classes(lives))


@given(cases())
@settings(settled, max_examples=30)
def test_marginals_are_the_blocks_of_the_dense_inverse(case: Case) -> None:
    solution = solve(case.lives, landmark_classes(case.lives))
    landmarks, poses = marginal_covariances(solution)
    P = np.linalg.inv(solution.H.toarray())
    n = len(solution.classes)
    for i, block in enumerate(landmarks):
        np.testing.assert_allclose(block, P[2 * i : 2 * i + 2, 2 * i : 2 * i + 2], rtol=1e-7, atol=1e-12)
    for i, block in enumerate(poses):
        at = slice(2 * n + 3 * i, 2 * n + 3 * i + 3)
        np.testing.assert_allclose(block, P[at, at], rtol=1e-7, atol=1e-12)
    assert np.array_equal(landmarks, landmarks.transpose(0, 2, 1))


@given(cases(), st.data())
@settings(settled, max_examples=30)
def test_chi_square_is_normalised_by_the_dense_joint_covariance_of_landmarks(case: Case, data: st.DataObject) -> None:
    solution = solve(case.lives, landmark_classes(case.lives))
    n = 2 * len(solution.classes)
    error = data.draw(vectors(n, 1.0))
    P = np.linalg.inv(solution.H.toarray())[:n, :n]
    expected = float(error @ np.linalg.solve(P, error))
    assert abs(landmark_chi_square(solution, error.reshape(-1, 2)) - expected) <= 1e-6 * max(1.0, expected)
