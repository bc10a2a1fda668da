from __future__ import annotations

import contextlib
import json
import logging
import os
from datetime import datetime
from pathlib import Path

import pytest
import yaml

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.runs import run_dir
from hudepth.runs.run import is_run, read_config


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
    with pytest.raises(ConfigError, match=r"^paths.runs: .*Not a directory.* Pass paths.runs="):
        run_dir.create(tmp_path / "runs", "x")


def test_a_link_to_a_disk_that_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_dir, "datetime", FixedClock)
    (tmp_path / "runs").symlink_to(tmp_path / "unmounted")
    with pytest.raises(ConfigError, match=r"^paths.runs: .*File exists.* Pass paths.runs="):
        run_dir.create(tmp_path / "runs", "x")


def test_what_is_known_at_the_start(tmp_path: Path) -> None:
    config = {"name": "größe", "optim": {"lr": 1.0e-4, "betas": [0.9, 0.999]}, "resume": None, "seed": 42}
    environment = {"seed": 42}
    run_dir.write_start(tmp_path, config=config, overrides=["optim.lr=1e-4", "+x=1"], environment=environment)
    assert read_config(tmp_path) == config
    assert (tmp_path / "overrides.txt").read_text() == "optim.lr=1e-4\n+x=1\n"
    assert json.loads((tmp_path / "environment.json").read_text()) == environment
    assert list(yaml.safe_load((tmp_path / "config.yaml").read_text())) == list(config)  # in the order it was given
    assert is_run(tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"config.yaml", "overrides.txt", "environment.json"}


def test_start_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file")
    with pytest.raises(ConfigError, match=r"/run' .*File exists.* Pass paths.runs="):
        run_dir.write_start(tmp_path / "run", config={}, overrides=[], environment={})


def test_overrides_that_are_not_utf_8_are_escaped(tmp_path: Path) -> None:
    run_dir.write_start(tmp_path, config={}, overrides=["resume=" + os.fsdecode(b"K\xfcche")], environment={})
    assert (tmp_path / "overrides.txt").read_text(encoding="utf-8") == "resume=K\\udcfcche\n"


def test_a_resumed_run_keeps_its_first_overrides(tmp_path: Path) -> None:
    run_dir.write_start(tmp_path, config={"a": 1}, overrides=["a=1"], environment={})
    run_dir.write_resumed(tmp_path, config={"a": 2}, overrides=["a=2"])
    assert (tmp_path / "overrides.txt").read_text() == "a=1\na=2\n"
    assert read_config(tmp_path) == {"a": 2}


def test_each_evaluation_on_test_images_is_recorded(tmp_path: Path) -> None:
    assert run_dir.note_scored(tmp_path, epoch=1, data="x", split="s", protocols=["paper"]) == []
    assert run_dir.note_scored(tmp_path, epoch=2, data="x", split="other", protocols=["paper"]) == []
    assert run_dir.note_scored(tmp_path, epoch=3, data="x", split="s", protocols=["paper"]) == [1]
    assert [entry["epoch"] for entry in run_dir.read_scored(tmp_path)] == [1, 2, 3]


def test_log_lines_go_to_the_file_while_it_lasts(tmp_path: Path) -> None:
    level = log.level
    log.setLevel(logging.INFO)
    try:
        log.info("before")
        with contextlib.suppress(RuntimeError), run_dir.log_to_file(tmp_path / "train.log"):
            log.info("epoch 1 of größe")
            logging.getLogger("lightning.pytorch").warning("careful")
            raise RuntimeError
        log.info("after")
    finally:
        log.setLevel(level)
    lines = (tmp_path / "train.log").read_text(encoding="utf-8").splitlines()
    assert [line.split(" ", 2)[2] for line in lines] == ["INFO epoch 1 of größe", "WARNING careful"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_log_file_on_a_full_disk_gives_up_with_one_warning(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "train.log").symlink_to("/dev/full")
    monkeypatch.setattr(log, "propagate", False)  # Hydra leaves a handler whose output other tests have closed
    with run_dir.log_to_file(tmp_path / "train.log"):
        for _ in range(3):
            log.warning("a line")
    assert "Traceback" not in capsys.readouterr().err
