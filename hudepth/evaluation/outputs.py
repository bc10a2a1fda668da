"""What a test leaves per protocol: metrics.json, per_image.csv, strata, and the printed table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.measure import Measurement

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.files import write_json, write_text
from hudepth.base.tables import Cell, Table, stdout
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.scoring import image_table
from hudepth.metrics.bootstrap import describe, intervals
from hudepth.metrics.catalogue import Level, metric_info, metric_names
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.strata import strata_csv, summarise_strata
from hudepth.metrics.summary import ImageTable, per_image_csv, summarise
from hudepth.metrics.uncertainty import UNCERTAINTY_NAMES
from hudepth.runs.results import METRICS, MODEL, PER_IMAGE
from hudepth.viz.strata import save_strata

Metrics = dict[str, dict[str, float]]
"""By predictor and name."""
LEVELS: tuple[Level, ...] = ("wide", "narrow", "headline")
"""Columns of the printed table; the first level that fits the terminal. metrics.json always has all metrics."""


def write_outputs(
    folder: Path, protocol: Protocol, evaluation: Evaluation, datamodule: DepthDataModule, stamp: Mapping[str, Any]
) -> Metrics:
    """Summarise, write and print the results of one protocol of a finished evaluation of the test subset.

    ``stamp`` is what else metrics.json states: data, split, checkpoint. Raises ConfigError if no pixel of any image
    counts.
    """
    records = [datamodule.store.records[index] for index in evaluation.indices]
    only_model: dict[str, Any] = {
        "boundary": evaluation.boundary.get(protocol.name), "uncertainty": evaluation.uncertainty.get(protocol.name),
    }  # fmt: skip
    tables = {
        name: image_table(
            protocol, evaluation.sums[name, protocol.name], records, **(only_model if name == MODEL else {})
        )
        for name in evaluation.predictors
    }
    model = tables[MODEL]
    left_out = _left_out(protocol, model)
    metrics = {name: summarise(table, **protocol.summary_options) for name, table in tables.items()}
    ranges = {name: intervals(table, **protocol.summary_options) for name, table in tables.items()}
    uncertainty = describe(model)
    document = {
        "metrics": {who: {k: _finite(v) for k, v in row.items()} for who, row in metrics.items()},
        "intervals": {who: {k: [*map(_finite, ends)] for k, ends in row.items()} for who, row in ranges.items()},
        "uncertainty": uncertainty,
        "images": len(model.ids),
        "left_out": left_out,
        "protocol": protocol.stamp(),
        **stamp,
    }
    write_json(folder / METRICS, document)
    write_text(folder / PER_IMAGE, per_image_csv(model))
    title = f"{protocol.name} protocol, {len(model.ids) - len(left_out)} test images of {datamodule.source.name}"
    if protocol.alignment != "none":
        title += f", each prediction aligned to its ground truth ({protocol.alignment})"
    if protocol.strata:
        rows = summarise_strata(evaluation.strata[protocol.name], model.categories)
        write_text(folder / "strata.csv", strata_csv(rows))
        save_strata(folder / "strata.png", rows, title=title)
    over = f"{uncertainty['scenes']} {'scenes' if any(model.scenes) else 'images of unknown scenes'}"
    print_results(metrics, ranges[MODEL], over=over, title=title)
    if "flip_ause" in metrics[MODEL]:
        found = (metrics[MODEL][name] for name in UNCERTAINTY_NAMES)
        log.info("disagreement with the mirrored image: AUSE %.3f, rank correlation with the error %.2f", *found)
    return metrics


def _left_out(protocol: Protocol, table: ImageTable) -> list[str]:
    """Return and log the images without a pixel that counts; refuse if that is all of them."""
    ids = [image for image, pixels in zip(table.ids, table.pixels.tolist(), strict=True) if not pixels]
    if len(ids) == len(table.ids):
        raise ConfigError(f"protocol={protocol.name}: no pixel of {len(ids)} images counts. Check its crop and caps.")
    if ids:
        why = "unmeasured, outside the caps, or smaller than the crop"
        text = "protocol=%s: no pixel of %d of %d images counts (%s); left out, the first is '%s'"
        log.warning(text, protocol.name, len(ids), len(table.ids), why, ids[0])
    return ids


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def print_results(
    metrics: Mapping[str, Mapping[str, float]], ranges: Mapping[str, tuple[float, float]], *, over: str, title: str
) -> None:
    """Print metrics, one row per predictor, the best of each column bold, with the first predictor's 95 % intervals.

    ``over`` is what was resampled, for example ``215 scenes``.
    """
    first = next(iter(metrics))
    caption = f"95 %: bootstrap over {over}"
    _print_widest([make_table(metrics, ranges, metric_names(level), title, caption) for level in LEVELS])
    if metric_names("scale", among=metrics[first]):
        columns = ["abs_rel", "abs_rel_aligned", "scale_sd", "rmse", "rmse_pooled"]
        about = "each image at its median scale; rmse of images and of all pixels"
        _print_widest([make_table(metrics, ranges, names, about, "") for names in (columns, columns[1:])])
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
