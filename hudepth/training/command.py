"""hudepth-train: from a configuration to a run directory with a trained, tested model."""

from __future__ import annotations

import logging
import os
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from hudepth.base.console import log
from hudepth.base.devices import is_first_process
from hudepth.base.errors import CheckpointError, ConfigError, HudepthError, Pruned
from hudepth.base.launched import shared_path
from hudepth.base.options import plain
from hudepth.base.wording import unwritten
from hudepth.runs import run_dir
from hudepth.runs.checkpoint import read_plain
from hudepth.runs.environment import environment
from hudepth.runs.identity import RESUMABLE, is_below, part_bound_to_length
from hudepth.runs.run import CHECKPOINTS, LAST, read_config
from hudepth.runs.sections import check_config, check_resumable
from hudepth.runs.status import lock_run, write_status
from hudepth.training.fit import fit
from hudepth.training.initial import Training
from hudepth.training.options import TrainOptions, parse_options
from hudepth.training.parts import check_parts

RUN_ENV = "HUDEPTH_RUN"
"""Holds the run directory that the first process of a distributed run made, for the others."""
LOCK_TIMEOUT_S = 30
"""How long to wait for another process to leave a run directory; one whose sweep was killed ends after its batch."""

PARTS = (
    "seed", "monitor", "mode", "data", "model", "loss", "optim", "schedule", "trainer", "callbacks", "logger",
    "protocol",
)  # fmt: skip
"""Groups and keys that the configuration of every training has."""


def train(cfg: DictConfig) -> float | None:
    """Train as configured, or resume a run; test the best checkpoint; return the best value of the monitored metric.

    Raises HudepthError with one line for the user, which the run's status and log repeat.
    """
    training = _resumed(cfg) if cfg.resume else _new(cfg)
    path = training.path
    if not is_first_process():
        log.setLevel(logging.WARNING)
    lock = lock_run(path, timeout_s=LOCK_TIMEOUT_S) if is_first_process() else nullcontext()
    with lock, _shared_with_children(path), run_dir.log_to_file(path / "train.log"):
        if training.overrides is None and is_first_process():
            options = training.options
            found = environment(
                seed=options.seed, accelerator=options.trainer.accelerator, precision=options.trainer.precision
            )
            run_dir.write_start(path, config=training.config, overrides=_overrides(), environment=found)
        return _run(training)


def _resumed(cfg: DictConfig) -> Training:
    if _in_sweep():
        raise ConfigError("resume: only applies to single runs. To resume a sweep, pass sweep_dir=<its folder>.")
    path = Path(cfg.resume).expanduser().resolve()
    config = resumed_config(path, _overrides())
    return Training(config, parse_options(config), path, _overrides())


def _new(cfg: DictConfig) -> Training:
    config = plain(cfg)
    options = parse_options(config)
    if not _in_sweep() and (key := "variant" if options.variant else "sweep_dir" if options.sweep_dir else None):
        raise ConfigError(f"{key}: only applies to sweeps. Pass +sweep=<name> or -m as well, or leave it out.")
    check_parts(config, options)
    path = _run_path(config, options)
    begun = (path / CHECKPOINTS / LAST).is_file()  # a job of a sweep that is resumed
    return Training(config, options, path, [] if begun else None, alone=_in_sweep())


def resumed_config(path: Path, overrides: list[str]) -> dict[str, Any]:
    """Return the configuration of a run to resume, with command-line overrides like ``trainer.max_epochs=50``.

    The run directory may come from somebody else, so only ``trust=`` on the command line counts. Raises CheckpointError
    if it is not a run or has no checkpoint to resume from, ConfigError if an override cannot change any more.
    """
    config = read_config(path)
    if lacking := [part for part in PARTS if part not in config]:
        raise CheckpointError(f"resume: '{path}' is not a training run: its config.yaml has no '{lacking[0]}'.")
    last = path / CHECKPOINTS / LAST
    if not last.is_file():
        raise CheckpointError(f"resume: '{path}' has no finished epoch to resume from. Train again without resume=.")
    check_config(config, where=path / "config.yaml")
    check_resumable(read_plain(last), where=last)
    epochs = config["trainer"].get("max_epochs")
    resumed = OmegaConf.create({**config, "trust": []})
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        if key == "resume":
            continue
        found = OmegaConf.select(resumed, key, default=resumed)
        if not is_below(key, RESUMABLE) or OmegaConf.is_dict(found):  # a group, or a key that the run does not have
            raise ConfigError(
                f"resume: '{override}' cannot be changed when a run is resumed; trainer.max_epochs and other "
                "values of trainer, callbacks and logger can. Start a new run for anything else."
            )
        OmegaConf.update(resumed, key, OmegaConf.from_dotlist([f"value={value}"])["value"])
    result = plain(resumed)
    if result["trainer"].get("max_epochs") != epochs and (part := part_bound_to_length(config)):
        raise ConfigError(
            f"resume: {part} of this run is laid out over {epochs} epochs, so trainer.max_epochs cannot change. "
            "Start a new run, or use schedule=constant and data.progressive=null from the start."
        )
    return result


def _overrides() -> list[str]:
    return [override.removeprefix("++") for override in HydraConfig.get().overrides.task]


def _in_sweep() -> bool:
    return bool(HydraConfig.get().mode == RunMode.MULTIRUN)


def _run_path(config: dict[str, Any], options: TrainOptions) -> Path:
    if RUN_ENV in os.environ:
        return Path(os.environ[RUN_ENV])
    if _in_sweep():  # hudepth.sweep.job has made it
        return Path(HydraConfig.get().runtime.output_dir).resolve()
    return shared_path(partial(run_dir.create, config["paths"]["runs"], options.name), config["trainer"])


@contextmanager
def _shared_with_children(path: Path) -> Iterator[None]:
    os.environ[RUN_ENV] = str(path)
    try:
        yield
    finally:
        os.environ.pop(RUN_ENV, None)


def _run(training: Training) -> float | None:
    """Fit and test; whatever happens, the run's status states how it ended."""
    path = training.path
    try:
        _write_status(path, "running")
        best = fit(training)
    except Pruned as pruned:
        _write_status(path, "pruned", best=pruned.value)
        log.info("%s", pruned)
        return pruned.value
    except (KeyboardInterrupt, SystemExit):
        _write_status(path, "interrupted")
        log.info("interrupted; resume with: hudepth-train resume=%s", path)
        raise KeyboardInterrupt from None  # Lightning raises SystemExit, whose exit code would be that of an error
    except BaseException as error:
        expected = isinstance(error, HudepthError | OSError)
        _write_failure(path, str(error) if expected else f"{type(error).__name__}: {error}")
        if not isinstance(error, OSError):
            raise
        error.filename = error.filename or str(path)
        why = unwritten(error) or f"{error.strerror or error} ('{error.filename}')."
        more = f"Resume with hudepth-train resume={path}" if training.last.is_file() else f"See {path / 'train.log'}."
        raise ConfigError(f"{why} {more}") from error
    _write_status(path, "finished", best=best)
    return best


def _write_status(path: Path, state: str, **more: Any) -> None:
    if is_first_process():
        write_status(path, state, **more)


def _write_failure(path: Path, message: str) -> None:
    try:
        _write_status(path, "failed", error=message)
        with (path / "train.log").open("a", encoding="utf-8") as file:
            file.write(traceback.format_exc())
    except OSError:  # probably a full disk; the error itself still goes to the terminal
        log.warning("the status in '%s' could not be written", path)
