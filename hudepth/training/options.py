"""The options of hudepth-train that are not parts to build, checked before anything is prepared or written."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import torch

from hudepth.base.devices import check_devices
from hudepth.base.errors import ConfigError
from hudepth.base.machine import Arithmetic
from hudepth.base.options import Range, parse
from hudepth.data.sources.pairing import printable
from hudepth.training.loggers.kinds import KINDS, Known, check_installed

MEMORY_FORMATS = {"contiguous": torch.contiguous_format, "channels_last": torch.channels_last}


def memory_format(name: str, arithmetic: Arithmetic) -> torch.memory_format:
    """Return the layout of the network; ``auto`` is channels-last where ``fast`` means bfloat16."""
    if name == "auto":
        name = "channels_last" if arithmetic == ("bf16-mixed", True) else "contiguous"
    return MEMORY_FORMATS[name]


_Share = Annotated[int, Range(0)] | Annotated[float, Range(0, 1)] | None
"""A number of batches, or their share."""


@dataclass(frozen=True)
class TrainerOptions:
    """Arguments of ``lightning.Trainer`` with a type of their own; Lightning checks the others."""

    accelerator: str = "auto"
    num_nodes: Annotated[int, Range(1)] = 1
    precision: str = "tf32"
    max_epochs: Annotated[int, Range(-1), "a whole number of at least 1"] | None = None
    max_steps: Annotated[int, Range(-1)] = -1
    max_time: Any = None
    accumulate_grad_batches: Annotated[int, Range(1)] = 1
    gradient_clip_val: Annotated[float, Range(0)] | None = None
    limit_train_batches: _Share = None
    limit_val_batches: _Share = None
    limit_test_batches: _Share = None
    overfit_batches: _Share = None
    deterministic: bool | Literal["warn"] | None = None
    check_val_every_n_epoch: Annotated[int, Range(1)] | None = 1
    log_every_n_steps: Annotated[int, Range(0)] = 50
    fast_dev_run: bool | int = False

    def __post_init__(self) -> None:
        if self.max_epochs == 0 or (self.max_epochs == -1 and self.max_steps < 1 and not self.max_time):
            why = "0 trains nothing" if self.max_epochs == 0 else "-1 trains for ever, unless +trainer.max_steps is set"
            raise ConfigError(f"trainer.max_epochs: {why}. Pass a whole number of at least 1.")
        if self.precision.startswith("64"):
            raise ConfigError(
                f"trainer.precision: {self.precision} is not supported, images have 32 bits. Pass 32-true."
            )
        if self.precision.endswith("16-true"):
            raise ConfigError(
                f"trainer.precision: {self.precision} keeps the weights in 16 bits, which loses updates. "
                "Pass tf32, fast, bf16-mixed, 16-mixed or 32-true."
            )


@dataclass(frozen=True)
class _EarlyStopping:
    patience: Annotated[int, Range(0)] = 3
    min_delta: Annotated[float, Range(0)] = 0.0


@dataclass(frozen=True)
class CallbackOptions:
    """Pictures, early stopping and further callbacks."""

    panels: Annotated[int, Range(0)] = 6
    panels_every_n_epochs: Annotated[int, Range(1)] = 1
    early_stopping: dict[str, Any] | None = None
    extra: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.early_stopping is not None:
            parse(_EarlyStopping, self.early_stopping, prefix="callbacks.early_stopping.")


@dataclass(frozen=True)
class LoggerOptions:
    """Options of each logger in addition to metrics.csv; None: not used."""

    tensorboard: dict[str, Any] | bool | None = None
    """A switch in the configurations of older runs."""
    csv: dict[str, Any] | None = None
    wandb: dict[str, Any] | None = None
    mlflow: dict[str, Any] | None = None
    comet: dict[str, Any] | None = None
    extra: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        for kind, options in self.chosen().items():
            parse(Known, options, prefix=f"logger.{kind}.")
            check_installed(kind)

    def chosen(self) -> dict[str, dict[str, Any]]:
        """Return the options of each kind of logger that is used."""
        found = {kind: getattr(self, kind) for kind in KINDS}
        return {kind: {} if x is True else x for kind, x in found.items() if x is not None and x is not False}


@dataclass(frozen=True)
class TrainOptions:
    """Options of a training. Those with a default are missing from the configurations of some old runs."""

    name: str
    seed: Annotated[int, Range(0, 2**32 - 1)]
    monitor: str
    mode: Literal["min", "max"]
    trainer: TrainerOptions
    callbacks: CallbackOptions
    logger: LoggerOptions
    test: bool
    trust: list[str]
    baselines: bool = True
    init: str | None = None
    init_skip: list[str] | None = None
    memory_format: Literal["auto", "contiguous", "channels_last"] = "auto"
    cuda_graph: bool = True
    compile: bool = False
    variant: str | None = None
    sweep_dir: str | None = None
    paths: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w.-]+(/[\w.-]+)*", self.name) or ".." in self.name.split("/"):
            raise ConfigError(f"name: '{self.name}' cannot name a folder. Use letters, digits, '.', '_' and '-'.")
        if self.init_skip and not self.init:
            raise ConfigError("init_skip: there is no init= of which parts could be left out. Pass init=<run>.")


def parse_options(config: Mapping[str, Any]) -> TrainOptions:
    """Check the options of a configuration; raise ConfigError for wrong types or ranges, and for missing devices."""
    _check_text("", config)
    options = parse(TrainOptions, config)
    if options.compile and config["model"].get("recompute"):
        raise ConfigError("compile: torch.compile does not support model.recompute. Set one of them to false.")
    check_devices(config["trainer"])
    return options


def _check_text(key: str, value: Any) -> None:
    """Refuse a path that is not UTF-8: a run's config.yaml could not hold it, so the run could not resume."""
    if isinstance(value, Mapping):
        for name, each in value.items():
            _check_text(f"{key}.{name}".lstrip("."), each)
    elif isinstance(value, str) and printable(value) != value:
        raise ConfigError(f"{key}: '{printable(value)}' is not UTF-8. Pass a link to it with a name that is.")
