"""Time of an image against the batch, a line a contender."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from hudepth.bench.rows import Row
from hudepth.bench.tables import label
from hudepth.viz.panels import save_figure
from hudepth.viz.variants import COLOURS

OURS_BESIDE_PEERS = ("eager", "default")
MARKERS = "osD^v"


def draw_bench(rows: Sequence[Row], *, title: str) -> Figure:
    """Draw the backends, and in a second plot the peers beside this model in PyTorch; bars are p25 to p75.

    Args:
        rows: at least one.
        title: above the figure.
    """
    peers = any(row.kind == "peer" for row in rows)
    figure = Figure(figsize=(13.5 if peers else 8.2, 4.8), dpi=130, layout="constrained")
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    axes = figure.subplots(1, 2 if peers else 1, squeeze=False)[0]
    _plot(axes[0], [row for row in rows if row.kind == "backend"], "this model")
    if peers:
        beside = [row for row in rows if row.kind == "peer" or row.contender in OURS_BESIDE_PEERS]
        _plot(axes[1], beside, "beside other networks in PyTorch (random weights)")
    return figure


def save_bench(path: Path, rows: Sequence[Row], *, title: str) -> None:
    """Write :func:`draw_bench` as a PNG file, whole or not at all."""
    save_figure(path, draw_bench(rows, title=title))


def _plot(axis: Axes, rows: Sequence[Row], title: str) -> None:
    ends = {name: rows_of[-1].ms_per_image for name, rows_of in _lines(rows).items()}
    names = sorted(ends, key=lambda name: -ends[name])  # the legend then has the lines' order
    for number, name in enumerate(names):
        own = _lines(rows)[name]
        middle = [row.ms_per_image for row in own]
        low = [row.ms_per_image - row.p25_ms / row.batch for row in own]
        high = [row.p75_ms / row.batch - row.ms_per_image for row in own]
        axis.errorbar(
            [row.batch for row in own], middle, yerr=[low, high], label=name, color=COLOURS[number % len(COLOURS)],
            marker=MARKERS[number % len(MARKERS)], markersize=5, linewidth=1.4, elinewidth=1, capsize=2,
            linestyle="--" if own[0].kind == "peer" else "-",
        )  # fmt: skip
    batches = sorted({row.batch for row in rows})
    axis.set_xscale("log", base=2)
    axis.set_yscale("log")
    axis.xaxis.set_major_locator(FixedLocator(batches))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for which in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
        which(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_xlabel("images a pass", fontsize=9)
    axis.set_ylabel("ms/image", fontsize=9)
    axis.set_title(title, fontsize=9, loc="left")
    axis.tick_params(which="both", labelsize=8)
    axis.grid(which="both", alpha=0.2)
    axis.margins(x=0.08)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def _lines(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(label(row), []).append(row)
    return found
