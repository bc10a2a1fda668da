"""Checkpoints are written whole or not at all."""

from __future__ import annotations

import errno
import multiprocessing
import os
import resource
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from hudepth.base.errors import TrainingError
from hudepth.runs.checkpoint import read_plain
from hudepth.training.checkpointing import AtomicCheckpointIO

FULL = "the disk is full, or a file may not be so large"


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (OSError(errno.EIO, "Input/output error"), "Input/output error"),
        (RuntimeError("PytorchStreamWriter failed writing file data/3: file write failed\nframe #0: c10::Error"), FULL),
        (RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 6656 vs 6550"), FULL),
        (RuntimeError("something else\nframe #0"), "something else"),
    ],
)
def test_a_failing_write_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, why: str
) -> None:
    run = tmp_path / "run"
    path = run / "checkpoints" / "last.ckpt"
    io = AtomicCheckpointIO()
    io.save_checkpoint({"x": torch.arange(1000)}, path)
    before = path.read_bytes()

    def half(content: object, part: Path) -> None:
        part.write_bytes(before[: len(before) // 2])
        raise error

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises(TrainingError) as caught:
        io.save_checkpoint({"x": torch.arange(2000)}, path)
    assert str(caught.value) == (
        f"the checkpoint '{path}' could not be saved ({why}). The previous one is intact: "
        f"free some space, then resume with hudepth-train resume={run}"
    )
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_a_full_disk(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", disk], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"no small disk can be mounted here: {mounted.stderr.strip()}")
    try:
        path = disk / "checkpoints" / "last.ckpt"
        with pytest.raises(TrainingError, match=rf"saved \({FULL}\)\. It is the first one: free some space"):
            AtomicCheckpointIO().save_checkpoint({"x": torch.zeros(100_000)}, path)
        AtomicCheckpointIO().save_checkpoint({"x": torch.zeros(10_000)}, path)
        before = path.read_bytes()
        with pytest.raises(TrainingError, match=rf"saved \({FULL}\)\. The previous one is intact"):
            AtomicCheckpointIO().save_checkpoint({"x": torch.zeros(100_000)}, path)
        assert path.read_bytes() == before
        assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]
    finally:
        subprocess.run(["umount", disk], check=True)


def in_a_process_of_its_own(work: Callable[[], None]) -> int:
    """Run ``work`` in a fork of this process; return its exit code, negative if a signal ended it."""
    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    process.join()
    assert process.exitcode is not None
    return process.exitcode


def test_a_file_size_limit_is_a_full_disk_too(tmp_path: Path) -> None:
    """What any account can provoke: the kernel cuts a real torch.save off in the middle."""
    path, report = tmp_path / "run" / "checkpoints" / "last.ckpt", tmp_path / "report"
    AtomicCheckpointIO().save_checkpoint({"x": torch.zeros(10_000)}, path)
    before = path.read_bytes()

    def save() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
        try:
            AtomicCheckpointIO().save_checkpoint({"x": torch.zeros(100_000)}, path)
        except TrainingError as error:
            report.write_text(str(error))

    assert in_a_process_of_its_own(save) == 0
    assert report.read_text().startswith(f"the checkpoint '{path}' could not be saved (")
    assert "\n" not in report.read_text()
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_a_kill_while_writing_leaves_the_previous_one_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint({"x": torch.zeros(10_000)}, path)
    whole = torch.save

    def killed(content: object, part: Path) -> None:
        whole(content, part)
        part.write_bytes(part.read_bytes()[:-5000])
        os.kill(os.getpid(), signal.SIGKILL)

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", killed)
        code = in_a_process_of_its_own(lambda: AtomicCheckpointIO().save_checkpoint({"x": torch.ones(10_000)}, path))
    assert code == -signal.SIGKILL
    assert torch.equal(read_plain(path)["x"], torch.zeros(10_000))
    left = [file for file in tmp_path.iterdir() if file != path]
    assert [file.suffix for file in left] == [".part"]  # hidden, and no later run takes it for a checkpoint
    AtomicCheckpointIO().save_checkpoint({"x": torch.ones(10)}, path)
    assert torch.equal(read_plain(path)["x"], torch.ones(10))


def test_errors_that_are_not_the_disks_are_not_called_so(tmp_path: Path) -> None:
    with pytest.raises(AttributeError):
        AtomicCheckpointIO().save_checkpoint({"x": lambda: 0}, tmp_path / "x.ckpt")
    assert list(tmp_path.iterdir()) == []
