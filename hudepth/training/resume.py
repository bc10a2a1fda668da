"""Continuing a run: its own configuration, with what was typed beside ``resume=`` on top."""

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
    "seed",
    "monitor",
    "mode",
    "data",
    "model",
    "loss",
    "optim",
    "schedule",
    "trainer",
    "callbacks",
    "logger",
    "protocol",
)
"""What the configuration of a run has."""


def resumed_config(path: Path, overrides: list[str]) -> dict[str, Any]:
    """Return the configuration of a run to continue, with what was typed beside ``resume=`` on top.

    The run directory may be a stranger's, so it does not vouch for its own classes: only a typed ``trust=`` counts.

    Args:
        path: the run directory.
        overrides: as typed, for example ``["resume=runs/x", "trainer.max_epochs=50"]``.

    Raises:
        CheckpointError: if it is no run, or has no checkpoint to continue from.
        ConfigError: if something typed cannot change any more.
    """
    config = read_config(path)
    lacking = [part for part in PARTS if part not in config]
    if lacking:
        raise CheckpointError(f"resume: '{path}' is no run of hudepth-train: its config.yaml has no '{lacking[0]}'.")
    last = path / CHECKPOINTS / LAST
    if not last.is_file():
        raise CheckpointError(f"resume: '{path}' has no finished epoch to continue from. Train anew, without resume=.")
    read_plain(last)
    epochs = config["trainer"].get("max_epochs")
    resumed = OmegaConf.create({**config, "trust": []})
    for override in overrides:
        key, _, value = override.partition("=")
        key = key.lstrip("+")
        if key == "resume":
            continue
        found = OmegaConf.select(resumed, key, default=resumed)
        if not is_below(key, RESUMABLE) or OmegaConf.is_dict(found) or (found is resumed and key.count(".") != 1):
            raise ConfigError(
                f"resume: '{override}' cannot be changed when a run is continued; trainer.max_epochs and other "
                "values of trainer, callbacks and logger can. Start a new run for anything else."
            )
        OmegaConf.update(resumed, key, OmegaConf.from_dotlist([f"value={value}"])["value"], force_add=True)
    result = plain(resumed)
    if result["trainer"].get("max_epochs") != epochs and (why := part_bound_to_length(config)):
        raise ConfigError(
            f"resume: {why} of this run is laid out over {epochs} epochs, so trainer.max_epochs cannot change. "
            "Start a new run, or use schedule=constant and data.progressive=null from the start."
        )
    return result
