"""Ratios of this run against those of the baseline.

1. Only ratios of times taken in one run are compared: they mean the same on another machine, and under load.
2. `baseline.json` says of each ratio its value, which direction is better, and the part of the value by which a run may
   be worse. Directions and tolerances are written by hand, values by `pytest ... --write-baseline`.
3. A ratio that the file does not name is refused.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Final

PATH: Final = Path(__file__).parent / "baseline.json"


class Better(StrEnum):
    LOWER = "lower"
    HIGHER = "higher"


@dataclass(frozen=True, kw_only=True)
class Expected:
    """One entry of the file. value: of the run that wrote it; tolerance: relative, e.g. 0.3."""

    value: float
    better: Better
    tolerance: float

    @property
    def worst(self) -> float:
        """The worst value that passes."""
        return (
            self.value * (1.0 + self.tolerance) if self.better is Better.LOWER else self.value / (1.0 + self.tolerance)
        )

    def allows(self, value: float) -> bool:
        return value <= self.worst if self.better is Better.LOWER else value >= self.worst


def load(path: Path = PATH) -> dict[str, Expected]:
    """Raises KeyError, TypeError or ValueError for a file that is not a baseline."""
    entries = json.loads(path.read_text(encoding="utf-8"))
    return {
        name: Expected(value=float(e["value"]), better=Better(e["better"]), tolerance=float(e["tolerance"]))
        for name, e in entries.items()
    }


def refusal(expected: Mapping[str, Expected], name: str, value: float) -> str | None:
    """Why a ratio does not pass; None where it does."""
    if name not in expected:
        return f"ratio {name} = {value:.3g} is not in {PATH.name}: add it there with a direction and a tolerance"
    entry = expected[name]
    if entry.allows(value):
        return None
    return (
        f"ratio {name} = {value:.3g}; {PATH.name} says {entry.value:.3g}, {entry.better} is better, and allows"
        f" {entry.worst:.3g}: something has become slower; run again on a quiet machine, mend it, or, where it is meant"
        " so, rewrite the baseline with --write-baseline and say why"
    )


def with_values(expected: Mapping[str, Expected], measured: Mapping[str, float]) -> dict[str, Expected]:
    """The baseline with the values of this run, three digits each; what was not measured stays."""
    return {
        name: replace(entry, value=float(f"{measured[name]:.3g}")) if name in measured else entry
        for name, entry in expected.items()
    }


def as_text(expected: Mapping[str, Expected]) -> str:
    """One entry a line."""
    lines = [f"  {json.dumps(name)}: {json.dumps(asdict(entry))}" for name, entry in expected.items()]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def save(expected: Mapping[str, Expected], path: Path = PATH) -> None:
    path.write_text(as_text(expected), encoding="utf-8")
