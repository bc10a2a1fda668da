"""Scoring a checkpoint: the part that ``hudepth-test`` shares with the end of a training."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import RichProgressBar
from torch import nn

from hudepth.base.console import log, shows_progress
from hudepth.base.devices import build_trainer, check_shares, without_known_warnings
from hudepth.base.errors import ConfigError
from hudepth.base.files import write_json, write_text
from hudepth.base.options import whole_number
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.baselines import trivial_baselines
from hudepth.evaluation.lineage import note_scored
from hudepth.evaluation.pictures import evenly_spaced, make_panels
from hudepth.evaluation.protocols import build_protocols
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.scoring import image_table
from hudepth.evaluation.tables import print_results
from hudepth.metrics.bootstrap import describe, intervals
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.strata import strata_csv, summarise_strata
from hudepth.metrics.summary import ImageTable, per_image_csv, summarise
from hudepth.models.inference import inference_form
from hudepth.runs.checkpoint import Checkpoint
from hudepth.runs.results import MODEL
from hudepth.viz.panels import save_panels
from hudepth.viz.strata import save_strata


def score_checkpoint(
    checkpoint: Checkpoint, *, config: dict[str, Any], output: Path, datamodule: DepthDataModule
) -> dict[str, dict[str, dict[str, float]]]:
    """Score a checkpoint and trivial baselines in one pass; write a folder a protocol; print a table each.

    Args:
        checkpoint: what to score.
        config: with ``trainer``, ``protocol``, ``trust`` and perhaps ``panels`` and ``baselines``.
        output: folder for ``<protocol>/metrics.json``, ``per_image.csv``, ``panels.png`` and, where the protocol asks
            for them, ``strata.csv`` and ``strata.png``.
        datamodule: with the split to test on.

    Returns:
        Metrics by protocol, predictor and name.

    Raises:
        HudepthError: with one line for the user.
    """
    count = whole_number(config, "panels", default=6)
    protocols = build_protocols(config["protocol"], datamodule=datamodule, trust=config["trust"])
    try:
        output.mkdir(parents=True, exist_ok=True)  # not after the work is done
    except OSError as error:
        raise ConfigError(f"output: cannot make '{output}' ({error.strerror}). Pass output=<a folder>.") from error
    net = checkpoint.build_net(trust=config["trust"])
    predictors: dict[str, nn.Module] = {MODEL: inference_form(net, size=datamodule.size)}
    if config.get("baselines", True):
        predictors |= trivial_baselines(datamodule.store, datamodule.split.train, max_depth_m=datamodule.max_depth_m)
    evaluation = Evaluation(predictors, protocols, max_depth_m=datamodule.max_depth_m, detailed=MODEL)
    with without_known_warnings():
        trainer = _trainer(config["trainer"])
        check_shares(trainer, subset="test", pairs=len(datamodule.split.test))
        trainer.test(evaluation, datamodule=datamodule, verbose=False)
    if not trainer.is_global_zero:
        return {}
    shared = _stamp(checkpoint, datamodule)
    shared["checkpoint"]["scored_before"] = note_scored(checkpoint, datamodule, protocols)
    results, failed = {}, []
    for protocol in protocols:
        try:
            results[protocol.name] = _write_results(output / protocol.name, protocol, evaluation, datamodule, shared)
        except ConfigError as error:  # what the other protocols say is not lost
            failed.append(error)
    if count:
        shown = evenly_spaced(evaluation.indices, count)
        panels = make_panels(predictors[MODEL], datamodule.store, shown, max_depth_m=datamodule.max_depth_m)
        for name in results:
            save_panels(output / name / "panels.png", panels)
    if failed:
        raise failed[0]
    log.info("tables and pictures: %s", output.resolve())
    return results


def _write_results(
    folder: Path, protocol: Protocol, evaluation: Evaluation, datamodule: DepthDataModule, shared: Mapping[str, Any]
) -> dict[str, dict[str, float]]:
    """Summarise, write and print what one protocol says; return its metrics by predictor."""
    records = [datamodule.store.records[index] for index in evaluation.indices]
    tables = {}
    for name in evaluation.predictors:
        tables[name] = image_table(
            protocol, evaluation.sums[name, protocol.name], records,
            boundary=evaluation.boundary.get(protocol.name) if name == MODEL else None,
        )  # fmt: skip
    model = tables[MODEL]
    left_out = _left_out(protocol, model)
    metrics = {name: summarise(table, **protocol.summary_options) for name, table in tables.items()}
    ranges = {name: intervals(table, **protocol.summary_options) for name, table in tables.items()}
    write_json(
        folder / "metrics.json",
        {
            "metrics": {who: {k: _finite(v) for k, v in row.items()} for who, row in metrics.items()},
            "intervals": {
                who: {k: [_finite(low), _finite(high)] for k, (low, high) in row.items()}
                for who, row in ranges.items()
            },
            "uncertainty": describe(model),
            "images": len(records),
            "left_out": left_out,
            "protocol": protocol.stamp(),
            **shared,
        },
    )  # fmt: skip
    write_text(folder / "per_image.csv", per_image_csv(model))
    title = f"{protocol.name} protocol, {len(records) - len(left_out)} test images of {datamodule.source.name}"
    if protocol.alignment != "none":
        title += f", each prediction aligned to its truth ({protocol.alignment})"
    if protocol.strata:
        rows = summarise_strata(evaluation.strata[protocol.name], model.categories)
        write_text(folder / "strata.csv", strata_csv(rows))
        save_strata(folder / "strata.png", rows, title=title)
    over = f"{describe(model)['scenes']} {'scenes' if any(model.scenes) else 'images, whose scenes are unknown'}"
    print_results(metrics, ranges[MODEL], over=over, title=title)
    return metrics


def _left_out(protocol: Protocol, table: ImageTable) -> list[str]:
    """Name the images of which no pixel counts, in a line of the log.

    Raises:
        ConfigError: if that is all of them.
    """
    ids = [image for image, pixels in zip(table.ids, table.pixels.tolist(), strict=True) if not pixels]
    if len(ids) == len(table.ids):
        raise ConfigError(f"protocol={protocol.name}: no pixel of {len(ids)} images counts; look at its crop and caps.")
    if ids:
        log.warning(
            "protocol=%s: no pixel of %d of %d images counts (its holes, the caps, or a crop that exceeds it); "
            "left out, the first is '%s'",
            protocol.name, len(ids), len(table.ids), ids[0],
        )  # fmt: skip
    return ids


def _trainer(options: dict[str, Any]) -> Trainer:
    return build_trainer(
        {"devices": 1, **options},
        logger=False,
        callbacks=[RichProgressBar()] if shows_progress() else None,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=shows_progress(),
        use_distributed_sampler=False,
        inference_mode=True,
    )


def _stamp(checkpoint: Checkpoint, datamodule: DepthDataModule) -> dict[str, Any]:
    info = datamodule.store.info
    return {
        "data": {key: info[key] for key in ("source", "fingerprint", "encoding", "pairs", "native_sizes", "skipped")},
        "split": datamodule.split.summary(),
        "network_size": list(datamodule.size),
        "max_depth_m": datamodule.max_depth_m,
        "checkpoint": {
            "file": checkpoint.path.name,
            "epoch": checkpoint.epoch,
            "trained_on": {**checkpoint.data, "split": checkpoint.split},
        },
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
