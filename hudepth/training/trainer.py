"""The Trainer of a run and its callbacks, from a configuration."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import RichProgressBar
from lightning.pytorch.loggers import Logger, TensorBoardLogger

from hudepth.base.console import shows_progress
from hudepth.base.devices import build_trainer
from hudepth.base.errors import ConfigError
from hudepth.base.instantiate import instantiate
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.pictures import evenly_spaced
from hudepth.runs.checkpoint import AtomicCheckpointIO
from hudepth.training.callbacks import (
    EpochLine,
    FullSizeEarlyStopping,
    History,
    Interrupt,
    PanelPictures,
    checkpoint_callbacks,
)
from hudepth.training.study import TRIAL_ENV, TrialPruner
from hudepth.training.times import Times


def build_callbacks(config: Mapping[str, Any], path: Path, datamodule: DepthDataModule) -> list[Callback]:
    """Build all that happens beside training, in order: history before checkpoints, which hold it.

    Args:
        config: of the run.
        path: its directory.
        datamodule: its data.

    Raises:
        ConfigError: if one cannot be built.
    """
    options = config["callbacks"]
    monitor, mode = config["monitor"], config["mode"]
    callbacks: list[Callback] = [
        Interrupt(),
        History(path / "metrics.csv"),
        Times(path / "times.csv"),
        EpochLine(monitor),
    ]
    if options["panels"]:
        callbacks.append(
            PanelPictures(
                path / "images",
                datamodule.store,
                evenly_spaced(sorted(datamodule.split.val), options["panels"]),
                every_n_epochs=options["panels_every_n_epochs"],
                max_depth_m=datamodule.max_depth_m,
            )
        )
    if shows_progress():
        callbacks.append(RichProgressBar(leave=False))
    if trial := os.environ.get(TRIAL_ENV):
        callbacks.append(TrialPruner(trial, monitor=monitor))
    if options["early_stopping"]:
        callbacks.append(
            FullSizeEarlyStopping(monitor, mode=mode, check_on_train_epoch_end=True, **options["early_stopping"])
        )
    callbacks += [instantiate(extra, trust=config["trust"], only=Callback) for extra in options["extra"]]
    return [*callbacks, *checkpoint_callbacks(path, monitor=monitor, mode=mode)]


def build_run_trainer(config: Mapping[str, Any], path: Path, callbacks: list[Callback], *, alone: bool) -> Trainer:
    """Build the Trainer of a run.

    Args:
        config: of the run.
        path: its directory.
        callbacks: see :func:`build_callbacks`.
        alone: one process, whatever cluster's environment it finds itself in.

    Raises:
        ConfigError: if its options do not fit.
    """
    if str(config["trainer"].get("precision", "")).endswith("16-true"):
        raise ConfigError(
            f"trainer.precision: {config['trainer']['precision']} keeps the weights in 16 bits, which loses updates. "
            "Pass bf16-mixed, 16-mixed or 32-true."
        )
    options = config["logger"]
    loggers: list[Logger] = [instantiate(extra, trust=config["trust"], only=Logger) for extra in options["extra"]]
    if options["tensorboard"]:
        loggers.append(TensorBoardLogger(path, name="tensorboard", version=""))
    return build_trainer(
        config["trainer"],
        logger=loggers or False,
        callbacks=callbacks,
        plugins=[AtomicCheckpointIO(), *([LightningEnvironment()] if alone else [])],
        default_root_dir=path,
        enable_model_summary=False,
        enable_progress_bar=shows_progress(),
        num_sanity_val_steps=0,
        use_distributed_sampler=False,  # the data module shards by itself, exactly
        log_every_n_steps=1,  # all is logged by epoch; a larger number only makes Lightning warn
    )
