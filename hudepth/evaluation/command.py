"""hudepth-test: score a checkpoint, or predictions in files, under protocols, alongside trivial baselines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.options import parse
from hudepth.data.build import build_data
from hudepth.evaluation.predictions import FilePredictions, PredictionOptions
from hudepth.evaluation.score import ScoreOptions, score_checkpoint, score_predictions
from hudepth.evaluation.test_data import open_data
from hudepth.runs.checkpoint import load_checkpoint


@dataclass(frozen=True, kw_only=True)
class CommandOptions(ScoreOptions):
    """Options of hudepth-test."""

    checkpoint: str | None = None
    """File, run directory, ``last``, or the name of a bundled pretrained model."""
    predictions: Path | None = None
    """Instead of a checkpoint: a folder of depth maps, see :mod:`hudepth.evaluation.predictions`."""
    paths: Mapping[str, str]
    """``runs`` and ``cache``."""
    data: Mapping[str, Any] | None = None
    """Overrides of the checkpoint's data, or another data set."""
    output: Path | None = None
    """Folder to write to; by default ``test`` in the run directory, else next to the working directory."""


def test(config: dict[str, Any]) -> None:
    """Score a checkpoint and write ``test/<protocol>/`` of its run directory, as conf/test.yaml and overrides ask."""
    options = parse(CommandOptions, config)
    if options.predictions:
        return _test_predictions(options, parse(PredictionOptions, config))
    if not options.checkpoint:
        places = "checkpoint=<file | run directory | last>, or predictions=<folder of depth maps>"
        raise ConfigError(f"checkpoint is not set. Pass {places}.")
    checkpoint = load_checkpoint(options.checkpoint, runs=options.paths["runs"])
    log.info("checkpoint: %s, after %d epochs on %s", checkpoint.path, checkpoint.epoch, checkpoint.data.get("source"))
    if "calibration" in checkpoint.data:
        log.warning("checkpoint: its calibration is left out: the network is scored as it was trained")
    # An untrusted checkpoint may choose what to read, but not where to write.
    overrides = {"cache": options.paths["cache"], **(options.data or {})}
    datamodule, other_data = open_data(checkpoint, overrides, typed=config["overrides"], trust=options.trust)
    output = options.output or Path(f"test_{checkpoint.path.stem}")
    if options.output is None and checkpoint.run:
        output = checkpoint.run / (f"test_{datamodule.source.name}" if other_data else "test")
    score_checkpoint(checkpoint, options, output=output, datamodule=datamodule)


def _test_predictions(options: CommandOptions, files: PredictionOptions) -> None:
    if options.checkpoint:
        raise ConfigError("checkpoint, predictions: both are set. Pass one of them.")
    if "_target_" not in (options.data or {}):
        raise ConfigError("data is not set. Pass data=<the set the predictions are of>, as data=nyu_labeled_mat.")
    datamodule = build_data({"cache": options.paths["cache"], **(options.data or {})}, trust=options.trust)
    output = options.output or Path(f"test_{files.predictions.resolve().name}")
    predictions = FilePredictions(files, datamodule)
    score_predictions(predictions, options, output=output, datamodule=datamodule)
