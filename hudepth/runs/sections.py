"""The parts of a run's configuration, and what its last checkpoint holds: checked once, where they are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.options import Range, TrainSize, parse

Part = Mapping[str, Any]


@dataclass(frozen=True)
class _Data:
    size: TrainSize | None = None
    max_depth_m: Annotated[float, Range(0, above=True)] | None = None
    source: Part = field(default_factory=dict)


@dataclass(frozen=True)
class _Extras:
    extra: list[Part] | None = None


@dataclass(frozen=True)
class _Config:
    """What every configuration has; the parts themselves are checked by what is built from them."""

    model: Part
    data: _Data | None = None
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    loss: Part = field(default_factory=dict)
    optim: Part = field(default_factory=dict)
    schedule: Part | None = None
    trainer: Part = field(default_factory=dict)
    callbacks: _Extras = field(default_factory=_Extras)
    logger: _Extras = field(default_factory=_Extras)
    protocol: Part | None = None
    augment: Part | None = None
    distill: Part | None = None
    auxiliary: Part | None = None
    paths: Part = field(default_factory=dict)
    monitor: str = ""
    name: str | None = None


@dataclass(frozen=True)
class _Resumable:
    """The entries of a checkpoint that resuming needs."""

    epoch: Annotated[int, Range(0)]
    global_step: Annotated[int, Range(0)]
    state_dict: Part
    loops: Part
    callbacks: Part
    optimizer_states: list[Part]
    lr_schedulers: list[Part]


def check_config(config: Mapping[str, Any], *, where: Path) -> None:
    """Raise CheckpointError, with ``where`` and the key, if a part of a configuration is of another type."""
    _check(_Config, config, f"'{where}' is damaged: its configuration's ")


def check_resumable(content: Mapping[str, Any], *, where: Path) -> None:
    """Raise CheckpointError if a checkpoint lacks what resuming needs, or counts steps by other things than numbers."""
    _check(_Resumable, content, f"'{where}' cannot be resumed from: its ")
    if damaged := _odd(content["loops"], "loops"):
        raise CheckpointError(
            f"'{where}' cannot be resumed from: its {damaged} is no count. Train again without resume=."
        )


def _check(schema: type, values: Mapping[str, Any], before: str) -> None:
    try:
        parse(schema, values)
    except ConfigError as error:
        what = str(error).partition(". ")[0].partition(" Pass ")[0].rstrip(".")
        raise CheckpointError(f"{before}{what}. Restore the file, or train again.") from error


def _odd(value: Any, name: str) -> str:
    """Return the name of the first leaf that is neither a count nor a flag; Lightning's loops hold nothing else."""
    if isinstance(value, Mapping):
        return next((found for key, each in value.items() if (found := _odd(each, f"{name}.{key}"))), "")
    if isinstance(value, list):
        return next((found for each in value if (found := _odd(each, name))), "")
    return "" if value is None or (isinstance(value, int) and 0 <= value < 2**53) else name
