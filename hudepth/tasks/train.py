"""hudepth-train: from a configuration to a run directory with a trained, tested model."""

from __future__ import annotations

import logging
import os
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch import seed_everything
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from hudepth import run_dir
from hudepth.checkpoint import load_checkpoint
from hudepth.console import log
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.splits import load_split, save_split
from hudepth.errors import ConfigError, HudepthError, Pruned
from hudepth.instantiate import instantiate
from hudepth.machine import keep_freed_memory
from hudepth.module import DepthModule
from hudepth.schedules import StepSchedule
from hudepth.tasks.checks import MEMORY_FORMATS, check_config, check_input, check_monitor
from hudepth.tasks.common import build_data, build_protocols, is_given, without_known_warnings
from hudepth.tasks.config import plain
from hudepth.tasks.devices import check_shares
from hudepth.tasks.launched import shared_path
from hudepth.tasks.lineage import BEFORE, lineage, refuse_training_pairs
from hudepth.tasks.resume import resumed_config
from hudepth.tasks.score import score_checkpoint
from hudepth.tasks.trainer import build_callbacks, build_run_trainer

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
        resumed = [] if (path / run_dir.CHECKPOINTS / run_dir.LAST).is_file() else None  # a job of a sweep that goes on
    if not _first_process():
        log.setLevel(logging.WARNING)
    with _held(path), _shared_with_children(path), run_dir.logged_to(path / "train.log"):
        if resumed is None and _first_process():
            environment = run_dir.environment(seed=config["seed"], accelerator=str(config["trainer"]["accelerator"]))
            run_dir.write_start(path, config=config, overrides=overrides, environment=environment)
        return _run(config, path, resumed=resumed)


@contextmanager
def _held(path: Path) -> Iterator[None]:
    """Keep other processes from the run directory, but for those of the same distributed run."""
    if not _first_process():
        yield
        return
    with run_dir.held(path, timeout_s=HELD_S):
        yield


@contextmanager
def _shared_with_children(path: Path) -> Iterator[None]:
    os.environ[RUN_ENV] = str(path)
    try:
        yield
    finally:
        os.environ.pop(RUN_ENV, None)


def _first_process() -> bool:
    """Tell whether this process writes to the run directory: of a distributed run only the first does."""
    return bool(getattr(rank_zero_only, "rank", 0) == 0)


def _status(path: Path, state: str, **more: Any) -> None:
    if _first_process():
        run_dir.write_status(path, state, **more)


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
        best = _fit(config, path, resumed=resumed)
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


def _fit(config: dict[str, Any], path: Path, *, resumed: list[str] | None) -> float | None:
    log.info("run directory: %s", path)
    seed_everything(config["seed"], verbose=False)
    keep_freed_memory()
    trust = list(config["trust"])
    distill = config.get("distill") or {}
    options = {**config["data"], **({"teacher": distill["teacher"]} if is_given(distill) else {})}
    datamodule = build_data(options, trust=trust, augment=config.get("augment"))
    if datamodule.source.name == "rooms":
        log.info("data: built-in rooms (the default). For real depth pass data=nyu_labeled data.root=<folder>.")
    if config["test"]:  # a wrong protocol should not be found after hours
        build_protocols(config["protocol"], datamodule=datamodule, trust=trust)
    net = instantiate(config["model"], trust=trust, only=nn.Module)
    net.to(memory_format=MEMORY_FORMATS[config.get("memory_format", "contiguous")])
    check_input(net, datamodule.sizes)
    split_file = path / "split.json"
    if resumed is not None and split_file.exists():
        datamodule.split = load_split(split_file, datamodule.store.records)
    elif _first_process():
        save_split(split_file, datamodule.split, datamodule.store.records)
    before = _seen_before(config, path, net, datamodule, resumed=resumed is not None)
    if config.get("compile"):
        net.compile()  # in place: names of parameters, and so checkpoints, stay as they are
    module = build_module(config, net, datamodule, trust=trust, before=before)
    check_monitor(config["monitor"], module)
    callbacks = build_callbacks(config, path, datamodule)
    with without_known_warnings():
        trainer = build_run_trainer(config, path, callbacks, alone=_sweeping())
    check_shares(trainer, subset="validation", pairs=len(datamodule.split.val))
    log.info(
        "%s: %s parameters; %s, split %s: %d train, %d val, %d test; batch %d%s, %s, %d threads",
        type(module.net).__name__, f"{sum(p.numel() for p in module.net.parameters()):,}", datamodule.source.name,
        datamodule.split.kind, len(datamodule.split.train), len(datamodule.split.val), len(datamodule.split.test),
        datamodule.batch_size, f" in each of {trainer.world_size} processes" if trainer.world_size > 1 else "",
        type(trainer.accelerator).__name__.removesuffix("Accelerator"),
        torch.get_num_threads(),
    )  # fmt: skip
    last = None
    if resumed is not None:
        last = path / run_dir.CHECKPOINTS / run_dir.LAST
        if _first_process():
            run_dir.write_resumed(path, config=config, overrides=resumed)
    with without_known_warnings():
        trainer.fit(module, datamodule=datamodule, ckpt_path=last, weights_only=True)
    best = next(c for c in callbacks if getattr(c, "monitor", None) and hasattr(c, "best_model_score"))
    score = best.best_model_score
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()  # one process tests: it should wait for no other
    if config["test"] and trainer.is_global_zero:
        checkpoint = load_checkpoint(str(path))
        options = {"accelerator": config["trainer"]["accelerator"]}  # one device and full precision, as hudepth-test
        score_checkpoint(checkpoint, config={**config, "trainer": options}, output=path / "test", datamodule=datamodule)
    return None if score is None else float(score)


def _seen_before(
    config: Mapping[str, Any], path: Path, net: nn.Module, datamodule: DepthDataModule, *, resumed: bool
) -> list[dict[str, Any]]:
    """Return what the weights that a run starts from were trained on, and put them into ``net`` if it is a new run."""
    if not resumed:
        return start_from(net, config, datamodule) if config.get("init") else []
    if epochs := sorted({look["epoch"] for look in run_dir.scored(path)}):
        log.warning(
            "the test images of this run were looked at after epoch %s: if that is why it goes on, its next test "
            "flatters it. metrics.json will say so (scored_before)",
            ", ".join(map(str, epochs)),
        )
    before: list[dict[str, Any]] = load_checkpoint(str(path / run_dir.CHECKPOINTS / run_dir.LAST)).data.get(BEFORE, [])
    return before


def start_from(net: nn.Module, config: Mapping[str, Any], datamodule: DepthDataModule) -> list[dict[str, Any]]:
    """Give a network the weights of a checkpoint to begin with.

    Args:
        net: to be filled.
        config: with ``init``, a run, a checkpoint or a bundle as for ``checkpoint=`` of the other verbs, and ``paths``.
        datamodule: of the training to come.

    Returns:
        What these weights were trained on: the checkpoints to come say so, too.

    Raises:
        CheckpointError: if there is no such checkpoint, or it is of another network.
        DataError: if it was trained on pairs that are to judge the network now.
    """
    checkpoint = load_checkpoint(str(config["init"]), runs=config["paths"]["runs"])
    refuse_training_pairs(checkpoint, datamodule, subsets=("val", "test"))
    checkpoint.fill(net)
    log.info("init: weights of '%s', epoch %d", checkpoint.path, checkpoint.epoch)
    trained = checkpoint.config.get("data")
    before_m = trained.get("max_depth_m") if isinstance(trained, dict) else None
    if before_m != datamodule.max_depth_m:
        log.warning(
            "init: these weights answer in shares of %s m, this training in shares of %s m, so all depths are learned "
            "anew. Pass data.max_depth_m=%s to keep them.",
            before_m, datamodule.max_depth_m, before_m,
        )  # fmt: skip
    return lineage(checkpoint)


def build_module(
    config: dict[str, Any],
    net: nn.Module,
    datamodule: DepthDataModule,
    *,
    trust: list[str],
    before: list[dict[str, Any]] | None = None,
) -> DepthModule:
    """Build loss, optimiser and schedule of a configuration around a network.

    Args:
        config: of the run.
        net: to be trained.
        datamodule: its data.
        trust: further modules whose classes may be named.
        before: what the weights it starts from were trained on.

    Raises:
        HudepthError: if a part cannot be built.
    """
    distill = {key: value for key, value in (config.get("distill") or {}).items() if key != "teacher"}

    def schedule(optimizer: Optimizer, total_steps: int) -> LRScheduler:
        knows_length = str(config["schedule"]["_target_"]).startswith(f"{StepSchedule.__module__}.")
        extra = {"total_steps": total_steps} if knows_length else {}
        built: LRScheduler = instantiate(config["schedule"], optimizer, trust=trust, only=LRScheduler, **extra)
        return built

    return DepthModule(
        net,
        instantiate(config["loss"], trust=trust, only=nn.Module),
        max_depth_m=datamodule.max_depth_m,
        optimizer=partial(instantiate, config["optim"], trust=trust, only=Optimizer),
        distill=instantiate(distill, trust=trust, only=nn.Module) if is_given(distill) else None,
        scheduler=schedule if is_given(config["schedule"]) else None,
        record={
            "config": config,
            "split": datamodule.split.summary(),
            "data": {
                **{
                    key: datamodule.store.info[key]
                    for key in ("source", "fingerprint", "encoding", "pairs", "native_sizes")
                },
                **({BEFORE: before} if before else {}),
            },
        },
    )
