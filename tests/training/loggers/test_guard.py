from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from hudepth.base.console import log
from hudepth.training.loggers.guard import drop_on_failure, is_dropped


class Full(CSVLogger):
    calls = 0

    def log_metrics(self, metrics: Any, step: int | None = None) -> None:
        Full.calls += 1
        raise OSError(28, "No space left on device")


def test_a_logger_that_fails_is_dropped_with_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    logger = drop_on_failure(Full(tmp_path))
    with caplog.at_level(logging.WARNING, logger=log.name):
        log.propagate = True
        for step in range(3):
            logger.log_metrics({"a": 1.0}, step)
        logger.finalize("success")
    assert Full.calls == 1
    assert is_dropped(logger)
    (warning,) = caplog.messages
    assert "No space left on device" in warning


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_tensorboard_on_a_full_disk_is_dropped(tmp_path: Path) -> None:
    logger = TensorBoardLogger(tmp_path, name="", version="")
    writer = logger.experiment.file_writer.event_writer  # type: ignore[attr-defined]
    writer._general_file_writer.filename = writer._file_name = "/dev/full"
    drop_on_failure(logger)
    for step in range(2000):
        logger.log_metrics({"a": 1.0}, step)
        if is_dropped(logger):
            break
    logger.save()
    logger.finalize("failed")
    assert is_dropped(logger)
