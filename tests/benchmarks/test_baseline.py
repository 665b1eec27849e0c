"""What the baseline of the benchmarks lets pass. It is part of the default run: nothing is timed."""

from pathlib import Path

import pytest

from tests.benchmarks import baseline
from tests.benchmarks.baseline import Better, Expected


@pytest.mark.parametrize(("better", "good", "bad"), [(Better.LOWER, 1.0, 2.6), (Better.HIGHER, 9.0, 1.5)])
def test_a_ratio_may_be_better_by_any_amount_and_worse_by_the_tolerance(
    better: Better, good: float, bad: float
) -> None:
    expected = {"a": Expected(value=2.0, better=better, tolerance=0.25)}
    worst = expected["a"].worst
    assert worst == {Better.LOWER: 2.5, Better.HIGHER: 1.6}[better]
    assert baseline.refusal(expected, "a", good) is None
    assert baseline.refusal(expected, "a", worst) is None
    why = baseline.refusal(expected, "a", bad)
    assert why is not None
    assert "--write-baseline" in why


def test_a_ratio_that_the_baseline_does_not_name_is_refused() -> None:
    why = baseline.refusal({}, "new", 1.0)
    assert why is not None
    assert "add it" in why


def test_rewriting_changes_the_values_that_were_measured_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    expected = {name: Expected(value=1.0, better=Better.LOWER, tolerance=0.3) for name in ("a", "b")}
    baseline.save(baseline.with_values(expected, {"b": 1.23456, "unknown": 2.0}), path)
    assert baseline.load(path) == {"a": expected["a"], "b": Expected(value=1.23, better=Better.LOWER, tolerance=0.3)}


def test_the_baseline_is_as_it_would_be_written() -> None:
    text = baseline.PATH.read_text(encoding="utf-8")
    copy = baseline.load()
    assert all(entry.value > 0.0 and 0.0 < entry.tolerance < 10.0 for entry in copy.values())
    assert text == baseline.as_text(copy)
