"""A run directory, read: its configuration, state, history, checkpoint and test results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from hudepth.base.errors import CheckpointError
from hudepth.base.files import read_yaml
from hudepth.runs.history import read_history
from hudepth.runs.identity import run_key
from hudepth.runs.results import Result, find_result
from hudepth.runs.sections import check_config
from hudepth.runs.status import read_state

CHECKPOINTS = "checkpoints"
BEST, LAST = "best.ckpt", "last.ckpt"


@dataclass(frozen=True)
class Run:
    """A run directory."""

    path: Path
    config: dict[str, Any]
    """config.yaml: resolved, nested."""
    state: str
    """``finished``, ``failed``, ``pruned``, ``interrupted`` (also: killed) or ``running``."""
    error: str = ""
    """The message of a failed run."""
    labels: dict[str, str] = field(default_factory=dict)
    """What a sweep varied, as typed: ``{"variant": "l1", "seed": "1"}``; empty outside of sweeps."""

    @classmethod
    def read(cls, path: Path, *, labels: Mapping[str, str] | None = None) -> Run:
        """Read a run directory. Raises CheckpointError if it is not one."""
        config = read_config(path)
        if missing := [part for part in ("seed", "data", "model", "loss") if part not in config]:
            why = f"its config.yaml has no '{missing[0]}'"
            raise CheckpointError(f"'{path}' is not a run of hudepth-train: {why}. Pass a run directory.")
        check_config(config, where=path / "config.yaml")
        return cls(path, config, *read_state(path), labels=dict(labels or {}))

    @property
    def key(self) -> str:
        """Equal for runs of one configuration; see :func:`hudepth.runs.identity.run_key`."""
        return run_key(self.config)

    @property
    def split(self) -> str:
        """Kind of the training's split: ``random``, ``scene`` or ``official``."""
        data = self.config.get("data")
        return str(data.get("split", "unknown")) if isinstance(data, Mapping) else "unknown"

    @property
    def checkpoint(self) -> Path | None:
        """The best checkpoint, else the last; None before the first epoch."""
        return best_checkpoint(self.path)

    def history(self) -> list[dict[str, float]]:
        """Read metrics.csv, one row per epoch; see :func:`hudepth.runs.history.read_history`."""
        return read_history(self.path / "metrics.csv")

    def result(self, protocol: str) -> Result:
        """Read the test result of a protocol; see :func:`hudepth.runs.results.find_result`."""
        return find_result(self.path, protocol)


def is_run(path: Path) -> bool:
    """Tell whether ``path`` is a run directory."""
    return (path / "config.yaml").is_file()


def read_config(path: Path) -> dict[str, Any]:
    """Read a run's config.yaml as plain Python. Raises CheckpointError if it is missing or damaged."""
    try:
        config = read_yaml(path / "config.yaml")
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        why = " ".join(str(error).split())
        raise CheckpointError(f"'{path}' is not a run directory: its config.yaml cannot be read ({why}).") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"'{path}' is not a run directory: its config.yaml is not a mapping.")
    return config


def newest_run(runs: str | Path) -> Path:
    """Return the run with a checkpoint below ``runs`` that was written to last. Raises CheckpointError if none is."""
    root = Path(runs).expanduser()
    found = [c.parent.parent for name in (BEST, LAST) for c in root.glob(f"**/{CHECKPOINTS}/{name}")]
    if not found:
        fix = "Train one with hudepth-train, or pass checkpoint=<file or run directory>."
        raise CheckpointError(f"checkpoint=last: no run with a checkpoint below '{root}'. {fix}")
    return max(found, key=lambda run: (run / CHECKPOINTS).stat().st_mtime_ns)


def best_checkpoint(run: Path) -> Path | None:
    """Return the best checkpoint of a run directory, else the last; None before the first epoch."""
    files = (run / CHECKPOINTS / name for name in (BEST, LAST))
    return next((file for file in files if file.is_file()), None)


def find_run(checkpoint: Path) -> Path | None:
    """Return the run directory that a checkpoint file lies in, None if the file was moved elsewhere."""
    run = checkpoint.parent.parent
    return run if checkpoint.parent.name == CHECKPOINTS and is_run(run) else None
