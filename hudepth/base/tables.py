"""One table, written for a terminal, as Markdown, CSV or LaTeX."""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from hudepth.base.console import wrap

if TYPE_CHECKING:
    from rich.console import Console, JustifyMethod
    from rich.table import Table as RichTable

LOG_WIDTH = 200
"""Columns of a table that does not go to a terminal: a log should not wrap what a wide terminal would show."""
GAP, LABEL = 2, 28
"""Letters between two columns; of a label that stays on one line while other columns can be left out."""
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
    """Rows under named columns. A line break makes a cell taller.

    A terminal shows whole words and numbers: where columns are too wide for it, text is broken between words, then
    columns are left out, the least important ones first, which a line below the table names.
    """

    columns: Sequence[str]
    rows: list[Sequence[Content]] = field(default_factory=list)
    title: str = ""
    caption: str = ""
    """Below the table."""
    left: int = 1
    """How many columns, from the first on, hold text, aligned to the left; the others hold numbers."""
    rank: Sequence[str] = ()
    """Columns that a narrow terminal may leave out, the most important first."""
    rest: str = ""
    """The file that has all columns."""

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

    def show(self) -> None:
        """Print to standard output, as wide as the terminal, or :data:`LOG_WIDTH` where there is none."""
        from rich.text import Text

        console = _stdout()
        widths = self._fit(console.width)
        if self.title:
            console.print(Text(wrap(self.title, console.width), "bold"), soft_wrap=True)
        console.print(self._build(widths), crop=False)
        left_out = ", ".join(name.rstrip(" ↑↓") for i, name in enumerate(self.columns) if i not in widths)
        lines = [self.caption, f"{self.rest} also has {left_out}" if left_out else ""]
        for line in filter(None, lines):
            console.print(Text(wrap(line, console.width), "dim"), soft_wrap=True)

    def _build(self, widths: Mapping[int, int]) -> RichTable:
        """Return the table for rich, with the columns in ``widths`` alone, so wide [letters]."""
        from rich.box import SIMPLE_HEAD
        from rich.markup import escape
        from rich.table import Table as Rich

        broken = [i for i, width in widths.items() if i < self.left and width < self._widths(i)[1]]
        table = Rich(
            box=SIMPLE_HEAD, padding=(0, GAP - 1, 0, 0), show_edge=False, pad_edge=False,
            show_header=any(self.columns), leading=int(len(broken) > 1),
        )  # fmt: skip
        for i, width in widths.items():
            justify: JustifyMethod = "left" if i < self.left else "right"
            table.add_column(escape(self.columns[i]), width=width, justify=justify, overflow="fold")
        for row in self.rows:
            cells = ((_hang(row[i], width) if i in broken else row[i]) for i, width in widths.items())
            table.add_row(*(_join(cell, _rich) for cell in cells))
        return table

    def _fit(self, room: int) -> dict[int, int]:
        """Return the columns that fit into ``room`` [letters], by number, and their widths."""
        widths = [self._widths(i) for i in range(len(self.columns))]
        least, natural = [width[0] for width in widths], [width[1] for width in widths]
        for i in range(self.left):  # a word too long for half the terminal is broken; labels rather not
            least[i] = min(natural[i], max(LABEL if self.rank else 0, min(least[i], room // 2)))
        kept, dispensable = list(range(len(self.columns))), [list(self.columns).index(name) for name in self.rank]

        def spare() -> int:
            return room + GAP - sum(least[i] + GAP for i in kept)

        while spare() < 0 and len(dispensable) > 1:
            kept.remove(dispensable.pop())
        while spare() < 0 and least[widest := max(range(self.left), key=lambda i: least[i])] > 1:
            least[widest] -= 1
        for done, i in enumerate(sorted(kept, key=lambda i: natural[i] - least[i])):  # the modest first
            least[i] += min(natural[i] - least[i], max(0, spare()) // (len(kept) - done))
        return {i: least[i] for i in kept}

    def _widths(self, column: int) -> tuple[int, int]:
        """Return the length of a column's longest word, or number, and of its longest line."""
        from rich.cells import cell_len

        name, cells = self.columns[column], [_join(row[column]) for row in self.rows]
        lines = [line for cell in cells for line in cell.split("\n")]
        wholes = lines if column >= self.left else [word for line in lines for word in re.findall(r"^\s+\S+|\S+", line)]
        least = max(map(cell_len, [*name.split(), *wholes]), default=0)
        return least, max(map(cell_len, [name, *lines]))


def _stdout() -> Console:
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=LOG_WIDTH)


def say(text: str) -> None:
    """Print a result to standard output; lines too long for :meth:`Table.show` are broken between words."""
    print(wrap(text, _stdout().width), flush=True)


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


def _hang(cell: Content, width: int) -> Content:
    """Return a cell of one part whose indented lines stay indented when they are broken, and long words are too."""
    if isinstance(cell, tuple):
        return cell
    part = cell if isinstance(cell, Cell) else Cell(cell)
    lines = (wrap(line, width, indent="  " * line.startswith(" ")) for line in part.text.split("\n"))

    def halve(found: re.Match[str]) -> str:
        kept = [""]
        for piece in re.split(r"(?<=[/_=,.:-])", found[0]):
            kept = [*kept[:-1], kept[-1] + piece] if len(kept[-1] + piece) <= width else [*kept, piece]
        return "\n".join(filter(None, kept))

    return replace(part, text=re.sub(rf"\S{{{width + 1},}}", halve, "\n".join(lines)))


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
