"""Which landmark is it: against all hypotheses there are, where the nearest one is wrong, and what is left open."""

import itertools
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import chi2

from fleet_seif.association import METHODS, Association, associate, limits
from fleet_seif.association_guards import AMBIGUOUS, NEAR, NEW, PAIRED
from fleet_seif.config import AssociationSettings
from fleet_seif.errors import NumericalError
from fleet_seif.geometry import act, wrap
from fleet_seif.models import COMPASS_XY, RANGE_BEARING, sight
from fleet_seif.records import Floats, Ints
from tests.strategies import finite, settled, spd

JOINT = AssociationSettings()
FREE = AssociationSettings(rivals="free")


class Case(NamedTuple):
    z: Floats
    Z: Floats
    h: Floats
    C: Floats


@st.composite
def cases(draw: st.DrawFn, most: int = 4) -> Case:
    """Small problems in which a good part of the pairs pass the gate, whose candidates move together."""
    m, n = draw(st.integers(0, most)), draw(st.integers(0, most))
    z, h = (draw(arrays(np.float64, (k, 2), elements=finite(3.0))) for k in (m, n))
    Z = np.array([draw(spd(2)) for _ in range(m)]).reshape(m, 2, 2)
    together = draw(arrays(np.float64, (2 * n, 3), elements=finite(1.0)))
    return Case(z, Z, h, together @ together.T + 0.05 * np.eye(2 * n))


def innovation(z: Floats, h: Floats) -> Floats:
    return np.array([z[0] - h[0], wrap(z[1] - h[1])])


def cost_of(case: Case, hypothesis: tuple[int, ...], cost_unpaired: float) -> tuple[float, float]:
    """The joint cost and r' S^-1 r of a hypothesis, by a dense inverse."""
    pairs = [(i, j) for i, j in enumerate(hypothesis) if j >= 0]
    if not pairs:
        return cost_unpaired * len(hypothesis), 0.0
    rows = np.concatenate([[2 * j, 2 * j + 1] for _, j in pairs])
    S = case.C[np.ix_(rows, rows)].copy()
    for k, (i, _) in enumerate(pairs):
        S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += case.Z[i]
    r = np.concatenate([innovation(case.z[i], case.h[j]) for i, j in pairs])
    d2 = float(r @ np.linalg.inv(S) @ r)
    volume = np.linalg.slogdet(S)[1] - sum(np.linalg.slogdet(case.Z[i])[1] for i, _ in pairs)
    return d2 + float(volume) + cost_unpaired * (len(hypothesis) - len(pairs)), d2


def allowed(case: Case, settings: AssociationSettings) -> dict[tuple[int, ...], float]:
    """The cost of every hypothesis that passes the gates."""
    gate = chi2.ppf(settings.gate_probability, 2)
    found = {}
    for hypothesis in itertools.product(range(-1, len(case.h)), repeat=len(case.z)):
        taken = [j for j in hypothesis if j >= 0]
        if len(set(taken)) < len(taken):
            continue
        if any(cost_of(case, (-1,) * i + (j,), 0.0)[1] > gate for i, j in enumerate(hypothesis) if j >= 0):
            continue
        cost, d2 = cost_of(case, hypothesis, settings.cost_unpaired)
        if not taken or d2 <= chi2.ppf(settings.joint_gate_probability, 2 * len(taken)):
            found[hypothesis] = cost
    return found


@given(cases(), st.sampled_from([0.5, 4.0, 13.0]), st.sampled_from([0.6, 0.99]))
@settled
def test_joint_compatibility_finds_the_least_cost_of_all_hypotheses(case: Case, unpaired: float, joint: float) -> None:
    settings = AssociationSettings(cost_unpaired=unpaired, joint_gate_probability=joint)
    found = associate(*case, settings)
    costs = allowed(case, settings)
    hypothesis = tuple(found.hypothesis.tolist())
    assert costs[hypothesis] == pytest.approx(min(costs.values()), abs=1e-8)
    assert found.squared_innovation == pytest.approx(cost_of(case, hypothesis, unpaired)[1], abs=1e-8)
    assert found.pairs == sum(j >= 0 for j in hypothesis)
    assert not found.cut_short


@given(cases(), st.sampled_from([1, 2, 5]))
@settled
def test_a_search_that_is_cut_short_says_so_and_returns_a_hypothesis_that_is_allowed(case: Case, nodes: int) -> None:
    settings = AssociationSettings(nodes_max=nodes)
    found = associate(*case, settings)
    costs = allowed(case, settings)
    cost = costs[tuple(found.hypothesis.tolist())]
    assert found.cut_short or cost == pytest.approx(min(costs.values()), abs=1e-8)


@given(cases(), st.sampled_from(METHODS))
@settled
def test_pairs_pass_the_gate_and_no_candidate_has_two_sightings(case: Case, method: str) -> None:
    settings = AssociationSettings.model_validate({"method": method})
    found = associate(*case, settings)
    taken = found.hypothesis[found.hypothesis >= 0]
    assert len(set(taken.tolist())) == len(taken)
    for i, j in enumerate(found.hypothesis.tolist()):
        assert j < 0 or cost_of(case, (-1,) * i + (j,), 0.0)[1] <= chi2.ppf(0.99, 2) * (1.0 + 1e-12)
    assert np.array_equal(found.assignment, np.where(found.verdict == PAIRED, found.hypothesis, -1))


@given(cases(), st.sampled_from(METHODS), st.data())
@settled
def test_order_of_sightings_and_candidates_does_not_matter(case: Case, method: str, data: st.DataObject) -> None:
    settings = AssociationSettings.model_validate({"method": method})
    m, n = len(case.z), len(case.h)
    costs = sorted(allowed(case, settings).values())
    assume(method != "joint_compatibility" or len(costs) < 2 or costs[1] - costs[0] > 1e-6)
    assume(len({tuple(row) for row in case.z}) == m and len({tuple(row) for row in case.h}) == n)
    of_z, of_h = (np.array(data.draw(st.permutations(range(k))), np.int64) for k in (m, n))
    rows = (2 * of_h[:, None] + np.arange(2)).ravel()
    shuffled = associate(case.z[of_z], case.Z[of_z], case.h[of_h], case.C[np.ix_(rows, rows)].copy(), settings)
    plain = associate(*case, settings)
    names = np.append(of_h, -1)
    assert np.array_equal(names[shuffled.hypothesis], plain.hypothesis[of_z])
    assert np.array_equal(shuffled.verdict, plain.verdict[of_z])
    np.testing.assert_allclose(shuffled.margin, plain.margin[of_z], atol=1e-7)


@given(cases(), st.sampled_from(METHODS))
@settled
def test_a_margin_is_what_the_best_change_to_a_free_candidate_costs(case: Case, method: str) -> None:
    settings = AssociationSettings.model_validate({"method": method, "rivals": "free"})
    found = associate(*case, settings)
    hypothesis = tuple(found.hypothesis.tolist())
    now = cost_of(case, hypothesis, settings.cost_unpaired)[0]
    wide = limits(settings, len(case.z)).birth_gate
    for i in range(len(case.z)):
        best = np.inf
        for j in set(range(len(case.h))) - set(hypothesis):
            if cost_of(case, (-1,) * i + (j,), 0.0)[1] <= wide:
                swapped = (*hypothesis[:i], j, *hypothesis[i + 1 :])
                best = min(best, cost_of(case, swapped, settings.cost_unpaired)[0] - now)
        assert found.margin[i] == best or found.margin[i] == pytest.approx(best, abs=1e-7)


class Scene(NamedTuple):
    """A vehicle that knows its landmarks well and its pose badly; sightings without noise from where it truly is."""

    case: Case
    seen: Ints


def scene(
    landmarks: Floats, error: Floats, pose_std: tuple[float, float, float], seen: list[int],
    spurious: Floats | None = None,
) -> Scene:  # fmt: skip
    """error: of the pose (0, 0, 0) that the vehicle believes in; spurious (k, 2): sightings of nothing in the map."""
    n = len(landmarks)
    h, J = np.empty((n, 2)), np.zeros((2 * n, 3 + 2 * n))
    for j, y in enumerate(landmarks):
        h[j], J[2 * j : 2 * j + 2, :3], J[2 * j : 2 * j + 2, 3 + 2 * j : 5 + 2 * j] = sight(
            RANGE_BEARING, np.zeros(3), y
        )
    P = np.diag(np.concatenate([np.square(pose_std), np.full(2 * n, 0.01**2)]))
    z = np.array([sight(RANGE_BEARING, error, landmarks[j])[0] for j in seen])
    if spurious is not None:
        z = np.concatenate([z, spurious])
    Z = np.tile(np.diag([0.02**2, 0.01**2]), (len(z), 1, 1))
    return Scene(Case(z, Z, h, J @ P @ J.T), np.append(seen, np.full(len(z) - len(seen), -1)))


def chosen(at: Scene, method: str, **options: float) -> Ints:
    return associate(*at.case, AssociationSettings.model_validate({"method": method, **options})).hypothesis


def test_where_the_pose_is_off_by_half_a_spacing_only_the_joint_decision_is_right() -> None:
    """Landmarks 1 m apart on a wall; the vehicle is 0.6 m further along it than it thinks. An end and a step in the
    wall, seen with the rest, say which of two shifts it is; each sighting by itself fits the wrong one."""
    wall = np.array([[k - 3.0, 5.0] for k in range(7)] + [[-3.0, 6.5], [1.0, 6.5]])
    at = scene(wall, np.array([0.6, 0.0, 0.0]), (0.5, 0.05, 0.01), [2, 3, 4, 8])
    assert np.array_equal(chosen(at, "joint_compatibility"), at.seen)
    assert np.sum(chosen(at, "nearest_neighbour") != at.seen) >= 2
    assert np.sum(chosen(at, "maximum_likelihood") != at.seen) >= 2


def test_where_the_heading_is_off_by_half_an_angle_between_landmarks_only_the_joint_decision_is_right() -> None:
    """A ring of landmarks with one gap and one further out."""
    angles = np.deg2rad(np.array([-60.0, -40.0, -20.0, 0.0, 20.0, 40.0, 60.0]))
    ranges = np.array([5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.2])
    ring = ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    at = scene(ring, np.array([0.0, 0.0, np.deg2rad(12.0)]), (0.02, 0.02, np.deg2rad(8.0)), [3, 4, 5, 6])
    assert np.array_equal(chosen(at, "joint_compatibility"), at.seen)
    assert np.sum(chosen(at, "nearest_neighbour") != at.seen) >= 2
    assert np.sum(chosen(at, "maximum_likelihood") != at.seen) >= 2


def test_a_spurious_sighting_stays_unpaired_though_it_is_close_to_a_candidate() -> None:
    """By itself it is as good as anything, so vague is the pose; the other sightings leave no room for it."""
    places = np.array([[4.0, 0.0], [5.0, 2.0], [5.0, -2.0], [3.0, 1.5]])
    spurious = sight(RANGE_BEARING, np.zeros(3), np.array([3.2, 1.5]))[0][None]
    at = scene(places, np.array([0.3, -0.2, 0.05]), (0.4, 0.4, 0.1), [0, 1, 2], spurious)
    assert chosen(at, "nearest_neighbour")[-1] == 3
    assert np.array_equal(chosen(at, "joint_compatibility"), at.seen)
    found = associate(*at.case, JOINT)
    assert found.verdict.tolist() == [PAIRED, PAIRED, PAIRED, NEAR]


def test_paying_for_what_is_unpaired_pairs_less_eagerly_than_counting_pairs() -> None:
    """A dear unpaired sighting is what makes the count of pairs decide."""
    places = np.array([[4.0, 0.0], [4.0, 1.0]])
    off = sight(RANGE_BEARING, np.zeros(3), np.array([4.06, 1.0]))[0][None]
    at = scene(places, np.zeros(3), (0.001, 0.001, 0.001), [0], off)
    assert chosen(at, "joint_compatibility", cost_unpaired=5.0).tolist() == [0, -1]
    assert chosen(at, "joint_compatibility", cost_unpaired=100.0).tolist() == [0, 1]


def test_the_joint_gate_is_asked_of_the_whole_hypothesis() -> None:
    """Squared distances 3 and 0.5; the gates are 1.83 for one pair and 4.04 for two. The worse is decided first."""
    z = np.array([[5.0 + 0.1 * np.sqrt(3.0), 0.0], [8.0, 0.1 * np.sqrt(0.5)]])
    h = np.array([[5.0, 0.0], [8.0, 0.0], [8.0, 0.32]])
    settings = AssociationSettings(joint_gate_probability=0.6, rivals="free")
    found = associate(z, np.tile(0.01 * np.eye(2), (2, 1, 1)), h, np.zeros((6, 6)), settings)
    assert found.hypothesis.tolist() == [0, 1]
    assert found.squared_innovation == pytest.approx(3.5)


def one_between_two(offset: float) -> Association:
    """A sighting between two candidates 0.2 m apart on a line of sight, `offset` m nearer to the first."""
    h = np.array([[5.0, 0.0], [5.2, 0.0]])
    z = np.array([[5.1 - offset, 0.0]])
    return associate(z, np.array([np.diag([0.1**2, 0.1**2])]), h, 1e-4 * np.eye(4), JOINT)


def test_a_sighting_half_way_between_two_candidates_is_ambiguous_and_stays_unassigned() -> None:
    found = one_between_two(0.0)
    assert found.verdict.tolist() == [AMBIGUOUS]
    assert found.hypothesis[0] >= 0
    assert found.assignment.tolist() == [-1]
    assert found.margin[0] == pytest.approx(0.0, abs=1e-9)
    clear = one_between_two(0.15)
    assert clear.verdict.tolist() == [PAIRED]
    assert clear.assignment.tolist() == [0]
    assert clear.margin[0] == pytest.approx((0.25**2 - 0.05**2) / (0.1**2 + 1e-4))


def test_two_sightings_that_could_change_places_are_ambiguous_among_joint_rivals_only() -> None:
    """The other way round costs 2 (15^2 - 5^2) / (10^2 + 1) = 3.96 more, in cm; no candidate is free."""
    h = np.array([[5.0, 0.0], [5.2, 0.0]])
    z = np.array([[5.05, 0.0], [5.15, 0.0]])
    case = Case(z, np.tile(np.diag([0.1**2, 0.1**2]), (2, 1, 1)), h, 1e-4 * np.eye(4))
    found = associate(*case, FREE)
    assert found.assignment.tolist() == [0, 1]
    assert np.all(np.isinf(found.margin))
    found = associate(*case, JOINT)
    assert found.hypothesis.tolist() == [0, 1]
    assert found.verdict.tolist() == [AMBIGUOUS, AMBIGUOUS]
    np.testing.assert_allclose(found.margin, 2.0 * (0.15**2 - 0.05**2) / (0.1**2 + 1e-4))


def test_a_whole_row_that_could_be_shifted_by_one_is_ambiguous_among_joint_rivals_only() -> None:
    """No sighting can go over alone: the others hold it. All together can, as well as not."""
    row = np.array([[k - 3.0, 5.0] for k in range(7)])
    at = scene(row, np.array([0.5, 0.0, 0.0]), (0.5, 0.05, 0.01), [2, 3, 4])
    assert associate(*at.case, FREE).verdict.tolist() == [PAIRED] * 3
    assert associate(*at.case, JOINT).verdict.tolist() == [AMBIGUOUS] * 3


@given(cases())
@settled
def test_a_joint_rival_is_the_best_hypothesis_that_gives_the_sighting_to_another(case: Case) -> None:
    found = associate(*case, JOINT)
    free = associate(*case, FREE)
    costs = allowed(case, JOINT)
    for i, j in enumerate(found.hypothesis.tolist()):
        others = [cost for hypothesis, cost in costs.items() if hypothesis[i] not in (-1, j)]
        more = min(others, default=np.inf) - min(costs.values())
        if j >= 0 and more < JOINT.ambiguity_margin:
            assert found.margin[i] == pytest.approx(min(more, free.margin[i]), abs=1e-7)
        else:
            assert found.margin[i] == free.margin[i]


def test_in_a_symmetric_scene_every_method_leaves_the_sighting_open() -> None:
    for method in METHODS:
        h = np.array([[5.0, 0.3], [5.0, -0.3]])
        Z = np.array([np.diag([0.1**2, 0.2**2])])
        settings = AssociationSettings.model_validate({"method": method})
        found = associate(np.array([[5.0, 0.0]]), Z, h, 1e-4 * np.eye(4), settings)
        assert found.verdict.tolist() == [AMBIGUOUS]


@pytest.mark.parametrize(("away_sigmas", "verdict"), [(2.0, PAIRED), (4.0, NEAR), (4.7, NEAR), (5.0, NEW)])
def test_a_landmark_is_born_only_where_none_is_near(away_sigmas: float, verdict: int) -> None:
    """Default gates: 3.03 and 4.80 standard deviations."""
    z = np.array([[5.0 + 0.1 * away_sigmas, 0.0]])
    found = associate(z, np.array([np.diag([0.1**2, 0.1**2])]), np.array([[5.0, 0.0]]), np.zeros((2, 2)), JOINT)
    assert found.verdict.tolist() == [verdict]


def test_beside_a_landmark_that_is_sighted_itself_another_may_be_born() -> None:
    z = np.array([[5.0, 0.0], [5.4, 0.0]])
    Z = np.tile(np.diag([0.1**2, 0.1**2]), (2, 1, 1))
    assert associate(z, Z, np.array([[5.0, 0.0]]), np.zeros((2, 2)), JOINT).verdict.tolist() == [PAIRED, NEW]


def test_two_sightings_of_one_candidate_nearest_neighbour_keeps_the_nearer_and_likelihood_gives_a_second_choice() -> (
    None
):
    z = np.array([[5.1, 0.0], [5.05, 0.0]])
    Z = np.tile(np.diag([0.1**2, 0.1**2]), (2, 1, 1))
    h = np.array([[5.0, 0.0], [5.25, 0.0]])
    settings = {method: AssociationSettings.model_validate({"method": method}) for method in METHODS}
    found = {method: associate(z, Z, h, np.zeros((4, 4)), settings[method]).hypothesis.tolist() for method in METHODS}
    assert found["nearest_neighbour"] == [-1, 0]
    assert found["maximum_likelihood"] == [1, 0]


def test_of_two_candidates_equally_far_the_better_known_is_likelier() -> None:
    """The vague one is nearer in its own sigmas."""
    h = np.array([[5.0, 0.0], [5.4, 0.0]])
    C = np.diag([0.01**2, 0.01**2, 1.0, 1.0])
    case = Case(np.array([[5.2, 0.0]]), np.array([np.diag([0.1**2, 0.1**2])]), h, C)
    assert associate(*case, AssociationSettings(method="nearest_neighbour")).hypothesis.tolist() == [1]
    assert associate(*case, AssociationSettings(method="maximum_likelihood")).hypothesis.tolist() == [0]
    assert associate(*case, JOINT).hypothesis.tolist() == [0]


def test_bearings_are_compared_across_the_back_and_metres_are_not_wrapped() -> None:
    z, h = np.array([[5.0, 3.14]]), np.array([[5.0, -3.14]])
    Z, C = np.array([np.diag([0.1**2, 0.1**2])]), np.zeros((2, 2))
    assert associate(z, Z, h, C, JOINT).assignment.tolist() == [0]
    assert associate(z, Z, h, C, JOINT, model=COMPASS_XY).verdict.tolist() == [NEW]


def test_a_search_ends_at_its_limit_of_nodes_and_says_so() -> None:
    """Ten sightings in a heap of twelve candidates that all fit."""
    rng = np.random.default_rng(3)
    z, h = rng.normal(5.0, 0.05, (10, 2)), rng.normal(5.0, 0.05, (12, 2))
    case = Case(z, np.tile(0.01 * np.eye(2), (10, 1, 1)), h, 0.01 * np.eye(24))
    found = associate(*case, JOINT)
    assert found.cut_short
    assert found.pairs == 10


def test_what_does_not_go_together_or_is_no_covariance_is_refused() -> None:
    z, Z, h, C = Case(np.ones((2, 2)), np.tile(np.eye(2), (2, 1, 1)), np.ones((1, 2)), np.eye(2))
    with pytest.raises(ValueError, match="do not go together"):
        associate(z, Z[:1], h, C, JOINT)
    with pytest.raises(NumericalError, match="cannot be associated"):
        associate(z * np.nan, Z, h, C, JOINT)
    with pytest.raises(NumericalError, match="cannot be associated"):
        associate(z, -Z, h, C, JOINT)
    with pytest.raises(NumericalError, match="cannot be associated"):
        associate(z, Z, h, -2.0 * C, JOINT)


def decisions() -> list[Association]:
    """Of every method on a few problems of a vehicle that turns in a ring of landmarks."""
    found = []
    rng = np.random.default_rng(5)
    places = rng.uniform(-5.0, 5.0, (8, 2))
    for method in METHODS:
        for k in range(3):
            error = np.array([0.1 * k, -0.1, 0.02])
            at = scene(places + 0.01, error, (0.2, 0.2, 0.05), [0, 3, 5, 6], act(error, places[:1].ravel())[None])
            found.append(associate(*at.case, AssociationSettings.model_validate({"method": method})))
    return found


WITHOUT_JIT = """
import sys
import numba, numpy as np
from tests.test_association import decisions
assert numba.config.DISABLE_JIT
found = decisions()
np.savez(sys.argv[1], *[each.hypothesis for each in found], *[each.verdict for each in found])
"""


def test_kernels_decide_the_same_as_ordinary_python(tmp_path: Path) -> None:
    out = tmp_path / "plain.npz"
    subprocess.run(
        [sys.executable, "-c", WITHOUT_JIT, str(out)],
        check=True, timeout=100, cwd=Path(__file__).parents[1], env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )  # fmt: skip
    found = decisions()
    with np.load(out) as plain:
        for name, compiled in zip(
            plain.files, [*(e.hypothesis for e in found), *(e.verdict for e in found)], strict=True
        ):
            assert np.array_equal(plain[name], compiled)
