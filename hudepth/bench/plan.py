"""The options of hudepth-bench."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from hudepth.base.errors import ConfigError
from hudepth.base.machine import torch_device, usable_cores
from hudepth.base.options import Choice, Range, Size, parse
from hudepth.bench.backends import BACKENDS, ON_CPU, ON_GPU, REFERENCE

SETTINGS = ("backends", "batches", "repeats", "seconds", "longest_pass", "threads", "device")
"""The options that bench.json states."""


@dataclass
class Plan:
    """What to measure, and how; conf/bench.yaml explains each option."""

    output: Path
    batches: list[Annotated[int, Range(1)]]
    """Rising."""
    backends: list[Annotated[str, Choice(tuple(BACKENDS))]] | None = None
    """In the order of the table, :data:`hudepth.bench.backends.REFERENCE` among them; None: those of the device."""
    checkpoint: str | None = None
    model: dict[str, Any] | None = None
    size: Size | None = None
    repeats: Annotated[int, Range(1)] = 5
    seconds: Annotated[float, Range(0)] = 1.0
    longest_pass: Annotated[float, Range(0, above=True)] = 10.0
    threads: Annotated[int, Range(1)] | None = None
    device: Annotated[str, Choice(("auto", "cpu", "cuda"))] = "auto"
    trust: list[str] | None = None

    def __post_init__(self) -> None:
        if (self.checkpoint is None) == (self.model is None):
            found = "neither is set" if self.model is None else "both are set"
            raise ConfigError(
                f"checkpoint, model: {found}. Pass checkpoint=<file | run directory | last> or model=<name>."
            )
        if not self.batches:
            raise ConfigError("batches: the list is empty. Pass batches=[1,4].")
        self.device = torch_device(self.device, among=("cuda", "cpu")).type
        wanted = self.backends if self.backends is not None else ON_GPU if self.device == "cuda" else ON_CPU
        self.backends = [name for name in BACKENDS if name == REFERENCE or name in wanted]
        self.batches, self.threads = sorted(set(self.batches)), self.threads or usable_cores()


def make_plan(config: dict[str, Any]) -> Plan:
    """Check every option; raises ConfigError if one is wrong."""
    return parse(Plan, config)
