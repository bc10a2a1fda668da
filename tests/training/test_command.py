from __future__ import annotations

import csv
import json
import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from hudepth.runs.checkpoint import read_plain
from hudepth.runs.run import newest_run
from tests.commands import TINY, Command, script


def history(run: Path) -> list[dict[str, str]]:
    with (run / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def status(run: Path) -> dict[str, Any]:
    return json.loads((run / "status.json").read_text())


def only_run(folder: Path, name: str) -> Path:
    (run,) = (folder / "runs" / name).iterdir()
    return run


def test_a_run_leaves_everything_the_contract_names(trained: Path) -> None:
    files = {str(path.relative_to(trained)) for path in trained.rglob("*") if path.is_file()}
    expected = {
        "config.yaml", "overrides.txt", "environment.json", "split.json", "status.json", "train.log", "metrics.csv",
        "times.csv", "scored.json",
        "checkpoints/best.ckpt", "checkpoints/last.ckpt", "images/epoch_001.png", "images/epoch_002.png",
        *(f"test/{p}/{name}" for p in ("paper", "eigen") for name in ("metrics.json", "per_image.csv", "panels.png")),
        "test/eigen/strata.csv", "test/eigen/strata.png",
    }  # fmt: skip
    assert expected <= files
    assert {name.split("/")[0] for name in files - expected} == {"tensorboard", ".lock"}
    assert status(trained)["state"] == "finished"
    assert (trained / "overrides.txt").read_text().splitlines() == [*TINY, "name=tiny"]
    config = yaml.safe_load((trained / "config.yaml").read_text())
    assert config["trainer"]["max_epochs"] == 2
    assert "${" not in (trained / "config.yaml").read_text()
    environment = json.loads((trained / "environment.json").read_text())
    assert environment["packages"]["torch"].startswith(torch.__version__.split("+")[0])
    rows = history(trained)
    assert [row["epoch"] for row in rows] == ["1", "2"]
    for stage in ("train", "val"):
        total = float(rows[1][f"{stage}/loss/total"])
        terms = [float(rows[1][f"{stage}/loss/{term}"]) for term in ("boundary", "smoothness", "scaling")]
        assert total == pytest.approx(3.0 * terms[0] + 1.2 * terms[1] + 1.0 * terms[2], rel=1e-5)


def test_the_log_says_that_rooms_are_the_default(trained: Path) -> None:
    log = (trained / "train.log").read_text()
    assert "data: built-in rooms (the default)" in log
    assert "epoch 2 of 2: train/loss/total" in log


def test_experiment_changes_values(command: Command) -> None:
    plain = yaml.safe_load(command("train", "--cfg", "job", "model=tiny").out)
    for argument in ("experiment=badcl", "+experiment=badcl"):
        badcl = yaml.safe_load(command("train", "--cfg", "job", argument).out)
        assert badcl["trainer"]["max_epochs"] == 100 != plain["trainer"]["max_epochs"]
        assert badcl["model"]["weights"] == "imagenet"
        assert (badcl["optim"]["lr"], badcl["data"]["batch_size"], badcl["seed"]) == (1e-4, 8, 42)


def test_a_loss_that_is_not_finite_names_its_batch(command: Command, tmp_path: Path) -> None:
    done = command("train", *TINY, "name=exploding", "optim.lr=1e30", "loss=l2", "model=tiny", "trainer.max_epochs=3")
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith("hudepth-train: the loss is nan in epoch 1, batch ")
    assert "of the pairs room_00" in done.err
    assert status(only_run(tmp_path, "exploding"))["state"] == "failed"


def test_a_root_that_is_missing_gives_one_line(command: Command) -> None:
    done = command("train", "data=nyu_labeled", "data.root=nowhere", "model=tiny")
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        "hudepth-train: data.root: 'nowhere' does not exist. "
        "Pass data.root=<folder with index.csv>, or run with data=rooms."
    )


def test_a_split_that_leaves_a_subset_empty_gives_one_line(command: Command) -> None:
    done = command("train", *TINY, "data.split=random", "data.fractions=[1.0,0.0,0.0]")
    assert done.code == 1
    assert "data.split=random: the val subset is empty (12 pairs" in done.err.splitlines()[-1]


def test_an_output_that_cannot_be_written_gives_one_line(command: Command, tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("in the way")
    done = command("train", *TINY)
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith("hudepth-train: paths.runs: cannot make 'runs/default/")
    assert done.err.splitlines()[-1].endswith("Pass paths.runs=<a folder you can write to>.")


def test_a_disk_that_fills_up_says_how_to_go_on(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(path: Path, rows: list[Any]) -> None:
        if len(rows) > 1:
            raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("hudepth.training.callbacks.write_history", write)
    done = command("train", *TINY, "name=full", "test=false", "callbacks.panels=0", "logger=none")
    run = only_run(tmp_path, "full")
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        f"hudepth-train: '{run / 'metrics.csv'}' cannot be written (No space left on device). Free some space, or pass "
        f"a folder on another disk. Resume with hudepth-train resume={run}"
    )
    assert status(run)["state"] == "failed"


def test_a_size_the_network_cannot_take_gives_the_nearest(command: Command) -> None:
    done = command("train", *TINY, "data.size=[40,48]")
    assert done.code == 1
    assert done.err.splitlines()[-1].endswith("Pass data.size=[32,48] or [48,48].")


def test_a_protocol_that_needs_what_is_not_prepared_is_refused_before_training(command: Command) -> None:
    done = command("train", *TINY, "data.native=false")
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        "hudepth-train: protocol=eigen scores at native resolution, which data.native=false leaves out. "
        "Pass data.native=true, or protocol=paper."
    )
    assert "epoch 1" not in done.err


@pytest.mark.slow
def test_early_stopping_and_schedules(command: Command, tmp_path: Path) -> None:
    done = command(
        "train", *TINY, "name=stop", "callbacks=early_stopping", "callbacks.panels=0", "schedule=cosine", "test=false",
        "callbacks.early_stopping.patience=1", "callbacks.early_stopping.min_delta=100", "trainer.max_epochs=9",
    )  # fmt: skip
    assert done.code == 0, done.err
    assert len(history(only_run(tmp_path, "stop"))) == 2


@pytest.mark.slow
def test_resume_refuses_what_it_cannot_do(command: Command, trained: Path, tmp_path: Path) -> None:
    assert "run directory" in command("train", "resume=nowhere").err.splitlines()[-1]
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "config.yaml").write_text("a: 1\n")
    done = command("train", f"resume={foreign}")
    assert done.err.splitlines()[-1].endswith("its config.yaml has no 'seed'.")
    assert [path.name for path in foreign.iterdir()] == ["config.yaml"]
    (foreign / "config.yaml").write_bytes((trained / "config.yaml").read_bytes())
    done = command("train", f"resume={foreign}")
    assert done.err.splitlines()[-1].endswith("Train again without resume=.")
    for override in ("optim.lr=1e-1", "data.split=random", "loss.boundary=1", "model.width=3", "seed=3"):
        done = command("train", f"resume={trained}", override)
        assert done.code == 1
        assert f"resume: '{override}' cannot be changed when a run is resumed" in done.err.replace("++", "")
    assert yaml.safe_load((trained / "config.yaml").read_text())["optim"]["lr"] == 1e-4
    done = command("train", f"resume={trained}", "loss=l1")
    assert done.code == 1
    assert "resume: 'loss=l1' cannot be changed when a run is resumed" in done.err.splitlines()[-1]


@pytest.mark.slow
def test_resume_adds_epochs_to_a_finished_run(command: Command, tmp_path: Path) -> None:
    """Two epochs and one more are bit for bit three epochs."""
    options = (*TINY, "test=false", "callbacks.panels=0", "logger=none")
    assert command("train", *options, "name=two").code == 0
    assert command("train", *options, "name=three", "trainer.max_epochs=3").code == 0
    two, three = only_run(tmp_path, "two"), only_run(tmp_path, "three")
    done = command("train", f"resume={two}", "trainer.max_epochs=3")
    assert done.code == 0, done.err
    assert yaml.safe_load((two / "config.yaml").read_text())["trainer"]["max_epochs"] == 3
    assert (two / "overrides.txt").read_text().splitlines()[-2:] == [f"resume={two}", "trainer.max_epochs=3"]
    assert_same_end(two, three)


def assert_same_end(run: Path, reference: Path) -> None:
    assert (run / "metrics.csv").read_bytes() == (reference / "metrics.csv").read_bytes()
    ours, theirs = (read_plain(r / "checkpoints" / "last.ckpt") for r in (run, reference))
    assert ours["epoch"] == theirs["epoch"]
    assert ours["global_step"] == theirs["global_step"]
    assert_equal(ours["state_dict"], theirs["state_dict"])
    assert_equal(ours["optimizer_states"], theirs["optimizer_states"])
    best, best_reference = (read_plain(r / "checkpoints" / "best.ckpt") for r in (run, reference))
    assert best["epoch"] == best_reference["epoch"]
    assert_equal(best["state_dict"], best_reference["state_dict"])


def assert_equal(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if isinstance(a, torch.Tensor):
        assert torch.equal(a, b)
    elif isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_equal(a[key], b[key])
    elif isinstance(a, list):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    else:
        assert a == b


RECIPE = (
    "augment=depth", "augment.cut_depth=0.5", "loss=mixture", "optim=adamw_grouped", "schedule=warmup_cosine",
    "callbacks=ema", "data.progressive=[{size:[16,32],until:0.5}]", "trainer.gradient_clip_val=1.0",
)  # fmt: skip


@pytest.mark.parametrize(
    "recipe",
    [
        ("schedule=cosine",),
        RECIPE,
        (*RECIPE, "data.num_workers=2", "trainer.accumulate_grad_batches=2"),
        ("schedule=cosine", "data.stream=4"),
    ],
    ids=["plain", "strong", "workers", "stream"],
)
@pytest.mark.slow
def test_killed_at_random_moments_and_resumed_it_ends_bit_for_bit_the_same(
    recipe: tuple[str, ...], command: Command, tmp_path: Path, cache: Path
) -> None:
    quiet = ["test=false", "callbacks.panels=0", "logger=none"]
    options = [*TINY, *recipe, *quiet, "trainer.max_epochs=40", "seed=7"]
    assert command("train", *options, "name=whole").code == 0
    reference = only_run(tmp_path, "whole")

    chance = random.Random(0)
    arguments, kills = [*options, "name=killed"], 0
    for _ in range(2):
        process = subprocess.Popen(**script("train", *arguments, cwd=tmp_path, cache=cache))
        wait_for_epoch(process, tmp_path, at_least=1 + 10 * kills)
        time.sleep(chance.uniform(0, 0.3))
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
        process.communicate()
        run = only_run(tmp_path, "killed")
        assert status(run)["state"] == "running" or status(run)["state"] == "finished"
        arguments = [f"resume={run}"]
    assert kills
    done = subprocess.run(**script("train", *arguments, cwd=tmp_path, cache=cache), check=False)
    assert done.returncode == 0, done.stdout
    assert status(run)["state"] == "finished"
    assert len(history(run)) == 40
    assert_same_end(run, reference)


def wait_for_epoch(process: subprocess.Popen[str], folder: Path, *, at_least: int) -> None:
    """Wait until the run's newest checkpoint is of an epoch later than it was, or the process has ended."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        for run in (folder / "runs" / "killed").glob("*"):
            if (run / "checkpoints" / "last.ckpt").exists() and len(history(run)) >= at_least:
                return
        time.sleep(0.02)


@pytest.mark.slow
def test_interrupt_ends_cleanly_and_says_how_to_go_on(tmp_path: Path, cache: Path) -> None:
    process = subprocess.Popen(
        **script("train", *TINY, "name=killed", "trainer.max_epochs=1000", "test=false", cwd=tmp_path, cache=cache)
    )
    wait_for_epoch(process, tmp_path, at_least=1)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    run = only_run(tmp_path, "killed")
    assert process.returncode != 0
    assert f"interrupted; resume with: hudepth-train resume={run}" in out
    assert "Traceback" not in out
    assert status(run)["state"] == "interrupted"


def test_a_gpu_that_fills_up(command: Command, trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A resumed run is not blamed for it."""

    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.")

    monkeypatch.setattr("hudepth.training.module.DepthModule.training_step", full)
    for options in ((*TINY, "name=new"), (f"resume={trained}", "trainer.max_epochs=3")):
        done = command("train", *options)
        assert done.code == 1
        line = done.err.splitlines()[-1]
        assert line.startswith("hudepth-train: the GPU has too little memory. Pass a smaller data.batch_size=")


def test_a_run_directory_does_not_vouch_for_its_own_classes(command: Command, trained: Path, tmp_path: Path) -> None:
    stranger = tmp_path / "stranger"
    shutil.copytree(trained, stranger)
    config = yaml.safe_load((stranger / "config.yaml").read_text())
    config["trust"] = ["subprocess"]
    config["model"] = {"_target_": "subprocess.Popen", "args": ["touch", str(tmp_path / "ran")]}
    (stranger / "config.yaml").write_text(yaml.safe_dump(config))
    done = command("train", f"resume={stranger}", "trainer.max_epochs=3")
    assert done.code == 1
    assert "_target_: 'subprocess.Popen' is not under a trusted module" in done.err
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        ("+trainer.fast_dev_run=true",),
        ("+trainer.enable_progress_bar=false", "+trainer.num_sanity_val_steps=2", "trainer.log_every_n_steps=10"),
        ("+trainer.check_val_every_n_epoch=2", "callbacks=early_stopping", "trainer.max_epochs=5"),
    ],
)
def test_lightnings_own_options(options: tuple[str, ...], command: Command, tmp_path: Path) -> None:
    done = command("train", *TINY, "logger=none", "callbacks.panels=0", "baselines=false", "name=a/b", *options)
    assert done.code == 0, done.err
    if "fast_dev_run" not in options[0]:
        assert newest_run(tmp_path / "runs").parent == tmp_path / "runs" / "a" / "b"


@pytest.mark.slow
def test_a_moved_run_keeps_its_best_when_it_goes_on(command: Command, tmp_path: Path) -> None:
    options = (*TINY, "test=false", "callbacks.panels=0", "logger=none", "monitor=train/loss/total", "mode=max")
    assert command("train", *options, "name=moving").code == 0  # mode=max: the first epoch is the best
    run = only_run(tmp_path, "moving").rename(tmp_path / "moved")
    best = (run / "checkpoints" / "best.ckpt").read_bytes()
    assert read_plain(run / "checkpoints" / "best.ckpt")["epoch"] == 0
    done = command("train", f"resume={run}", "trainer.max_epochs=3")
    assert done.code == 0, done.err
    assert (run / "checkpoints" / "best.ckpt").read_bytes() == best


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("monitor=val/total", "monitor: no 'val/total'. Did you mean 'val/loss/total'?"),
        ("mode=mni", "mode: 'mni' is not one of min, max. Did you mean"),
        ("+trainer.logger=false", "trainer.logger is set by hudepth"),
        ("trainer.precision=64-true", "trainer.precision: 64-true"),
        ("trainer.max_steps=3", "no key 'trainer.max_steps'. Did you mean 'trainer.max_epochs'? See hudepth-train"),
    ],
)
def test_mistakes_are_found_before_any_work(override: str, message: str, command: Command, tmp_path: Path) -> None:
    cache = "test=false" if "monitor" in override else f"paths.cache={tmp_path / 'empty'}"
    done = command("train", *TINY, override, cache)
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith(f"hudepth-train: {message}")
    assert not list(tmp_path.glob("empty/*.h5"))
    assert "epoch 1" not in done.err


@pytest.mark.slow
def test_a_cosine_schedule_has_its_end(command: Command, tmp_path: Path) -> None:
    assert command("train", *TINY, "name=cosine", "schedule=cosine", "test=false", "callbacks.panels=0").code == 0
    done = command("train", f"resume={only_run(tmp_path, 'cosine')}", "trainer.max_epochs=4")
    assert done.code == 1
    assert (
        "resume: the learning-rate schedule of this run is laid out over 2 epochs, so trainer.max_epochs cannot"
        in done.err.splitlines()[-1]
    )


def test_a_last_checkpoint_of_another_training_is_named(command: Command, trained: Path) -> None:
    last = trained / "checkpoints" / "last.ckpt"
    content = read_plain(last)
    for state in content["optimizer_states"][0]["state"].values():
        state["exp_avg"] = torch.zeros(7)
    torch.save(content, last)
    done = command("train", f"resume={trained}", "trainer.max_epochs=3")
    assert done.code == 1
    assert f"'{last}' does not fit this training" in done.err.splitlines()[-1]
    assert status(trained)["state"] == "failed"


@pytest.mark.slow
def test_another_optimiser_of_torch(command: Command) -> None:
    """One that takes no fused update, with the options of AdamW."""
    options = (*TINY, "optim=adamw", "optim._target_=torch.optim.RAdam", "trainer.max_epochs=1", "test=false")
    assert command("train", *options).code == 0
