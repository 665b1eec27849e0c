"""What should be in view and is not seen: the sign of doubt that a map begun twice cannot hide (MATHS.md 19)."""

from collections import Counter
from collections.abc import Iterable
from typing import Any, Final

EXPECTED_STEPS: Final = 5
"""Steps of a frame in which a landmark should have been in view, to be missed."""
EXPECTED_LEAST: Final = 5
"""Landmarks that should have been in view, for a share of them to say anything."""
UNSEEN_FRAMES: Final = 4
"""Newest frames over which they are counted."""


class Unseen:
    """Counts landmarks by their keys: step by step in the open frame, then frame by frame."""

    def __init__(self) -> None:
        self._expected: Counter[int] = Counter()
        self._sighted: set[int] = set()
        self._frames: list[tuple[int, int]] = []

    def add(self, expected: Iterable[int], sighted: Iterable[int]) -> None:
        """A step, after which these should be in view, and in which those were sighted."""
        self._expected.update(expected)
        self._sighted.update(sighted)

    def close(self) -> None:
        """The frame has ended."""
        expected = {key for key, steps in self._expected.items() if steps >= EXPECTED_STEPS}
        self._frames = [*self._frames, (len(expected - self._sighted), len(expected))][-UNSEEN_FRAMES:]
        self._expected, self._sighted = Counter(), set()

    @property
    def share(self) -> float:
        """Of the landmarks that should have been in view in the last frames that have ended, those not sighted then."""
        missed, expected = (sum(counts) for counts in zip((0, 0), *self._frames, strict=True))
        return missed / expected if expected >= EXPECTED_LEAST else 0.0

    def state(self) -> tuple[Any, ...]:
        """Plain values for msgpack; `restore` takes them back."""
        return list(self._expected.items()), sorted(self._sighted), list(self._frames)

    def restore(self, state: tuple[Any, ...]) -> None:
        expected, sighted, frames = state
        self._expected, self._sighted = Counter(dict(expected)), set(sighted)
        self._frames = [(a, b) for a, b in frames]
