"""hudepth-train: from a configuration to a run directory with a trained, tested model."""

from __future__ import annotations

import logging
import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from hudepth.base.console import log
from hudepth.base.devices import is_first_process
from hudepth.base.errors import ConfigError, HudepthError, Pruned
from hudepth.base.launched import shared_path
from hudepth.base.options import plain
from hudepth.runs import run_dir
from hudepth.runs.environment import environment as run_environment
from hudepth.runs.run import CHECKPOINTS, LAST
from hudepth.runs.status import lock_run, write_status
from hudepth.training.checks import check_config
from hudepth.training.fit import fit
from hudepth.training.resume import resumed_config

RUN_ENV = "HUDEPTH_RUN"
"""Tells the processes of a distributed run which run directory the first one made."""
HELD_S = 30
"""How long to wait for another process to leave a run directory: one whose sweep was killed ends after its batch."""


def train(cfg: DictConfig) -> float | None:
    """Train as configured, or continue a run; then test the best checkpoint.

    Args:
        cfg: what conf/train.yaml and the command line compose to.

    Returns:
        The best value of the monitored metric.

    Raises:
        HudepthError: with one line for the user; the run's status and log say the same.
    """
    overrides = [typed.removeprefix("++") for typed in HydraConfig.get().overrides.task]
    if cfg.resume:
        if _sweeping():
            raise ConfigError("resume: is of one run. To go on with a sweep, pass sweep_dir=<its folder>.")
        path = Path(cfg.resume).expanduser().resolve()
        config = resumed_config(path, overrides)
        check_config(config)
        resumed: list[str] | None = overrides
    else:
        config = plain(cfg)
        check_config(config)
        if not _sweeping() and (config["variant"] or config["sweep_dir"]):
            key = "variant" if config["variant"] else "sweep_dir"
            raise ConfigError(f"{key}: is of sweeps. Pass +sweep=<name> too, or -m, or leave it out.")
        path = _run_path(config)
        resumed = [] if (path / CHECKPOINTS / LAST).is_file() else None  # a job of a sweep that goes on
    if not is_first_process():
        log.setLevel(logging.WARNING)
    with _held(path), _shared_with_children(path), run_dir.log_to_file(path / "train.log"):
        if resumed is None and is_first_process():
            environment = run_environment(seed=config["seed"], accelerator=str(config["trainer"]["accelerator"]))
            run_dir.write_start(path, config=config, overrides=overrides, environment=environment)
        return _run(config, path, resumed=resumed)


@contextmanager
def _held(path: Path) -> Iterator[None]:
    """Keep other processes from the run directory, but for those of the same distributed run."""
    if not is_first_process():
        yield
        return
    with lock_run(path, timeout_s=HELD_S):
        yield


@contextmanager
def _shared_with_children(path: Path) -> Iterator[None]:
    os.environ[RUN_ENV] = str(path)
    try:
        yield
    finally:
        os.environ.pop(RUN_ENV, None)


def _status(path: Path, state: str, **more: Any) -> None:
    if is_first_process():
        write_status(path, state, **more)


def _sweeping() -> bool:
    """Whether this run is a job of a sweep: alone in its process, whatever cluster that is on, and silent."""
    return bool(HydraConfig.get().mode == RunMode.MULTIRUN)


def _run_path(config: dict[str, Any]) -> Path:
    if RUN_ENV in os.environ:
        return Path(os.environ[RUN_ENV])
    if _sweeping():
        path = Path(HydraConfig.get().runtime.output_dir)
        path.mkdir(parents=True, exist_ok=True)
        return path.resolve()
    return shared_path(partial(run_dir.create, config["paths"]["runs"], str(config["name"])), config["trainer"])


def _run(config: dict[str, Any], path: Path, *, resumed: list[str] | None) -> float | None:
    """Fit and test inside a run directory, whose status always tells how it went."""
    try:
        _status(path, "running")
        best = fit(config, path, resumed=resumed, alone=_sweeping())
    except HudepthError as error:
        _failed(path, str(error))
        raise
    except OSError as error:
        _failed(path, str(error))
        raise ConfigError(
            f"{error.strerror or error} ('{error.filename or path}'). See {path / 'train.log'}."
        ) from error
    except Pruned as pruned:
        _status(path, "pruned", best=pruned.value)
        log.info("%s", pruned)
        return pruned.value
    except (KeyboardInterrupt, SystemExit):
        _status(path, "interrupted")
        log.info("interrupted; continue with: hudepth-train resume=%s", path)
        raise KeyboardInterrupt from None  # which Lightning turns into the exit code of an error
    except BaseException as error:
        _failed(path, f"{type(error).__name__}: {error}")
        raise
    _status(path, "finished", best=best)
    return best


def _failed(path: Path, message: str) -> None:
    try:
        with (path / "train.log").open("a", encoding="utf-8") as file:
            file.write(traceback.format_exc())
        _status(path, "failed", error=message)
    except OSError:  # a full disk is the likely reason to be here; the message below still goes to the terminal
        log.warning("the status in '%s' could not be written", path)
