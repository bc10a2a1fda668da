"""The table, for a terminal, as Markdown and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.table import Table

from hudepth.bench.rows import Row, plain, spelt

COLUMNS: tuple[tuple[str, Callable[[Row], str]], ...] = (
    ("ms/image", lambda row: figure_text(row.ms_per_image)),
    ("images/s", lambda row: figure_text(row.images_per_s)),
    ("x eager", lambda row: "" if row.times_eager is None else f"{row.times_eager:.2f}"),
    ("p50 [ms]", lambda row: figure_text(row.p50_ms)),
    ("p25-p75", lambda row: f"{figure_text(row.p25_ms)}-{figure_text(row.p75_ms)}"),
    ("p95", lambda row: figure_text(row.p95_ms)),
    ("MB", lambda row: f"{row.peak_mb:.0f}"),
    ("GFLOP/s", lambda row: "" if row.gflop_per_s is None else figure_text(row.gflop_per_s)),
    ("% peak", lambda row: "" if row.share_of_peak is None else f"{100 * row.share_of_peak:.0f}"),
    ("diff [mm]", lambda row: "" if row.difference_mm is None else f"{row.difference_mm:.2g}"),
)
"""Title and text of each column after the contender's name."""
LEGEND = (
    "ms/image and images/s are those of the median pass; p50, p25-p75 and p95 are quantiles of a pass [ms]; x eager is "
    "images/s over those of this model in eager mode, the median over rounds in which both ran; MB is the most memory "
    "the process held, libraries included; GFLOP/s and % peak count the operations of the network as it was trained "
    "(nominal), % peak of the best single-precision matrix product of the same run, a yardstick and no bound, since "
    "operations that merging saves are counted; diff is the largest difference from eager at any pixel."
)


def terminal_table(rows: Sequence[Row], *, title: str) -> Table:
    """Return the rows as a table, batch by batch."""
    table = Table(title=title, title_justify="left", title_style="bold", pad_edge=False)
    table.add_column("batch", justify="right")
    table.add_column("", min_width=13)
    for name, _ in COLUMNS:
        table.add_column(name, justify="right", no_wrap=True)
    for before, row in zip((None, *rows), rows, strict=False):
        if before is not None and before.batch != row.batch:
            table.add_section()
        first = before is None or before.batch != row.batch
        table.add_row(str(row.batch) if first else "", label(row), *(text(row) for _, text in COLUMNS))
    return table


def label(row: Row) -> str:
    """Return what a row is called: peers have more than one size."""
    return row.contender if row.kind == "backend" else f"{row.contender}, {spelt((row.height, row.width))}"


def markdown(
    rows: Sequence[Row], *, title: str, machine: Mapping[str, Any], sentences: Sequence[str], notes: Sequence[str]
) -> str:
    """Return a page: where it was measured, the table, what follows from it, notes."""
    head = ["batch", "contender", *(name for name, _ in COLUMNS)]
    lines = [f"# {title}", "", f"On {machine_line(machine)}.", ""]
    lines += [f"| {' | '.join(head)} |", f"|---:|---|{'---:|' * len(COLUMNS)}"]
    lines += [f"| {row.batch} | {label(row)} | {' | '.join(text(row) for _, text in COLUMNS)} |" for row in rows]
    lines += ["", LEGEND, ""]
    lines += [f"- {line}" for line in (*sentences, *notes)]
    return "\n".join(lines) + "\n"


def machine_line(machine: Mapping[str, Any]) -> str:
    """Return where something was measured, in one line."""
    versions = ", ".join(f"{name} {version}" for name, version in machine["packages"].items() if version)
    memory = f"{machine['memory_gb']:.0f} GB, " if machine["memory_gb"] else ""
    sets = " ".join(machine["instruction_sets"]) or "instruction sets unknown"
    return (
        f"{machine['processor']}, {machine['cores']} cores of which {machine['usable_cores']} may be used, {memory}"
        f"{sets}; {machine['system']}, Python {machine['python']}, {versions}"
    )


def csv_text(rows: Sequence[Row]) -> str:
    """Return the rows as CSV; what is not known is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(Row.__dataclass_fields__), lineterminator="\n")
    writer.writeheader()
    writer.writerows(plain(row) for row in rows)
    return text.getvalue()


def figure_text(value: float) -> str:
    """Return a positive number with three digits, or all its whole ones."""
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"
