"""Time of an image: against the batch for the backends, and beside other networks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

from hudepth.bench.rows import Row, beside_peers
from hudepth.bench.tables import figure_text, label
from hudepth.viz.panels import save_figure
from hudepth.viz.style import COLOURS

MARKERS = "osD^v"
OURS, OTHERS = COLOURS[1], "0.45"


def draw_bench(rows: Sequence[Row], *, title: str) -> Figure:
    """Draw the backends, and in a second plot the peers beside this model; bars of errors are p25 to p75.

    Args:
        rows: at least one, of a backend.
        title: above the figure.
    """
    beside = beside_peers(rows)
    figure = Figure(figsize=(14 if beside else 8.2, 4.8), dpi=130, layout="constrained")
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    axes = figure.subplots(1, 2 if beside else 1, squeeze=False)[0]
    _lines(axes[0], [row for row in rows if row.kind == "backend"])
    if beside:
        _dots(axes[1], beside)
    return figure


def save_bench(path: Path, rows: Sequence[Row], *, title: str) -> None:
    """Write :func:`draw_bench` as a PNG file, whole or not at all."""
    save_figure(path, draw_bench(rows, title=title))


def _lines(axis: Axes, rows: Sequence[Row]) -> None:
    by_name: dict[str, list[Row]] = {}
    for row in rows:
        by_name.setdefault(row.contender, []).append(row)
    order = sorted(by_name, key=lambda name: -by_name[name][-1].ms_per_image)  # the legend is in the lines' order
    for name in order:
        own, number = by_name[name], list(by_name).index(name)
        low = [row.ms_per_image - row.p25_ms / row.batch for row in own]
        high = [row.p75_ms / row.batch - row.ms_per_image for row in own]
        axis.errorbar(
            [row.batch for row in own], [row.ms_per_image for row in own], yerr=[low, high], label=name,
            color=COLOURS[number % len(COLOURS)], marker=MARKERS[number % len(MARKERS)], markersize=5, linewidth=1.4,
            elinewidth=1, capsize=2,
        )  # fmt: skip
    axis.set_xscale("log", base=2)
    axis.xaxis.set_major_locator(FixedLocator(sorted({row.batch for row in rows})))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7)))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_xlabel("images a pass", fontsize=9)
    axis.set_ylabel("ms/image", fontsize=9)
    axis.margins(x=0.06)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    _finish(axis, "this model")


def _dots(axis: Axes, rows: Sequence[Row]) -> None:
    """Draw times at one batch size, the fastest at the top; points, since bars on a scale of powers have no start."""
    ordered = sorted(rows, key=lambda row: row.ms_per_image)
    for place, row in enumerate(ordered):
        colour = OURS if row.kind == "backend" else OTHERS
        axis.plot([row.p25_ms / row.batch, row.p75_ms / row.batch], [place, place], color=colour, linewidth=2)
        axis.plot(row.ms_per_image, place, "o", color=colour, markersize=7)
        end = max(row.ms_per_image, row.p75_ms / row.batch)
        axis.annotate(f"   {figure_text(row.ms_per_image)}", (end, place), va="center", fontsize=8)
    names = [f"this model, {row.contender}" if row.kind == "backend" else label(row) for row in ordered]
    axis.set_yticks(range(len(ordered)), names)
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_xlim(0.5 * ordered[0].ms_per_image, 2.5 * ordered[-1].ms_per_image)
    axis.set_xlabel("ms/image", fontsize=9)
    _finish(axis, f"beside other networks (random weights, eager PyTorch), at batch {ordered[0].batch}")


def _finish(axis: Axes, title: str) -> None:
    axis.set_title(title, fontsize=9, loc="left")
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.25)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
