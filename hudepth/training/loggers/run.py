"""The loggers of a run: opened at its start, told what is not logged by Lightning, and closed at its end."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.loggers import CometLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from numpy.typing import NDArray
from PIL import Image

from hudepth.base.console import log
from hudepth.base.devices import is_first_process
from hudepth.base.errors import ConfigError, HudepthError, Pruned, first_line
from hudepth.base.files import read_json, write_json
from hudepth.base.instantiate import instantiate
from hudepth.runs.identity import flat
from hudepth.training.loggers.guard import drop_on_failure, guarded, is_dropped
from hudepth.training.loggers.kinds import KINDS, STORE, Place

FILE = "loggers.json"
"""Holds, in a run directory, by which names the services know the run."""
_NO_PARAMETERS = ("logger", "protocol", "trust", "resume", "debug")
"""Parts of a configuration that say nothing about the training."""
_FIX = {kind: f"Pass logger.{kind}.offline=true to write to the run directory alone." for kind in ("wandb", "comet")}


@contextmanager
def open_loggers(
    chosen: Mapping[str, Mapping[str, Any]], path: Path, config: Mapping[str, Any], *, in_sweep: bool, resumed: bool
) -> Iterator[list[Logger]]:
    """Open loggers for a run, log its hyperparameters, and close them at the end of the block.

    Args:
        chosen: options of each kind of logger, by its name in :data:`hudepth.training.loggers.kinds.KINDS`.
        path: the run directory. In it, loggers.json holds by which names services know the run; it continues there.
        config: the run's configuration.
        in_sweep: whether the run is a job of a sweep.
        resumed: whether the run was begun before.

    Yields:
        The loggers, which cannot fail any more: one that does is dropped with a warning. In processes other than the
        first, only those of ``logger.extra``.

    Raises:
        ConfigError: if one cannot be opened.
    """
    loggers: dict[str, Logger] = {}
    extra = [instantiate(each, trust=config["trust"], only=Logger) for each in config["logger"].get("extra") or []]
    state = "failed"
    try:
        if is_first_process() and chosen:
            known = _known(path)
            place = _place(path, config, in_sweep=in_sweep)
            if "mlflow" in known:  # the run is resumed, perhaps from another folder, or elsewhere than it began
                stores = (each for each in path.parents if (each / STORE).is_file())
                place = replace(place, runs=next(stores, place.runs))
            for kind, options in chosen.items():
                loggers[kind] = _open(kind, dict(options), replace(place, known=known.get(kind)))
            names = {kind: name for kind, each in loggers.items() if (name := _name(each))}
            if names:
                write_json(path / FILE, {**known, **names})
        every = [drop_on_failure(each) for each in (*loggers.values(), *extra)]
        log_parameters(every, config, resumed=resumed)
        yield every
        state = "success"
    except Pruned:
        state = "success"
        raise
    except (KeyboardInterrupt, SystemExit):
        state = "KILLED"  # MLflow's word, which Lightning hands on
        raise
    finally:
        for each in loggers.values():
            _close(each, state)


def _place(path: Path, config: Mapping[str, Any], *, in_sweep: bool) -> Place:
    """Return what all loggers are told about a run."""
    runs = Path(config["paths"]["runs"]).expanduser().resolve()
    if not in_sweep:
        return Place(path, runs, f"{config['name']}/{path.name}")
    folder, sweeps = path.parent, Path(config["paths"].get("sweeps", ".")).expanduser().resolve()
    sweep = folder.relative_to(sweeps).as_posix() if folder.is_relative_to(sweeps) else folder.name
    return Place(path, runs, path.name, sweep)


def _known(path: Path) -> dict[str, str]:
    """Return the names in loggers.json; of a foreign run directory, those that could not be a path."""
    try:
        names = read_json(path / FILE)
    except (OSError, ValueError):
        return {}
    fine = names.items() if isinstance(names, dict) else ()
    return {kind: name for kind, name in fine if isinstance(name, str) and re.fullmatch(r"[\w-]{1,64}", name)}


def _open(kind: str, options: dict[str, Any], place: Place) -> Logger:
    try:
        return KINDS[kind](options, place)
    except HudepthError:
        raise
    except ImportError as error:
        why = f"a package of it is missing ({first_line(error)}). Run pip install 'hudepth[{kind}]'."
        raise ConfigError(f"logger={kind}: {why}") from error
    except Exception as error:  # of libraries, which fail in many ways
        check = f"Check the options below logger.{kind}."
        why, fix = first_line(error).rstrip("."), check if isinstance(error, TypeError) else _FIX.get(kind, check)
        if place.known:
            fix = f"If the run is gone there, delete '{place.path / FILE}' to begin another. {fix}"
        raise ConfigError(f"logger={kind}: it cannot be opened ({why}). {fix}") from None  # it may hold a password


def _name(logger: Logger) -> str | None:
    """Return by which name a service knows the run."""
    if isinstance(logger, WandbLogger | MLFlowLogger | CometLogger):
        return None if logger.version is None else str(logger.version)
    return None


def _close(logger: Logger, state: str) -> None:
    """End what belongs to a run: the next one of this process has its own."""
    if isinstance(logger, WandbLogger):
        try:
            logger.experiment.finish(exit_code=int(state != "success"))
        except Exception as error:  # its server is gone, or too slow
            place = logger.experiment.settings.sync_dir
            log.warning("wandb: not all was uploaded (%s). Run wandb sync %s", first_line(error), place)
        return
    if isinstance(logger, CometLogger):
        guarded(logger, logger.experiment.end)()
    logger.finalize(state)


def log_parameters(loggers: Iterable[Logger], config: Mapping[str, Any], *, resumed: bool) -> None:
    """Log the configuration as hyperparameters, by dotted key: ``optim.lr``.

    Those of a run that is resumed stay as they were where a service cannot change them.
    """
    chosen = {key: value for key, value in config.items() if key not in _NO_PARAMETERS}
    by_key = {key: x if isinstance(x, bool | int | float | str) else json.dumps(x) for key, x in flat(chosen).items()}
    for logger in loggers:
        if isinstance(logger, WandbLogger):  # which shows nested ones by dotted key
            logger.log_hyperparams(chosen)
        elif not (resumed and isinstance(logger, MLFlowLogger | TensorBoardLogger)):
            logger.log_hyperparams(by_key)
            if isinstance(logger, TensorBoardLogger):
                guarded(logger, _add_parameters)(logger, by_key, str(config["monitor"]))


def _add_parameters(logger: TensorBoardLogger, parameters: dict[str, Any], metric: str) -> None:
    """Fill TensorBoard's table of hyperparameters; Lightning's own way adds a point to the curve of the metric."""
    from torch.utils.tensorboard.summary import hparams

    for each in hparams(parameters, {metric: 0.0}):  # type: ignore[no-untyped-call]
        logger.experiment._get_file_writer().add_summary(each)


def log_picture(loggers: Iterable[Logger], name: str, picture: NDArray[np.uint8], step: int) -> None:
    """Log an RGB picture (height, width, 3) to each logger that takes pictures."""
    for logger in loggers:
        if not is_dropped(logger):
            guarded(logger, _add_picture)(logger, name, picture, step)


def _add_picture(logger: Logger, name: str, picture: NDArray[np.uint8], step: int) -> None:
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_image(name, picture, step, dataformats="HWC")
    elif isinstance(logger, WandbLogger):
        logger.log_image(name, [picture], step)
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_image(logger.run_id, picture, key=name, step=step)
    elif isinstance(logger, CometLogger):
        logger.experiment.log_image(Image.fromarray(picture), name=name, step=step)


def log_tests(loggers: Iterable[Logger], results: Mapping[str, Mapping[str, float]], step: int) -> None:
    """Log test metrics, by protocol and name, as ``test/<protocol>/<metric>``."""
    values = {f"test/{protocol}/{name}": x for protocol, row in results.items() for name, x in row.items()}
    for logger in loggers:
        logger.log_metrics({name: value for name, value in values.items() if math.isfinite(value)}, step)
        logger.save()
