from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
import torch

from hudepth.base.wording import one_line


@pytest.mark.parametrize(
    ("code", "fix"),
    [
        (errno.ENOSPC, "Free some space"),
        (errno.EROFS, "folder"),
        (errno.EACCES, "folder"),
        (errno.EFBIG, "ulimit"),
        (errno.EISDIR, "Remove the folder"),
        (errno.ENAMETOOLONG, "shorter"),
    ],
)
def test_a_file_that_cannot_be_written(code: int, fix: str) -> None:
    line = one_line(OSError(code, os.strerror(code), "runs/x/metrics.json"), "test")
    assert line.startswith("'runs/x/metrics.json' cannot be written")
    assert fix in line
    assert "debug" not in line


def test_the_file_of_an_error_while_it_is_written(tmp_path: Path) -> None:
    from hudepth.base.files import written_whole

    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(OSError, match="space") as caught, written_whole(tmp_path / "a.json"):
        raise full
    assert str(tmp_path / "a.json") in one_line(caught.value, "test")
    assert not list(tmp_path.iterdir())


def test_errors_that_are_each_others_context_end() -> None:
    one, other = OSError(28, "No space left on device"), RuntimeError("at the end")
    one.__context__, other.__context__ = other, one
    assert "No space left" in one_line(one, "train")


FULL = torch.OutOfMemoryError(
    "CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total capacity of 139.80 GiB of which 3.50 GiB is "
    "free. Including non-PyTorch memory, this process has 136.00 GiB memory in use.\nSee documentation for Memory"
)


@pytest.mark.parametrize(
    ("task", "fix"),
    [
        ("train", "Pass a smaller data.batch_size=, data.on_device=false or trainer.accelerator=cpu"),
        ("test", "Pass a smaller data.batch_size= or trainer.accelerator=cpu"),
        ("predict", "Pass a smaller batch_size= or size=, or device=cpu"),
        ("demo", "Pass device=cpu"),
        ("bench", "Pass smaller batches= or device=cpu"),
    ],
)
def test_a_full_gpu(task: str, fix: str) -> None:
    rest = f"{fix}, or end what else uses the GPU (nvidia-smi lists it)."
    wrapped = RuntimeError("while training")
    wrapped.__cause__ = FULL
    for error in (FULL, wrapped):
        line = one_line(error, task)
        assert line == f"the GPU has too little memory (20.00 GiB more needed, 3.50 GiB free). {rest}"
    for text in (
        "CUDA error: out of memory\nCUDA kernel errors",
        "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling",
    ):
        assert one_line(RuntimeError(text), task) == f"the GPU has too little memory. {rest}"


def test_a_gpu_of_somebody_else() -> None:
    error = RuntimeError("CUDA error: CUDA-capable device(s) is/are busy or unavailable\nCUDA kernel errors might")
    for task, key in (("train", "trainer.accelerator=cpu"), ("predict", "device=cpu")):
        line = one_line(error, task)
        assert line == f"the GPU is taken by another program (nvidia-smi lists it). Pass {key}."
