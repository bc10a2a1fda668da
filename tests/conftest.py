"""Set up before hudepth is imported: shapes and types of every call are checked while the tests run."""

from __future__ import annotations

import logging
import os
import shutil
import sys
from pathlib import Path

import absl.logging
import jaxtyping
import pytest
import torch
from filelock import FileLock
from hypothesis import settings

from tests.commands import TINY, Command, Result

# pep484_tower: an int is welcome where a float is asked for, as in any YAML file
jaxtyping.install_import_hook("hudepth", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")
# One thread for each process, whatever a command asks for: several workers' threads would wait for the same cores.
os.environ |= {"OMP_NUM_THREADS": "1", "GOMP_SPINCOUNT": "10000"}
torch.set_num_threads(1)
torch.set_num_threads = lambda _: None
# OpenVINO imports absl, whose handler would close the standard error that pytest captures when Hydra resets logging
absl.logging.get_absl_handler().python_handler.stream = sys.__stderr__
settings.register_profile("hudepth", deadline=None, max_examples=25)  # a busy machine is no failure
settings.load_profile("hudepth")


def pytest_configure(config: pytest.Config) -> None:
    """Hide GPUs from all tests but those that are for one: what is computed should not depend on the machine."""
    if config.option.markexpr == "gpu":
        os.environ["CUBLAS_WORKSPACE_CONFIG"] = ":4096:8"  # read once, and trainer.deterministic needs it
    else:
        os.environ["CUDA_VISIBLE_DEVICES"] = ""


LONGEST = ("test_docs.py", "test_typing.py", "test_ddp.py", "sweep/test_kill.py", "training/test_command.py")
"""Files whose tests should not be the last to begin."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Move the longest files to the beginnings of both halves, where two processes begin."""
    order = {name: [item for item in items if item.path.as_posix().endswith(name)] for name in LONGEST}
    first, second = ([item for name in names for item in order[name]] for names in (LONGEST[::2], LONGEST[1::2]))
    others = [item for item in items if item not in {*first, *second}]
    middle = len(items) // 2 - len(first)
    items[:] = [*first, *others[: max(middle, 0)], *second, *others[max(middle, 0) :]]


@pytest.fixture(scope="session")
def nyu_root() -> Path:
    """Folder of the labelled NYU frames."""
    default = Path(__file__).parents[1] / ".." / "shared" / "data" / "nyu_labeled"
    root = Path(os.environ.get("HUDEPTH_NYU_ROOT", default)).resolve()
    if not root.is_dir():
        pytest.skip(f"no NYU frames in '{root}'; set HUDEPTH_NYU_ROOT to where they are")
    return root


def _restore_logging(patch: pytest.MonkeyPatch) -> None:
    """Undo in the end what a console script run in this process does to the log: its lines would come twice."""
    log = logging.getLogger("hudepth")
    patch.setattr(log, "handlers", list(log.handlers))
    patch.setattr(log, "propagate", log.propagate)


@pytest.fixture(autouse=True)
def _own_logging(monkeypatch: pytest.MonkeyPatch) -> None:
    _restore_logging(monkeypatch)


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all test processes share: what is expensive is made there once."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def cache(shared: Path) -> Path:
    """One folder of depth stores for all tests, so that rooms are rendered once."""
    folder = shared / "cache"
    folder.mkdir(exist_ok=True)
    return folder


def _run_script(task: str, *arguments: str) -> int:
    """Run a console script's function in this process."""
    from hydra.core.global_hydra import GlobalHydra

    from hudepth import cli

    GlobalHydra.instance().clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [f"hudepth-{task}", *arguments])
        code: int = getattr(cli, task)()
    return code


@pytest.fixture
def command(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """Return a function that runs a console script's function in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HUDEPTH_CACHE", str(cache))

    def run(task: str, *arguments: str) -> Result:
        capfd.readouterr()
        code = _run_script(task, *arguments)
        captured = capfd.readouterr()
        return Result(code, captured.out, captured.err)

    return run


@pytest.fixture(scope="session")
def trained(shared: Path, tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """The run directory of a two-epoch run, made once for all processes; each has a copy of its own."""
    with FileLock(shared / "trained.lock"), pytest.MonkeyPatch.context() as patch:
        _restore_logging(patch)  # the fixture of each test comes later
        if not (shared / "trained").is_dir():
            folder = tmp_path_factory.mktemp("trained")
            patch.chdir(folder)
            patch.setenv("HUDEPTH_CACHE", str(cache))
            assert _run_script("train", *TINY, "name=tiny") == 0
            folder.rename(shared / "trained")
    copy = tmp_path_factory.mktemp("copy")
    shutil.copytree(shared / "trained" / "runs", copy / "runs")
    (run,) = (copy / "runs" / "tiny").iterdir()
    return run
