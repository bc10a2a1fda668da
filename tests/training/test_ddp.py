"""One run over several processes beside the same run in one."""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from hudepth.runs.checkpoint import read_plain
from tests.commands import TINY, Command, script

NET = '''
import torch
from torch import nn


class NoNorm(nn.Module):
    """TinyUNet without batch norm, whose statistics are those of each process's share of a batch."""

    def __init__(self, *, channels=8):
        super().__init__()
        self.encode = nn.Conv2d(3, channels, 16, stride=16)
        self.decode = nn.ConvTranspose2d(channels, 1, 16, stride=16)

    def forward(self, image):
        return torch.sigmoid(self.decode(nn.functional.gelu(self.encode(image))))
'''

NO_NORM = ("model._target_=no_norm.NoNorm", "trust=[no_norm]")
TWO = ("trainer.devices=2", "trainer.strategy=ddp")
# 30 pairs: 16 train in steps of 4, and 7 (an odd number) or 3 (fewer than a batch) validate.
PAIRS = ("data.source.scenes=6", "data.source.frames_per_scene=5", "data.split=random", "optim.lr=1e-3")
SEVEN, THREE = "data.fractions=[0.54,0.24,0.22]", "data.fractions=[0.54,0.1,0.36]"


@pytest.fixture
def no_norm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "no_norm.py").write_text(NET)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


def run(task: str, *arguments: str, folder: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    command = script(task, *arguments, cwd=folder, cache=cache)
    return subprocess.run(**command, check=False, timeout=240)  # type: ignore[call-overload, no-any-return]


def trained(name: str, *arguments: str, folder: Path, cache: Path) -> Path:
    done = run("train", *TINY, *PAIRS, f"name={name}", *arguments, folder=folder, cache=cache)
    assert done.returncode == 0, done.stdout
    (made,) = (folder / "runs" / name).iterdir()
    return made


def history(path: Path) -> list[dict[str, float]]:
    with (path / "metrics.csv").open() as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def results(path: Path) -> dict[str, Any]:
    return {file.parent.name: json.loads(file.read_text()) for file in sorted(path.glob("test*/*/metrics.json"))}


def assert_same_metrics(one: Path, two: Path) -> None:
    rows = history(one), history(two)
    assert len(rows[0]) == len(rows[1]) > 1
    for a, b in zip(*rows, strict=True):
        assert len(a) > 20
        assert b == pytest.approx(a, rel=1e-5, abs=1e-5)
    tested = results(one), results(two)
    assert tested[0].keys() == tested[1].keys() == {"paper", "eigen"}
    for protocol, result in tested[0].items():
        assert tested[1][protocol]["images"] == result["images"]
        for predictor, metrics in result["metrics"].items():
            other = tested[1][protocol]["metrics"][predictor]
            assert other == pytest.approx(metrics, rel=1e-5, abs=1e-5, nan_ok=True), (protocol, predictor)


@pytest.mark.parametrize("fractions", [SEVEN, THREE], ids=["7 to validate", "3 to validate"])
@pytest.mark.usefixtures("no_norm")
@pytest.mark.slow
def test_two_processes_give_the_metrics_of_one(fractions: str, tmp_path: Path, cache: Path) -> None:
    """Each with half the batch: the same pairs a step, the same history, the same test, all of it once."""
    options = (*NO_NORM, fractions)
    one = trained("one", *options, "data.batch_size=4", folder=tmp_path, cache=cache)
    two = trained("two", *options, "data.batch_size=2", *TWO, folder=tmp_path, cache=cache)
    assert_same_metrics(one, two)
    assert json.loads((two / "status.json").read_text())["state"] == "finished"
    assert [row["step"] for row in history(two)] == [4, 8]
    assert (two / "train.log").read_text().count("epoch 2 of 2") == 1


@pytest.mark.slow
def test_a_run_of_two_processes_goes_on_as_if_never_stopped(tmp_path: Path, cache: Path) -> None:
    """With batch norm, whose statistics each process gathers by itself and all take from the first."""
    options = (SEVEN, *TWO, "test=false", "callbacks.panels=0", "logger=none")
    whole = trained("whole", *options, "trainer.max_epochs=3", folder=tmp_path, cache=cache)
    stopped = trained("stopped", *options, folder=tmp_path, cache=cache)
    done = run("train", f"resume={stopped}", "trainer.max_epochs=3", folder=tmp_path, cache=cache)
    assert done.returncode == 0, done.stdout
    assert (stopped / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    ours, theirs = (read_plain(path / "checkpoints" / "last.ckpt")["state_dict"] for path in (stopped, whole))
    assert ours.keys() == theirs.keys()
    assert all(bool((ours[name] == theirs[name]).all()) for name in ours)


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGTERM between processes")
@pytest.mark.parametrize("to_all", [True, False], ids=["to both", "to the first"])
@pytest.mark.slow
def test_two_processes_end_together_when_asked_to(to_all: bool, tmp_path: Path, cache: Path) -> None:
    options = (SEVEN, *TWO, "test=false", "callbacks.panels=0", "logger=none", "trainer.max_epochs=1000", "name=asked")
    command = script("train", *TINY, *PAIRS, *options, cwd=tmp_path, cache=cache)
    process = subprocess.Popen(**command, start_new_session=True)  # type: ignore[call-overload]
    while not list(tmp_path.glob("runs/asked/*/checkpoints/last.ckpt")):
        assert process.poll() is None
        time.sleep(0.05)
    (os.killpg if to_all else os.kill)(process.pid, signal.SIGTERM)
    out, _ = process.communicate(timeout=60)  # until both have closed their output
    (made,) = (tmp_path / "runs" / "asked").iterdir()
    assert process.returncode == 130
    assert out.splitlines()[-1] == f"interrupted; resume with: hudepth-train resume={made}"
    assert json.loads((made / "status.json").read_text())["state"] == "interrupted"


@pytest.mark.slow
def test_two_processes_test_as_one_does(trained: Path, tmp_path: Path, cache: Path) -> None:
    """Not a digit differs: rows of images are gathered, and all is computed from them."""
    for name, more in (("test_one", ()), ("test_two", ("trainer.devices=2",))):
        options = (f"checkpoint={trained}", f"output={tmp_path / name}", "trainer.accelerator=cpu", "panels=0", *more)
        done = run("test", *options, folder=tmp_path, cache=cache)
        assert done.returncode == 0, done.stdout
    for protocol in ("paper", "eigen"):
        for file in ("metrics.json", "per_image.csv"):
            one, two = ((tmp_path / name / protocol / file).read_text() for name in ("test_one", "test_two"))
            assert one == two


def test_more_processes_than_pairs_give_one_line(command: Command, trained: Path) -> None:
    small = ("data.split=random", "data.fractions=[0.8,0.1,0.1]", "trainer.devices=2")  # 9, 1 and 2 of 12
    done = command("train", *TINY, *small)
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        "hudepth-train: trainer.devices: the validation subset has 1 pair for 2 processes, each of which needs one. "
        "Pass trainer.devices=1."
    )
    done = command("test", f"checkpoint={trained}", "trainer.accelerator=cpu", "trainer.devices=3")
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        "hudepth-test: trainer.devices: the test subset has 2 pairs for 3 processes, each of which needs one. "
        "Pass trainer.devices=2."
    )


def torchrun(*arguments: str, folder: Path, cache: Path, node: Sequence[str]) -> subprocess.Popen[str]:
    """hudepth-train in processes that PyTorch's launcher starts, as on a cluster."""
    command = script("train", *arguments, cwd=folder, cache=cache)
    launcher = [sys.executable, "-m", "torch.distributed.run", *node, "--no-python"]
    return subprocess.Popen(**{**command, "args": [*launcher, *command["args"]]})  # type: ignore[call-overload, misc]


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@pytest.mark.slow
def test_processes_of_torchrun_share_one_run_and_have_its_history(no_norm: None, tmp_path: Path, cache: Path) -> None:
    options = (*TINY, *PAIRS, *NO_NORM, SEVEN, "test=false")
    alone = trained("alone", *NO_NORM, SEVEN, "data.batch_size=4", "test=false", folder=tmp_path, cache=cache)
    process = torchrun(
        *options, *TWO, "name=launched", folder=tmp_path, cache=cache,
        node=["--nproc-per-node=2", f"--master-port={free_port()}"],
    )  # fmt: skip
    out, _ = process.communicate(timeout=240)
    assert process.returncode == 0, out
    (launched,) = (tmp_path / "runs" / "launched").iterdir()
    assert [row.keys() for row in history(launched)] == [row.keys() for row in history(alone)]
    for ours, theirs in zip(history(launched), history(alone), strict=True):
        assert ours == pytest.approx(theirs, rel=1e-5)


@pytest.mark.slow
def test_two_machines_share_one_run(no_norm: None, tmp_path: Path, cache: Path) -> None:
    """Two launchers that know each other by address, as on two machines: here they are both this one."""
    options = (*TINY, *PAIRS, *NO_NORM, SEVEN, "name=machines", "protocol=paper", "baselines=false")
    count = ("trainer.devices=1", "trainer.num_nodes=2", "trainer.strategy=ddp")
    port = free_port()
    nodes = [
        torchrun(
            *options, *count, folder=tmp_path, cache=cache,
            node=["--nnodes=2", f"--node-rank={rank}", "--nproc-per-node=1", f"--master-port={port}",
                  "--master-addr=127.0.0.1"],
        )
        for rank in (0, 1)
    ]  # fmt: skip
    outs = [node.communicate(timeout=240)[0] for node in nodes]
    assert [node.returncode for node in nodes] == [0, 0], outs
    (run,) = (tmp_path / "runs" / "machines").iterdir()
    assert json.loads((run / "status.json").read_text())["state"] == "finished"
    assert len(history(run)) == 2
    assert (run / "test" / "paper" / "metrics.json").is_file()


@pytest.mark.slow
def test_launched_processes_must_be_as_many_as_asked_for(tmp_path: Path, cache: Path) -> None:
    process = torchrun(
        *TINY, "test=false", folder=tmp_path, cache=cache,
        node=["--nproc-per-node=2", f"--master-port={free_port()}"],
    )  # fmt: skip
    out, _ = process.communicate(timeout=240)
    assert process.returncode != 0
    assert (
        "hudepth-train: trainer.devices=1 trainer.num_nodes=1: that is 1 processes, but 2 were launched together. "
        "Pass trainer.devices=<processes of each machine> trainer.num_nodes=<machines>."
    ) in out
