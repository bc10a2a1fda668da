"""Sweeps as processes: killed, interrupted, run side by side; they go on and end as if nothing had happened."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from hudepth.runs.sweeps import read_jobs
from tests.commands import script

from .test_sweeper import FAST, runs, states

KILLS = int(os.environ.get("HUDEPTH_KILLS", "2"))
"""How often the sweep is killed; more take longer and prove the same."""
SWEEP = ("-m", *FAST, "trainer.max_epochs=3", "loss=l1,l2", "seed=1,2")


def start(cwd: Path, cache: Path, *arguments: str) -> subprocess.Popen[str]:
    # a session of its own, so that its workers can be killed with it
    return subprocess.Popen(**script("train", *arguments, cwd=cwd, cache=cache), start_new_session=True)  # type: ignore[call-overload]


def finish(cwd: Path, cache: Path, *arguments: str) -> str:
    process = start(cwd, cache, *arguments)
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0, out
    return str(out)


def table(folder: Path) -> dict[str, Any]:
    """All numbers of a sweep, as they stand in its files."""
    found = {}
    for name, run in runs(folder).items():
        test = json.loads((run / "test" / "paper" / "metrics.json").read_text())
        images = (run / "test" / "paper" / "per_image.csv").read_text()
        found[name] = ((run / "metrics.csv").read_text(), images, test["metrics"], test["intervals"])
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """The folder of a sweep that nobody disturbed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    finish(folder, cache, *SWEEP, "sweep_dir=s")
    return folder / "s"


@pytest.mark.parametrize("launcher", ["basic", "joblib"])
@pytest.mark.slow
def test_a_sweep_that_is_killed_again_and_again_ends_with_the_same_table(
    launcher: str, undisturbed: Path, tmp_path: Path, cache: Path
) -> None:
    rng = random.Random(launcher)
    for number in range(KILLS):
        process = start(tmp_path, cache, *SWEEP, "sweep_dir=s", f"hydra/launcher={launcher}")
        wait_for(lambda least=2 * number: len(list(tmp_path.glob("s/*/metrics.csv"))) > least)
        time.sleep(rng.random())
        if rng.random() < 0.5:  # the launcher alone: what it started must end by itself
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    finish(tmp_path, cache, *SWEEP, "sweep_dir=s", f"hydra/launcher={launcher}")
    assert table(tmp_path / "s") == table(undisturbed)


def wait_for(condition: Any, *, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


@pytest.mark.slow
def test_a_kill_loses_at_most_the_epoch_that_was_running(tmp_path: Path, cache: Path) -> None:
    arguments = ("-m", *FAST, "trainer.max_epochs=500", "loss=l1", "seed=1", "sweep_dir=s")
    process = start(tmp_path, cache, *arguments)
    wait_for(lambda: [f for f in tmp_path.glob("s/*/metrics.csv") if len(f.read_text().splitlines()) > 5])
    process.kill()
    process.wait()
    (run,) = runs(tmp_path / "s").values()
    had = len((run / "metrics.csv").read_text().splitlines()) - 1
    process = start(tmp_path, cache, *arguments)
    wait_for(lambda: len((run / "metrics.csv").read_text().splitlines()) - 1 > had)
    process.kill()
    process.wait()
    assert (run / "train.log").read_text().count(f"epoch {had - 1} of 500") == 1  # was not trained again


@pytest.mark.slow
def test_ctrl_c_ends_between_two_batches_and_says_how_to_go_on(tmp_path: Path, cache: Path) -> None:
    process = start(tmp_path, cache, "-m", *FAST, "trainer.max_epochs=5000", "loss=l1,l2", "sweep_dir=s")
    wait_for(lambda: list(tmp_path.glob("s/*/metrics.csv")))
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130, out
    assert "stopping after this batch; Ctrl-C again stops at once" in out
    assert re.search(r"^sweep tried: 0 finished, 2 unfinished; in ", out, re.MULTILINE)
    assert "to resume: hudepth-train -m model=tiny" in out
    assert "Traceback" not in out
    (begun,) = tmp_path.glob("s/*/status.json")
    assert json.loads(begun.read_text())["state"] == "interrupted"


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_no_other_job(tmp_path: Path, cache: Path) -> None:
    """As when memory runs out: joblib gives up its whole pool, and what had not begun is launched anew."""
    epochs = ("trainer.max_epochs=100", "loss=l1,l2", "seed=1,2", "sweep_dir=s", "hydra/launcher=joblib")
    process = start(tmp_path, cache, "-m", *FAST, *epochs, "hydra.launcher.n_jobs=2")
    wait_for(lambda: len(list(tmp_path.glob("s/*/metrics.csv"))) == 2)
    victim = min(tmp_path.glob("s/*/status.json"))
    os.kill(json.loads(victim.read_text())["pid"], signal.SIGKILL)
    out, _ = process.communicate(timeout=300)
    assert "the launcher stopped: " in out, out
    left = [name for name, state in states(tmp_path / "s").items() if state != "finished"]
    assert 1 <= len(left) <= 2, out  # the victim, and perhaps the one whose pool went down with it
    assert f"{len(left)} unfinished" in out
    assert process.returncode == 1


@pytest.mark.parametrize("launcher", ["submitit_local", "ray"])
@pytest.mark.slow
def test_jobs_of_a_cluster(launcher: str, tmp_path: Path, cache: Path) -> None:
    if launcher == "ray":
        pytest.importorskip("hydra_plugins.hydra_ray_launcher", reason="ray is large, and no part of the dev extra")
    out = finish(tmp_path, cache, "-m", *FAST, "loss=l1,l2", "sweep_dir=s", f"hydra/launcher={launcher}")
    assert states(tmp_path / "s") == {"l1": "finished", "l2": "finished"}
    assert re.search(r"^\[1/2\] loss=l1: epoch 1 of 1, val/abs_rel 0\.\d+", out, re.MULTILINE)
    assert len({json.loads((run / "status.json").read_text())["pid"] for run in runs(tmp_path / "s").values()}) == 2
    assert read_jobs(tmp_path / "s").keys() == {"tried"}
