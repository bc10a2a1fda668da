"""What hudepth-bench is to measure, and how: the options, checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from hudepth.base.errors import ConfigError
from hudepth.base.machine import usable_cores
from hudepth.base.options import output_folder, whole_number
from hudepth.bench.backends import check_backends


@dataclass(frozen=True)
class Plan:
    """What is to be measured, and how."""

    backends: list[str]
    batches: list[int]
    peers: bool
    peer_batches: list[int]
    repeats: int
    seconds: float
    longest_pass: float
    threads: int
    device: str
    output: Path


def make_plan(config: dict[str, Any]) -> Plan:
    """Check every option, and that the output folder can be written, before anything is built.

    Args:
        config: of hudepth-bench.

    Raises:
        ConfigError: for values out of range, or an output folder that cannot be made.
    """
    threads = usable_cores() if config["threads"] is None else whole_number(
        config, "threads", default=usable_cores(), least=1
    )  # fmt: skip
    return Plan(
        backends=check_backends(config["backends"]),
        batches=_batches(config["batches"]),
        peers=bool(config["peers"]),
        peer_batches=_peer_batches(config),
        repeats=whole_number(config, "repeats", default=5, least=1),
        seconds=_seconds(config, "seconds", default=1, zero=True),
        longest_pass=_seconds(config, "longest_pass", default=10, zero=False),
        threads=threads,
        device=_device(str(config["device"])),
        output=output_folder(config["output"]),
    )


def _batches(value: Any, *, key: str = "batches") -> list[int]:
    batches = value if isinstance(value, list) else [value]
    if not batches or not all(type(batch) is int and batch > 0 for batch in batches):
        raise ConfigError(f"{key}: {value} is no list of positive whole numbers. Pass {key}=[1,4].")
    return sorted(set(batches))


def _peer_batches(config: dict[str, Any]) -> list[int]:
    batches, wanted = _batches(config["batches"]), _batches(config["peer_batches"], key="peer_batches")
    chosen = [batch for batch in wanted if batch in batches]
    if config["peers"] and not chosen:
        raise ConfigError(
            f"peer_batches: none of {wanted} is among batches={batches}. Pass peer_batches=[{batches[0]}]."
        )
    return chosen


def _seconds(config: dict[str, Any], key: str, *, default: float, zero: bool) -> float:
    value = config[key]
    good = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < float("inf")
    if not good or (value == 0 and not zero):
        raise ConfigError(f"{key}: {value} is no number of seconds. Leave it out for {default}.")
    return float(value)


def _device(name: str) -> str:
    there = {"cpu": True, "cuda": torch.cuda.is_available()}
    if name == "auto":
        return "cuda" if there["cuda"] else "cpu"
    if not there.get(name):
        raise ConfigError(
            f"device: no '{name}' here. Pass device={' or '.join(k for k, here in there.items() if here)}."
        )
    return name
