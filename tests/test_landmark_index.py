"""The grid of landmarks against a list that is scanned."""

import time

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fleet_seif.landmark_index import CELLS_MAX, NUMBER_MAX, LandmarkIndex

CELL_M = 0.5
COORDINATES = st.one_of(st.floats(-3.0, 3.0), st.integers(-6, 6).map(lambda k: k * CELL_M), st.floats(-1e6, 1e6))
RADII = st.one_of(st.floats(0.0, 2.0), st.just(CELL_M), st.floats(0.0, 1e7))


class AgainstAList(RuleBasedStateMachine):
    """Whatever was inserted, moved and removed, a query finds what a scan of a plain table finds."""

    def __init__(self) -> None:
        super().__init__()
        self.index = LandmarkIndex(CELL_M)
        self.table: dict[int, tuple[float, float]] = {}

    @rule(number=st.one_of(st.integers(0, 20), st.integers(0, 700)), x=COORDINATES, y=COORDINATES)
    def insert(self, number: int, x: float, y: float) -> None:
        if number in self.table:
            with pytest.raises(ValueError, match="cannot be inserted"):
                self.index.insert(number, x, y)
            return
        self.index.insert(number, x, y)
        self.table[number] = (x, y)

    @precondition(lambda self: self.table)
    @rule(data=st.data(), x=COORDINATES, y=COORDINATES)
    def move(self, data: st.DataObject, x: float, y: float) -> None:
        number = data.draw(st.sampled_from(sorted(self.table)))
        self.index.move(number, x, y)
        self.table[number] = (x, y)

    @precondition(lambda self: self.table)
    @rule(dx=st.floats(-1.0, 1.0), dy=st.floats(-1.0, 1.0))
    def move_all(self, dx: float, dy: float) -> None:
        self.table = {number: (x + dx, y + dy) for number, (x, y) in self.table.items()}
        self.index.move_all(np.array(list(self.table)), np.array(list(self.table.values())))

    @precondition(lambda self: self.table)
    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        number = data.draw(st.sampled_from(sorted(self.table)))
        self.index.remove(number)
        del self.table[number]

    @rule(x=COORDINATES, y=COORDINATES, radius=RADII)
    def within(self, x: float, y: float, radius: float) -> None:
        expected = [
            number
            for number, (px, py) in sorted(self.table.items())
            if (px - x) * (px - x) + (py - y) * (py - y) <= radius * radius
        ]
        assert self.index.within(x, y, radius).tolist() == expected

    @invariant()
    def knows_what_it_holds(self) -> None:
        assert len(self.index) == len(self.table)
        assert all(number in self.index for number in self.table)


AgainstAList.TestCase.settings = settings(deadline=None, derandomize=True, max_examples=60, stateful_step_count=40)
TestAgainstAList = AgainstAList.TestCase


def test_what_lies_on_the_circle_or_on_an_edge_of_a_cell_is_found() -> None:
    index = LandmarkIndex(1.0)
    for number, place in enumerate([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 1.0)]):
        index.insert(number, *place)
    for number in range(6, 200):
        index.insert(number, 100.0 + number, 0.0)
    assert index.within(0.0, 0.0, 1.0).tolist() == [0, 1, 2, 3, 4]
    assert index.within(0.0, 0.0, 0.0).tolist() == [0]


def test_what_cannot_be_done_is_refused_and_changes_nothing() -> None:
    index = LandmarkIndex(1.0)
    index.insert(0, 0.5, 0.5)
    beyond = 2.0 * CELLS_MAX
    for number, x in ((1, np.nan), (1, beyond), (-1, 0.0), (NUMBER_MAX + 1, 0.0)):
        with pytest.raises(ValueError, match=r"beyond|cannot be inserted"):
            index.insert(number, x, 0.0)
    with pytest.raises(ValueError, match="not in the index"):
        index.move_all(np.array([0, 3]), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="beyond"):
        index.move(0, np.inf, 0.0)
    with pytest.raises(ValueError, match="not in the index"):
        index.remove(7)
    with pytest.raises(ValueError, match="radius"):
        index.within(0.0, 0.0, -1.0)
    with pytest.raises(ValueError, match="cell_m"):
        LandmarkIndex(0.0)
    assert index.within(0.5, 0.5, 0.0).tolist() == [0]


def query_us(landmarks: int, index: LandmarkIndex) -> float:
    """Median time of a query along a circle in the middle of a map with one landmark a square metre."""
    side = np.sqrt(landmarks)
    angles = np.linspace(0.0, 2.0 * np.pi, 2000)
    taken = []
    for x, y in (side / 2 + 10.0 * np.column_stack([np.cos(angles), np.sin(angles)])).tolist():
        begin = time.thread_time_ns()
        index.within(x, y, 3.0)
        taken.append(time.thread_time_ns() - begin)
    return float(np.median(taken)) * 1e-3


@pytest.mark.slow
def test_a_vehicle_asks_a_map_of_a_hundred_thousand_landmarks_as_fast_as_one_of_a_thousand() -> None:
    rng = np.random.default_rng(0)
    us: dict[int, list[float]] = {1_000: [], 100_000: []}
    maps: dict[int, LandmarkIndex] = {}
    for landmarks in us:
        places = rng.uniform(0.0, np.sqrt(landmarks), (landmarks, 2))
        index = LandmarkIndex(3.0)
        for number, (x, y) in enumerate(places.tolist()):
            index.insert(number, x, y)
        maps[landmarks] = index
    for _ in range(5):
        for landmarks, index in maps.items():
            us[landmarks].append(query_us(landmarks, index))
    best = {landmarks: min(taken) for landmarks, taken in us.items()}
    print("median us of a query by landmarks:", best)
    assert best[100_000] < 2.0 * best[1_000]
