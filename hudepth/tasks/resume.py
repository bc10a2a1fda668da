"""Continuing a run: its own configuration, with what was typed beside ``resume=`` on top."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from hudepth import run_dir
from hudepth.errors import CheckpointError, ConfigError
from hudepth.tasks.common import plain


def resumed_config(path: Path, overrides: list[str]) -> dict[str, Any]:
    """Return the configuration of a run to continue, with what was typed beside ``resume=`` on top.

    Args:
        path: the run directory.
        overrides: as typed, for example ``["resume=runs/x", "trainer.max_epochs=50"]``.

    Raises:
        CheckpointError: if it is no run, or has no checkpoint to continue from.
        ConfigError: if something typed is not a value of that run's configuration.
    """
    config = run_dir.read_config(path)
    if not (path / run_dir.CHECKPOINTS / run_dir.LAST).is_file():
        raise CheckpointError(f"resume: '{path}' has no finished epoch to continue from. Train anew, without resume=.")
    resumed = OmegaConf.create(config)
    for override in overrides:
        key, _, value = override.partition("=")
        key = key.lstrip("+")
        if key in ("resume", "paths.runs"):
            continue
        found = OmegaConf.select(resumed, key, default=resumed)
        if found is resumed or OmegaConf.is_dict(found):
            raise ConfigError(
                f"resume: '{override}' cannot be changed when a run is continued; only values that its config.yaml "
                "has can, such as trainer.max_epochs. Start a new run for anything else."
            )
        OmegaConf.update(resumed, key, OmegaConf.from_dotlist([f"value={value}"])["value"])
    return plain(resumed)
