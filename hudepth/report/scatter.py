"""Two results image by image: which images each network predicts better, and by how much."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hudepth.metrics.summary import Floats
from hudepth.viz.style import BLUE, ORANGE

SIDES = {"a": BLUE, "b": ORANGE}
LONGEST = 32  # letters of an image id that fit next to a bar


def draw_comparison(
    ids: Sequence[str], a: Floats, b: Floats, *, shown: Sequence[str], metric: str = "abs_rel", title: str = ""
) -> Figure:
    """Draw each image's error under a against that under b, and the images ``shown`` as pairs of bars, from the top.

    ``a`` and ``b`` are [n] values of a metric, smaller is better; NaN is left out on the left and written on the right.
    """
    rows = [list(ids).index(image) for image in shown]
    figure = Figure(figsize=(11, 5.2), dpi=110, layout="constrained")
    if title:
        figure.suptitle(title, fontsize=10)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1))
    _scatter(left, a, b, rows=rows, metric=metric)
    _bars(right, shown, a[rows], b[rows], metric=metric)
    return figure


def _scatter(axis: Axes, a: Floats, b: Floats, *, rows: Sequence[int], metric: str) -> None:
    finite = np.isfinite(a) & np.isfinite(b)
    highest = 1.05 * float(max(a[finite].max(initial=0), b[finite].max(initial=0))) or 1.0
    for name, won in (("a", finite & (a < b)), ("b", finite & (b < a))):
        label = f"{name} better: {np.count_nonzero(won)} images"
        axis.scatter(a[won], b[won], s=12, color=SIDES[name], alpha=0.6, linewidths=0, label=label)
    even = finite & (a == b)
    if even.any():
        axis.scatter(a[even], b[even], s=12, color="0.5", linewidths=0, label=f"equal: {np.count_nonzero(even)} images")
    axis.scatter(
        a[rows], b[rows], s=55, facecolors="none", edgecolors="0.2", linewidths=0.8, label="shown on the right"
    )
    axis.plot([0, highest], [0, highest], color="0.5", linewidth=0.8, zorder=0)
    axis.set(
        xlim=(0, highest), ylim=(0, highest), aspect="equal", xlabel=f"{metric} under a", ylabel=f"{metric} under b"
    )
    axis.grid(alpha=0.3)
    axis.set_title(f"{metric} of each image", fontsize=10)
    axis.legend(fontsize=8)


def _bars(axis: Axes, names: Sequence[str], a: Floats, b: Floats, *, metric: str) -> None:
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
