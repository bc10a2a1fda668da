"""The pictures of a sweep's report: each is drawn if the sweep has something to show in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from hudepth.base.console import log
from hudepth.base.errors import HudepthError
from hudepth.report.ablation.effects import draw_effects
from hudepth.report.ablation.heatmap import draw_heatmap, find_grid
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.rows import Row
from hudepth.report.ablation.variants import draw_variants
from hudepth.report.compare import tested_on_training_data
from hudepth.viz.panels import save_figure

IMAGES, NETWORKS = 4, 12  # most columns and networks in panels.png
NAMED, COLOURED = 16, 8  # lines with a colour in curves.png: up to 16 rows all of them, else 8
BY = "abs_rel"


@dataclass(frozen=True)
class Picture:
    """A picture on the page."""

    png: bytes
    title: str
    caption: str


Drawn = tuple[Figure, str, str] | None  # figure, title and caption; None if there is nothing to show


def draw_pictures(report: Report, folder: Path, *, config: Mapping[str, Any]) -> list[Picture]:
    """Draw what there is to show into ``folder``; remove what an earlier report drew and this one does not.

    ``config`` holds ``panels`` (how many images, 0: none), and ``paths``, ``data`` and ``trust`` to open runs with.
    """
    pictures = []
    for name, draw in DRAWN.items():
        path = folder / f"{name}.png"
        if found := draw(report, config):
            save_figure(path, found[0])
            pictures.append(Picture(path.read_bytes(), *found[1:]))
        else:
            path.unlink(missing_ok=True)
    return pictures


def _effects(report: Report, _config: Mapping[str, Any]) -> Drawn:
    if not any(row.contrasts for row in report.rows):
        return None
    caption = (
        "Dots: mean over the seeds that both rows have. Thick: 95 % interval over scenes; thin: over seeds. In colour: "
        "both exclude 0. Arrows point to what lies outside the plot."
    )
    return draw_effects(report), f"Differences from {report.reference.label}", caption


def _curves(report: Report, _config: Mapping[str, Any]) -> Drawn:
    histories: dict[str, list[list[dict[str, float]]]] = {}
    for row in report.rows:
        for each in row.runs.values():
            try:
                histories.setdefault(row.label, []).append(each.run.history())
            except HudepthError as error:
                log.warning("not in curves.png: %s", error)
    histories = {label: runs for label, runs in histories.items() if runs}
    if not any(key.startswith("val/") for runs in histories.values() for run in runs for row in run for key in row):
        return None
    order = sort_by_accuracy(report)
    rows, count = (order, COLOURED) if len(order) > NAMED else (report.rows, NAMED)
    shown = list(dict.fromkeys([report.reference.label, *(row.label for row in rows)]))[:count]
    monitor = str(next(iter(report.reference.runs.values())).run.config.get("monitor") or "")
    figure = draw_variants(histories, shown=shown, monitor=monitor)
    return figure, "Validation by epoch", "Lines: mean over seeds. Bands: from the lowest to the highest seed."


def _heatmap(report: Report, _config: Mapping[str, Any]) -> Drawn:
    grid = find_grid(report.rows)
    if grid is None or BY not in report.metrics:
        return None
    caption = f"{BY}, mean over seeds; the best is ringed; grey: no finished run."
    return draw_heatmap(grid, metric=BY), "Weights of the loss terms", caption


def _cost(report: Report, config: Mapping[str, Any]) -> Drawn:
    if BY not in report.metrics or not any(f.key.startswith("model.") or f.key == "data.size" for f in report.factors):
        return None
    from hudepth.report.ablation.cost import draw_cost, find_costs  # imports torch

    try:
        costs = find_costs(report, metric=BY, trust=config["trust"])
    except HudepthError as error:
        log.warning("no cost.png: %s", error)
        return None
    if not costs:
        return None
    caption = f"{BY} over parameters and multiply-adds per image at the run's size; bars: 95 % interval over seeds."
    return draw_cost(costs, metric=BY), "Accuracy against cost", caption


def _panels(report: Report, config: Mapping[str, Any]) -> Drawn:
    count = min(IMAGES, config["panels"])
    if not count:
        return None
    order = sort_by_accuracy(report)
    best = {row.label for row in order[:NETWORKS]}
    runs = {row.label: next(iter(row.runs.values())) for row in report.rows if row.label in best}
    usable = [x for x in runs.items() if x[1].run.checkpoint and tested_on_training_data(x[1].result)]
    if not usable:
        log.info("no panels.png: no run has its checkpoint and was tested on the data it was trained on")
        return None
    from hudepth.evaluation.pictures import evenly_spaced, panels_beside  # imports torch and lightning
    from hudepth.viz.sheet import draw_sheet

    ids = sorted(report.first.table.ids)
    images = [ids[place] for place in evenly_spaced(range(len(ids)), count)]
    found = {}
    for label, each in usable:
        try:
            found[label] = panels_beside({label: each.run.path}, images, config=config)
        except HudepthError as error:
            log.warning("not in panels.png: '%s': %s", label, error)
    if not found:
        return None
    few = f" The reference and the {NETWORKS - 1} best of {len(report.rows)} rows." if len(runs) < len(order) else ""
    caption = f"Test images, their ground truth, and the lowest finished seed of each row, on one scale.{few}"
    return draw_sheet(found, titles=images), "Predictions", caption


def sort_by_accuracy(report: Report) -> list[Row]:
    """Return the rows with a result: the reference, then the best first."""

    def place(row: Row) -> tuple[bool, float]:
        mean = row.estimates[BY].mean if BY in row.estimates else math.nan
        return row is not report.reference, mean if math.isfinite(mean) else math.inf

    return sorted((row for row in report.rows if row.runs), key=place)


DRAWN = {"effects": _effects, "curves": _curves, "heatmap": _heatmap, "cost": _cost, "panels": _panels}
"""By name of the file, in the order of the page."""
