"""metrics.csv of a run: one row per epoch."""

from __future__ import annotations

import csv
from pathlib import Path

from hudepth.base.errors import DataError


def read_history(path: Path) -> list[dict[str, float]]:
    """Read a run's metrics.csv.

    Raises:
        DataError: if it is missing or holds no epoch.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(file)]
    except (OSError, ValueError, TypeError, csv.Error) as error:  # TypeError: a row with more values than names
        raise DataError(f"'{path}' cannot be read as a history of epochs ({error}).") from error
    if not all("epoch" in row for row in rows):
        raise DataError(f"'{path}' is not a history of epochs: it has rows without an epoch.")
    if not rows:
        raise DataError(f"'{path}' holds no finished epoch.")
    return rows
