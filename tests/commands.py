"""Runs the console scripts: in this process where that will do, as processes where it matters."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

TINY = (
    "model=tiny",
    "data.size=[32,48]",
    "data.source.scenes=6",
    "data.source.frames_per_scene=2",
    "data.source.size=[48,64]",
    "data.batch_size=2",
    "callbacks.panels=1",
    "trainer.accelerator=cpu",
    "trainer.max_epochs=2",
)
"""What turns any training configuration into seconds on rooms."""


@dataclass(frozen=True)
class Result:
    """What a command left: its exit code and what it printed."""

    code: int
    out: str
    err: str


Command = Callable[..., Result]


def script(task: str, *arguments: str, cwd: Path, cache: Path) -> Sequence[str] | dict[str, object]:
    """Return the arguments of subprocess.run and Popen for the installed console script."""
    environment = {**os.environ, "HUDEPTH_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    return {
        "args": [str(Path(sys.executable).parent / f"hudepth-{task}"), *arguments],
        "cwd": cwd,
        "env": environment,
        "text": True,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.STDOUT,
    }
