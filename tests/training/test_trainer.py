from __future__ import annotations

import subprocess
import sys
from typing import Any
from unittest.mock import Mock

import pytest
from lightning.pytorch import Trainer

from hudepth.base.errors import TrainingError
from hudepth.training.callbacks import Interrupt
from hudepth.training.trainer import one_ending

LOST = "[gloo/transport/tcp/pair.cc:553] Connection closed by peer [127.0.0.1]:50861."


def trainer_of(processes: list[subprocess.Popen[bytes]], *, asked: bool = False) -> Any:
    """Return what one_ending looks at; the real thing is in test_ddp.py."""
    interrupt = Interrupt()
    interrupt.asked = asked
    trainer = Mock(spec=Trainer, world_size=2, default_root_dir="runs/x", callbacks=[interrupt])
    trainer.strategy.launcher.procs = processes
    return trainer


def sleeping() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"])


def fails(trainer: Any, error: BaseException) -> None:
    with one_ending(trainer):
        raise error


def test_an_error_ends_the_other_processes() -> None:
    with sleeping() as process:
        others = [process]
        with pytest.raises(OSError, match="No space"):
            fails(trainer_of(others), OSError(28, "No space left on device"))
        assert process.wait(20) != 0
        assert others == []  # Lightning watches this list, and would kill this process for that exit code


def test_an_end_without_an_error_leaves_the_others_alone() -> None:
    with sleeping() as process:
        others = [process]
        with one_ending(trainer_of(others)):
            pass
        assert process.poll() is None
        process.kill()


@pytest.mark.parametrize(
    ("asked", "error", "kind"),
    [
        (True, RuntimeError(LOST), KeyboardInterrupt),
        (True, RuntimeError("DataLoader worker (pid 7) is killed by signal: Terminated."), KeyboardInterrupt),
        (False, RuntimeError(LOST), TrainingError),
        (False, RuntimeError("mat1 and mat2 shapes cannot be multiplied"), RuntimeError),
    ],
)
def test_what_a_lost_process_means(asked: bool, error: Exception, kind: type[BaseException]) -> None:
    with pytest.raises(kind) as caught:
        fails(trainer_of([], asked=asked), error)
    if kind is TrainingError:
        assert "another of the 2 processes" in str(caught.value)
        assert "resume=runs/x" in str(caught.value)
