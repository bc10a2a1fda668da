"""Time per image against the batch size, one line per backend."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

from hudepth.bench.rows import Row
from hudepth.viz.style import COLOURS

MARKERS = "osD^v"


def draw_bench(rows: Sequence[Row], *, title: str) -> Figure:
    """Draw the backends, at least one; error bars are p25 to p75."""
    figure = Figure(figsize=(8.2, 4.8), dpi=130, layout="constrained")
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    axis = figure.subplots()
    _draw_lines(axis, [row for row in rows if row.kind == "backend"])
    axis.set_xscale("log", base=2)
    axis.xaxis.set_major_locator(FixedLocator(sorted({row.batch for row in rows})))
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7)))
    for scale in (axis.xaxis, axis.yaxis):
        scale.set_minor_locator(NullLocator())
        scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_xlabel("images per pass", fontsize=9)
    axis.set_ylabel("ms/image", fontsize=9)
    axis.margins(x=0.06)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.25)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_lines(axis: Axes, rows: Sequence[Row]) -> None:
    by_name: dict[str, list[Row]] = {}
    for row in rows:
        by_name.setdefault(row.contender, []).append(row)
    for name in sorted(by_name, key=lambda name: -by_name[name][-1].ms_per_image):  # the legend follows the lines
        own, number = by_name[name], list(by_name).index(name)
        low = [row.ms_per_image - row.p25_ms / row.batch for row in own]
        high = [row.p75_ms / row.batch - row.ms_per_image for row in own]
        axis.errorbar(
            [row.batch for row in own], [row.ms_per_image for row in own], yerr=[low, high], label=name,
            color=COLOURS[number % len(COLOURS)], marker=MARKERS[number % len(MARKERS)], markersize=5,
            linewidth=1.4, elinewidth=1, capsize=2,
        )  # fmt: skip
