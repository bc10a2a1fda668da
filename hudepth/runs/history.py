"""metrics.csv of a run: one row per epoch."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from hudepth.base.errors import DataError
from hudepth.base.files import read_text, write_text

FILE = "metrics.csv"
WHOLE_NUMBERS = ("epoch", "step")


def write_history(path: Path, rows: Sequence[Mapping[str, float]]) -> None:
    """Write all rows so far; a value that an epoch lacks stays empty."""
    text = io.StringIO()
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: int(v) if name in WHOLE_NUMBERS else repr(v) for name, v in row.items()})
    write_text(path, text.getvalue())


def read_history(path: Path) -> list[dict[str, float]]:
    """Read a run's metrics.csv: one row per epoch. Raises DataError if it is missing or holds no epoch."""
    try:
        lines = io.StringIO(read_text(path), newline="")
        rows = [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(lines)]
    except (OSError, ValueError, TypeError, csv.Error) as error:  # TypeError: a row with more values than names
        raise DataError(f"'{path}' cannot be read as a history of epochs ({error}).") from error
    if not all("epoch" in row for row in rows):
        raise DataError(f"'{path}' is not a history of epochs: it has rows without an epoch.")
    if not rows:
        raise DataError(f"'{path}' holds no finished epoch.")
    return rows
