"""Resuming a run: its own configuration, with the command-line overrides that may change applied on top."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.options import plain
from hudepth.runs.checkpoint import read_plain
from hudepth.runs.identity import RESUMABLE, is_below, part_bound_to_length
from hudepth.runs.run import CHECKPOINTS, LAST, read_config

PARTS = (
    "seed", "monitor", "mode", "data", "model", "loss", "optim", "schedule", "trainer", "callbacks", "logger",
    "protocol",
)  # fmt: skip
"""Groups and keys that the configuration of every training has."""


def resumed_config(path: Path, overrides: list[str]) -> dict[str, Any]:
    """Return the configuration of a run to resume.

    The run directory may come from somebody else, so the classes that it trusts are not trusted here: only ``trust=``
    on the command line counts.

    Args:
        path: the run directory.
        overrides: from the command line, for example ``["resume=runs/x", "trainer.max_epochs=50"]``.

    Raises:
        CheckpointError: if it is not a run, or has no checkpoint to resume from.
        ConfigError: if an override cannot change any more.
    """
    config = read_config(path)
    if lacking := [part for part in PARTS if part not in config]:
        raise CheckpointError(f"resume: '{path}' is not a training run: its config.yaml has no '{lacking[0]}'.")
    last = path / CHECKPOINTS / LAST
    if not last.is_file():
        raise CheckpointError(f"resume: '{path}' has no finished epoch to resume from. Train again without resume=.")
    read_plain(last)
    epochs = config["trainer"].get("max_epochs")
    resumed = OmegaConf.create({**config, "trust": []})
    for override in overrides:
        key, _, value = override.partition("=")
        key = key.lstrip("+")
        if key == "resume":
            continue
        found = OmegaConf.select(resumed, key, default=resumed)
        if not is_below(key, RESUMABLE) or OmegaConf.is_dict(found):  # a group, or a key that the run does not have
            raise ConfigError(
                f"resume: '{override}' cannot be changed when a run is resumed; trainer.max_epochs and other "
                "values of trainer, callbacks and logger can. Start a new run for anything else."
            )
        OmegaConf.update(resumed, key, OmegaConf.from_dotlist([f"value={value}"])["value"])
    result = plain(resumed)
    if result["trainer"].get("max_epochs") != epochs and (part := part_bound_to_length(config)):
        raise ConfigError(
            f"resume: {part} of this run is laid out over {epochs} epochs, so trainer.max_epochs cannot change. "
            "Start a new run, or use schedule=constant and data.progressive=null from the start."
        )
    return result
