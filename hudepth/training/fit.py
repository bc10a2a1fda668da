"""From a configuration to a trained, tested network inside a run directory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import seed_everything
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from hudepth.base.console import log
from hudepth.base.devices import check_shares, is_first_process, without_known_warnings
from hudepth.base.instantiate import instantiate
from hudepth.base.machine import keep_freed_memory
from hudepth.data.build import build_data, is_given
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.splits import load_split, save_split
from hudepth.evaluation.lineage import BEFORE, lineage, refuse_training_pairs
from hudepth.evaluation.protocols import build_protocols
from hudepth.evaluation.score import score_checkpoint
from hudepth.models.encoder import find_encoder
from hudepth.runs import run_dir
from hudepth.runs.checkpoint import load_checkpoint
from hudepth.runs.run import CHECKPOINTS, LAST
from hudepth.training.checks import MEMORY_FORMATS, check_input, check_monitor
from hudepth.training.module import DepthModule
from hudepth.training.optim import GroupedAdamW
from hudepth.training.schedules import StepSchedule
from hudepth.training.trainer import build_callbacks, build_run_trainer


def fit(config: dict[str, Any], path: Path, *, resumed: list[str] | None, alone: bool) -> float | None:
    """Train and test inside a run directory."""
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
    elif is_first_process():
        save_split(split_file, datamodule.split, datamodule.store.records)
    before = _seen_before(config, path, net, datamodule, resumed=resumed is not None)
    if config.get("compile"):
        net.compile()  # in place: names of parameters, and so checkpoints, stay as they are
    module = build_module(config, net, datamodule, trust=trust, before=before)
    check_monitor(config["monitor"], module)
    callbacks = build_callbacks(config, path, datamodule)
    with without_known_warnings():
        trainer = build_run_trainer(config, path, callbacks, alone=alone)
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
        last = path / CHECKPOINTS / LAST
        if is_first_process():
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
    if epochs := sorted({look["epoch"] for look in run_dir.read_scored(path)}):
        log.warning(
            "the test images of this run were looked at after epoch %s: if that is why it goes on, its next test "
            "flatters it. metrics.json will say so (scored_before)",
            ", ".join(map(str, epochs)),
        )
    before: list[dict[str, Any]] = load_checkpoint(str(path / CHECKPOINTS / LAST)).data.get(BEFORE, [])
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

    def optimizer(parameters: Iterable[tuple[str, nn.Parameter]]) -> Optimizer:
        grouped = str(config["optim"]["_target_"]).startswith(f"{GroupedAdamW.__module__}.")
        extra = {"encoder": find_encoder(net)} if grouped else {}
        built: Optimizer = instantiate(config["optim"], parameters, trust=trust, only=Optimizer, **extra)
        return built

    def schedule(optimizer: Optimizer, total_steps: int) -> LRScheduler:
        knows_length = str(config["schedule"]["_target_"]).startswith(f"{StepSchedule.__module__}.")
        extra = {"total_steps": total_steps} if knows_length else {}
        built: LRScheduler = instantiate(config["schedule"], optimizer, trust=trust, only=LRScheduler, **extra)
        return built

    return DepthModule(
        net,
        instantiate(config["loss"], trust=trust, only=nn.Module),
        max_depth_m=datamodule.max_depth_m,
        optimizer=optimizer,
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
