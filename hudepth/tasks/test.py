"""hudepth-test: score a checkpoint under one or more protocols, beside trivial baselines."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import RichProgressBar
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from torch import nn

from hudepth.callbacks import evenly_spaced, make_panels, shows_progress
from hudepth.checkpoint import Checkpoint, load_checkpoint
from hudepth.console import log
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.splits import load_split
from hudepth.data.store import DepthStore
from hudepth.errors import ConfigError, DataError, did_you_mean
from hudepth.evaluation import Evaluation, trivial_baselines
from hudepth.files import write_json, write_text
from hudepth.metrics.protocol import Protocol
from hudepth.tasks.common import build_data, build_protocols, plain, without_known_warnings
from hudepth.viz.panels import save_panels

SHOWN = ("abs_rel", "sq_rel", "rmse", "rmse_log", "log10", "silog", "mae", "ssim", "delta1", "delta2", "delta3")
NARROW = ("abs_rel", "rmse", "log10", "ssim", "delta1", "delta2", "delta3")
"""Columns of the printed table, in a terminal wide enough for all and in others; metrics.json always has all."""
MODEL = "model"


def test(cfg: DictConfig) -> None:
    """Score a checkpoint and write ``test/<protocol>/`` of its run directory.

    Args:
        cfg: what conf/test.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user.
    """
    config = plain(cfg)
    checkpoint = load_checkpoint(str(config["checkpoint"]), runs=config["paths"]["runs"])
    # The checkpoint may be a stranger's: it says what to read, but not where to write.
    own = {"cache": config["paths"]["cache"]}
    config["data"], other_data = _data_config(checkpoint, {**own, **(config.get("data") or {})})
    log.info("checkpoint: %s, after %d epochs on %s", checkpoint.path, checkpoint.epoch, checkpoint.data.get("source"))
    datamodule = build_data(config["data"], trust=config["trust"])
    if not other_data:
        _restore_split(checkpoint, datamodule)
    output = config["output"] or (checkpoint.run / "test" if checkpoint.run else f"test_{checkpoint.path.stem}")
    if config["output"] is None and other_data and checkpoint.run:
        output = checkpoint.run / f"test_{datamodule.source.name}"
    score_checkpoint(checkpoint, config=config, output=Path(output), datamodule=datamodule)


def _data_config(checkpoint: Checkpoint, typed: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """Return the data configuration to test on, and whether it is another set than the checkpoint's."""
    trained = checkpoint.config["data"]
    if "_target_" in typed:
        return typed, True
    unknown = [key for key in typed if key not in trained]
    if unknown:
        raise ConfigError(
            f"data.{unknown[0]}: the checkpoint's data has no such key.{did_you_mean(unknown[0], trained)} "
            "To test on another data set pass data=<name>."
        )
    merged = OmegaConf.to_container(OmegaConf.merge(OmegaConf.create(trained), OmegaConf.create(typed)))
    assert isinstance(merged, dict)
    return {str(key): value for key, value in merged.items()}, any(key.startswith("split") for key in typed)


def _restore_split(checkpoint: Checkpoint, datamodule: DepthDataModule) -> None:
    """Use the very split of the training run: from its split.json, else made again and compared by hash."""
    if checkpoint.run and (checkpoint.run / "split.json").is_file():
        datamodule.split = load_split(checkpoint.run / "split.json", datamodule.store.records)
    if datamodule.store.info["fingerprint"] != checkpoint.data.get("fingerprint"):
        log.warning("the files of %s have changed since the checkpoint was trained", datamodule.source.name)
    if datamodule.split.sha256 != checkpoint.split.get("sha256"):
        raise DataError(
            f"'{checkpoint.path}': the split of {datamodule.source.name} is not the one it was trained on, so "
            "test pairs may have been trained on. "
            "Pass the data.root it was trained on, or data=<name> to test on other data."
        )


def score_checkpoint(
    checkpoint: Checkpoint, *, config: dict[str, Any], output: Path, datamodule: DepthDataModule
) -> dict[str, dict[str, dict[str, float]]]:
    """Score a checkpoint and trivial baselines; write metrics.json, per_image.csv and panels.png; print the table.

    Args:
        checkpoint: what to score.
        config: with ``trainer``, ``protocol``, ``trust`` and perhaps ``panels`` and ``baselines``.
        output: folder for one folder a protocol.
        datamodule: with the split to test on.

    Returns:
        Metrics by protocol, predictor and name.

    Raises:
        HudepthError: with one line for the user.
    """
    protocols = build_protocols(config["protocol"], datamodule=datamodule, trust=config["trust"])
    store, split = datamodule.store, datamodule.split
    predictors: dict[str, nn.Module] = {MODEL: checkpoint.build_net(trust=config["trust"])}
    if config.get("baselines", True):
        predictors |= trivial_baselines(store, split.train, max_depth_m=datamodule.max_depth_m)
    evaluation = Evaluation(predictors, protocols, max_depth_m=datamodule.max_depth_m)
    with without_known_warnings():
        trainer = _trainer(config["trainer"])
        trainer.test(evaluation, datamodule=datamodule, verbose=False)
    results = {}
    indices = evaluation.indices
    shared = _stamp(checkpoint, datamodule)
    for protocol in protocols:
        folder = output / protocol.name
        sums = {name: evaluation.sums[name, protocol.name] for name in predictors}
        metrics = {name: protocol.summary(rows) for name, rows in sums.items()}
        results[protocol.name] = metrics
        if trainer.is_global_zero:
            write_json(
                folder / "metrics.json",
                {"metrics": _finite(metrics), "images": len(indices), "protocol": protocol.stamp(), **shared},
            )
            _write_per_image(folder / "per_image.csv", protocol, sums[MODEL], store, indices)
            print_table(
                metrics, title=f"{protocol.name} protocol, {len(indices)} test images of {datamodule.source.name}"
            )
    count = config.get("panels", 6)
    if count and trainer.is_global_zero:
        shown = evenly_spaced(sorted(indices), count)
        panels = make_panels(predictors[MODEL], store, shown, max_depth_m=datamodule.max_depth_m)
        for protocol in protocols:
            save_panels(output / protocol.name / "panels.png", panels)
    log.info("tables and pictures: %s", output.resolve())
    return results


def _trainer(options: dict[str, Any]) -> Trainer:
    try:
        return Trainer(
            **{"devices": 1, **options},
            logger=False,
            callbacks=[RichProgressBar()] if shows_progress() else None,
            enable_checkpointing=False,
            enable_model_summary=False,
            enable_progress_bar=shows_progress(),
            use_distributed_sampler=False,
            inference_mode=True,
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(f"trainer: {error}") from error


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


def _finite(metrics: dict[str, dict[str, float]]) -> dict[str, dict[str, float | None]]:
    return {who: {k: v if math.isfinite(v) else None for k, v in row.items()} for who, row in metrics.items()}


def _write_per_image(path: Path, protocol: Protocol, sums: Any, store: DepthStore, indices: list[int]) -> None:
    text = io.StringIO()
    columns = protocol.per_image(sums)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["id", "scene", "category", "pixels", *columns])
    values = zip(*(column.tolist() for column in columns.values()), strict=True)
    for index, pixels, row in zip(indices, sums[:, 0].tolist(), values, strict=True):
        record = store.records[index]
        writer.writerow([record.id, record.scene, record.category, int(pixels), *(f"{value:.6g}" for value in row)])
    write_text(path, text.getvalue())


def print_table(metrics: dict[str, dict[str, float]], *, title: str) -> None:
    """Print metrics to standard output, a row a predictor, the best of each column bold."""
    out = Console()
    if not out.is_terminal:
        out = Console(width=130)  # a log should not wrap what a wide terminal would show
    names = SHOWN if out.width >= 118 else NARROW
    table = Table(title=title, caption="rmse and mae in metres; delta and ssim: higher is better", title_justify="left")
    table.add_column("")
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    for who, row in metrics.items():
        cells = []
        for name in names:
            column = [other[name] for other in metrics.values()]
            best = max(column) if name in ("ssim", "delta1", "delta2", "delta3") else min(column)
            text = f"{row[name]:.3f}" if row[name] < 100 else f"{row[name]:.1f}"
            cells.append(f"[bold]{text}[/]" if row[name] == best and len(metrics) > 1 else text)
        table.add_row(who.replace("_", " "), *cells)
    out.print(table)
