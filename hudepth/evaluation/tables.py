"""Results of a test on standard output."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.table import Table

from hudepth.metrics.summary import higher_is_better

SHOWN = ("abs_rel", "sq_rel", "rmse", "rmse_log", "log10", "silog", "mae", "ssim", "delta1", "delta2", "delta3")
NARROW = ("abs_rel", "rmse", "log10", "ssim", "delta1", "delta2", "delta3")
"""Columns of the printed table, in a terminal wide enough for all and in others; metrics.json always has all."""
EDGES = ("edge_f1_0.25", "edge_f1_0.5", "edge_f1_1", "si_boundary_f1", "dbe_acc_px", "dbe_comp_px")
"""What is shown of the boundary metrics."""


def print_results(
    metrics: Mapping[str, Mapping[str, float]], ranges: Mapping[str, tuple[float, float]], *, over: str, title: str
) -> None:
    """Print metrics, a row a predictor, the best of each column bold, and the intervals of the first predictor.

    Args:
        metrics: by predictor and name.
        ranges: 95 % interval of each metric of the first predictor.
        over: what was resampled, for example ``215 scenes``.
        title: above the table.
    """
    out = Console()
    if not out.is_terminal:
        out = Console(width=130)  # a log should not wrap what a wide terminal would show
    first = next(iter(metrics))
    names = SHOWN if out.width >= 118 else NARROW
    caption = f"rmse and mae in metres; delta and ssim: higher is better; intervals: bootstrap over {over}"
    table = _table(title, caption, names)
    for who in metrics:
        table.add_row(who.replace("_", " "), *(_cell(metrics, who, name) for name in names))
        if who == first:
            for word, side in (("  95 % from", 0), ("       to", 1)):
                table.add_row(word, *(_number(ranges[name][side]) for name in names), style="dim")
    out.print(table)
    if any(name in metrics[first] for name in EDGES):
        _print_edges(out, metrics[first], ranges)


def _print_edges(out: Console, row: Mapping[str, float], ranges: Mapping[str, tuple[float, float]]) -> None:
    names = [name for name in EDGES if name in row]
    table = _table("depth edges of the model", "f1: higher is better; dbe: distance in pixels, lower is better", names)
    table.add_row("model", *(_number(row[name]) for name in names))
    for word, side in (("  95 % from", 0), ("       to", 1)):
        table.add_row(word, *(_number(ranges[name][side]) for name in names), style="dim")
    out.print(table)


def _table(title: str, caption: str, names: Sequence[str]) -> Table:
    table = Table(title=title, caption=caption, title_justify="left", caption_justify="left")
    table.add_column("")
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _cell(metrics: Mapping[str, Mapping[str, float]], who: str, name: str) -> str:
    column = [row[name] for row in metrics.values()]
    best = max(column) if higher_is_better(name) else min(column)
    text = _number(metrics[who][name])
    return f"[bold]{text}[/]" if metrics[who][name] == best and len(metrics) > 1 else text


def _number(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.3f}" if value < 100 else f"{value:.1f}"
