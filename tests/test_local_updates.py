"""Each update of the SEIF on a dense block, against the formula it stands for."""

from dataclasses import dataclass

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fleet_seif.dense import cholesky_into
from fleet_seif.local_updates import (
    NORMALISED,
    add_outer_into,
    link_strengths,
    measurement_update_into,
    motion_update_into,
    sparsify_into,
    squared_innovation,
    weakest_links,
)
from fleet_seif.models import COMPASS_XY, RANGE_BEARING
from fleet_seif.records import Floats
from tests import reference
from tests.strategies import finite, settled, spd, vectors

MODELS = st.sampled_from([RANGE_BEARING, COMPASS_XY])
LANDMARKS = 3
N = 3 + 2 * LANDMARKS


def close(a: Floats, b: Floats, tolerance: float = 1e-9) -> None:
    """Equal relative to the largest entry."""
    np.testing.assert_allclose(a, b, rtol=0.0, atol=tolerance * max(1.0, float(np.max(np.abs(b)))))


def step_covariances() -> st.SearchStrategy[Floats]:
    return spd(3, least=1e-3).map(lambda A: (A + A.T) * 0.05)


def noises() -> st.SearchStrategy[Floats]:
    return spd(2, least=0.01).map(lambda A: (A + A.T) * 0.05)


@given(arrays(float, (3, 5), elements=finite(3.0)), spd(3), st.sampled_from([1.0, -1.0]))
@settled
def test_adding_an_outer_product_adds_w_transposed_k_w_and_stays_symmetric(W: Floats, K: Floats, sign: float) -> None:
    K = (K + K.T) / 2
    H = np.eye(5)
    add_outer_into(H, W, K, sign)
    close(H, np.eye(5) + sign * W.T @ K @ W, 1e-12)
    assert np.array_equal(H, H.T)


@given(MODELS, spd(N), vectors(N, 3.0), vectors(3, 2.0), step_covariances())
@settled
def test_motion_propagates_mean_and_covariance_where_the_mean_is_exact(
    model: int, H: Floats, mu: Floats, u: Floats, cov: Floats
) -> None:
    check_motion(model, (H + H.T) / 2, mu, np.zeros(N), u, cov)


@given(MODELS, spd(N), vectors(N, 3.0), vectors(N, 1.0), vectors(3, 2.0), step_covariances())
@settled
def test_motion_propagates_the_true_mean_where_the_filters_mean_is_off(
    model: int, H: Floats, mu: Floats, residual: Floats, u: Floats, cov: Floats
) -> None:
    check_motion(model, (H + H.T) / 2, mu, residual, u, cov)


def check_motion(model: int, H: Floats, mu: Floats, residual: Floats, u: Floats, cov: Floats) -> None:
    b = H @ mu + residual
    expected_H, expected_b, expected_mu = reference.motion_update(H, b, mu, model, u, cov)
    motion_update_into(H, b, mu, model, u, cov)
    close(H, expected_H)
    close(b, expected_b)
    close(mu, expected_mu, 1e-12)
    assert np.array_equal(H, H.T)


def test_motion_without_noise_is_reversible() -> None:
    H = np.diag(np.arange(1.0, N + 1)) + 0.1
    mu = np.arange(float(N))
    b, before = H @ mu, H.copy()
    still = np.zeros((3, 3))
    motion_update_into(H, b, mu, COMPASS_XY, np.array([1.0, 2.0, 3.0]), still)
    motion_update_into(H, b, mu, COMPASS_XY, -np.array([1.0, 2.0, 3.0]), still)
    close(H, before, 1e-13)
    close(b, before @ np.arange(float(N)), 1e-13)


@given(MODELS, spd(N), vectors(N, 5.0), vectors(N, 1.0), st.lists(st.integers(0, LANDMARKS - 1), max_size=3), st.data())
@settled
def test_sightings_one_by_one_add_what_the_stacked_jacobian_adds(
    model: int, H: Floats, mu: Floats, residual: Floats, seen: list[int], data: st.DataObject
) -> None:
    H = (H + H.T) / 2
    at = [3 + 2 * i for i in seen]
    assume(all(np.hypot(*(mu[a : a + 2] - mu[:2])) > 0.1 for a in at))
    z = np.array([data.draw(vectors(2, 4.0)) for _ in seen]).reshape(-1, 2)
    Z = np.array([data.draw(noises()) for _ in seen]).reshape(-1, 2, 2)
    b = H @ mu + residual
    expected_H, expected_b = reference.measurement_update(H, b, mu, model, z, Z, at)
    for k, a in enumerate(at):
        measurement_update_into(H, b, mu, model, z[k], Z[k], a)
    close(H, expected_H)
    close(b, expected_b)
    assert np.array_equal(H, H.T)


@given(MODELS, spd(N), vectors(N, 5.0), vectors(2, 4.0), noises(), st.integers(0, LANDMARKS - 1))
@settled
def test_the_squared_innovation_is_normalised_by_its_covariance(
    model: int, H: Floats, mu: Floats, z: Floats, Z: Floats, landmark: int
) -> None:
    at = 3 + 2 * landmark
    assume(np.hypot(*(mu[at : at + 2] - mu[:2])) > 0.1)
    L = np.zeros((N, N))
    assert cholesky_into(L, H, N)
    J = np.zeros((2, N))
    J[:, [0, 1, 2, at, at + 1]] = reference.sighting_jacobian(model, mu[:3], mu[at : at + 2])
    r = reference.difference(model, z, reference.expected(model, mu[:3], mu[at : at + 2]))
    expected = float(r @ np.linalg.solve(J @ np.linalg.inv(H) @ J.T + Z, r))
    assert abs(squared_innovation(L, N, mu, model, z, Z, at) - expected) <= 1e-8 * max(1.0, expected)


@dataclass(frozen=True, eq=False)
class Block:
    """A positive definite block: landmarks that stay active, are dropped, and have no link to the pose."""

    H: Floats
    mu: Floats
    stay: tuple[int, ...]
    drop: tuple[int, ...]
    passive: tuple[int, ...]

    def rows(self, landmarks: tuple[int, ...]) -> list[int]:
        return [row for i in landmarks for row in (3 + 2 * i, 4 + 2 * i)]


@st.composite
def blocks(draw: st.DrawFn) -> Block:
    counts = draw(st.tuples(st.integers(0, 3), st.integers(1, 3), st.integers(0, 2)))
    order = draw(st.permutations(range(sum(counts))))
    stay, drop, passive = (tuple(sorted(order[sum(counts[:i]) : sum(counts[: i + 1])])) for i in range(3))
    n = 3 + 2 * len(order)
    linked = [0, 1, 2, *(r for i in (*stay, *drop) for r in (3 + 2 * i, 4 + 2 * i))]
    unlinked = list(range(3, n))
    H = np.zeros((n, n))
    H[np.ix_(linked, linked)] += draw(spd(len(linked)))
    H[np.ix_(unlinked, unlinked)] += draw(spd(len(unlinked)))
    assume(all(np.any(H[:3, 3 + 2 * i : 5 + 2 * i]) for i in (*stay, *drop)))  # active means linked to the pose
    return Block((H + H.T) / 2, draw(vectors(n, 5.0)), stay, drop, passive)


@given(blocks())
@settled
def test_sparsification_is_equations_42_and_43(block: Block) -> None:
    H, b, mu = block.H.copy(), block.H @ block.mu, block.mu.copy()
    expected_H, expected_b = reference.sparsified(H, b, mu, block.rows(block.stay), block.rows(block.drop))
    assert sparsify_into(H, b, mu, np.array(block.drop), 1.0)
    close(H, expected_H)
    close(b, expected_b)
    assert np.array_equal(H, H.T)


@given(blocks(), st.data())
@settled
def test_sparsification_moves_the_vector_by_the_change_of_the_matrix_also_where_the_mean_is_off(
    block: Block, data: st.DataObject
) -> None:
    residual = data.draw(vectors(len(block.mu), 1.0))
    H, b = block.H.copy(), block.H @ block.mu + residual
    assert sparsify_into(H, b, block.mu, np.array(block.drop), 1.0)
    close(b - H @ block.mu, residual)


@given(blocks())
@settled
def test_sparsification_cuts_the_dropped_links_to_exactly_zero_and_no_others(block: Block) -> None:
    H = block.H.copy()
    assert sparsify_into(H, H @ block.mu, block.mu, np.array(block.drop), 1.0)
    assert not np.any(H[:3, block.rows(block.drop)])
    assert not np.any(H[:3, block.rows(block.passive)])
    assert not np.any(H[block.rows(block.drop), :3])


@given(blocks())
@settled
def test_sparsification_keeps_the_matrix_positive_definite_and_an_exact_mean(block: Block) -> None:
    H, b = block.H.copy(), block.H @ block.mu
    assert sparsify_into(H, b, block.mu, np.array(block.drop), 1.0)
    assert np.linalg.eigvalsh(H)[0] > 0.0
    np.testing.assert_allclose(np.linalg.solve(H, b), block.mu, rtol=0.0, atol=5e-8)


@given(blocks())
@settled
def test_sparsification_never_makes_the_pose_more_certain_given_the_map(block: Block) -> None:
    H = block.H.copy()
    assert sparsify_into(H, H @ block.mu, block.mu, np.array(block.drop), 1.0)
    assert np.linalg.eigvalsh(block.H[:3, :3] - H[:3, :3])[0] >= -1e-9


def test_sparsification_refuses_a_block_whose_dropped_landmarks_hold_no_information() -> None:
    H = np.eye(5)
    H[3, 3] = -1.0
    assert not sparsify_into(H, np.zeros(5), np.zeros(5), np.array([0]), 1.0)


@given(blocks(), st.integers(0, 4))
@settled
def test_the_links_to_cut_are_the_weakest_normalised_ones(block: Block, active_max: int) -> None:
    strength = {}
    for i in (*block.stay, *block.drop):
        at = 3 + 2 * i
        strength[i] = sum(block.H[r, c] ** 2 / (block.H[r, r] * block.H[c, c]) for r in range(3) for c in (at, at + 1))
    strength = {i: s for i, s in strength.items() if s > 0}
    drop = weakest_links(link_strengths(block.H, NORMALISED), active_max).tolist()
    assert len(drop) == max(len(strength) - active_max, 0)
    assert len(set(drop)) == len(drop)
    kept = [s for i, s in strength.items() if i not in drop]
    assert max((strength[i] for i in drop), default=0.0) <= min(kept, default=np.inf) * (1 + 1e-12)
