"""What a test leaves per protocol: metrics.json, per_image.csv and strata."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.files import write_json, write_text
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.results_table import Scored
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.scoring import image_table
from hudepth.metrics.bootstrap import describe, intervals
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.strata import strata_csv, summarise_strata
from hudepth.metrics.summary import ImageTable, per_image_csv, summarise
from hudepth.metrics.uncertainty import UNCERTAINTY_NAMES
from hudepth.runs.results import METRICS, MODEL, PER_IMAGE
from hudepth.viz.strata import save_strata


def write_outputs(
    folder: Path, protocol: Protocol, evaluation: Evaluation, datamodule: DepthDataModule, stamp: Mapping[str, Any]
) -> Scored:
    """Summarise and write the results of one protocol of a finished evaluation of the test subset.

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
    counted = len(model.ids) - len(left_out)
    if protocol.strata:
        rows = summarise_strata(evaluation.strata[protocol.name], model.categories)
        write_text(folder / "strata.csv", strata_csv(rows))
        title = f"{protocol.name} protocol, {counted} test images of {datamodule.source.name}"
        if protocol.alignment != "none":
            title += f", each prediction aligned to its ground truth ({protocol.alignment})"
        save_strata(folder / "strata.png", rows, title=title)
    if "flip_ause" in metrics[MODEL]:
        found = (metrics[MODEL][name] for name in UNCERTAINTY_NAMES)
        text = "%s protocol: disagreement with the mirrored image: AUSE %.3f, rank correlation with the error %.2f"
        log.info(text, protocol.name, *found)
    over = _resampled(model, uncertainty["scenes"])
    return Scored(protocol.name, metrics, ranges[MODEL], counted, over, protocol.alignment)


def _resampled(table: ImageTable, count: int) -> str:
    if any(table.scenes):
        return f"{count} scene{'s' * (count != 1)}"
    return f"{count} image{'s' * (count != 1)} of unknown scenes"


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
