"""Runs the console scripts: in this process where that will do, as processes where it matters."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

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


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder of depth stores for all tests, so that rooms are rendered once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def command(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """Return a function that runs a console script's function in this process, in an empty folder."""
    from hydra.core.global_hydra import GlobalHydra

    from hudepth import cli

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HUDEPTH_CACHE", str(cache))

    def run(task: str, *arguments: str) -> Result:
        GlobalHydra.instance().clear()
        monkeypatch.setattr(sys, "argv", [f"hudepth-{task}", *arguments])
        capfd.readouterr()
        code = getattr(cli, task)()
        captured = capfd.readouterr()
        return Result(code, captured.out, captured.err)

    return run


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


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """A run directory of a finished two-epoch run, made by the installed script from a folder of its own."""
    folder = tmp_path_factory.mktemp("trained")
    done = subprocess.run(**script("train", *TINY, "name=tiny", cwd=folder, cache=cache), check=False)
    assert done.returncode == 0, done.stdout
    (run,) = (folder / "runs" / "tiny").iterdir()
    return run
