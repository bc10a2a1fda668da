"""docs/extending.md, step by step, from outside the package."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
PAGE = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run directory that the page's command leaves."""
    folder = tmp_path_factory.mktemp("extending")
    (folder / "my_depth.py").write_text("\n".join(blocks("python")))
    for text in blocks("yaml"):
        place = folder / text.splitlines()[0].removeprefix("# ")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text)
    (command,) = blocks("bash")
    script, *words = shlex.split(command)
    environment = {**os.environ, "PYTHONPATH": str(folder), "HUDEPTH_CACHE": str(folder / "cache")}
    words += ["trainer.accelerator=cpu", "logger=none", "callbacks.panels=0"]
    done = subprocess.run(
        [str(Path(sys.executable).parent / script), *words],
        cwd=folder, env=environment, text=True, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (path,) = (folder / "runs" / "default").iterdir()
    return path


def test_the_loss_is_logged(run: Path) -> None:
    with (run / "metrics.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert 0 < float(row["train/loss/log_cosh"]) < 1
    assert row["val/loss/log_cosh"] == row["val/loss/total"]


def test_the_metric_is_measured(run: Path) -> None:
    with (run / "metrics.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert float(row["val/bias"])
    metrics = json.loads((run / "test" / "eigen" / "metrics.json").read_text())["metrics"]
    assert abs(metrics["model"]["bias"]) <= metrics["model"]["mae"]
    with (run / "test" / "eigen" / "per_image.csv").open() as file:
        assert all("bias" in row for row in csv.DictReader(file))


def test_the_data_set_is_read(run: Path) -> None:
    split = json.loads((run / "split.json").read_text())
    assert "staircase" in (run / "config.yaml").read_text().lower()
    assert split["kind"] == "random"
