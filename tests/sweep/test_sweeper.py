"""Sweeps in this process: which jobs there are, which of them run, and what is said of them."""

from __future__ import annotations

import importlib.util
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from filelock import FileLock

from hudepth.runs.status import LOCK, lock_run
from hudepth.runs.sweeps import read_jobs
from tests.commands import TINY, Command

FAST = (
    *TINY,
    "name=tried",
    "trainer.max_epochs=1",
    "callbacks.panels=0",
    "logger=none",
    "baselines=false",
    "protocol=paper",
)
"""Of a job in about a second."""


def runs(folder: Path) -> dict[str, Path]:
    """The run directories of a sweep by what was varied in them."""
    jobs = [job for each in read_jobs(folder).values() for job in each if "run" in job]
    return {" ".join(job["labels"].values()): folder / job["run"] for job in jobs}


def status(run: Path) -> dict[str, Any]:
    return json.loads((run / "status.json").read_text())


def states(folder: Path) -> dict[str, str]:
    return {name: str(status(run)["state"]) for name, run in runs(folder).items()}


def times(folder: Path) -> dict[str, int]:
    return {name: (run / "status.json").stat().st_mtime_ns for name, run in runs(folder).items()}


def sweep(command: Command, *arguments: str, folder: str = "s") -> Any:
    return command("train", "-m", *FAST, f"sweep_dir={folder}", *arguments)


@pytest.mark.slow
def test_only_what_is_new_runs(command: Command, tmp_path: Path) -> None:
    first = sweep(command, "loss=l1,l2")
    assert first.code == 0, first.err
    assert states(tmp_path / "s") == {"l1": "finished", "l2": "finished"}
    before = times(tmp_path / "s")
    again = sweep(command, "loss=l1,l2,berhu")
    assert again.code == 0, again.err
    assert "sweep tried: 1 of 3 jobs to run, 2 already finished" in again.err
    after = times(tmp_path / "s")
    assert {name: after[name] for name in before} == before
    assert set(after) - set(before) == {"berhu"}
    seeds = sweep(command, "loss=l1", "seed=42,7")
    assert "1 of 2 jobs to run, 1 already finished" in seeds.err  # 42 is the default, typed or not


@pytest.mark.slow
def test_lines_tell_what_each_job_does(command: Command, tmp_path: Path) -> None:
    done = sweep(command, "loss=l1,l2", "trainer.max_epochs=2")
    lines = done.err.splitlines()
    assert lines[0] == "sweep tried: 2 of 2 jobs to run"
    for number, loss in ((1, "l1"), (2, "l2")):
        (end,) = [line for line in lines if line.startswith(f"[{number}/2] loss={loss}: finished")]
        assert re.fullmatch(r".*finished( in \d+ s)?, val/abs_rel \d\.\d{4}(; sweep: \d+ s left)?", end)
        assert any(
            re.match(rf"\[{number}/2\] loss={loss}: epoch [12] of 2, val/abs_rel 0\.\d+", line) for line in lines
        )
    assert lines[-2] == f"sweep tried: 2 finished; in {tmp_path}/s"
    assert lines[-1] == "table and plots: hudepth-report sweep dir=s protocol=paper"
    assert done.out == ""  # results are in the runs
    log = (runs(tmp_path / "s")["l1"] / "train.log").read_text()
    assert "epoch 2 of 2: train/loss/total" in log
    assert "paper protocol" in log


NEGATIVE = "optim.lr: -1 is not a number of at least 0. The default is 0.0001."


@pytest.mark.slow
def test_a_failing_job_stops_no_other_and_is_tried_again(command: Command, tmp_path: Path) -> None:
    done = sweep(command, "optim.lr=-1,1e-3")
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        f"hudepth-train: 1 of 2 jobs failed: optim.lr=-1: {NEGATIVE} See s/*/train.log."
    )
    found = runs(tmp_path / "s")
    assert status(found["-1"])["error"] == NEGATIVE
    assert (found["-1"] / "train.log").read_text().count("Traceback (most recent call last)") == 1
    assert status(found["0.001"])["state"] == "finished"
    again = sweep(command, "optim.lr=-1,1e-3")
    assert again.code == 1
    assert "sweep tried: 1 of 2 jobs to run, 1 already finished" in again.err
    assert "to resume: hudepth-train -m model=tiny" in again.err
    assert "optim.lr=-1,1e-3 sweep_dir=s" in again.err


@pytest.mark.slow
def test_a_job_that_is_refused_before_it_starts_leaves_a_status_too(command: Command, tmp_path: Path) -> None:
    assert sweep(command, "callbacks.panels_every_n_epochs=1", "mode=min,mean").code == 1
    run = runs(tmp_path / "s")["mean"]
    assert status(run)["state"] == "failed"
    assert status(run)["error"].startswith("mode: 'mean'")
    assert "Traceback" in (run / "train.log").read_text()


@pytest.mark.slow
def test_a_value_that_does_not_compose_stops_no_other(command: Command, tmp_path: Path) -> None:
    done = sweep(command, "loss=l1,l3")
    assert done.code == 1
    line = "loss=l3: loss: no 'l3'. Pass one of badcl, berhu, edges, gradient, image_scale, l1, l2, mixture, silog."
    assert done.err.splitlines()[0] == line
    assert done.err.splitlines()[-1] == f"hudepth-train: 1 of 2 jobs failed: {line} See s/*/train.log."
    assert states(tmp_path / "s") == {"l1": "finished"}
    assert [job for job in read_jobs(tmp_path / "s")["tried"] if "run" not in job] == [
        {
            "labels": {"loss": "l3"},
            "error": "loss: no 'l3'. Pass one of badcl, berhu, edges, gradient, image_scale, l1, l2, mixture, silog.",
        }
    ]


def test_nothing_is_made_where_no_job_composes(command: Command, tmp_path: Path) -> None:
    done = sweep(command, "loss=l3,l4")
    assert done.code == 1
    (line,) = done.err.splitlines()
    assert line.startswith("hudepth-train: loss: no 'l3'.")
    assert "all 2 jobs" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_foreign_and_half_written_folders_stay_as_they_are(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "s"
    for name, text in (
        ("mine/notes.txt", "notes"),
        ("half/metrics.csv", "epoch\n"),
        ("odd/config.yaml", "{"),
        ("x.txt", ""),
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / "other/config.yaml").parent.mkdir()
    (folder / "other/config.yaml").write_text("a: 1\n")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert sweep(command, "loss=l1,l2").code == 0
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.slow
def test_a_run_is_known_by_its_configuration_and_not_by_its_name(command: Command, tmp_path: Path) -> None:
    assert sweep(command, "loss=l1,l2").code == 0
    run = runs(tmp_path / "s")["l1"]
    run.rename(run.with_name("renamed"))
    (tmp_path / "s" / "sweep.yaml").unlink()
    (tmp_path / "s").rename(tmp_path / "moved")
    done = sweep(command, "loss=l1,l2", folder="moved")
    assert "sweep tried: 0 of 2 jobs to run, 2 already finished" in done.err
    assert runs(tmp_path / "moved")["l1"].name == "renamed"


@pytest.mark.slow
def test_another_protocol_tests_again_and_trains_no_more(command: Command, tmp_path: Path) -> None:
    assert sweep(command, "loss=l1,l2").code == 0
    before = {name: (run / "metrics.csv").read_bytes() for name, run in runs(tmp_path / "s").items()}
    weights = {name: (run / "checkpoints" / "best.ckpt").read_bytes() for name, run in runs(tmp_path / "s").items()}
    done = sweep(command, "loss=l1,l2", "protocol=[paper,eigen]")
    assert done.code == 0, done.err
    assert "2 of 2 jobs to run" in done.err
    for name, run in runs(tmp_path / "s").items():
        assert (run / "metrics.csv").read_bytes() == before[name]
        assert (run / "checkpoints" / "best.ckpt").read_bytes() == weights[name]
        assert (run / "test" / "eigen" / "metrics.json").is_file()
        assert list(yaml.safe_load((run / "config.yaml").read_text())["protocol"]) == ["paper", "eigen"]
    assert "0 of 2 jobs to run" in sweep(command, "loss=l1,l2", "protocol=[paper,eigen]").err


@pytest.mark.slow
def test_variants_are_picked_and_seeds_change_last(command: Command, tmp_path: Path) -> None:
    arguments = ("+sweep=loss_terms", "model=tiny", *FAST[1:], "sweep_dir=s", "variant=l1,scaling", "seed=1,2")
    done = command("train", *arguments)
    assert done.code == 0, done.err
    jobs = read_jobs(tmp_path / "s")["tried"]
    assert [job["labels"] for job in jobs] == [
        {"variant": name, "seed": seed} for seed in ("1", "2") for name in ("l1", "scaling")
    ]
    config = yaml.safe_load((runs(tmp_path / "s")["scaling 2"] / "config.yaml").read_text())
    assert (config["loss"]["boundary"], config["loss"]["smoothness"], config["loss"]["scaling"]) == (0, 0, 1.0)
    assert (config["variant"], config["seed"], config["data"]["seed"]) == ("scaling", 2, 2)
    one = command("train", *arguments[:-2], "variant=l1", "seed=3")
    assert "1 of 1 jobs to run" in one.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "key", "word"),
    [
        (("+sweep=loss_terms", "variant=l1,scalng"), "variant:", "Did you mean 'scaling'?"),
        (("-m", "loss=l1,l2", "trainer.devices=2", "trainer.strategy=ddp"), "trainer.devices=2, ", "one process"),
        (("-m", "loss=l1,l2", "trainer=ddp"), "trainer.devices=auto, ", "one process"),
        (("-m", "data.root=a,b", "data=nyu_labeled"), "data.root:", "'data.root=a' and 'data.root=b'"),
        (("-m", "optim.lr=interval(1e-4,1e-3)"), "'optim.lr=interval(1e-4,1e-3)'", "optim.lr=1,2,3"),
        (("-m", "loss=l1,l2", "resume=runs/x"), "2 of 2 jobs failed: loss=l1: resume:", "sweep_dir=<its folder>"),
        (("-m", "loss=l1,l2", "sweep_dir=/proc/none"), "sweep_dir:", "'/proc/none' (No such file or directory)"),
        (("-m", "loss=l1,l2", "hydra/launcher=submitit"), "hydra/launcher:", "no SLURM"),
        (("-m", "loss=l1,l2", "hydra/launcher=jobli"), "hydra/launcher:", "Did you mean 'joblib'?"),
        (("-m", "loss=l1,l2", "hydra.sweeper.search.trials=0"), "hydra.sweeper.search.trials:", "at least 1"),
        (("variant=l1",), "variant:", "only applies to sweeps"),
        (("sweep_dir=x",), "sweep_dir:", "only applies to sweeps"),
    ],
)
def test_mistakes_give_one_line(
    command: Command, arguments: tuple[str, ...], key: str, word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", os.defpath)
    done = command("train", *arguments, *(word for word in FAST if not word.startswith("data.source")))
    assert done.code == 1
    line = done.err.splitlines()[-1]
    assert line.startswith(f"hudepth-train: {key}"), done.err
    assert word in line
    assert "Traceback" not in done.err


@pytest.mark.parametrize(
    ("name", "extra", "jobs"),
    [("ray", "ray", "loss=l1,l2"), ("joblib", "joblib", "variant=l1,silog"), ("submitit_local", "slurm", "loss=l1,l2")],
)
def test_a_launcher_that_is_not_installed(
    command: Command, name: str, extra: str, jobs: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    find_spec = importlib.util.find_spec

    def without_launchers(package: str) -> object:
        return None if package.endswith("_launcher") else find_spec(package)

    monkeypatch.setattr(importlib.util, "find_spec", without_launchers)
    done = command("train", "+sweep=loss_terms", jobs, f"hydra/launcher={name}")
    assert done.code == 1
    assert done.err.splitlines() == [
        f"hudepth-train: hydra/launcher={name}: its package is not installed. Run pip install 'hudepth[{extra}]'."
    ]


def test_two_commands_do_not_run_one_sweep(command: Command, tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    with FileLock(tmp_path / "s" / LOCK):
        done = sweep(command, "loss=l1,l2")
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        f"hudepth-train: sweep_dir: another process is running the sweep in '{tmp_path}/s'. Wait for it, or end it."
    )


@pytest.mark.slow
def test_a_run_that_another_process_works_on_is_left_to_it(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import hudepth.training.command

    monkeypatch.setattr(hudepth.training.command, "LOCK_TIMEOUT_S", 0.2)
    assert sweep(command, "loss=l1,l2").code == 0
    run = runs(tmp_path / "s")["l1"]
    (run / "status.json").write_text(json.dumps({"state": "running", "pid": 4711}))
    with lock_run(run):
        done = sweep(command, "loss=l1,l2")
    assert f"'{run}' is in use by another process (pid 4711)" in done.err
    assert "sweep tried: 1 finished, 1 unfinished" in done.err
    assert done.code == 1
    assert done.err.splitlines()[-1] == ("hudepth-train: 1 of 2 jobs did not end. Resume them with the command above.")
    assert status(run) == {"state": "running", "pid": 4711}


@pytest.mark.slow
def test_a_sweep_is_called_by_its_file_also_beside_an_experiment(command: Command, tmp_path: Path) -> None:
    fast = [word for word in FAST if not word.startswith("name=")]
    arguments = ("+sweep=loss_terms", "+experiment=demo", *fast, "variant=l1", "seed=1", "test=false")
    done = command("train", *arguments, "schedule=constant")
    assert done.code == 0, done.err
    (folder,) = (tmp_path / "sweeps" / "loss_terms").iterdir()
    assert list(read_jobs(folder)) == ["loss_terms"]
    assert list(states(folder).values()) == ["finished"]


@pytest.mark.slow
def test_without_a_folder_there_is_a_dated_one(command: Command, tmp_path: Path) -> None:
    assert command("train", "-m", *FAST, "loss=l1", "test=false").code == 0
    (folder,) = (tmp_path / "sweeps" / "tried").iterdir()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d", folder.name)
    assert list(states(folder).values()) == ["finished"]
    assert not (tmp_path / "runs").exists()
