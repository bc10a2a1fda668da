"""One job of a sweep: a training that writes its output and its errors to its own run directory."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import traceback
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from hudepth.base.console import setup_logging
from hudepth.base.machine import usable_cores
from hudepth.base.wording import one_line
from hudepth.runs.status import LockedError, read_status, write_status


def run_job(cfg: DictConfig) -> None:
    """Call :func:`hudepth.training.command.train` as one job of a sweep.

    Errors end up in the run's status and log and are never raised, so that the other jobs continue. Output goes to
    train.log; only warnings reach the terminal.
    """
    path = Path(HydraConfig.get().runtime.output_dir)
    path.mkdir(parents=True, exist_ok=True)
    setup_logging(logging.WARNING, prefix=f"{path.name}: ")
    train = importlib.import_module("hudepth.training.command").train
    _share_machine(cfg)
    try:
        with (path / "train.log").open("a", encoding="utf-8") as log, contextlib.redirect_stdout(log):
            train(cfg)
    except LockedError as error:  # another process runs this job, which has not failed
        logging.getLogger("hudepth").warning("%s", error)
    except Exception as error:
        _write_failure(path, error)


def _write_failure(path: Path, error: Exception) -> None:
    status = read_status(path)
    with contextlib.suppress(OSError):  # a full disk: the launcher's process finds the run unfinished
        if status.get("state") != "failed" or status.get("pid") != os.getpid():
            with (path / "train.log").open("a", encoding="utf-8") as log:
                log.write(traceback.format_exc())
        write_status(path, "failed", error=one_line(error, "train"))


def _share_machine(cfg: DictConfig) -> None:
    """Divide the cores among jobs that run in parallel, and assign the GPUs in turn."""
    hydra = HydraConfig.get()
    parallel = hydra.launcher.get("n_jobs")
    if parallel in (None, 1):
        return
    import torch

    torch.set_num_threads(max(1, usable_cores() // parallel) if parallel > 0 else 1)
    gpus = torch.cuda.device_count()
    if gpus > 1 and cfg.trainer.accelerator in ("auto", "gpu", "cuda"):
        cfg.trainer.devices = [int(hydra.job.num) % gpus]
