"""One table, written for a terminal, as Markdown, CSV or LaTeX."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

LOG_WIDTH = 130
"""Columns of a table that does not go to a terminal: a log should not wrap what a wide terminal would show."""
_LATEX = {c: f"\\{c}" for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "↑": r"\(\uparrow\)",
    "↓": r"\(\downarrow\)", "±": r"\(\pm\)", "−": r"\(-\)", "≥": r"\(\geq\)", "²": r"\(^2\)",
    "<": r"\textless{}", ">": r"\textgreater{}", "…": r"\dots{}",
    "†": r"\textsuperscript{\dag}", "⁺": r"\textsuperscript{+}", "⁻": r"\textsuperscript{\(-\)}",
}  # fmt: skip
_MARKDOWN = {"|": "&#124;", "<": "&lt;", "*": r"\*"}


@dataclass(frozen=True)
class Cell:
    """Text of a cell, or of a part of one; a plain string serves where it has no style."""

    text: str
    bold: bool = False
    dim: bool = False
    """Grey on a terminal, small in LaTeX."""


Content = str | Cell | tuple[Cell, ...]
"""Of a cell; parts are joined by spaces."""


@dataclass
class Table:
    """Rows under named columns. A line break makes a cell taller."""

    columns: Sequence[str]
    rows: list[Sequence[Content]] = field(default_factory=list)
    title: str = ""
    caption: str = ""
    """Below the table."""
    left: int = 1
    """How many columns, from the first on, are aligned to the left."""

    def add(self, *cells: Content) -> None:
        """Append a row."""
        self.rows.append(cells)

    def to_markdown(self) -> str:
        """Return a Markdown table; title and caption are not part of it."""
        rule = "|" + "".join("---|" if i < self.left else "---:|" for i in range(len(self.columns)))
        lines = [_markdown_row(self.columns), rule, *(_markdown_row(row) for row in self.rows)]
        return "\n".join(lines) + "\n"

    def to_csv(self) -> str:
        """Return comma-separated values with a header."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([_join(cell) for cell in row] for row in self.rows)
        return text.getvalue()

    def to_latex(self) -> str:
        """Return a ``tabular`` for the booktabs package."""
        align = "l" * self.left + "r" * (len(self.columns) - self.left)
        lines = [rf"\begin{{tabular}}{{{align}}}", r"\toprule", _latex_row(self.columns), r"\midrule"]
        return "\n".join([*lines, *(_latex_row(row) for row in self.rows), r"\bottomrule", r"\end{tabular}"]) + "\n"

    def to_rich(self, **style: Any) -> RichTable:
        """Return a table for rich; ``style`` goes to its constructor."""
        from rich.markup import escape
        from rich.table import Table as Rich

        table = Rich(
            title=escape(self.title) or None, caption=escape(self.caption) or None,
            title_justify="left", caption_justify="left", **style,
        )  # fmt: skip
        for i, name in enumerate(self.columns):
            table.add_column(escape(name), justify="left" if i < self.left else "right", no_wrap=i >= self.left)
        for row in self.rows:
            table.add_row(*(_join(cell, _rich) for cell in row))
        return table

    def show(self, log_width: int = LOG_WIDTH, **style: Any) -> None:
        """Print to standard output; ``style`` goes to :meth:`to_rich`."""
        stdout(log_width).print(self.to_rich(**style))


def stdout(log_width: int = LOG_WIDTH) -> Console:
    """Return a console for results: as wide as the terminal, or ``log_width`` where there is none."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=log_width)


def escape_markdown(text: str) -> str:
    """Return text in which nothing is markup."""
    return "".join(_MARKDOWN.get(letter, letter) for letter in text)


def escape_latex(text: str) -> str:
    """Return text in which nothing is a command; symbols of these tables become their commands."""
    return "".join(_LATEX.get(letter, letter) for letter in text)


def _join(cell: Content, style: Callable[[Cell], str] = lambda part: part.text) -> str:
    text = ""
    for part in cell if isinstance(cell, tuple) else (cell if isinstance(cell, Cell) else Cell(cell),):
        breaks, words = part.text.startswith("\n"), style(replace(part, text=part.text.removeprefix("\n")))
        text += f"\n{words}" if breaks else f" {words}" if text else words
    return text


def _rich(part: Cell) -> str:
    from rich.markup import escape

    text = escape(part.text)
    return f"[bold]{text}[/]" if part.bold else f"[dim]{text}[/]" if part.dim else text


def _markdown_row(cells: Iterable[Content]) -> str:
    def style(part: Cell) -> str:
        text = escape_markdown(part.text)
        return f"**{text}**" if part.bold else text

    return f"| {' | '.join(_join(cell, style) for cell in cells)} |".replace("\n", " ")


def _latex_row(cells: Iterable[Content]) -> str:
    def style(part: Cell) -> str:
        text = escape_latex(part.text)
        return rf"\textbf{{{text}}}" if part.bold else rf"{{\scriptsize {text}}}" if part.dim else text

    return " & ".join(_join(cell, style) for cell in cells).replace("\n", " ") + r" \\"
