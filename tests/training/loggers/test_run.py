"""What a training logs is read back from the files of each service and compared with those of the run directory."""

from __future__ import annotations

import csv
import json
import math
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hudepth.runs.identity import flat
from tests.commands import TINY, script
from tests.training.loggers.readers import (
    Logged,
    read_comet,
    read_csv,
    read_mlflow,
    read_tensorboard,
    read_wandb,
    rgb,
)  # fmt: skip

KINDS = ("tensorboard", "csv", "wandb", "mlflow", "comet")
FAST = (
    *TINY, "data.fractions=[0.6,0.2,0.2]", "data.split=random", "baselines=false", "trainer.log_every_n_steps=2",
    "optim=adamw_grouped", "schedule=warmup_cosine", "callbacks=ema", "protocol=paper",
)  # fmt: skip
OFFLINE = ("logger.wandb.offline=true", "logger.comet.offline=true")
STEPS = 4  # of an epoch: 7 pairs in batches of two
LOSSES = ("total", "boundary", "smoothness", "scaling")


def train(*arguments: str, folder: Path, cache: Path, code: int = 0, **environment: str) -> str:
    """Run the console script as a user without accounts does; return what it printed."""
    options: Any = script("train", *arguments, cwd=folder, cache=cache)
    foreign = ("WANDB_", "MLFLOW_", "COMET_")
    inherited = {key: value for key, value in options["env"].items() if not key.startswith(foreign)}
    options["env"] = {**inherited, "HOME": str(folder), **environment}
    done = subprocess.run(**options, stdin=subprocess.DEVNULL)
    assert done.returncode == code, done.stdout
    return str(done.stdout)


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> tuple[Path, str]:
    """A run with all loggers, and what it printed."""
    folder = tmp_path_factory.mktemp("logged")
    out = train(*FAST, *OFFLINE, f"logger=[{','.join(KINDS)}]", "name=all", folder=folder, cache=cache)
    (run,) = (folder / "runs" / "all").iterdir()
    return run, out


def read(kind: str, run: Path) -> Logged:
    if kind == "mlflow":
        return read_mlflow(
            f"sqlite:///{run.parents[1]}/mlflow.db", json.loads((run / "loggers.json").read_text())[kind]
        )
    return {"tensorboard": read_tensorboard, "csv": read_csv, "wandb": read_wandb, "comet": read_comet}[kind](run)


def ids(run: Path) -> dict[str, str]:
    return dict(json.loads((run / "loggers.json").read_text()))


def rows(file: Path) -> list[dict[str, float]]:
    with file.open() as text:
        return [{name: float(value) for name, value in row.items() if value} for row in csv.DictReader(text)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_curves_are_those_of_the_history(kind: str, logged: tuple[Path, str]) -> None:
    curves = read(kind, logged[0]).curves
    for epoch, row in enumerate(rows(logged[0] / "metrics.csv")):
        names = [name for name in row if name not in ("epoch", "step")]
        assert {name.split("/")[0] for name in names} == {"train", "val"}
        for name in names:
            assert len(curves[name]) == 2, name
            assert sorted(curves[name].items())[epoch][1] == pytest.approx(row[name], rel=1e-6), name


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_losses_between_epochs_are_means_over_the_steps(kind: str, logged: tuple[Path, str]) -> None:
    """Two values of two batches each, of four and of three images: their weighted mean is the epoch's."""
    curves = read(kind, logged[0]).curves
    for epoch, row in enumerate(rows(logged[0] / "metrics.csv")):
        for term in LOSSES:
            values = curves[f"train/loss/{term}_step"]
            assert sorted(values) == [2, 4, 6, 8]
            two = [values[epoch * STEPS + step] for step in (2, 4)]
            assert np.average(two, weights=[4, 3]) == pytest.approx(row[f"train/loss/{term}"], rel=1e-5)
            assert two[0] != two[1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_learning_rate_is_that_of_the_step(kind: str, logged: tuple[Path, str]) -> None:
    """Warm-up over 5 % of eight steps is over after the first; then half a cosine down to a hundredth."""
    curves, config = read(kind, logged[0]).curves, yaml.safe_load((logged[0] / "config.yaml").read_text())
    highest, warmup, final = config["optim"]["lr"], config["schedule"]["warmup"], config["schedule"]["final"]
    for step in (2, 4, 6, 8):
        done = (step / 8 - warmup) / (1 - warmup)
        expected = highest * (final + (1 - final) * (1 + math.cos(math.pi * done)) / 2)
        assert curves["lr/rest"][step] == pytest.approx(expected, rel=1e-5)
        assert curves["lr/rest_no_decay"][step] == curves["lr/rest"][step]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_test_metrics_are_those_of_the_file(kind: str, logged: tuple[Path, str]) -> None:
    curves = read(kind, logged[0]).curves
    metrics = json.loads((logged[0] / "test" / "paper" / "metrics.json").read_text())["metrics"]["model"]
    found = {name.removeprefix("test/paper/"): x for name, x in curves.items() if name.startswith("test/")}
    assert found.keys() == {name for name, value in metrics.items() if value is not None}
    for name, values in found.items():
        assert list(values.values()) == [pytest.approx(metrics[name], rel=1e-6)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_hyperparameters_are_the_configuration(kind: str, logged: tuple[Path, str]) -> None:
    parameters = read(kind, logged[0]).parameters
    config = yaml.safe_load((logged[0] / "config.yaml").read_text())
    for key, value in flat({part: config[part] for part in ("optim", "loss", "model", "seed", "data")}).items():
        if isinstance(value, bool | list) or value is None:
            assert parameters[key] in (value, json.dumps(value), str(value)), key
        elif isinstance(value, int | float):
            assert float(parameters[key]) == pytest.approx(value), key
        else:
            assert parameters[key] == value
    assert not [key for key in parameters if key.startswith(("logger", "protocol", "hp_metric"))]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "csv"])
def test_pictures_are_those_of_the_folder(kind: str, logged: tuple[Path, str]) -> None:
    pictures = read(kind, logged[0]).pictures
    assert list(pictures) == ["val/panels"]
    files = [rgb((logged[0] / "images" / f"epoch_{epoch:03d}.png").read_bytes()) for epoch in (1, 2)]
    assert len(pictures["val/panels"]) == 2
    for file in files:
        assert any(np.array_equal(file, picture) for picture in pictures["val/panels"])


@pytest.mark.slow
def test_one_line_says_where_each_service_has_the_run(logged: tuple[Path, str]) -> None:
    run, out = logged
    lines = out.splitlines()
    (upload,) = (run / "wandb").glob("offline-run-*")
    (archive,) = run.glob("*.zip")
    assert f"wandb: upload with wandb sync {upload}" in lines
    assert (
        f"mlflow: mlflow ui --backend-store-uri sqlite:///{run.parents[1]}/mlflow.db, run {ids(run)['mlflow']}" in lines
    )
    assert f"comet: upload with comet upload {run}/{ids(run)['comet']}*.zip" in lines
    assert archive.name.startswith(ids(run)["comet"])
    chatter = [line for line in lines if any(word in line for word in ("wandb", "mlflow", "comet", "COMET", "WARN"))]
    assert len(chatter) == 3, chatter
    assert sorted(path.name for path in run.parents[2].iterdir() if path.name[0] != ".") == ["runs"]
    assert not os.path.lexists(run.parents[2] / "mlruns")


@pytest.mark.slow
def test_services_know_the_run_by_its_name(logged: tuple[Path, str]) -> None:
    name = f"all/{logged[0].name}"
    wandb, mlflow, comet = (read(kind, logged[0]).about for kind in ("wandb", "mlflow", "comet"))
    assert (wandb["name"], wandb["project"], wandb["group"], wandb["exit"]) == (name, "hudepth", "", 0)
    assert (mlflow["mlflow.runName"], mlflow["experiment"], mlflow["status"]) == (name, "hudepth", "FINISHED")
    assert comet["project_name"] == "hudepth"
