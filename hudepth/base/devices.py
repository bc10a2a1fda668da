"""The Trainer of a training or a test, on devices that exist, in no more processes than there are pairs."""

from __future__ import annotations

import inspect
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, Literal

from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.accelerators import AcceleratorRegistry, CUDAAccelerator, MPSAccelerator
from lightning.pytorch.callbacks import RichProgressBar
from lightning.pytorch.strategies import StrategyRegistry
from lightning.pytorch.utilities import rank_zero_only

from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.base.machine import resolve_precision
from hudepth.base.options import Choice, Range, convert

GPUS = {
    "gpu": (CUDAAccelerator, MPSAccelerator),
    "cuda": (CUDAAccelerator,),
    "mps": (MPSAccelerator,),
}
"""Accelerators that a machine may lack, and their implementations."""


_STRATEGIES = ("auto", *StrategyRegistry.available_strategies())
_PRECISIONS = (
    "tf32", "fast", "32-true", "bf16-mixed", "16-mixed", "bf16-true", "16-true", "64-true", "transformer-engine",
    "transformer-engine-float16",
)  # fmt: skip
_SHORT = ("16", "32", "64", "bf16")
"""Names that Lightning takes for 16-mixed, and so on."""
_KINDS = {
    "accelerator": Annotated[str, Choice(("auto", "gpu", *sorted(AcceleratorRegistry.available_accelerators())))],
    "devices": Annotated[int, Range(1)] | Literal["auto", -1],
    "strategy": Annotated[str, Choice(_STRATEGIES), "a strategy, as auto or ddp"],
    "precision": Annotated[str, Choice(_PRECISIONS), "a precision, as tf32, fast, 32-true, bf16-mixed or 16-mixed"],
}
"""Types of arguments of Lightning's Trainer."""
_SET_HERE = {"logger", "callbacks", "plugins", "default_root_dir", "use_distributed_sampler"}


class ProgressBar(RichProgressBar):
    """Lightning's progress bar on standard error, with the epochs of the log."""

    def __init__(self) -> None:
        super().__init__(console_kwargs={"stderr": True})

    def _get_train_description(self, current_epoch: int) -> str:
        return spell_epoch(self.trainer).ljust(len(self.validation_description))

    def get_metrics(
        self, trainer: Trainer, pl_module: LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """Return what to show behind the bar: nothing of loggers, whose name of the run would come first."""
        return {name: value for name, value in super().get_metrics(trainer, pl_module).items() if name != "v_num"}


def spell_epoch(trainer: Trainer) -> str:
    """Return ``epoch 3 of 30``, the one that runs or has just ended; without ``of`` if there is no last one."""
    last = trainer.max_epochs
    return f"epoch {trainer.current_epoch + 1}" + (f" of {last}" if last is not None and last > 0 else "")


def check_devices(options: Mapping[str, Any]) -> None:
    """Check that the requested devices exist, before anything is prepared or written.

    Args:
        options: the ``trainer`` part of a configuration.

    Raises:
        ConfigError: for names that do not exist, a GPU where there is none, or synchronised batch norm without one.
    """
    if unknown := [key for key in options if key not in inspect.signature(Trainer).parameters]:
        hint = did_you_mean(unknown[0], inspect.signature(Trainer).parameters)
        raise ConfigError(f"trainer.{unknown[0]}: lightning.Trainer has no such argument.{hint or ' Leave it out.'}")
    for key, kind in _KINDS.items():
        value = options.get(key)
        if not (isinstance(value, list | None) or (key == "precision" and str(value) in _SHORT)):
            convert(f"trainer.{key}", value, kind)
    if taken := sorted(_SET_HERE & options.keys()):
        raise ConfigError(f"trainer.{taken[0]} is set by hudepth. See logger= and callbacks= for your own.")
    accelerator = str(options.get("accelerator", "auto"))
    if accelerator in GPUS and not any(kind.is_available() for kind in GPUS[accelerator]):
        several = str(options.get("devices", 1)) != "1"
        fix = "trainer.accelerator=cpu" + (" trainer.devices=2, or as many as there are cores" if several else "")
        raise ConfigError(f"trainer.accelerator={accelerator}: no GPU here. Pass {fix}.")
    on_cpu = accelerator == "cpu" or (accelerator == "auto" and not any(kind.is_available() for kind in GPUS["gpu"]))
    if options.get("sync_batchnorm") and on_cpu:
        raise ConfigError(
            "trainer.sync_batchnorm: PyTorch supports it on GPUs only. Pass trainer.sync_batchnorm=false; then each "
            "process normalises by its own share of a batch."
        )


def build_trainer(options: Mapping[str, Any], **fixed: Any) -> Trainer:
    """Build a Trainer.

    Args:
        options: the ``trainer`` part of a configuration.
        **fixed: arguments that are not configurable.

    Raises:
        ConfigError: if a device is missing, or Lightning refuses an option.
    """
    check_devices(options)
    try:
        asked, accelerator = (str(options.get(key, "auto")) for key in ("precision", "accelerator"))
        known = {"precision": resolve_precision(asked, accelerator).precision} if "precision" in options else {}
        return Trainer(**{**options, **known}, **fixed)
    except (TypeError, ValueError, MisconfigurationException) as error:
        raise ConfigError(f"trainer: {error}") from error


def check_shares(trainer: Trainer, *, subset: str, pairs: int) -> None:
    """Check that every process has a pair to score: the others would wait for one without.

    Args:
        trainer: with the number of processes.
        subset: ``validation`` or ``test``.
        pairs: in the subset.

    Raises:
        ConfigError: if there are fewer pairs than processes.
    """
    if pairs < trainer.world_size:
        raise ConfigError(
            f"trainer.devices: the {subset} subset has {pairs} pair{'s' * (pairs != 1)} for {trainer.world_size} "
            f"processes, each of which needs one. Pass trainer.devices={pairs}."
        )


@contextmanager
def without_known_warnings() -> Iterator[None]:
    """Hide warnings of libraries that no user can act on."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*does not have many workers.*")  # reading a store needs none
        warnings.filterwarnings("ignore", ".*exists and is not empty.*")  # the run directory, by design
        warnings.filterwarnings("ignore", ".*smaller than the logging interval.*")  # epochs are logged, too
        warnings.filterwarnings("ignore", ".*LeafSpec.*")  # between Lightning and torch
        warnings.filterwarnings("ignore", ".*in eval mode at the start.*")  # model.encoder_norm=frozen, by design
        for name in ("lightning.pytorch", "lightning.fabric"):
            logging.getLogger(name).setLevel(logging.WARNING)  # their greetings
        yield


def is_first_process() -> bool:
    """Return whether this process writes to the run directory: only the first of a distributed run does."""
    return bool(getattr(rank_zero_only, "rank", 0) == 0)
