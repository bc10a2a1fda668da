"""Scoring a checkpoint under test protocols: what hudepth-test does, and hudepth-train at its end."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from hudepth.base.console import log, shows_progress
from hudepth.base.devices import ProgressBar, build_trainer, check_shares, without_known_warnings
from hudepth.base.errors import ConfigError
from hudepth.base.files import output_folder, written_whole
from hudepth.base.instantiate import import_trusted
from hudepth.base.machine import float32_products
from hudepth.base.options import Range
from hudepth.base.types import RawBatch
from hudepth.cuda import graphs
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.baselines import trivial_baselines
from hudepth.evaluation.lineage import note_scored
from hudepth.evaluation.outputs import write_outputs
from hudepth.evaluation.pictures import draw_beside, evenly_spaced, make_panels
from hudepth.evaluation.predictions import FilePredictions
from hudepth.evaluation.protocols import build_protocols
from hudepth.evaluation.results_table import Metrics, Scored, print_results
from hudepth.evaluation.routine import Evaluation
from hudepth.metrics.protocol import Protocol
from hudepth.models.inference import inference_form
from hudepth.runs.checkpoint import Checkpoint
from hudepth.runs.results import MODEL
from hudepth.viz.panels import Panel, save_panels


@dataclass(frozen=True, kw_only=True)
class ScoreOptions:
    """Options of a test."""

    trainer: Mapping[str, Any]
    """Arguments of Lightning's Trainer."""
    protocol: Mapping[str, Any]
    """Configurations of the test protocols, by name."""
    trust: list[str]
    """Packages whose classes a configuration may name."""
    panels: Annotated[int, Range(0)] = 6
    """Rows of panels.png; 0: none."""
    baselines: bool = True
    """Whether to score trivial baselines too."""


BEFORE = "before_training"
"""Name among the predictors of the network that a training started from."""


def score_checkpoint(
    checkpoint: Checkpoint,
    options: ScoreOptions,
    *,
    output: Path,
    datamodule: DepthDataModule,
    before: nn.Module | None = None,
) -> dict[str, Metrics]:
    """Score a checkpoint and trivial baselines in one pass; write a folder per protocol and print a table.

    Below ``output`` it writes ``<protocol>/metrics.json``, ``per_image.csv``, ``panels.png`` and, if the protocol asks
    for them, ``strata.csv`` and ``strata.png``. ``before`` is the network that the training started from, scored next
    to it. Returns metrics by protocol, predictor and name; empty except in the
    first process.
    """
    import_trusted(options.trust)
    protocols = build_protocols(options.protocol, datamodule=datamodule, trust=options.trust)
    output_folder(output, within=checkpoint.run if checkpoint.run in output.parents else None)
    net = inference_form(checkpoint.build_net(trust=options.trust), size=datamodule.size)

    def origin() -> dict[str, Any]:
        found = {"file": checkpoint.path.name, "epoch": checkpoint.epoch}
        found["trained_on"] = {**checkpoint.data, "split": checkpoint.split}
        return {"checkpoint": {**found, "scored_before": note_scored(checkpoint, datamodule, protocols)}}

    def draw(shown: Sequence[int]) -> list[Panel]:
        return make_panels(net, datamodule.store, shown, max_depth_m=datamodule.max_depth_m)

    models = {MODEL: net} if before is None else {MODEL: net, BEFORE: before}
    return _score(models, protocols, options, output=output, datamodule=datamodule, origin=origin, draw=draw)


def score_predictions(
    predictions: FilePredictions, options: ScoreOptions, *, output: Path, datamodule: DepthDataModule
) -> dict[str, Metrics]:
    """Score predictions of test pairs that lie in files, as :func:`score_checkpoint` does a checkpoint's."""
    import_trusted(options.trust)
    protocols = build_protocols(options.protocol, datamodule=datamodule, trust=options.trust)
    protocols = [predictions.protocol(protocol) for protocol in protocols]
    output_folder(output)

    def draw(shown: Sequence[int]) -> list[Panel]:
        def predict(raw: RawBatch, truth_m: NDArray[np.float32]) -> NDArray[np.float32]:
            return predictions.beside(int(raw["index"][0]), truth_m)

        return draw_beside(predict, datamodule.store, shown, max_depth_m=datamodule.max_depth_m)

    return _score(
        {MODEL: predictions}, protocols, options, output=output, datamodule=datamodule,
        origin=lambda: {"predictions": predictions.stamp()}, draw=draw,
    )  # fmt: skip


def _score(
    models: Mapping[str, nn.Module],
    protocols: Sequence[Protocol],
    options: ScoreOptions,
    *,
    output: Path,
    datamodule: DepthDataModule,
    origin: Callable[[], dict[str, Any]],
    draw: Callable[[Sequence[int]], list[Panel]],
) -> dict[str, Metrics]:
    """Score models and trivial baselines; ``origin`` states what :data:`MODEL` is, ``draw`` makes its panels."""
    predictors = dict(models)
    if options.baselines and not datamodule.split.train:
        log.info("no trivial baselines: data.split=%s has no training pairs to make them of", datamodule.split.kind)
    elif options.baselines:
        predictors |= trivial_baselines(datamodule.store, datamodule.split.train, max_depth_m=datamodule.max_depth_m)
    evaluation = Evaluation(predictors, protocols, max_depth_m=datamodule.max_depth_m, detailed=MODEL)
    if not run_evaluation(evaluation, datamodule, options.trainer):
        return {}
    stamp = {**_stamp(datamodule), **origin()}
    scored: list[Scored] = []
    failed = []
    for protocol in protocols:
        try:
            scored.append(write_outputs(output / protocol.name, protocol, evaluation, datamodule, stamp))
        except ConfigError as error:  # the results of the other protocols are not lost
            failed.append(error)
    print_results(scored, source=datamodule.source.name, files="<protocol>/metrics.json")
    results = {each.protocol: each.metrics for each in scored}
    for name, metrics in results.items():
        _tell_change(name, metrics)
    if options.panels:
        panels = draw(evenly_spaced(evaluation.indices, options.panels))
        paths = [output / name / "panels.png" for name in results]
        for path in paths[:1]:
            save_panels(path, panels)
        for path in paths[1:]:
            with written_whole(path) as part:
                shutil.copyfile(paths[0], part)
    if failed:
        raise failed[0]
    log.info("tables and pictures: %s", output.resolve())
    return results


def _tell_change(protocol: str, metrics: Metrics) -> None:
    """Say what a training made of the network that it started from, and warn if that was better."""
    if BEFORE not in metrics:
        return
    before, after = (metrics[name]["abs_rel"] for name in (BEFORE, MODEL))
    if after > before:
        text = "%s protocol: worse than the network it started from: abs_rel %.3f after training, %.3f before"
        log.warning(text, protocol, after, before)
    else:
        log.info("%s protocol: abs_rel %.3f after training, %.3f before", protocol, after, before)


def run_evaluation(evaluation: Evaluation, datamodule: DepthDataModule, options: Mapping[str, Any]) -> bool:
    """Run an evaluation over the test subset; return whether this is the first process, which has the results.

    ``options`` are arguments of Lightning's Trainer. Raises ConfigError if the devices are not available.
    """
    with without_known_warnings():
        trainer = build_trainer(
            {"devices": 1, **options},
            logger=False,
            callbacks=[ProgressBar()] if shows_progress() else None,
            enable_checkpointing=False,
            enable_model_summary=False,
            enable_progress_bar=shows_progress(),
            use_distributed_sampler=False,
            inference_mode=True,
        )
        check_shares(trainer, subset="test", pairs=len(datamodule.split.test))
        with float32_products(tf32=False):  # figures should not depend on the device
            trainer.test(evaluation, datamodule=datamodule, verbose=False)
        graphs.forget()
    return trainer.is_global_zero


def _stamp(datamodule: DepthDataModule) -> dict[str, Any]:
    """Return what metrics.json states about data and split."""
    info = datamodule.store.info
    return {
        "data": {key: info[key] for key in ("source", "fingerprint", "encoding", "pairs", "native_sizes", "skipped")},
        "split": datamodule.split.summary(),
        "network_size": list(datamodule.size),
        "max_depth_m": datamodule.max_depth_m,
    }
