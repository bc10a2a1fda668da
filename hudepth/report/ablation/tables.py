"""A sweep's table on a terminal, as Markdown and as LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from hudepth.base.tables import Cell, Content, Table, escape_latex, escape_markdown, say
from hudepth.metrics.catalogue import metric_names
from hudepth.report.ablation import words
from hudepth.report.ablation.estimates import BETTER, NOT_SHOWN
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.rows import Row

Form = Literal["terminal", "markdown", "latex"]


def print_table(report: Report) -> None:
    """Print one row per variant: each metric with its interval over seeds, below it the difference from the reference;
    then a line for each run that does not count."""
    table = _results(report, report.metrics, "terminal")
    table.rank = [words.heading(name) for name in sorted(report.metrics, key=_is_further)]
    table.rest = "table.csv"
    table.title = f"{words.about(report)}; {words.seeds(report)}"
    table.caption = (
        f"± half the 95 % interval over seeds; below: difference from {report.reference.label}, "
        "better or worse if the intervals over seeds and over scenes both show it; bold: best"
    )
    table.show()
    for each in report.troubles:
        say(f"not counted: {each}")


def table_md(report: Report) -> str:
    """Return table.md: the metrics, the differences from the reference, and what does not count."""
    text, digits = _results(report, report.metrics, "markdown").to_markdown(), words.places(report)
    if any(row.contrasts for row in report.rows):
        differences = Table(["", *map(words.heading, report.metrics)])
        for row in (row for row in report.rows if row.contrasts):
            found = ((digits[name], row.contrasts.get(name)) for name in report.metrics)
            cells = (f"{words.number(x.value, places, sign=True)} {x.verdict}" if x else "-" for places, x in found)
            differences.add(row.label, *cells)
        text += f"\nDifference from {escape_markdown(report.reference.label)}:\n\n{differences.to_markdown()}"
    text += f"\n{escape_markdown(f'{words.about(report)}; {words.seeds(report)}. {words.method(report)}')}\n"
    lines = [*report.warnings, *(f"not counted: {trouble}" for trouble in report.troubles)]
    return text + "\n" * bool(lines) + "".join(f"- {escape_markdown(line)}\n" for line in lines)


def table_tex(report: Report) -> str:
    """Return table.tex: a booktabs table for \\input, the best in bold, shown differences marked."""
    about = words.about(report)
    caption = (
        f"{about[0].upper()}{about[1:]}; mean over {words.seeds(report)}, ± half the 95 % interval over seeds; best in "
        f"bold. {words.method(report)} ⁺ better, ⁻ worse."
    )
    if any(row.differs for row in report.rows):
        caption += " † Tested under other conditions, so not compared."
    return (
        "% needs \\usepackage{booktabs,graphicx}\n\\begin{table}\n\\centering\n"
        f"\\caption{{{escape_latex(caption)}}}\n\\resizebox{{\\linewidth}}{{!}}{{%\n"
        f"{_results(report, report.metrics, 'latex').to_latex().rstrip()}}}\n\\end{{table}}\n"
    )


def _results(report: Report, metrics: Sequence[str], form: Form) -> Table:
    digits = words.places(report)
    factors = report.factors if form == "markdown" and report.rows[0].named else []
    table = Table(["", *(factor.name for factor in factors), "seeds", *map(words.heading, metrics)])
    for row in report.rows:
        cells = (_cell(row, name, digits[name], form) for name in metrics)
        table.add(_label(row, form), *(row.factors if factors else ()), row.counted, *cells)
    return table


def _label(row: Row, form: Form) -> Content:
    parts = [Cell(row.label)]
    if row.is_reference and form != "latex":
        parts.append(Cell("(reference)", dim=True))
    if row.differs:
        parts.append(Cell(f"\ndiffers: {row.differs[0]}", dim=True) if form == "terminal" else Cell("†"))
    return tuple(parts)


def _cell(row: Row, name: str, digits: int, form: Form) -> tuple[Cell, ...]:
    found, difference = row.estimates.get(name), row.contrasts.get(name)
    if found is None:
        return (Cell("-"),)
    parts = [Cell(words.number(found.mean, digits), bold=name in row.best)]
    parts.append(Cell(words.half_width(found.seeds, digits), dim=True))
    if form == "markdown" and found.scenes.known:
        parts.append(Cell(f"({words.between(found.scenes, digits)})"))
    if difference is not None and form != "markdown":
        word = "" if difference.verdict == NOT_SHOWN else difference.verdict
        if form == "terminal":
            parts += [Cell(f"\n{words.number(difference.value, digits, sign=True)}", dim=True), Cell(word, bold=True)]
        elif word:
            parts.append(Cell("⁺" if word == BETTER else "⁻"))
    return tuple(part for part in parts if part.text)


def _is_further(name: str) -> bool:
    return name not in metric_names("headline")
