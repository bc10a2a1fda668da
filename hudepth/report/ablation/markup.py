"""A sweep's table for people who write: table.md and table.tex."""

from __future__ import annotations

from collections.abc import Sequence

from hudepth.metrics.summary import higher_is_better
from hudepth.report.ablation import words
from hudepth.report.ablation.estimates import BETTER, NOT_SHOWN
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.row import Row

_MARKDOWN = {"|": "&#124;", "<": "&lt;", "*": "\\*", "_": "\\_", "`": "\\`", "[": "\\["}
_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "±": r"\(\pm\)", "²": r"\textsuperscript{2}", "…": r"\dots{}",
}  # fmt: skip


def table_md(report: Report) -> str:
    """Return table.md: the metrics, the differences from the reference, what does not count."""
    digits = words.places(report)
    factors = [] if report.rows[0].variant.named == "" else [factor.name for factor in report.factors]
    heads = ["", *factors, "seeds", *(words.heading(name) for name in report.metrics)]
    lines = [*_grid(heads, [_metrics(row, report, digits, with_factors=bool(factors)) for row in report.rows]), ""]
    paired = [row for row in report.rows if row.contrasts]
    if paired:
        heads = ["", *(words.heading(name) for name in report.metrics)]
        lines += [f"Difference from {_md(report.reference.label)}:", ""]
        lines += [*_grid(heads, [_differences(row, report, digits) for row in paired]), ""]
    lines += [f"{_md(words.about(report))}; {words.seeds(report)}; rmse in metres. {_md(words.method(report))}", ""]
    lines += [f"- {_md(line)}" for line in report.warnings]
    lines += [_md_trouble([t.run or t.row, t.seed, t.state, t.why]) for t in report.troubles]
    return "\n".join(lines).rstrip() + "\n"


def _grid(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    marks = ["---", *("---:" for _ in heads[1:])]
    return [f"| {' | '.join(cells)} |" for cells in ([_md(head) for head in heads], marks, *rows)]


def _metrics(row: Row, report: Report, digits: dict[str, int], *, with_factors: bool) -> list[str]:
    label = _md(row.label) + (" (reference)" if row.is_reference else "") + (" †" if row.differs else "")
    cells = [label, *(map(_md, row.variant.factors) if with_factors else ()), row.counted]
    for name in report.metrics:
        found = row.estimates.get(name)
        if found is None:
            cells.append("-")
            continue
        mean = words.number(found.mean, digits[name])
        scenes = words.between(found.scenes, digits[name])
        parts = [f"**{mean}**" if name in row.best else mean, words.half_width(found.seeds, digits[name])]
        cells.append(" ".join(part for part in (*parts, f"({scenes})" if scenes else "") if part))
    return cells


def _differences(row: Row, report: Report, digits: dict[str, int]) -> list[str]:
    cells = [_md(row.label)]
    for name in report.metrics:
        found = row.contrasts.get(name)
        value = "-" if found is None else words.number(found.value, digits[name], sign=True)
        cells.append(value if found is None else f"{value} {found.verdict}")
    return cells


def _md_trouble(cells: Sequence[str]) -> str:
    run, seed, state, why = map(_md, cells)
    return f"- not counted: {run}, seed {seed}: {state}{f': {why}' if why else ''}"


def _md(text: str) -> str:
    return "".join(_MARKDOWN.get(letter, letter) for letter in text)


def tex(text: str) -> str:
    """Return text with every letter that means something to LaTeX escaped."""
    return "".join(_TEX.get(letter, letter) for letter in text)


def table_tex(report: Report) -> str:
    """Return table.tex: a booktabs table for \\input, with the best in bold and marked differences."""
    digits = words.places(report)
    heads = ["", "seeds", *(_tex_head(name) for name in report.metrics)]
    body = [" & ".join(_tex_cells(row, report, digits)) + r" \\" for row in report.rows]
    return "\n".join(
        [
            r"% needs \usepackage{booktabs,graphicx}",
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{_caption(report)}}}",
            r"\resizebox{\linewidth}{!}{%",
            rf"\begin{{tabular}}{{lr{'r' * len(report.metrics)}}}",
            r"\toprule",
            " & ".join(heads) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}}",
            r"\end{table}",
            "",
        ]
    )


def _tex_head(name: str) -> str:
    arrow = r"\(\uparrow\)" if higher_is_better(name) else r"\(\downarrow\)"
    return f"{tex(words.heading(name)[:-2])} {arrow}"


def _tex_cells(row: Row, report: Report, digits: dict[str, int]) -> list[str]:
    label = tex(row.label) + (r"\textsuperscript{\dag}" if row.differs else "")
    cells = [label, row.counted]
    for name in report.metrics:
        found, difference = row.estimates.get(name), row.contrasts.get(name)
        if found is None:
            cells.append("--")
            continue
        mean = words.number(found.mean, digits[name])
        cell = rf"\textbf{{{mean}}}" if name in row.best else mean
        if half := words.half_width(found.seeds, digits[name]):
            cell += rf"{{\scriptsize\,{tex(half)}}}"
        if difference is not None and difference.verdict != NOT_SHOWN:
            cell += r"\textsuperscript{+}" if difference.verdict == BETTER else r"\textsuperscript{\(-\)}"
        cells.append(cell)
    return cells


def _caption(report: Report) -> str:
    text = (
        f"{words.about(report)[0].upper()}{words.about(report)[1:]}; mean over {words.seeds(report)}, "
        f"± half the 95 % interval over seeds; rmse in metres; best in bold. {words.method(report)} "
    )
    marks = r"\textsuperscript{+} better, \textsuperscript{\(-\)} worse."
    other = r" \textsuperscript{\dag} Tested under other conditions, so not compared." * any(
        row.differs for row in report.rows
    )
    return tex(text) + marks + other
