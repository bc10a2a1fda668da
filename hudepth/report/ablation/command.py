"""hudepth-report sweep: all runs of a sweep in one table, with what its differences show, as a page and for a paper."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from hudepth.base.console import log, track
from hudepth.base.errors import ConfigError, HudepthError
from hudepth.base.files import write_json, write_text
from hudepth.base.options import whole_number
from hudepth.metrics.bootstrap import REPEATS, SEED
from hudepth.report.ablation.console import print_table
from hudepth.report.ablation.document import document, table_csv
from hudepth.report.ablation.markup import table_md, table_tex
from hudepth.report.ablation.page import page
from hudepth.report.ablation.pictures import draw_pictures
from hudepth.report.ablation.report import Report, make_report
from hudepth.report.ablation.runs import Rows, sort_runs
from hudepth.runs.sweeps import Sweep, SweepRun, read_jobs, read_sweep

FOLDER = "report"
"""Below the sweep's, unless another is named."""


def sweep_report(config: Mapping[str, Any]) -> None:
    """Print the table of a sweep; write table.csv, table.md, table.tex, document.json, pictures and report.html.

    Args:
        config: ``dir`` (the sweep's folder), ``protocol`` (its name), and perhaps ``name`` (of one sweep in the
            folder), ``reference`` (a row), ``output`` (a folder), ``repeats`` and ``seed`` of the bootstrap, ``panels``
            (how many images), and ``paths``, ``data`` and ``trust`` to open runs with.

    Raises:
        HudepthError: with one line for the user.
    """
    if not config.get("dir"):
        raise ConfigError("dir is not set. Pass dir=<folder of a sweep>, for example sweeps/<name>/<date_time>.")
    folder, name = Path(str(config["dir"])).expanduser(), config.get("name")
    output = Path(str(config["output"])).expanduser() if config.get("output") else folder / FOLDER
    sweep = _without_reports(read_sweep(folder, name=None if name is None else str(name)), output)
    protocol = str(config.get("protocol") or "eigen")
    rows = sort_runs(sweep, protocol, going_through=_tracked)
    report = _report(rows, sweep, protocol, config)
    for line in [*report.warnings, *sweep.notes]:
        log.warning("%s", line)
    print_table(report)
    try:
        _write(report, sweep, output, config)
    except OSError as error:
        raise ConfigError(f"output: cannot write '{output}' ({error.strerror}). Pass output=<a folder>.") from error
    log.info("page, tables and pictures: %s", (output / "report.html").resolve())


def _tracked(runs: list[SweepRun]) -> Iterator[SweepRun]:
    return track(runs, total=len(runs), what="reading runs")


def _without_reports(sweep: Sweep, output: Path) -> Sweep:
    """Say nothing of an earlier report that lies among the runs."""
    own = [f"left alone: '{path}' " for path in (sweep.folder / FOLDER, output)]
    return replace(sweep, notes=[note for note in sweep.notes if not note.startswith(tuple(own))])


def _report(rows: Rows, sweep: Sweep, protocol: str, config: Mapping[str, Any]) -> Report:
    reference = config.get("reference")
    try:
        return make_report(
            rows,
            protocol=protocol,
            reference=None if reference is None else str(reference),
            repeats=whole_number(config, "repeats", default=REPEATS, least=100),
            seed=whole_number(config, "seed", default=SEED),
        )
    except HudepthError:
        for each in rows.troubles:  # where there is no table, these are what keeps it from being
            log.warning("%s: %s%s", each.run or each.row, each.state, f": {each.why}" if each.why else "")
        for line in sweep.notes:
            log.warning("%s", line)
        raise


def _write(report: Report, sweep: Sweep, output: Path, config: Mapping[str, Any]) -> None:
    write_text(output / "table.csv", table_csv(report))
    write_text(output / "table.md", table_md(report))
    write_text(output / "table.tex", table_tex(report))
    write_json(output / "document.json", document(report, sweep))
    pictures = draw_pictures(report, output, config=config)
    title = f"Sweep {_title(sweep, config.get('name'))}"
    facts = {"Made": date.today().isoformat()}
    write_text(output / "report.html", page(report, title=title, pictures=pictures, notes=sweep.notes, facts=facts))


def _title(sweep: Sweep, name: Any) -> str:
    if name is not None:
        return str(name)
    try:
        names = list(read_jobs(sweep.folder))
    except HudepthError:
        names = []
    return names[0] if len(names) == 1 else sweep.folder.resolve().name
