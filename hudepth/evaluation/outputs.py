"""What a test leaves per protocol: metrics.json, per_image.csv, strata, and the printed table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.files import write_json, write_text
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.scoring import image_table
from hudepth.evaluation.tables import print_results
from hudepth.metrics.bootstrap import describe, intervals
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.strata import strata_csv, summarise_strata
from hudepth.metrics.summary import ImageTable, per_image_csv, summarise
from hudepth.runs.results import METRICS, MODEL, PER_IMAGE
from hudepth.viz.strata import save_strata

Metrics = dict[str, dict[str, float]]
"""By predictor and name."""


def write_outputs(
    folder: Path, protocol: Protocol, evaluation: Evaluation, datamodule: DepthDataModule, stamp: Mapping[str, Any]
) -> Metrics:
    """Summarise, write and print the results of one protocol. Raises ConfigError if the protocol counts no pixel of any
    image.

    Args:
        folder: to write to.
        protocol: one of the evaluation's.
        evaluation: finished.
        datamodule: whose test subset was scored.
        stamp: what else metrics.json states: data, split, checkpoint.
    """
    tables = _image_tables(protocol, evaluation, datamodule)
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
    return metrics


def _image_tables(protocol: Protocol, evaluation: Evaluation, datamodule: DepthDataModule) -> dict[str, ImageTable]:
    records = [datamodule.store.records[index] for index in evaluation.indices]
    return {
        name: image_table(
            protocol, evaluation.sums[name, protocol.name], records,
            boundary=evaluation.boundary.get(protocol.name) if name == MODEL else None,
        )
        for name in evaluation.predictors
    }  # fmt: skip


def _left_out(protocol: Protocol, table: ImageTable) -> list[str]:
    """Return and log the images without a pixel that counts; refuse if that is all of them."""
    ids = [image for image, pixels in zip(table.ids, table.pixels.tolist(), strict=True) if not pixels]
    if len(ids) == len(table.ids):
        raise ConfigError(f"protocol={protocol.name}: no pixel of {len(ids)} images counts. Check its crop and caps.")
    if ids:
        log.warning(
            "protocol=%s: no pixel of %d of %d images counts (unmeasured, outside the caps, or smaller than the crop); "
            "left out, the first is '%s'",
            protocol.name, len(ids), len(table.ids), ids[0],
        )  # fmt: skip
    return ids


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
