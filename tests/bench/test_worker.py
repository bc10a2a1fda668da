"""Processes that do what they should not; the runners here are found by their dotted names, so they import nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hudepth.bench.memory import reset_peak
from hudepth.bench.worker import ContenderError, Spec, Worker, summarise_error

FAKES = """
import os, signal, time
import numpy as np
from hudepth.bench import worker

class Runner(worker.Runner):
    def __init__(self, spec):
        self.spec, self.passes = spec, 0
        print("talk")
        os.system("echo talk of a child")
    def describe(self):
        return {"flops": 5, "threads": os.environ["OMP_NUM_THREADS"]}
    def load(self, images):
        self.images = images
    def run(self):
        self.passes += 1
        todo = self.spec.options.get("todo")
        if todo == "die" and self.passes > 2:
            os.kill(os.getpid(), signal.SIGKILL)
        if todo == "raise" and self.passes > 2:
            raise RuntimeError("first line\\nsecond line")
        if todo == "hold":
            self.held = np.ones(20_000_000)
            del self.held
        time.sleep(0.001)
    def result(self):
        return self.images[:, :1] * 2

def broken(spec):
    raise ValueError("no network")
"""


@pytest.fixture
def spec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    (tmp_path / "bench_fakes.py").write_text(FAKES)
    np.save(tmp_path / "images.npy", np.arange(3 * 3 * 2 * 2, dtype=np.float32).reshape(3, 3, 2, 2))
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])  # spawned processes get it

    def make(factory: str = "bench_fakes:Runner", **options: Any) -> Spec:
        return Spec("fake", factory, tmp_path / "images.npy", 3, options)

    return make


def test_passes_are_timed_and_batches_are_the_images_over_and_over(
    spec: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with Worker(spec(), log=tmp_path / "log") as worker:
        assert worker.build() == {"flops": 5, "threads": "3"}
        begun = worker.begin(5)
        images = np.load(tmp_path / "images.npy")
        np.testing.assert_array_equal(begun.result, 2 * images[[0, 1, 2, 0, 1], :1])
        assert begun.first_pass_s >= 0.001
        assert len(worker.turn(0)) == 1
        times = worker.turn(0.02)
        assert sum(times) >= 0.02 > sum(times[:-1])
        assert 1 < worker.peak_mb() < 1000
    assert capfd.readouterr() == ("", "")
    assert "talk of a child" in (tmp_path / "log").read_text()


@pytest.mark.parametrize(
    ("factory", "options", "line"),
    [
        ("bench_fakes:broken", {}, "ValueError: no network"),
        ("bench_fakes:absent", {}, "AttributeError: module 'bench_fakes' has no attribute 'absent'"),
        ("bench_absent:any", {}, "ModuleNotFoundError: No module named 'bench_absent'"),
    ],
)
def test_what_cannot_be_built_says_why(
    spec: Any, tmp_path: Path, factory: str, options: dict[str, Any], line: str
) -> None:
    with Worker(spec(factory, **options), log=tmp_path / "log") as worker:
        with pytest.raises(ContenderError) as error:
            worker.build()
        assert str(error.value) == line


@pytest.mark.parametrize(
    ("todo", "line"),
    [("die", "its process was ended by SIGKILL (memory?)"), ("raise", "RuntimeError: first line")],
)
def test_what_ends_in_the_middle_says_why(spec: Any, tmp_path: Path, todo: str, line: str) -> None:
    with Worker(spec(todo=todo), log=tmp_path / "log") as worker:
        worker.build()
        worker.begin(1)
        with pytest.raises(ContenderError) as error:
            worker.turn(0)
        assert str(error.value) == line
        if todo == "die":  # and it goes on saying so
            with pytest.raises(ContenderError):
                worker.peak_mb()


def test_ctrl_c_is_the_parents_affair(spec: Any, tmp_path: Path) -> None:
    with Worker(spec(), log=tmp_path / "log") as worker:
        worker.build()
        pid = worker._process.pid
        assert pid
        os.kill(pid, signal.SIGINT)
        time.sleep(0.05)
        assert worker.begin(1).result.shape == (1, 1, 2, 2)
    assert not worker._process.is_alive() if worker._process._popen else True  # type: ignore[attr-defined]


@pytest.mark.skipif(not reset_peak(), reason="the peak cannot be reset on this system")
def test_memory_of_an_earlier_batch_does_not_count(spec: Any, tmp_path: Path) -> None:
    with Worker(spec(), log=tmp_path / "a") as small, Worker(spec(todo="hold"), log=tmp_path / "b") as large:
        for worker in (small, large):
            worker.build()
            worker.begin(1)
        assert 155 < large.peak_mb() - small.peak_mb() < 175  # 20 million numbers of 8 bytes


@pytest.mark.skipif(not reset_peak(), reason="the peak cannot be reset on this system")
def test_peak_is_in_megabytes() -> None:
    """In a process of its own: here other tests' memory comes and goes."""
    code = (
        "import numpy as np; from hudepth.bench.memory import peak_mb, reset_peak; reset_peak(); before = peak_mb(); "
        "held = np.ones(10_000_000); first = peak_mb() - before; del held; second = peak_mb() - before; reset_peak(); "
        "print(first, second, peak_mb() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, second, after = (float(word) for word in done.stdout.split())
    assert 70 < first < 90
    assert 70 < second < 90
    assert after < 40


def test_errors_are_one_moderate_line() -> None:
    assert summarise_error(ValueError()) == "ValueError"
    assert summarise_error(ValueError("\n \n a \nb")) == "ValueError: a"
    assert len(summarise_error(ValueError("x" * 1000))) == 200
