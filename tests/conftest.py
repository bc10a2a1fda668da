"""Set up before hudepth is imported: shapes and types of every call are checked while the tests run."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

import absl.logging
import jaxtyping
import pytest
import torch
from hypothesis import settings

# pep484_tower: an int is welcome where a float is asked for, as in any YAML file
jaxtyping.install_import_hook("hudepth", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")
torch.set_num_threads(1)
# OpenVINO imports absl, whose handler would close the standard error that pytest captures when Hydra resets logging
absl.logging.get_absl_handler().python_handler.stream = sys.__stderr__
settings.register_profile("hudepth", deadline=None, max_examples=25)  # a busy machine is no failure
settings.load_profile("hudepth")


@pytest.fixture(scope="session")
def nyu_root() -> Path:
    """Folder of the labelled NYU frames."""
    default = Path(__file__).parents[1] / ".." / "shared" / "data" / "nyu_labeled"
    root = Path(os.environ.get("HUDEPTH_NYU_ROOT", default)).resolve()
    if not root.is_dir():
        pytest.skip(f"no NYU frames in '{root}'; set HUDEPTH_NYU_ROOT to where they are")
    return root


@pytest.fixture(autouse=True)
def _own_logging(monkeypatch: pytest.MonkeyPatch) -> None:
    """Undo what a console script run in this process does to the log: other tests would see its lines twice."""
    log = logging.getLogger("hudepth")
    monkeypatch.setattr(log, "handlers", list(log.handlers))
    monkeypatch.setattr(log, "propagate", log.propagate)
