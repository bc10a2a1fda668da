from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import shutil
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest
import torch
import yaml

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.runs import run_dir


class FixedClock(datetime):
    """Stands still, so that two runs begin in one second."""

    @classmethod
    def now(cls, tz: object = None) -> FixedClock:
        return cls(2025, 3, 4, 5, 6, 7)


def test_two_runs_in_one_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_dir, "datetime", FixedClock)
    made = [run_dir.create(tmp_path / "runs", "badcl") for _ in range(3)]
    base = tmp_path / "runs" / "badcl"
    stamp = "2025-03-04_05-06-07"
    assert made == [base / stamp, base / f"{stamp}_2", base / f"{stamp}_3"]
    assert all(path.is_dir() and not list(path.iterdir()) for path in made)


def test_a_run_directory_is_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_dir.create("runs", "x").is_absolute()


@pytest.mark.parametrize("blocked", ["runs", "runs/x"])
def test_a_file_in_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blocked: str) -> None:
    monkeypatch.setattr(run_dir, "datetime", FixedClock)
    (tmp_path / blocked).parent.mkdir(exist_ok=True)
    (tmp_path / blocked).write_text("a file")
    with pytest.raises(ConfigError) as caught:
        run_dir.create(tmp_path / "runs", "x")
    assert str(caught.value) == (
        f"paths.runs: cannot make '{tmp_path}/runs/x/2025-03-04_05-06-07' (Not a directory). "
        "Pass paths.runs=<a folder you can write to>."
    )


def test_a_link_to_a_disk_that_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_dir, "datetime", FixedClock)
    (tmp_path / "runs").symlink_to(tmp_path / "unmounted")
    with pytest.raises(ConfigError) as caught:
        run_dir.create(tmp_path / "runs", "x")
    assert str(caught.value) == (
        f"paths.runs: cannot make '{tmp_path}/runs/x/2025-03-04_05-06-07' (File exists). "
        "Pass paths.runs=<a folder you can write to>."
    )


def test_what_is_known_at_the_start(tmp_path: Path) -> None:
    config = {"name": "größe", "optim": {"lr": 1.0e-4, "betas": [0.9, 0.999]}, "resume": None, "seed": 42}
    environment = run_dir.environment(seed=42, accelerator="cpu")
    run_dir.write_start(tmp_path, config=config, overrides=["optim.lr=1e-4", "+x=1"], environment=environment)
    assert run_dir.read_config(tmp_path) == config
    assert (tmp_path / "overrides.txt").read_text() == "optim.lr=1e-4\n+x=1\n"
    assert json.loads((tmp_path / "environment.json").read_text()) == environment
    assert list(yaml.safe_load((tmp_path / "config.yaml").read_text())) == list(config)  # in the order it was given
    assert run_dir.is_run(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"config.yaml", "overrides.txt", "environment.json"}


def test_start_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file")
    with pytest.raises(ConfigError) as caught:
        run_dir.write_start(tmp_path / "run", config={}, overrides=[], environment={})
    assert str(caught.value) == (
        f"'{tmp_path}/run' cannot be written (File exists). Pass paths.runs=<a folder you can write to>."
    )


def test_environment_is_plain_and_complete() -> None:
    environment = run_dir.environment(seed=7, accelerator="cpu")
    assert json.loads(json.dumps(environment, allow_nan=False)) == environment
    assert environment["seed"] == 7
    assert environment["accelerator"] == "cpu"
    assert environment["threads"] == torch.get_num_threads()
    assert environment["packages"]["torch"] == torch.__version__
    assert all(environment[key] for key in ("python", "platform", "device", "command"))


def test_a_package_of_another_build_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_dir, "PACKAGES", ("torch", "a-package-nobody-has"))
    assert run_dir.environment(seed=0, accelerator="cpu")["packages"] == {
        "torch": torch.__version__,
        "a-package-nobody-has": None,
    }


def repository(folder: Path, monkeypatch: pytest.MonkeyPatch, *, tracked: bool) -> str | None:
    """Make a repository with a copy of run_dir.py, let the module believe it lies there; return the commit."""
    shutil.copy(Path(run_dir.__file__), folder / "run_dir.py")
    monkeypatch.setattr(run_dir, "__file__", str(folder / "run_dir.py"))
    who = {"GIT_AUTHOR_NAME": "a", "GIT_AUTHOR_EMAIL": "a@b", "GIT_COMMITTER_NAME": "a", "GIT_COMMITTER_EMAIL": "a@b"}

    def git(*words: str) -> str:
        environment = {**os.environ, **who}
        done = subprocess.run(
            ["git", "-C", folder, *words], env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    git("init", "-q")
    (folder / "other.txt").write_text("x")
    git("add", "other.txt", *(["run_dir.py"] if tracked else []))
    git("commit", "-q", "-m", "x")
    return git("rev-parse", "HEAD")


@pytest.fixture
def no_repository_above(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))


def git_state() -> object:
    return run_dir.environment(seed=0, accelerator="cpu")["git"]


@pytest.mark.usefixtures("no_repository_above")
def test_git_state_of_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commit = repository(tmp_path, monkeypatch, tracked=True)
    assert git_state() == {"commit": commit, "dirty": False}
    (tmp_path / "run_dir.py").write_text("changed")
    assert git_state() == {"commit": commit, "dirty": True}


@pytest.mark.usefixtures("no_repository_above")
def test_no_git_state_of_a_wheel_inside_somebody_elses_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repository(tmp_path, monkeypatch, tracked=False)
    assert git_state() is None


@pytest.mark.usefixtures("no_repository_above")
def test_no_git_state_outside_a_repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_dir, "__file__", str(tmp_path / "run_dir.py"))
    assert git_state() is None


def test_no_git_state_without_git(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert git_state() is None


def test_status(tmp_path: Path) -> None:
    for state, more in (("running", {}), ("failed", {"error": "the loss is nan"}), ("finished", {"best": 0.125})):
        before = datetime.now(UTC).replace(microsecond=0)
        run_dir.write_status(tmp_path, state, **more)
        status = json.loads((tmp_path / "status.json").read_text())
        time = datetime.fromisoformat(status.pop("time"))
        assert before <= time <= datetime.now(UTC)
        assert status == {"state": state, "pid": os.getpid(), **more}
    assert [file.name for file in tmp_path.iterdir()] == ["status.json"]


@pytest.mark.parametrize("best", [math.nan, math.inf, -math.inf])
def test_a_best_that_is_not_finite_is_null(tmp_path: Path, best: float) -> None:
    run_dir.write_status(tmp_path, "finished", best=best)
    assert json.loads((tmp_path / "status.json").read_text())["best"] is None


def test_log_lines_go_to_the_file_while_it_lasts(tmp_path: Path) -> None:
    level = log.level
    log.setLevel(logging.INFO)
    try:
        log.info("before")
        with contextlib.suppress(RuntimeError), run_dir.logged_to(tmp_path / "train.log"):
            log.info("epoch 1 of größe")
            logging.getLogger("lightning.pytorch").warning("careful")
            raise RuntimeError
        log.info("after")
    finally:
        log.setLevel(level)
    lines = (tmp_path / "train.log").read_text(encoding="utf-8").splitlines()
    assert [line.split(" ", 2)[2] for line in lines] == ["INFO epoch 1 of größe", "WARNING careful"]


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "its config.yaml cannot be read ([Errno 2] No such file or directory: '{path}/config.yaml')."),
        (b"- 1\n- 2\n", "its config.yaml holds no mapping."),
        (b"", "its config.yaml holds no mapping."),
    ],
)
def test_no_run_directory(tmp_path: Path, content: bytes | None, why: str) -> None:
    if content is not None:
        (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        run_dir.read_config(tmp_path)
    assert str(caught.value) == f"'{tmp_path}' is no run directory: " + why.format(path=tmp_path)


@pytest.mark.parametrize(
    "content", [b"a: [1, 2\nb: 3\n", b"\xff\xfe\x00\x81", b"a: !!python/object/apply:os.getpid []\n"]
)
def test_damaged_config_is_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        run_dir.read_config(tmp_path)
    assert str(caught.value).startswith(f"'{tmp_path}' is no run directory: its config.yaml cannot be read (")
    assert "\n" not in str(caught.value)


def test_code_in_a_config_is_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    (tmp_path / "config.yaml").write_text(f"a: !!python/object/apply:os.system ['touch {marker}']\n")
    with pytest.raises(CheckpointError, match="could not determine a constructor"):
        run_dir.read_config(tmp_path)
    assert not marker.exists()


def test_the_run_of_a_checkpoint(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    assert run_dir.run_of(run / "checkpoints" / "best.ckpt") is None  # no config.yaml: not one of ours
    (run / "config.yaml").touch()
    assert run_dir.run_of(run / "checkpoints" / "best.ckpt") == run
    assert run_dir.run_of(run / "elsewhere" / "best.ckpt") is None
    assert run_dir.run_of(run / "best.ckpt") is None
