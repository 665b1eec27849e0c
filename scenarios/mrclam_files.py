"""The text files of MR.CLAM: numbers in columns, `#` comments. What is malformed is named with file and line."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleet_seif.records import Floats


class DatasetError(ValueError):
    """The data set's folder, or a file in it, is not as described above."""


@dataclass(frozen=True)
class Format:
    """Columns of a file; `whole` lists those that hold whole numbers from 0 up."""

    columns: tuple[str, ...]
    whole: tuple[int, ...] = ()


BARCODES = Format(("subject", "barcode"), whole=(0, 1))
LANDMARKS = Format(("subject", "x m", "y m", "std x m", "std y m"), whole=(0,))
ODOMETRY = Format(("time s", "forward velocity m/s", "angular velocity rad/s"))
MEASUREMENT = Format(("time s", "barcode", "range m", "bearing rad"), whole=(1,))
GROUNDTRUTH = Format(("time s", "x m", "y m", "heading rad"))


def read(path: Path, form: Format, max_rows: int | None = None) -> Floats:
    """A file's numbers, shape (n, columns); n may be 0 for measurements only.

    Raises:
        DatasetError: the file is missing, has no rows, or a row is malformed; names the file and line.
    """
    if not path.is_file():
        raise DatasetError(f"{path} is missing: columns {', '.join(form.columns)}. {_remedy(form)}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # "input contained no data": handled below
            rows = np.loadtxt(path, ndmin=2, max_rows=max_rows, encoding="utf-8")
    except ValueError as error:
        raise DatasetError(_first_fault(path, form)) from error
    if rows.size == 0 and form is not MEASUREMENT:
        raise DatasetError(f"{path} has no rows: columns {', '.join(form.columns)}. {_remedy(form)}")
    if rows.size == 0:
        rows = np.empty((0, len(form.columns)))
    if rows.shape[1] != len(form.columns) or not _well_formed(rows, form).all():
        raise DatasetError(_first_fault(path, form))
    return rows


def _remedy(form: Format) -> str:
    if form is GROUNDTRUTH:
        return "A robot's start pose is taken from it; use a data set that has it for every robot (2 and 6 do)"
    return "Unpack the whole data set into this folder"


def _well_formed(rows: Floats, form: Format) -> NDArray[np.bool_]:
    """Which rows hold finite numbers, whole ones from 0 up where they must, shape (n,)."""
    whole = rows[:, list(form.whole)]
    fine: NDArray[np.bool_] = np.isfinite(rows).all(axis=1) & ((whole >= 0) & (whole == np.rint(whole))).all(axis=1)
    return fine


def _first_fault(path: Path, form: Format) -> str:
    """Which line of a file is malformed, and what was expected there."""
    expected = f"expected {len(form.columns)} numbers ({', '.join(form.columns)})"
    for number, words in _lines(path):
        try:
            row = np.array([[float(word) for word in words]])
        except ValueError:
            row = np.empty((1, 0))
        if row.shape[1] != len(form.columns) or not _well_formed(row, form).all():
            return f"{path}, line {number}: {expected}, got '{' '.join(words)[:80]}'; mend or remove the line"
    return f"{path}: {expected} in every line; unpack the file again"


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers from 1 and the words of every line that is not blank or a comment."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            words = line.partition("#")[0].split()
            if words:
                yield number, words
