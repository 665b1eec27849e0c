"""What all experiments share: how they are asked, what they answer, and the files they leave.

An experiment is a function `run(out, seed, quick, progress)`: it writes `<name>.png` and `<name>.csv` into the folder
`out`, calls progress(done, total) now and then, and returns the rows of its summary. Worlds are numbered: the first is
world `seed`, and the same seed gives the same files, but for columns of measured times.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fleet_seif.errors import RunError

Progress = Callable[[int, int], None]
Cell = str | int | float
NOT_PRINTED: Final = "-"
"""In place of the paper's number where the issue has none."""
HEADS: Final = ("quantity", "the paper", "ours", "command")


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of a summary: a quantity with its unit, what the paper prints, and what was measured."""

    quantity: str
    paper: str = NOT_PRINTED
    ours: str


def prepare_folder(out: Path, name: str) -> None:
    """Make the folder, without what an earlier run of this experiment left there. Raises RunError if it cannot be."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in (png_of(out, name), csv_of(out, name), summary_of(out)):
            old.unlink(missing_ok=True)
    except OSError as error:
        raise RunError(f"cannot write to {out}: {error.strerror or error}; give another --out DIR") from None


def png_of(out: Path, name: str) -> Path:
    return out / f"{name}.png"


def csv_of(out: Path, name: str) -> Path:
    return out / f"{name}.csv"


def summary_of(out: Path) -> Path:
    return out / "summary.md"


def write_csv(path: Path, rows: Sequence[Mapping[str, Cell]]) -> None:
    """A header and a line for each row; every row has the columns of the first. Floats with nine digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(rows[0])
        for row in rows:
            cells = (row[column] for column in rows[0])
            writer.writerow(f"{cell:.9g}" if isinstance(cell, float) else cell for cell in cells)


def write_summary(path: Path, title: str, command: str, rows: Sequence[Row], quick: bool) -> None:
    """A Markdown table of HEADS."""
    lines = [f"# {title}", ""]
    if quick:
        lines += ["Made with `--quick`: fewer worlds and steps than the experiment asks for. Not for comparison.", ""]
    lines += [_line(HEADS), _line(["---"] * len(HEADS))]
    lines += [_line((row.quantity, row.paper, row.ours, f"`{command}`")) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _line(cells: Sequence[str]) -> str:
    escaped = [cell.replace("|", "\\|") for cell in cells]
    return f"| {' | '.join(escaped)} |"
