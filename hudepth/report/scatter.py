"""Two results image by image: which images each network predicts better, and by how much."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hudepth.viz.style import BLUE, ORANGE

SIDES = {"a": BLUE, "b": ORANGE}
LONGEST = 32
"""Letters of an image id that fit next to a bar."""


def draw_comparison(
    ids: Sequence[str],
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    *,
    shown: Sequence[str],
    metric: str = "abs_rel",
    title: str = "",
) -> Figure:
    """Draw each image's error under a against that under b, and some images as pairs of bars.

    Args:
        ids: of the images.
        a: [n] a metric of each image under a, smaller is better; NaN is left out on the left and written on the right.
        b: [n] the same under b.
        shown: ids for the right plot, from the top; they are ringed in the left one.
        metric: its name.
        title: of the figure.
    """
    rows = [list(ids).index(image) for image in shown]
    figure = Figure(figsize=(11, 5.2), dpi=110, layout="constrained")
    if title:
        figure.suptitle(title, fontsize=10)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1))
    _scatter(left, a, b, rows=rows, metric=metric)
    _bars(right, shown, a[rows], b[rows], metric=metric)
    return figure


def _scatter(axis: Axes, a: NDArray[np.float64], b: NDArray[np.float64], *, rows: Sequence[int], metric: str) -> None:
    finite = np.isfinite(a) & np.isfinite(b)
    highest = 1.05 * float(max(a[finite].max(initial=0), b[finite].max(initial=0))) or 1.0
    for name, won in (("a", finite & (a < b)), ("b", finite & (b < a))):
        label = f"{name} better: {np.count_nonzero(won)} images"
        axis.scatter(a[won], b[won], s=12, color=SIDES[name], alpha=0.6, linewidths=0, label=label)
    even = finite & (a == b)
    if even.any():
        axis.scatter(a[even], b[even], s=12, color="0.5", linewidths=0, label=f"equal: {np.count_nonzero(even)} images")
    ring: dict[str, Any] = {"s": 55, "facecolors": "none", "edgecolors": "0.2", "linewidths": 0.8}
    axis.scatter(a[rows], b[rows], label="shown on the right", **ring)
    axis.plot([0, highest], [0, highest], color="0.5", linewidth=0.8, zorder=0)
    axis.set(xlim=(0, highest), ylim=(0, highest), aspect="equal")
    axis.grid(alpha=0.3)
    axis.set(xlabel=f"{metric} under a", ylabel=f"{metric} under b")
    axis.set_title(f"{metric} of each image", fontsize=10)
    axis.legend(fontsize=8)


def _bars(axis: Axes, names: Sequence[str], a: NDArray[np.float64], b: NDArray[np.float64], *, metric: str) -> None:
    places = np.arange(len(names))
    for label, values, offset in (("a", a, -0.2), ("b", b, 0.2)):
        lengths = np.nan_to_num(values, posinf=0)
        axis.barh(places + offset, lengths, height=0.38, color=SIDES[label], label=label)
        for place, value in zip(places + offset, values, strict=True):
            if not np.isfinite(value):  # no bar can show it
                axis.text(0, place, f" {value}", va="center", fontsize=7, color=SIDES[label])
    axis.set_yticks(places, [name if len(name) <= LONGEST else f"…{name[1 - LONGEST :]}" for name in names], fontsize=8)
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.grid(axis="x", alpha=0.3)
    axis.set_axisbelow(True)
    axis.set_xlabel(f"{metric} (smaller is better)")
    axis.set_title(f"the {len(names)} images that differ most", fontsize=10)
    axis.legend(fontsize=8)
