"""When two configurations describe the same training, and what may change when a run is resumed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

LABELS = ("name", "variant", "sweep_dir", "resume", "hydra", "debug")
"""Keys that name a run and say how it was started."""
SURROUNDINGS = (
    "trust", "test", "baselines", "protocol", "paths", "logger", "callbacks.panels", "callbacks.panels_every_n_epochs",
    "cuda_graph", "data.source.camera", "data.root", "data.cache", "data.num_workers", "data.on_device",
    "data.prepare_workers", "trainer.accelerator", "trainer.devices", "trainer.num_nodes", "trainer.strategy",
    "trainer.log_every_n_steps",
)  # fmt: skip
"""Keys that do not change the trained weights either: paths, hardware, pictures, and how the result is tested."""
INCIDENTAL = (*LABELS, *SURROUNDINGS)
"""Keys in which two configurations of the same training may differ."""
SEEDS = ("seed", "data.seed")
"""Keys in which repetitions of a configuration differ. Not ``data.split_seed``, which makes another test set."""
RESUMABLE = (*SURROUNDINGS, "trainer", "callbacks", "distill.teacher", "distill.pictures")
"""Keys that may change when a run is resumed; everything else is fixed by its checkpoint and its split."""


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values by dotted key, each key with ``prefix`` before it."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


def identity(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what defines a training: its configuration by dotted key, without the :data:`INCIDENTAL` keys."""
    values = flat(config)
    return {key: values[key] for key in sorted(values) if not is_below(key, INCIDENTAL)}


def is_below(key: str, names: tuple[str, ...]) -> bool:
    """Return whether a dotted key is one of ``names`` or lies below one."""
    return any(key == name or key.startswith(f"{name}.") for name in names)


def run_key(config: Mapping[str, Any]) -> str:
    """Return 10 hexadecimal digits that are equal for configurations of equal :func:`identity`.

    A key that is null counts as absent, so that a run is not trained again when a later version has a further option.
    """
    values = {key: _normalise(value) for key, value in identity(config).items() if value is not None}
    text = json.dumps(values, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def canonical(value: Any) -> str:
    """Return a text that is equal for equal values: 1 and 1.0 are equal, 1 and true are not."""
    return json.dumps(_normalise(value), sort_keys=True, default=str)


def _normalise(value: Any) -> Any:
    """Make 1 and 1.0 the same number, also within lists."""
    if isinstance(value, list | tuple):
        return [_normalise(item) for item in value]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def part_bound_to_length(config: Mapping[str, Any]) -> str:
    """Name the part for which a run cannot be resumed with another ``trainer.max_epochs``; empty if there is none."""
    schedule = config["schedule"] or {}
    if "T_max" in schedule or str(schedule.get("_target_")).startswith("hudepth.training.schedules."):
        return "the learning-rate schedule"
    if config["data"].get("progressive"):
        return "the progressive resolution"
    extras = [str(extra.get("_target_")) for extra in config["callbacks"].get("extra") or []]
    return "FreezeEncoder" if any("FreezeEncoder" in extra for extra in extras) else ""
