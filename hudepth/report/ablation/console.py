"""A sweep's table on standard output."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from hudepth.report.ablation import words
from hudepth.report.ablation.estimates import NOT_SHOWN
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.row import Row

FIRST = ("abs_rel", "rmse", "delta1")
"""What a narrow terminal shows before the others."""
WIDTH = 200
"""Columns of letters where there is no terminal: a log should not wrap what a wide terminal would show."""
LONGEST = 28
"""Letters of a label before it is folded."""


def print_table(report: Report) -> None:
    """Print a row a variant: each metric with its interval over seeds, and below it the difference from the reference;
    then a line for each run that does not count."""
    out = Console()
    if not out.is_terminal:
        out = Console(width=WIDTH)
    labels = [_label(row) for row in report.rows]
    room = min(LONGEST, max(len(line) for label in labels for line in label.plain.splitlines()))
    columns = _fitting(report, out.width - room - 12)
    table = Table(
        title=f"{words.about(report)}; {words.seeds(report)}",
        caption=f"± half the 95 % interval over seeds; below: difference from {escape(report.reference.label)}, "
        "better or worse if the intervals over seeds and over scenes both show it; bold: best",
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
    )
    table.add_column("", overflow="fold", width=room)
    table.add_column("seeds", justify="right", no_wrap=True)
    for name in columns:
        table.add_column(escape(words.heading(name)), justify="right", no_wrap=True)
    for number, (row, label) in enumerate(zip(report.rows, labels, strict=True)):
        table.add_row(label, row.counted, *(cells[number] for cells in columns.values()))
    out.print(table)
    for each in report.troubles:
        what = f"'{each.run}' of row" if each.run else "a job of row"
        why = f": {each.why}" if each.why else ""
        out.print(
            f"not counted: {what} '{each.row}', seed {each.seed}: {each.state}{why}",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip


def _label(row: Row) -> Text:
    label = Text(row.label)
    if row.is_reference:
        label.append(" (reference)", style="dim")
    if row.differs:
        label.append(f"\ndiffers: {row.differs[0]}", style="dim")
    return label


def _fitting(report: Report, room: int) -> dict[str, list[Text]]:
    """Return the cells of as many metrics as there is room for, at least one; the files always have all."""
    digits = words.places(report)
    columns: dict[str, list[Text]] = {}
    for name in sorted(report.metrics, key=lambda name: name not in FIRST):
        cells = [_cell(row, name, digits[name]) for row in report.rows]
        room -= 1 + max(
            len(line) for text in (words.heading(name), *(c.plain for c in cells)) for line in text.splitlines()
        )
        if room < 0 and columns:
            break
        columns[name] = cells
    return {name: columns[name] for name in report.metrics if name in columns}


def _cell(row: Row, name: str, digits: int) -> Text:
    found, difference = row.estimates.get(name), row.contrasts.get(name)
    if found is None:
        return Text("-")
    cell = Text(words.number(found.mean, digits), style="bold" if name in row.best else "")
    if half := words.half_width(found.seeds, digits):
        cell = Text.assemble(cell, f" {half}")
    if difference is not None:
        value = words.number(difference.value, digits, sign=True)
        word = "" if difference.verdict == NOT_SHOWN else f" {difference.verdict}"
        cell = Text.assemble(cell, "\n", (value, "dim"), (word, "bold"))
    return cell
