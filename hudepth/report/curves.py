"""Loss curves of a run over its epochs (figure 5 of the paper)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hudepth.base.errors import DataError


def draw_curves(history: Sequence[Mapping[str, float]], *, title: str = "") -> Figure:
    """Draw training and validation curves of the total loss and of its terms, one plot each.

    Rows of the history hold ``epoch``, ``train/loss/<term>`` and ``val/loss/<term>``; DataError if there is no term.
    """
    names = [key.removeprefix("train/loss/") for key in history[0] if key.startswith("train/loss/")]
    if not names:
        missing = "the history of epochs has no training loss (train/loss/total)"
        raise DataError(f"{missing}. Pass the metrics.csv of a training run.")
    names.sort(key=lambda name: name != "total")
    figure = Figure(figsize=(3.4 * len(names), 3.2), dpi=110, layout="constrained")
    if title:
        figure.suptitle(title, fontsize=10)
    first, last = history[0]["epoch"], history[-1]["epoch"]
    for axis, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        for stage, label in (("train", "training"), ("val", "validation")):
            key = f"{stage}/loss/{name}"
            points = [(row["epoch"], row[key]) for row in history if key in row]  # not every epoch validates
            if points:
                axis.plot(*zip(*points, strict=True), marker=".", label=label)
        axis.set_title(f"{name} loss", fontsize=10)
        axis.set(xlabel="epoch", xlim=(first - 0.5, last + 0.5))
        axis.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=1))
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axis.legend()
    return figure
