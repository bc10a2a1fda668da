from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from hudepth.runs import environment


def test_environment_is_plain_and_complete() -> None:
    found = environment.environment(seed=7, accelerator="cpu", precision="fast")
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["seed"] == 7
    assert found["accelerator"] == "cpu"
    assert (found["precision"], found["tf32"]) == ("32-true", False)
    assert found["threads"] == torch.get_num_threads()
    assert found["packages"]["torch"] == torch.__version__
    assert all(found[key] for key in ("python", "platform", "device", "command"))


def test_a_package_of_another_build_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "PACKAGES", ("torch", "a-package-nobody-has"))
    assert environment.environment(seed=0, accelerator="cpu", precision="fast")["packages"] == {
        "torch": torch.__version__,
        "a-package-nobody-has": None,
    }


def repository(folder: Path, monkeypatch: pytest.MonkeyPatch, *, tracked: bool) -> str | None:
    """Make a repository with a copy of environment.py, let the module believe it lies there; return the commit."""
    shutil.copy(Path(environment.__file__), folder / "environment.py")
    monkeypatch.setattr(environment, "__file__", str(folder / "environment.py"))
    who = {"GIT_AUTHOR_NAME": "a", "GIT_AUTHOR_EMAIL": "a@b", "GIT_COMMITTER_NAME": "a", "GIT_COMMITTER_EMAIL": "a@b"}

    def git(*words: str) -> str:
        variables = {**os.environ, **who}
        done = subprocess.run(["git", "-C", folder, *words], env=variables, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    git("init", "-q")
    (folder / "other.txt").write_text("x")
    git("add", "other.txt", *(["environment.py"] if tracked else []))
    git("commit", "-q", "-m", "x")
    return git("rev-parse", "HEAD")


@pytest.fixture
def no_repository_above(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))


def git_state() -> object:
    return environment.environment(seed=0, accelerator="cpu", precision="fast")["git"]


@pytest.mark.usefixtures("no_repository_above")
def test_git_state_of_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commit = repository(tmp_path, monkeypatch, tracked=True)
    assert git_state() == {"commit": commit, "dirty": False}
    (tmp_path / "environment.py").write_text("changed")
    assert git_state() == {"commit": commit, "dirty": True}


@pytest.mark.usefixtures("no_repository_above")
def test_no_git_state_of_a_wheel_inside_somebody_elses_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repository(tmp_path, monkeypatch, tracked=False)
    assert git_state() is None


@pytest.mark.usefixtures("no_repository_above")
def test_no_git_state_outside_a_repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "__file__", str(tmp_path / "environment.py"))
    assert git_state() is None


def test_no_git_state_without_git(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert git_state() is None
