"""hudepth-report sweep: all runs of a sweep in one table, with what their differences show, and as a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Annotated, Any

from hudepth.base.console import log, track
from hudepth.base.errors import HudepthError
from hudepth.base.files import output_folder, write_json, write_text
from hudepth.base.options import Range
from hudepth.metrics.bootstrap import REPEATS, SEED
from hudepth.report.ablation.document import document, table_csv
from hudepth.report.ablation.page import page
from hudepth.report.ablation.pictures import draw_pictures
from hudepth.report.ablation.report import Report, make_report
from hudepth.report.ablation.rows import sort_runs
from hudepth.report.ablation.tables import print_table, table_md, table_tex
from hudepth.report.ablation.words import finding
from hudepth.runs.sweeps import Sweep, read_jobs, read_sweep

FOLDER = "report"  # within the sweep's folder, unless overridden


@dataclass(frozen=True)
class SweepOptions:
    """Options of ``hudepth-report sweep``; conf/report.yaml explains them."""

    dir: Annotated[Path, "folder of a sweep, for example sweeps/<name>/<date_time>"]
    protocol: str = "eigen"
    name: str | None = None
    reference: str | None = None
    output: Path | None = None
    repeats: Annotated[int, Range(100)] = REPEATS
    seed: Annotated[int, Range(0)] = SEED
    panels: Annotated[int, Range(0)] = 0
    paths: Mapping[str, Any] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)
    trust: list[str] = field(default_factory=list)


def report_sweep(options: SweepOptions) -> None:
    """Print the table of a sweep; write table.csv, table.md, table.tex, document.json, pictures and report.html.

    Raises HudepthError if the folder holds no run with a result, or nothing can be written.
    """
    output = options.output or options.dir / FOLDER
    sweep = read_sweep(options.dir, name=options.name)
    reports = tuple(f"skipped: '{path}' " for path in (options.dir / FOLDER, output))  # earlier ones
    sweep = replace(sweep, notes=[note for note in sweep.notes if not note.startswith(reports)])
    rows = sort_runs(sweep, options.protocol, track=lambda runs: track(runs, total=len(runs), what="reading runs"))
    draws = {"repeats": options.repeats, "seed": options.seed}
    try:
        report = make_report(rows, protocol=options.protocol, reference=options.reference, **draws)
    except HudepthError:  # without a table, this is what explains why there is none
        for line in (*rows.troubles, *sweep.notes):
            log.warning("%s", line)
        raise
    for line in [*report.warnings, *sweep.notes]:
        log.warning("%s", line)
    print_table(report)
    _write(report, sweep, output_folder(output, within=None if options.output else options.dir), options)
    log.info("%s", finding(report))
    log.info("page, tables and pictures: %s", (output / "report.html").resolve())


def _write(report: Report, sweep: Sweep, output: Path, options: SweepOptions) -> None:
    for name, text in (("table.csv", table_csv), ("table.md", table_md), ("table.tex", table_tex)):
        write_text(output / name, text(report))
    write_json(output / "document.json", document(report, sweep))
    pictures = draw_pictures(report, output, config=vars(options))
    try:
        names = list(read_jobs(sweep.folder))
    except HudepthError:
        names = []
    name = options.name or (names[0] if len(names) == 1 else sweep.folder.resolve().name)
    facts = {"Made": date.today().isoformat()}
    write_text(
        output / "report.html", page(report, title=f"Sweep {name}", pictures=pictures, notes=sweep.notes, facts=facts)
    )
