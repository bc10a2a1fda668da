"""hudepth-test: score a checkpoint under one or more protocols, beside trivial baselines."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import RichProgressBar
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from torch import nn

from hudepth.callbacks import evenly_spaced, make_panels, shows_progress
from hudepth.checkpoint import Checkpoint, load_checkpoint
from hudepth.console import log
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.splits import Split, load_split, make_split
from hudepth.data.store import DepthStore
from hudepth.errors import CheckpointError, ConfigError, DataError, did_you_mean
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
    typed = {"cache": config["paths"]["cache"], **(config.get("data") or {})}
    config["data"] = _data_config(checkpoint, typed, list(HydraConfig.get().overrides.task))
    log.info("checkpoint: %s, after %d epochs on %s", checkpoint.path, checkpoint.epoch, checkpoint.data.get("source"))
    datamodule = build_data(config["data"], trust=config["trust"])
    other_data = "_target_" in typed or any(key.startswith(("split", "fractions")) for key in typed)
    if other_data:
        _refuse_training_pairs(checkpoint, datamodule)
    else:
        _restore_split(checkpoint, datamodule)
    output = config["output"] or (checkpoint.run / "test" if checkpoint.run else f"test_{checkpoint.path.stem}")
    if config["output"] is None and other_data and checkpoint.run:
        output = checkpoint.run / f"test_{datamodule.source.name}"
    score_checkpoint(checkpoint, config=config, output=Path(output), datamodule=datamodule)


def _data_config(checkpoint: Checkpoint, typed: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """Return the data configuration to test on: the checkpoint's with what was typed, or another set's.

    A network keeps the input size it was trained at, unless another is typed, and the scale of its output in any case.
    """
    trained = checkpoint.config.get("data")
    if not isinstance(trained, dict):
        raise CheckpointError(f"'{checkpoint.path}' does not say what data it was trained on.")
    if "_target_" in typed:
        keys = {override.lstrip("+").partition("=")[0] for override in overrides}
        data = {**typed, **{k: trained[k] for k in ("size", "max_depth_m") if k in trained and f"data.{k}" not in keys}}
    else:
        unknown = [key for key in typed if key not in trained]
        if unknown:
            raise ConfigError(
                f"data.{unknown[0]}: the checkpoint's data has no such key.{did_you_mean(unknown[0], trained)} "
                "To test on another data set pass data=<name>."
            )
        source = {**trained.get("source", {}), **typed.get("source", {})}
        data = {**trained, **typed, "source": source}
    if data.get("max_depth_m") != trained.get("max_depth_m"):
        raise ConfigError(
            f"data.max_depth_m: the network was trained for {trained.get('max_depth_m')} m and answers in shares of "
            f"it, not of {data.get('max_depth_m')} m. Leave data.max_depth_m out."
        )
    return data


def _recorded_split(checkpoint: Checkpoint, datamodule: DepthDataModule) -> Split | None:
    """Return the split of the training run from its split.json, if the checkpoint still lies beside it."""
    file = checkpoint.run / "split.json" if checkpoint.run else None
    return load_split(file, datamodule.store.records) if file and file.is_file() else None


def _restore_split(checkpoint: Checkpoint, datamodule: DepthDataModule) -> None:
    """Use the very split of the training run: from its split.json, else made again and compared by hash."""
    recorded = _recorded_split(checkpoint, datamodule)
    if recorded:
        datamodule.split = recorded
    if datamodule.store.info["fingerprint"] != checkpoint.data.get("fingerprint"):
        log.warning("the files of %s have changed since the checkpoint was trained", datamodule.source.name)
    if datamodule.split.sha256 != checkpoint.split.get("sha256"):
        raise DataError(
            f"'{checkpoint.path}': the split of {datamodule.source.name} is not the one it was trained on, so "
            "test pairs may have been trained on. "
            "Pass the data.root it was trained on, or data=<name> to test on other data."
        )


def _refuse_training_pairs(checkpoint: Checkpoint, datamodule: DepthDataModule) -> None:
    """Refuse to test on pairs the network was trained on, where the data is the very set of its training."""
    if datamodule.store.info["fingerprint"] != checkpoint.data.get("fingerprint"):
        return
    split = checkpoint.split
    trained = _recorded_split(checkpoint, datamodule) or make_split(
        datamodule.store.records, kind=split["kind"], seed=split["seed"], fractions=split["fractions"]
    )
    shared = set(trained.train) & set(datamodule.split.test)
    if shared:
        raise DataError(
            f"data.split={datamodule.split.kind}: {len(shared)} of {len(datamodule.split.test)} test pairs were "
            f"trained on, under data.split={trained.kind}. Leave data.split out to test on what was held out."
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
    try:
        output.mkdir(parents=True, exist_ok=True)  # not after the work is done
    except OSError as error:
        raise ConfigError(f"output: cannot make '{output}' ({error.strerror}). Pass output=<a folder>.") from error
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
            print_table(
                metrics, title=f"{protocol.name} protocol, {len(indices)} test images of {datamodule.source.name}"
            )
            write_json(
                folder / "metrics.json",
                {"metrics": _finite(metrics), "images": len(indices), "protocol": protocol.stamp(), **shared},
            )
            _write_per_image(folder / "per_image.csv", protocol, sums[MODEL], store, indices)
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
