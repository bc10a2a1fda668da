"""The pictures of a sweep's report, those that there is something to show in."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import HudepthError
from hudepth.base.options import whole_number
from hudepth.report.ablation.effects import save_effects
from hudepth.report.ablation.grid import find_grid
from hudepth.report.ablation.heatmap import save_heatmap
from hudepth.report.ablation.page import Picture
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.row import Row
from hudepth.report.ablation.variants import save_variants
from hudepth.report.compare import tested_on_training_data
from hudepth.runs.history import read_history
from hudepth.runs.run_dir import BEST, CHECKPOINTS, LAST

IMAGES = 4
"""Most columns of panels.png."""
NETWORKS = 12
"""Most networks in panels.png."""
COLOURED = 8
"""Most lines with a colour in curves.png, if there are more than :data:`NAMED`."""
NAMED = 16
BY = "abs_rel"


def draw_pictures(report: Report, folder: Path, *, config: Mapping[str, Any]) -> list[Picture]:
    """Draw what there is to show; a picture of an earlier report that is not drawn this time is taken away.

    Args:
        report: of the sweep.
        folder: to write to.
        config: ``panels`` (how many images, 0: none), and ``paths``, ``data`` and ``trust`` to open runs with.

    Raises:
        OSError: if a file cannot be written.
    """
    drawn = []
    for name, draw in DRAWN.items():
        path = folder / f"{name}.png"
        found = draw(report, path, config)
        if found is None:
            path.unlink(missing_ok=True)
        else:
            drawn.append(Picture(path.read_bytes(), *found))
    return drawn


Said = tuple[str, str] | None
"""Title and caption of a picture; None if there is none."""


def _effects(report: Report, path: Path, _config: Mapping[str, Any]) -> Said:
    if not any(row.contrasts for row in report.rows):
        return None
    save_effects(path, report)
    return (
        f"Differences from {report.reference.label}",
        "Dots: mean over the seeds that both rows have. Thick: 95 % interval over scenes; thin: over seeds. In colour: "
        "both leave out 0. Arrows lead to what lies outside the plot.",
    )


def _curves(report: Report, path: Path, _config: Mapping[str, Any]) -> Said:
    histories: dict[str, list[list[dict[str, float]]]] = {}
    for row in report.rows:
        for each in row.runs.values():
            try:
                histories.setdefault(row.label, []).append(read_history(each.run.path / "metrics.csv"))
            except HudepthError as error:
                log.warning("not in curves.png: %s", error)
    if not any(key.startswith("val/") for runs in histories.values() for run in runs for rows in run for key in rows):
        return None
    order = by_accuracy(report)
    labels = [row.label for row in order] if len(order) > NAMED else [row.label for row in report.rows]
    shown = list(dict.fromkeys([report.reference.label, *labels]))
    monitor = str(next(iter(report.reference.runs.values())).run.config.get("monitor") or "")
    save_variants(path, histories, shown=shown[: COLOURED if len(order) > NAMED else NAMED], monitor=monitor)
    return "Validation by epoch", "Lines: mean over seeds. Bands: from the lowest to the highest seed."


def _heatmap(report: Report, path: Path, _config: Mapping[str, Any]) -> Said:
    grid = find_grid(report.rows)
    if grid is None or BY not in report.metrics:
        return None
    save_heatmap(path, grid, metric=BY)
    return "Weights of the loss's terms", f"{BY}, mean over seeds; the best is ringed; grey: no finished run."


def _cost(report: Report, path: Path, config: Mapping[str, Any]) -> Said:
    if BY not in report.metrics or not any(f.key.startswith("model.") or f.key == "data.size" for f in report.factors):
        return None
    from hudepth.report.ablation.networks import costs  # torch, which only some reports need
    from hudepth.report.ablation.tradeoff import save_tradeoff

    try:
        found = costs(report, trust=config.get("trust") or [])
    except HudepthError as error:
        log.warning("no cost.png: %s", error)
        return None
    if not found:
        return None
    save_tradeoff(path, found, metric=BY)
    return (
        "Accuracy against cost",
        f"{BY} over parameters and over multiply-adds of one image at the run's size; bars: 95 % interval over seeds.",
    )


def _panels(report: Report, path: Path, config: Mapping[str, Any]) -> Said:
    count = min(IMAGES, whole_number(config, "panels", default=IMAGES))
    if not count:
        return None
    runs = {row.label: next(iter(row.runs.values())) for row in by_accuracy(report)[:NETWORKS]}
    runs = {row.label: runs[row.label] for row in report.rows if row.label in runs}
    usable = {
        label: each.run.path
        for label, each in runs.items()
        if any((each.run.path / CHECKPOINTS / name).is_file() for name in (BEST, LAST))
        and tested_on_training_data(each.result)
    }
    if not usable:
        log.info("no panels.png: no run has its checkpoint and was tested on the data it was trained on")
        return None
    from hudepth.report.ablation.networks import predictions  # torch and lightning, which only this picture needs
    from hudepth.report.ablation.sheet import save_sheet

    found, images = predictions(usable, report.first.table.ids, count=count, config=config)
    if not found:
        log.info("no panels.png: no run could be opened")
        return None
    save_sheet(path, found, titles=images)
    few = (
        f" The reference and the {NETWORKS - 1} best of {len(report.rows)} rows."
        if len(runs) < len(by_accuracy(report))
        else ""
    )
    return "Predictions", f"Test images, their truth, and the lowest finished seed of each row, on one scale.{few}"


def by_accuracy(report: Report) -> list[Row]:
    """Return the rows with a result: the reference, then the best first."""

    def place(row: Row) -> tuple[bool, float]:
        mean = row.estimates[BY].mean if BY in row.estimates else math.nan
        return row is not report.reference, mean if math.isfinite(mean) else math.inf

    return sorted((row for row in report.rows if row.runs), key=place)


DRAWN: dict[str, Callable[[Report, Path, Mapping[str, Any]], Said]] = {
    "effects": _effects,
    "curves": _curves,
    "heatmap": _heatmap,
    "cost": _cost,
    "panels": _panels,
}
"""By name of the file, in the order of the page."""
