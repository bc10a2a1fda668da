"""One training inside its run directory, step by step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.loggers import Logger
from torch import nn
from torch.optim import Optimizer

from hudepth.base.camera import CameraChoice
from hudepth.base.console import log, typed
from hudepth.base.devices import check_shares, is_first_process, without_known_warnings
from hudepth.base.errors import CheckpointError, ConfigError, first_line
from hudepth.base.instantiate import has_target, import_trusted, instantiate
from hudepth.base.machine import float32_products, keep_freed_memory, resolve_precision, uses_cuda
from hudepth.base.options import parse
from hudepth.data.build import build_data
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.dataset import PicturedDataset
from hudepth.data.splits import load_split, save_split
from hudepth.evaluation.lineage import BEFORE
from hudepth.evaluation.protocols import build_protocols
from hudepth.evaluation.results_table import Metrics
from hudepth.evaluation.score import ScoreOptions, score_checkpoint
from hudepth.models.build import build_network
from hudepth.models.encoder import find_encoder
from hudepth.runs import run_dir
from hudepth.runs.checkpoint import load_checkpoint, read_plain
from hudepth.runs.results import MODEL
from hudepth.runs.run import best_checkpoint
from hudepth.training.initial import Parents, Training, network_before, restore_parents
from hudepth.training.loggers.run import log_tests, open_loggers
from hudepth.training.module import DepthModule
from hudepth.training.options import memory_format
from hudepth.training.parts import build_auxiliary, build_distillation, build_optimizer, build_schedule
from hudepth.training.trainer import build_callbacks, build_run_trainer, one_ending


def fit(training: Training) -> float | None:
    """Train, test the best checkpoint, and return the best value of the monitored metric."""
    log.info("run directory: %s", training.path)
    chosen = {} if training.options.trainer.fast_dev_run else training.options.logger.chosen()
    resumed = training.overrides is not None
    # Before anything is prepared, which may take hours, and before random numbers are drawn.
    with open_loggers(chosen, training.path, training.config, in_sweep=training.alone, resumed=resumed) as loggers:
        return _fit(training, loggers)


def _fit(training: Training, loggers: list[Logger]) -> float | None:
    config, options, path = training.config, training.options, training.path
    seed_everything(options.seed, verbose=False)
    keep_freed_memory()
    import_trusted(options.trust)
    data = build_datamodule(training)
    net = build_network(config["model"], trust=options.trust)
    arithmetic = resolve_precision(options.trainer.precision, options.trainer.accelerator)
    if uses_cuda(options.trainer.accelerator):
        torch.set_num_threads(1)  # more of them delay the one that launches the GPU's work
    net.to(memory_format=memory_format(options.memory_format, arithmetic))  # type: ignore[call-overload]
    check_input(net, data.sizes)
    restore_split(training, data)
    parents = restore_parents(training, net, data)
    if options.compile:
        net.compile()  # in place: names of parameters, and so checkpoints, stay as they are
    module = build_module(config, net, data, trust=options.trust, before=parents)
    callbacks = build_callbacks(config, path, data)
    with without_known_warnings():
        trainer = build_run_trainer(config, path, callbacks, loggers, alone=training.alone)
    check_shares(trainer, subset="validation", pairs=len(data.split.val))
    log_start(trainer, module, data)
    with float32_products(tf32=arithmetic.tf32):
        run_epochs(training, trainer, module, data)
    if options.test and trainer.fast_dev_run:  # type: ignore[attr-defined]  # set by Lightning's connector
        log.info("trainer.fast_dev_run: no checkpoint was written, so nothing is tested")
    elif options.test and trainer.is_global_zero:
        results = test_best(training, data)
        log_tests(loggers, {name: metrics[MODEL] for name, metrics in results.items()}, trainer.global_step)
    best = next(c for c in callbacks if getattr(c, "monitor", None) and hasattr(c, "best_model_score"))
    value = None if best.best_model_score is None else float(best.best_model_score)
    if trainer.is_global_zero and best_checkpoint(path):
        log_end(training, value, epochs=trainer.current_epoch)
    return value


def test_best(training: Training, data: DepthDataModule) -> dict[str, Metrics]:
    """Test the best checkpoint as hudepth-test does, on one device and in full precision; return its results."""
    config, path = training.config, training.path
    tested = {**config, "trainer": {"accelerator": config["trainer"]["accelerator"]}}
    checkpoint = load_checkpoint(str(path))
    before = network_before(training, size=data.size, max_depth_m=data.max_depth_m)
    options = parse(ScoreOptions, tested)
    return score_checkpoint(checkpoint, options, output=path / "test", datamodule=data, before=before)


def build_datamodule(training: Training) -> DepthDataModule:
    """Prepare the data, and check the protocols of the final test while nothing is lost yet."""
    config, trust = training.config, training.options.trust
    distill = config.get("distill") or {}
    teacher = {key: distill.get(key) for key in ("teacher", "pictures")} if has_target(distill) else {}
    data = build_data({**config["data"], **teacher}, trust=trust, augment=config.get("augment"))
    if data.source.name == "rooms":
        real = "hudepth-data download data=nyu_labeled_mat data.root=nyu"
        log.info("data: built-in rooms (the default). For real depth: %s", real)
    if training.options.test:
        build_protocols(config["protocol"], datamodule=data, trust=trust)
    return data


@torch.inference_mode()
def check_input(net: nn.Module, sizes: list[tuple[int, int]]) -> None:
    """Pass an image of each (height, width) [pixels] through the network, which raises if it does not take it."""
    net.eval()
    for number, size in enumerate(sizes):
        try:
            net(torch.zeros(1, 3, *size))
        except ConfigError as error:
            key = "data.size" if size == sizes[-1] else f"data.progressive[{number}].size"
            raise ConfigError(str(error).replace("data.size", key)) from error
    net.train()


def restore_split(training: Training, data: DepthDataModule) -> None:
    """Use the split of a run that is resumed; write that of a new run."""
    file = training.path / "split.json"
    if training.overrides is not None and file.exists():
        data.split = load_split(file, data.store.records)
    elif is_first_process():
        save_split(file, data.split, data.store.records)


def build_module(
    config: Mapping[str, Any],
    net: nn.Module,
    datamodule: DepthDataModule,
    *,
    trust: list[str],
    before: Parents | None = None,
) -> DepthModule:
    """Build loss, optimiser and schedule of a configuration around a network.

    ``trust`` lists further modules whose classes a ``_target_`` may name; ``before`` is what the initial weights were
    trained on. Raises ConfigError if a part cannot be built.
    """

    def optimizer(parameters: Iterable[tuple[str, nn.Parameter]]) -> Any:
        return build_optimizer(config, parameters, encoder=find_encoder(net), trust=trust)

    def schedule(optimizer: Optimizer, total_steps: int) -> Any:
        return build_schedule(config, optimizer, total_steps=total_steps, trust=trust)

    info = datamodule.store.info
    data = {key: info[key] for key in ("source", "fingerprint", "encoding", "pairs", "native_sizes")}
    if isinstance(pairs := datamodule.training_pairs, PicturedDataset):
        data["pictures"] = len(pairs.pictures)
    if datamodule.source.camera is not None:
        choice = CameraChoice.of(datamodule.source.camera, key="data.source.camera")
        data["focal"] = list(choice.over_sides(info["native_sizes"], key="data.source.camera"))
    if before:
        data[BEFORE] = before
    return DepthModule(
        net,
        instantiate(config["loss"], trust=trust, only=nn.Module),
        max_depth_m=datamodule.max_depth_m,
        optimizer=optimizer,
        distill=build_distillation(config, trust=trust),
        auxiliary=build_auxiliary(config, trust=trust),
        scheduler=schedule if has_target(config["schedule"]) else None,
        record={"config": dict(config), "split": datamodule.split.summary(), "data": data},
        cuda_graph=bool(config.get("cuda_graph", True)),
    )


def log_start(trainer: Trainer, module: DepthModule, data: DepthDataModule) -> None:
    """Log what is trained on what."""
    split, world = data.split, trainer.world_size
    log.info(
        "%s: %s parameters; %s, split %s: %d train, %d val, %d test; batch %d%s, %s, %d threads",
        type(module.net).__name__, f"{sum(p.numel() for p in module.net.parameters()):,}", data.source.name,
        split.kind, len(data.training_pairs), len(split.val), len(split.test),
        data.batch_size, f" in each of {world} processes" if world > 1 else "",
        type(trainer.accelerator).__name__.removesuffix("Accelerator"), torch.get_num_threads(),
    )  # fmt: skip


def log_end(training: Training, best: float | None, *, epochs: int) -> None:
    """Log which epoch was best, with its value of the monitored metric, where it is, and what to do with it."""
    config, options = training.config, training.options
    checkpoint = load_checkpoint(str(training.path))
    value = "" if best is None else f": {options.monitor} {best:.4f}"
    protocols, trust = ",".join(config["protocol"]), [f"trust=[{','.join(options.trust)}]"] * bool(options.trust)
    chosen = [f"protocol=[{protocols}]"] * (protocols != "paper,eigen")
    log.info("best epoch: %d of %d%s", checkpoint.epoch, epochs, value)
    log.info("checkpoint: %s", checkpoint.path)
    log.info(
        "to test it, and to predict the depth of your pictures in a folder photos:\n  %s\n  %s",
        typed("hudepth-test", *chosen, *trust, checkpoint=training.path),
        typed("hudepth-predict", "input=photos", *trust, checkpoint=training.path),
    )  # fmt: skip


def run_epochs(training: Training, trainer: Trainer, module: DepthModule, data: DepthDataModule) -> None:
    """Train, from the last checkpoint if the run is resumed."""
    last = None if training.overrides is None else training.last
    if training.overrides is not None and is_first_process():
        run_dir.write_resumed(training.path, config=training.config, overrides=training.overrides)
    with without_known_warnings():
        try:
            with one_ending(trainer):
                trainer.fit(module, datamodule=data, ckpt_path=last, weights_only=True)
        except torch.OutOfMemoryError:
            raise
        except (AttributeError, IndexError, KeyError, TypeError, ValueError, RuntimeError) as error:
            steps = read_plain(last).get("global_step") if last else None
            if trainer.global_step not in (0, steps) or last is None:
                raise
            why = first_line(error)  # torch and Lightning fail in many ways on foreign states
            raise CheckpointError(
                f"'{last}' does not fit this training ({type(error).__name__}: {why}). Train again without resume=."
            ) from error
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()  # one process tests: it should not wait for the others
