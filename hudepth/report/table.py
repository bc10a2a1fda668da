"""hudepth-report table: results of several runs in one table, with whatever keeps them from being compared."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.files import output_folder, write_text
from hudepth.base.tables import Table
from hudepth.metrics.bootstrap import intervals
from hudepth.metrics.catalogue import metric_info, metric_names
from hudepth.runs.comparison import merge
from hudepth.runs.results import Result, find_result
from hudepth.runs.run import CHECKPOINTS


@dataclass(frozen=True)
class TableOptions:
    """Options of ``hudepth-report table``; conf/report.yaml explains them."""

    runs: list[Path]
    protocols: list[str]
    output: Path | None = None
    trust: list[str] = field(default_factory=list)


def write_table(options: TableOptions) -> None:
    """Print a row for each run and protocol, with 95 % intervals; write table.csv and table.md.

    Columns state where protocols, data or splits differ. Raises HudepthError if a run has no result under a protocol.
    """
    if not options.runs:
        raise ConfigError("runs is not set. Pass runs=[<run directory>,<run directory>].")
    results = _results(options.runs, options.protocols)
    names = metric_names("narrow")
    rows: Sequence[Mapping[str, Any]] = merge(results, metrics=names, mark=True)
    ranges = {name: intervals(result.table, **result.averaging) for name, result in results.items()}
    marks = [key for key in rows[0] if key != "name" and key not in names]

    output = output_folder(options.output or "table")
    heading = {name: f"{metric_info(name).label} {metric_info(name).arrow}" for name in names}

    def tabulate(*, between: str = " ") -> Table:
        columns = ["", *marks, *heading.values()]
        rank = [heading[name] for name in dict.fromkeys((*metric_names("headline"), *names))]
        caption = "in brackets: 95 % intervals over scenes"
        table = Table(columns, left=1 + len(marks), caption=caption, rank=rank, rest=str(output / "table.csv"))
        for row in rows:
            cells = (_cell(name, row[name], ranges[row["name"]].get(name), between) for name in names)
            table.add(row["name"], *(row[key] for key in marks), *cells)
        return table

    numbers = Table(["name", *marks, *(f"{name}{part}" for name in names for part in ("", "_low", "_high"))])
    for row in rows:
        values = [x for name in names for x in (row[name], *ranges[row["name"]].get(name, (math.nan, math.nan)))]
        numbers.add(row["name"], *(row[key] for key in marks), *(f"{value:.9g}" for value in values))
    write_text(output / "table.csv", numbers.to_csv())
    full = tabulate()
    write_text(output / "table.md", f"{full.to_markdown()}\n{full.caption.capitalize()}.\n")
    tabulate(between="\n").show()
    log.info("as text: %s", output.resolve())


def _results(runs: Sequence[Path], protocols: Sequence[str]) -> dict[str, Result]:
    # the name of a run directory is a date; the folder above it names the run
    short = [run.resolve().parent.name if (run / CHECKPOINTS).is_dir() else run.resolve().name for run in runs]
    found: dict[str, Result] = {}
    troubles: list[DataError] = []
    for run, name in zip(runs, short, strict=True):
        full = name if short.count(name) == 1 else f"{name}/{run.resolve().name}"
        for protocol in protocols:
            key = full if len(protocols) == 1 else f"{full}, {protocol}"
            if key in found:
                raise ConfigError(f"runs: two are called '{full}'. Pass each once, or rename a folder.")
            try:
                found[key] = find_result(run, protocol)
            except DataError as error:  # one damaged run does not end the table
                troubles.append(error)
    if not found:
        raise troubles[0]
    for trouble in troubles:
        log.warning("left out: %s", trouble)
    return found


def _cell(name: str, value: float, interval: tuple[float, float] | None, between: str) -> str:
    info = metric_info(name)
    if interval is None or math.isnan(interval[0]):
        return info.format(value)
    return f"{info.format(value)}{between}[{info.format(interval[0])}, {info.format(interval[1])}]"
