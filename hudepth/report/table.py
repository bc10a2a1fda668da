"""hudepth-report table: results of several runs in one table, with all that keeps them from comparing beside them."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.files import write_text
from hudepth.evaluation.tables import NARROW as METRICS
from hudepth.metrics.bootstrap import intervals
from hudepth.runs.results import Result, find_result, merge
from hudepth.runs.run_dir import CHECKPOINTS

FEW = ("abs_rel", "rmse", "ssim", "delta1")
"""Columns in a terminal too narrow for all; the files always have all."""


def table(config: dict[str, Any]) -> None:
    """Print a row for each run and protocol, with 95 % intervals; write table.csv and table.md.

    Where protocols, data or splits differ, columns say in what.

    Args:
        config: ``runs`` (run directories or folders of test results), ``protocol`` (names) and ``output``.

    Raises:
        HudepthError: if a run has no result of a protocol.
    """
    if not config["runs"]:
        raise ConfigError("runs is not set. Pass runs=[<run directory>,<run directory>].")
    results = _results([Path(str(run)).expanduser() for run in config["runs"]], config["protocol"])
    rows = merge(results, metrics=METRICS, mark=True)
    marks = [key for key in rows[0] if key != "name" and key not in METRICS]
    ranges = {name: intervals(result.table, **result.averaging) for name, result in results.items()}
    output = Path(config["output"] or "table").expanduser()
    try:
        write_text(output / "table.csv", _csv(rows, ranges))
        write_text(output / "table.md", _markdown(rows, ranges, marks))
    except OSError as error:
        raise ConfigError(f"output: cannot write '{output}' ({error.strerror}). Pass output=<a folder>.") from error
    _print(rows, ranges, marks)
    log.info("as text: %s", output.resolve())


def _results(runs: Sequence[Path], protocols: Sequence[str]) -> dict[str, Result]:
    # a run directory is called by its date; what it is, the folder above says
    short = [run.resolve().parent.name if (run / CHECKPOINTS).is_dir() else run.resolve().name for run in runs]
    found: dict[str, Result] = {}
    for run, name in zip(runs, short, strict=True):
        full = name if short.count(name) == 1 else f"{name}/{run.resolve().name}"
        for protocol in protocols:
            key = full if len(protocols) == 1 else f"{full}, {protocol}"
            if key in found:
                raise ConfigError(f"runs: two are called '{full}'. Pass each once, or rename a folder.")
            found[key] = find_result(run, protocol)
    return found


Rows = Sequence[dict[str, Any]]
Ranges = dict[str, dict[str, tuple[float, float]]]


def _csv(rows: Rows, ranges: Ranges) -> str:
    text = io.StringIO()
    marks = [key for key in rows[0] if key not in METRICS]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*marks, *(f"{metric}{part}" for metric in METRICS for part in ("", "_low", "_high"))])
    for row in rows:
        values = [(row[metric], *ranges[row["name"]].get(metric, (math.nan, math.nan))) for metric in METRICS]
        writer.writerow([*(row[key] for key in marks), *(f"{x:.9g}" for triple in values for x in triple)])
    return text.getvalue()


def _markdown(rows: Rows, ranges: Ranges, marks: Sequence[str]) -> str:
    names = ["", *marks, *METRICS]
    lines = [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"]
    for row in rows:
        cells = [row["name"], *(row[key] for key in marks), *(" ".join(_cell(row, ranges, m)) for m in METRICS)]
        lines.append(f"| {' | '.join(str(cell).replace('|', '&#124;') for cell in cells)} |")
    return "\n".join([*lines, "", "In brackets: 95 % intervals by scene; rmse in metres.", ""])


def _cell(row: dict[str, Any], ranges: Ranges, metric: str) -> tuple[str, str]:
    low, high = ranges[row["name"]].get(metric, (math.nan, math.nan))
    interval = "" if math.isnan(low) else f"[{low:.3f}, {high:.3f}]"
    return "-" if math.isnan(row[metric]) else f"{row[metric]:.3f}", interval


def _print(rows: Rows, ranges: Ranges, marks: Sequence[str]) -> None:
    out = Console()
    if not out.is_terminal:
        out = Console(width=200)
    shown = Table(caption="rmse in metres; delta and ssim: higher is better; in brackets: 95 % by scene")
    for name in ("", *marks):
        shown.add_column(name, overflow="fold", min_width=10 if name else 20)
    metrics = METRICS if out.width >= 190 else FEW
    for metric in metrics:
        shown.add_column(metric, justify="right", no_wrap=True)
    for row in rows:
        cells = ["\n".join(_cell(row, ranges, metric)) for metric in metrics]
        shown.add_row(row["name"], *(row[key] for key in marks), *(cell.replace("[", "\\[") for cell in cells))
    out.print(shown)
