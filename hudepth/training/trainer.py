"""The Trainer of a run and its callbacks, from a configuration."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import Logger

from hudepth.base.console import shows_progress
from hudepth.base.devices import ProgressBar, build_trainer
from hudepth.base.errors import TrainingError
from hudepth.base.instantiate import instantiate
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.pictures import evenly_spaced
from hudepth.runs import history
from hudepth.training.callbacks import CompileTime, EpochLine, EpochSeed, History, Interrupt, LogLosses, PanelPictures
from hudepth.training.checkpointing import AtomicCheckpointIO, FullSizeEarlyStopping, checkpoint_callbacks
from hudepth.training.loggers.steps import LogSteps
from hudepth.training.study import TRIAL_ENV, TrialPruner
from hudepth.training.times import Times


def build_callbacks(config: Mapping[str, Any], path: Path, datamodule: DepthDataModule) -> list[Callback]:
    """Build the callbacks of a run in a directory: history before checkpoints, which hold it."""
    options, monitor, mode = config["callbacks"], config["monitor"], config["mode"]
    callbacks: list[Callback] = [
        Interrupt(), EpochSeed(config["seed"]), LogLosses(), History(path / history.FILE), Times(path / "times.csv"),
        EpochLine(monitor), LogSteps(),
    ]  # fmt: skip
    if config.get("compile"):
        callbacks.append(CompileTime())
    if options["panels"]:
        indices = evenly_spaced(sorted(datamodule.split.val), options["panels"])
        how = {"every_n_epochs": options["panels_every_n_epochs"], "max_depth_m": datamodule.max_depth_m}
        callbacks.append(PanelPictures(path / "images", datamodule.store, indices, **how))
    if shows_progress() and config["trainer"].get("enable_progress_bar", True):
        callbacks.append(ProgressBar())
    if trial := os.environ.get(TRIAL_ENV):
        callbacks.append(TrialPruner(trial, monitor=monitor))
    if stop := options["early_stopping"]:
        callbacks.append(FullSizeEarlyStopping(monitor, mode=mode, check_on_train_epoch_end=True, **stop))
    callbacks += [instantiate(extra, trust=config["trust"], only=Callback) for extra in options["extra"]]
    return [*callbacks, *checkpoint_callbacks(path, monitor=monitor, mode=mode)]


def build_run_trainer(
    config: Mapping[str, Any], path: Path, callbacks: list[Callback], loggers: list[Logger], *, alone: bool
) -> Trainer:
    """Build the Trainer of a run; ``alone`` means one process, whatever cluster it runs on."""
    defaults = {
        "enable_model_summary": False, "enable_progress_bar": shows_progress(), "num_sanity_val_steps": 0,
        "benchmark": not config["trainer"].get("deterministic"),  # cuDNN tries its algorithms: sizes hardly change
    }  # fmt: skip
    return build_trainer(
        {**defaults, **config["trainer"]}, logger=loggers or False, callbacks=callbacks,
        plugins=[AtomicCheckpointIO(), *([LightningEnvironment()] if alone else [])], default_root_dir=path,
        use_distributed_sampler=False,  # the data module divides the pairs among processes itself, exactly
    )  # fmt: skip


@contextmanager
def one_ending(trainer: Trainer) -> Iterator[None]:
    """Let the processes of a training end together, with one message, if one of them cannot go on.

    Raises KeyboardInterrupt if this process was asked to stop and another one was faster, whose connection is lost
    then; TrainingError if another one failed.
    """
    others = getattr(trainer.strategy.launcher, "procs", [])
    try:
        yield
    except BaseException as error:
        for process in others:  # they would wait for this one
            process.send_signal(signal.SIGKILL if os.name != "nt" else signal.SIGTERM)
        if isinstance(error, RuntimeError):
            if any(isinstance(each, Interrupt) and each.asked for each in trainer.callbacks):  # type: ignore[attr-defined]
                raise KeyboardInterrupt from error
            if trainer.world_size > 1 and re.search(r"gloo|nccl|peer", str(error), re.IGNORECASE):
                raise TrainingError(
                    f"another of the {trainer.world_size} processes of this training was killed, or failed as it says "
                    f"above. Resume with hudepth-train resume={trainer.default_root_dir}"
                ) from error
        raise
    finally:
        others.clear()  # else Lightning, which watches them, would kill this process for their exit codes
