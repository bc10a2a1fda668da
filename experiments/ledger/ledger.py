"""The ledger: all rows, as Markdown, as plain types, and as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from experiments.ledger.row import VERDICTS, Row, Sheet
from experiments.ledger.runs import Run
from experiments.ledger.tables import CITATION

COLOURS = {
    "holds": "green", "contradicted": "red", "cannot be": "red", "not reached": "yellow", "another device": "blue",
    "measured": "blue", "not measured": "dim",
}  # fmt: skip


def markdown(rows: Sequence[Row], *, table_2: Sheet, runs: Sequence[Run], environment: Mapping[str, Any]) -> str:
    """Return the ledger as a Markdown page.

    Args:
        rows: in the order to show.
        table_2: the paper's table 2 with the runs next to it.
        runs: what was given as evidence.
        environment: versions, device and the command.
    """
    command = " ".join(environment["command"])
    parts = [
        f"# What the paper claims, and what is measured\n\nThe paper: {CITATION}. Every figure under *measured* was "
        f"computed by `{command}` when it ran, or read from the runs listed at the end; only what stands under *the "
        "paper says* is taken from the paper. ARE is the mean relative depth error (abs_rel), delta1 the share of "
        "pixels within a factor 1.25.",
        "\n".join(f"- **{verdict}**: {meaning}" for verdict, meaning in VERDICTS.items()),
        _count(rows),
        _table(
            ("#", "claim", "the paper says", "measured", "verdict"),
            [[str(n), row.claim, row.says, row.measured, f"**{row.verdict}**"] for n, row in enumerate(rows, start=1)],
        ),
        *(_detail(number, row) for number, row in enumerate(rows, start=1)),
        _sheet(table_2),
        _runs(runs),
        _environment(environment),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def plain_ledger(
    rows: Sequence[Row], *, table_2: Sheet, runs: Sequence[Run], environment: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the ledger as dicts, lists and scalars; arguments as :func:`markdown`."""
    return {
        "paper": CITATION,
        "rows": [
            {
                "key": row.key,
                "claim": row.claim,
                "says": row.says,
                "measured": row.measured,
                "how": row.how,
                "verdict": row.verdict,
                "values": row.values,
                "tables": [_plain_sheet(sheet) for sheet in row.sheets],
            }
            for row in rows
        ],
        "table_2": _plain_sheet(table_2),
        "runs": [{"name": run.name, "path": str(run.path), "problems": run.problems} for run in runs],
        "environment": dict(environment),
    }


def terminal_table(rows: Sequence[Row]) -> Table:
    """Return the ledger as a table that reads well at 120 columns."""
    table = Table(title="The paper's claims, measured", title_justify="left", show_lines=True, expand=True)
    table.add_column("claim", ratio=16)
    table.add_column("the paper says", ratio=30)
    table.add_column("measured", ratio=54)
    table.add_column("verdict", width=14)
    for row in rows:
        colour = COLOURS[row.verdict]
        table.add_row(escape(row.claim), escape(row.says), escape(row.measured), f"[{colour}]{row.verdict}[/]")
    return table


def _count(rows: Sequence[Row]) -> str:
    verdicts = [row.verdict for row in rows]
    return f"{len(rows)} rows: " + ", ".join(f"{verdicts.count(v)} {v}" for v in VERDICTS if v in verdicts) + "."


def _detail(number: int, row: Row) -> str:
    lines = [
        f"## {number}. {row.claim}",
        f"*The paper says:* {row.says}.",
        f"*Measured:* {row.measured}.",
        f"*How:* {row.how}",
        f"*Verdict:* **{row.verdict}**.",
        *map(_sheet, row.sheets),
    ]
    return "\n\n".join(lines)


def _sheet(sheet: Sheet) -> str:
    return f"**{sheet.title}**\n\n{_table(sheet.header, sheet.cells)}"


def _runs(runs: Sequence[Run]) -> str:
    if not runs:
        return "## Runs\n\nNone were given: pass `--runs <run directory> ...`."
    lines = [f"- {run.name}: `{run.path}`" + "".join(f"\n  - problem: {line}" for line in run.problems) for run in runs]
    return "## Runs\n\n" + "\n".join(lines)


def _environment(environment: Mapping[str, Any]) -> str:
    packages = ", ".join(f"{name} {version}" for name, version in environment.get("packages", {}).items() if version)
    rest = [
        f"- {key}: {environment[key]}"
        for key in ("device", "threads", "python", "platform", "git")
        if key in environment
    ]
    return "## Environment\n\n" + "\n".join([*rest, f"- packages: {packages}"])


def _table(header: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *cells]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _plain_sheet(sheet: Sheet) -> dict[str, Any]:
    return {"title": sheet.title, "header": list(sheet.header), "cells": [list(row) for row in sheet.cells]}
