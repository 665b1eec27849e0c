"""Deltas under other names and from dense posteriors, against dense matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_seif.errors import NumericalError
from fleet_seif.frame_deltas import quantised, renumbered
from fleet_seif.information import B_QUANTUM, H_QUANTUM, FrameDelta, FrameTotal, delta_digest, to_information
from fleet_seif.records import Floats
from tests.strategies import settled, spd, vectors

LANDMARKS = 4
N = 3 + 2 * LANDMARKS


def dense_of(delta: FrameDelta) -> tuple[Floats, Floats]:
    info = to_information(delta)
    return info.H.toarray(), info.b


@given(spd(N), vectors(N, 3.0), st.permutations(range(LANDMARKS)))
@settled
def test_another_numbering_permutes_rows_and_columns(H: Floats, b: Floats, order: list[int]) -> None:
    H = (H + H.T) / 2
    H[3:5, 7:9] = H[7:9, 3:5] = 0.0
    H += 10 * np.eye(N)
    delta = quantised(np.arange(LANDMARKS + 1), H, b, np.zeros(N))
    numbers = np.array(order) * 3
    moved = renumbered(delta, numbers)
    assert moved.variables.tolist() == [0, *(3 * n + 1 for n in range(LANDMARKS))]
    rows = [0, 1, 2, *(3 + 2 * order.index(n) + axis for n in range(LANDMARKS) for axis in (0, 1))]
    before_H, before_b = dense_of(delta)
    after_H, after_b = dense_of(moved)
    assert np.array_equal(after_H, before_H[np.ix_(rows, rows)])
    assert np.array_equal(after_b, before_b[rows])
    total = FrameTotal()
    total.add(moved)
    assert delta_digest(total.delta()) == delta_digest(moved)  # in canonical order


def test_a_delta_without_the_pose_is_renumbered_too() -> None:
    delta = FrameDelta(
        variables=np.array([1, 2]), rows=np.array([0, 0, 1]), cols=np.array([0, 1, 1]),
        H=np.array([1, 2, 3, 4, 5, 6, 7, 8, 9, 10]), b=np.array([1, 2, 3, 4]),
    )  # fmt: skip
    moved = renumbered(delta, np.array([9, 2]))
    assert moved.variables.tolist() == [3, 10]
    assert moved.H.tolist() == [8, 9, 10, 4, 6, 5, 7, 1, 2, 3]
    assert moved.b.tolist() == [3, 4, 1, 2]


@given(spd(N), vectors(N, 3.0))
@settled
def test_a_posterior_in_quanta_is_positive_definite_and_keeps_its_mean(H: Floats, mean: Floats) -> None:
    H = (H + H.T) / 2 + 0.1 * np.eye(N)
    delta = quantised(np.arange(LANDMARKS + 1), H, H @ mean, mean)
    got_H, got_b = dense_of(delta)
    assert np.max(np.abs(got_H - H - np.diag(np.diag(got_H - H)))) <= 0.5 * H_QUANTUM
    assert np.linalg.eigvalsh(got_H)[0] > 0.0
    assert np.max(np.abs(got_b - H @ mean)) <= B_QUANTUM + N * H_QUANTUM * np.max(np.abs(mean), initial=0.0)


def test_a_posterior_beyond_the_quanta_is_refused() -> None:
    with pytest.raises(NumericalError, match="quanta"):
        quantised(np.arange(1), 1e12 * np.eye(3), np.zeros(3), np.zeros(3))
