"""A report to write down and to draw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hudepth.report.ablation.report import Report, make_report
from hudepth.report.ablation.rows import sort_runs
from hudepth.runs.sweeps import Sweep, read_sweep
from tests.report.ablation.synthetic import image_table, make_run, make_sweep

VARIANTS: dict[str, dict[str, Any]] = {
    "paper": {},
    "no_smooth": {"loss.smoothness": 0},
    "no_scale": {"loss.scaling": 0},
    "neither": {"loss.smoothness": 0, "loss.scaling": 0},
    "si|log & <b>": {"loss": {"_target_": "hudepth.losses.baselines.SILog", "factor": 10.0}},
}


def worked_out(folder: Path, **options: Any) -> Report:
    """Read a folder and work out its table."""
    return make_report(sort_runs(read_sweep(folder), "eigen"), protocol="eigen", **{"repeats": 200, **options})


@pytest.fixture(scope="session")
def sweep_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of five rows with three seeds, one of which failed. Not to be written to."""
    folder = make_sweep(tmp_path_factory.mktemp("lab") / "sweep", VARIANTS, seeds=3, step=0.01)
    make_run(folder / "z_failed", seed=4, state="failed", error="loss is <nan> & more", table=image_table())
    return folder


@pytest.fixture(scope="session")
def sweep(sweep_folder: Path) -> Sweep:
    """See :func:`sweep_folder`."""
    return read_sweep(sweep_folder)


@pytest.fixture(scope="session")
def report(sweep_folder: Path) -> Report:
    """See :func:`sweep_folder`."""
    return worked_out(sweep_folder)
