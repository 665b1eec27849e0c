"""The experiments by name, and how one is run: into a folder with a figure, a CSV and a summary."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final, Protocol

from rich.table import Table
from rich.text import Text

from scenarios.config import ScenarioError
from scenarios.experiments.study import HEADS, Progress, Row, prepare_folder, summary_of, write_summary


class Run(Protocol):
    """See `study`."""

    def __call__(self, out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]: ...


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """title: what is shown, and which figure of the paper it stands beside."""

    name: str
    title: str
    run: Run


EXPERIMENTS: Final = ("correlation", "cost", "error", "sparsity", "confidence", "fleet", "bandwidth")


def find_experiment(name: str) -> Experiment:
    """Raises ScenarioError that lists the names."""
    if name not in EXPERIMENTS:
        raise ScenarioError(f"no experiment {name!r}: use one of {', '.join(EXPERIMENTS)}")
    module = import_module(f"scenarios.experiments.{name}")  # now: what draws takes half a second to import
    return Experiment(name=name, title=module.TITLE, run=module.run)


def run_experiment(chosen: Experiment, out: Path, seed: int, quick: bool, progress: Progress) -> list[Row]:
    """Run it and write its files into the folder `out`. Raises RunError or NumericalError."""
    prepare_folder(out, chosen.name)
    rows = chosen.run(out, seed, quick, progress)
    command = f"fleet-seif experiment {chosen.name} --seed {seed}{' --quick' if quick else ''}"
    write_summary(summary_of(out), chosen.title, command, rows, quick)
    return rows


def summary_table(chosen: Experiment, rows: Sequence[Row], quick: bool) -> Table:
    """The summary for the terminal."""
    note = " (quick: fewer worlds and steps, not for comparison)" if quick else ""
    table = Table(title=f"{chosen.title}{note}", box=None, padding=(0, 1))
    for head in HEADS[:3]:
        table.add_column(head)
    for row in rows:
        table.add_row(Text(row.quantity), row.paper, row.ours)
    return table
