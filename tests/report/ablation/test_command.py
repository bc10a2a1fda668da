from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import pytest

from tests.commands import Command
from tests.report.ablation.synthetic import image_table, make_run, make_sweep, write_sweep

VARIANTS: dict[str, dict[str, Any]] = {
    "paper": {},
    "no_smooth": {"loss.smoothness": 0},
    "no_scale": {"loss.scaling": 0},
    "neither": {"loss.smoothness": 0, "loss.scaling": 0},
}
TABLES = {"table.csv", "table.md", "table.tex", "document.json", "report.html"}


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    return make_sweep(tmp_path / "sweep", VARIANTS, seeds=2)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_sweep_becomes_tables_pictures_and_a_page(command: Command, sweep: Path) -> None:
    (sweep / "report").mkdir()
    (sweep / "report" / "cost.png").write_bytes(b"of an earlier report, to be removed")
    done = command("report", "sweep", "dir=sweep")
    assert done.code == 0, done.err
    assert names(sweep / "report") == TABLES | {"effects.png", "curves.png", "heatmap.png"}
    for name in ("effects.png", "curves.png", "heatmap.png"):
        picture = cv2.imread(str(sweep / "report" / name))
        assert picture is not None
        assert picture.std() > 10
    assert "eigen protocol, 24 test images (8 scenes) of rooms, official split; 2 seeds" in done.out
    assert "paper (reference)" in done.out
    assert "no panels.png: no run has its checkpoint" in done.err
    html = (sweep / "report" / "report.html").read_text()
    assert "<h1>Sweep losses</h1>" in html
    assert html.count("data:image/png;base64,") == 3


@pytest.mark.slow
def test_its_own_report_is_no_foreign_folder(command: Command, sweep: Path) -> None:
    command("report", "sweep", "dir=sweep", "panels=0")
    (sweep / "foreign").mkdir()
    done = command("report", "sweep", "dir=sweep", "panels=0")
    assert done.code == 0
    assert [line for line in done.err.splitlines() if line.startswith("skipped")] == [
        line for line in done.err.splitlines() if "sweep/foreign'" in line
    ]
    assert len(json.loads((sweep / "report" / "document.json").read_text())["notes"]) == 1
    assert names(sweep) >= {"foreign", "report", "paper_s1"}


@pytest.mark.slow
def test_reference_output_and_another_sweep_of_the_folder(command: Command, sweep: Path, tmp_path: Path) -> None:
    make_run(sweep / "late", changes={"optim.lr": 1}, table=image_table())
    text = (sweep / "sweep.yaml").read_text()
    write_sweep(sweep, [{"labels": {"variant": "late", "seed": "1"}, "run": "late"}], name="second")
    (sweep / "sweep.yaml").write_text(text + (sweep / "sweep.yaml").read_text().removeprefix("sweeps:\n"))
    done = command("report", "sweep", "dir=sweep", "name=losses", "reference=no_scale", f"output={tmp_path / 'out'}")
    assert done.code == 0, done.err
    with (tmp_path / "out" / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["row"] for row in rows] == list(VARIANTS)
    assert [row["reference"] for row in rows] == ["false", "false", "true", "false"]
    assert not (sweep / "report").exists()


@pytest.mark.slow
def test_cost_is_drawn_where_networks_differ(command: Command, tmp_path: Path) -> None:
    sizes: dict[str, dict[str, Any]] = {"small": {}, "large": {"data.size": [64, 96]}}
    make_sweep(tmp_path / "sweep", sizes, seeds=2)
    done = command("report", "sweep", "dir=sweep", "panels=0")
    assert done.code == 0, done.err
    assert "cost.png" in names(tmp_path / "sweep" / "report")


def test_a_network_that_cannot_be_built_has_no_cost(command: Command, tmp_path: Path) -> None:
    models: dict[str, dict[str, Any]] = {"a": {}, "b": {"model": {"_target_": "os.system"}}}
    make_sweep(tmp_path / "sweep", models, seeds=1)
    done = command("report", "sweep", "dir=sweep", "panels=0")
    assert done.code == 0, done.err
    assert "no cost.png: _target_: 'os.system' is not under a trusted module" in done.err
    assert "cost.png" not in names(tmp_path / "sweep" / "report")


@pytest.mark.slow
def test_predictions_of_real_runs(command: Command, trained: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(trained, tmp_path / "sweep" / name)
    config = tmp_path / "sweep" / "b" / "config.yaml"
    config.write_text(config.read_text().replace("max_epochs: 2", "max_epochs: 3"))
    done = command("report", "sweep", "dir=sweep", "protocol=paper", "panels=2")
    assert done.code == 0, done.err
    picture = cv2.imread(str(tmp_path / "sweep" / "report" / "panels.png"))
    assert picture is not None
    assert picture.std() > 10
    (tmp_path / "sweep" / "b" / "checkpoints" / "best.ckpt").write_bytes(b"damaged")
    done = command("report", "sweep", "dir=sweep", "protocol=paper", "panels=2")
    assert done.code == 0, done.err
    assert "not in panels.png: 'max_epochs=3': " in done.err


def test_without_a_result_each_run_says_why(command: Command, tmp_path: Path) -> None:
    make_run(tmp_path / "sweep" / "x", state="failed", error="loss is nan")
    done = command("report", "sweep", "dir=sweep")
    assert done.code == 1
    first, last = done.err.splitlines()
    assert re.match(r"'x' .*failed: loss is nan", first)
    assert re.match(r"hudepth-report: no run .*protocol 'eigen'", last)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], r"dir is not set"),
        (["dir=nowhere"], r"dir: .*'nowhere'"),
        (["dir=."], r"dir: '\.' .*run"),
        (["dir=sweep", "name=loses"], r"name: .*'loses'.* Did you mean 'losses'\?"),
        (["dir=sweep", "reference=papr"], r"reference: no row 'papr'\. Did you mean 'paper'\?"),
        (["dir=sweep", "protocol=[paper,eigen]"], r"protocol: sweep takes one, not 2"),
        (["dir=sweep", "repeats=5"], r"repeats: 5 "),
        (["dir=sweep", "output=sweep/sweep.yaml"], r"output: .*'sweep/sweep.yaml'"),
    ],
)
def test_mistakes(arguments: list[str], message: str, command: Command, sweep: Path) -> None:
    done = command("report", "sweep", *arguments)
    assert done.code == 1
    assert re.match(f"hudepth-report: {message}", done.err.splitlines()[-1])
