"""Results of a test on standard output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.measure import Measurement

from hudepth.base.tables import Cell, Table, stdout
from hudepth.metrics.catalogue import Level, metric_info, metric_names

LEVELS: tuple[Level, ...] = ("wide", "narrow", "headline")
"""Columns of the printed table; the first level that fits the terminal. metrics.json always has all metrics."""


def print_results(
    metrics: Mapping[str, Mapping[str, float]], ranges: Mapping[str, tuple[float, float]], *, over: str, title: str
) -> None:
    """Print metrics, one row per predictor, the best of each column bold, with the first predictor's intervals.

    Args:
        metrics: by predictor and name.
        ranges: 95 % interval of each metric of the first predictor.
        over: what was resampled, for example ``215 scenes``.
        title: above the table.
    """
    first = next(iter(metrics))
    caption = f"95 %: bootstrap over {over}"
    _print_widest([make_table(metrics, ranges, metric_names(level), title, caption) for level in LEVELS])
    if edges := metric_names("edges", among=metrics[first]):
        chosen = [edges, metric_names("edge", among=edges)]
        only = {first: metrics[first]}
        _print_widest([make_table(only, ranges, names, "depth edges of the model", "") for names in chosen])


def make_table(
    metrics: Mapping[str, Mapping[str, float]],
    ranges: Mapping[str, tuple[float, float]],
    names: Sequence[str],
    title: str,
    caption: str,
) -> Table:
    """Return a table of some metrics; other arguments as for :func:`print_results`."""
    infos = [metric_info(name) for name in names]
    rising = ", ".join(info.name for info in infos if info.higher_is_better)
    caption = "; ".join(filter(None, [f"higher is better: {rising}" if rising else "", caption]))
    table = Table(["", *(info.label for info in infos)], title=title, caption=caption)
    best = {
        info.name: (max if info.higher_is_better else min)(row[info.name] for row in metrics.values())
        for info in infos
    }  # fmt: skip
    for number, (who, row) in enumerate(metrics.items()):
        cells = [
            Cell(info.format(row[info.name]), bold=len(metrics) > 1 and row[info.name] == best[info.name])
            for info in infos
        ]
        table.add(who.replace("_", " "), *cells)
        if number == 0:
            for word, side in (("  95 % from", 0), ("       to", 1)):
                table.add(Cell(word, dim=True), *(Cell(i.format(ranges[i.name][side]), dim=True) for i in infos))
    return table


def _print_widest(tables: Sequence[Table]) -> None:
    """Print the first table that fits the terminal, else the last."""
    console = stdout()
    built = [table.to_rich(box=SIMPLE_HEAD, show_edge=False, pad_edge=False) for table in tables]
    unbounded = console.options.update(width=1000)
    fitting = (table for table in built if Measurement.get(console, unbounded, table).maximum <= console.width)
    console.print(next(fitting, built[-1]))
