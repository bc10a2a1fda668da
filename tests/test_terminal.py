"""What a person sees: nothing wider than the terminal, nothing shortened, and commands that work when pasted."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from hudepth.base import tables
from hudepth.bench.report import bench_table
from hudepth.metrics.catalogue import metric_info, metric_names
from tests.bench.test_rows import rows_of
from tests.commands import TINY, Command
from tests.report.ablation.synthetic import make_sweep
from tests.terminal import WIDTHS, assert_fits, in_terminal, numbers

SIX = ("paper", "eigen", "eigen_flip", "densedepth", "guided", "raw_holes")
ROOMS = tuple(each for each in TINY if each.startswith("data."))


@pytest.fixture(params=WIDTHS)
def width(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """A width for everything that is printed in this process."""
    monkeypatch.setattr(tables, "LOG_WIDTH", request.param)
    return int(request.param)


def results(run: Path) -> dict[str, Any]:
    return {each.parent.name: json.loads(each.read_text()) for each in sorted(run.glob("test/*/metrics.json"))}


def check_results(text: str, found: dict[str, Any]) -> None:
    """Check that rows, and all values of metrics that are not said to be elsewhere, are there as a whole."""
    left_out = text.partition("metrics.json also has ")[2].partition("\n\n")[0]
    rows = {row.removeprefix("  ").partition("  ")[0].strip() for row in text.splitlines()}
    for protocol, document in found.items():
        for who, metrics in document["metrics"].items():
            assert who.replace("_", " ") in rows
            for name in metric_names("wide"):
                if not re.search(rf"\b{name}\b", left_out):
                    assert metric_info(name).format(abs(metrics[name])) in numbers(text), (protocol, who, name)
        model = document["metrics"]["model"]
        for name in ("abs_rel_aligned", "scale_sd", "rmse_pooled", *metric_names("edges", among=model)):
            assert f"{metric_info(name).label} {metric_info(name).arrow}" in rows
            assert metric_info(name).format(model[name]) in numbers(text)


def test_six_protocols_are_one_table(command: Command, trained: Path, width: int) -> None:
    done = command("test", f"checkpoint={trained}", f"protocol=[{','.join(SIX)}]", "panels=0")
    assert done.code == 0, done.err
    assert_fits(done.out, width)
    found = results(trained)
    assert set(found) == set(SIX)
    check_results(done.out, found)
    heads = [line.split()[0] for line in done.out.splitlines() if line.strip() in SIX]
    assert heads == list(SIX)
    assert done.out.count("──\n") == 2  # the table, and that of scales and edges
    assert "no 95 % intervals: 1 scene, they need 5" in done.out


def test_reports(command: Command, trained: Path, tmp_path: Path, width: int) -> None:
    command("test", f"checkpoint={trained}", "protocol=[paper,eigen]", f"output={tmp_path / 'again' / 'test'}")
    for arguments in (
        ("table", f"runs=[{trained},again]", "protocol=[paper,eigen]"),
        ("compare", f"a={trained}", "b=again"),
        ("sweep", f"dir={make_sweep(tmp_path / 'sweep', {'paper': {}, 'no_scale': {'loss.scaling': 0}}, seeds=2)}"),
    ):
        done = command("report", *arguments)
        assert done.code == 0, done.err
        assert_fits(done.out, width)
        assert "delta1" in done.out
    compared = json.loads((tmp_path / "compare" / "compare.json").read_text())
    done = command("report", "compare", f"a={trained}", "b=again")
    for name, row in compared["metrics"].items():
        (line,) = (x for x in done.out.splitlines() if x.startswith(f"{metric_info(name).label} "))
        assert f"{row['a']:.4f}" in line or f"{row['a']:.2f}" in line


def test_data(command: Command, width: int) -> None:
    for verb in ("info", "audit"):
        done = command("data", verb, *ROOMS)
        assert done.code == 0, done.err
        assert_fits(done.out, width)
    for text in ("with a training frame at most 5", "mean distance to the nearest", "unreadable pairs"):
        assert text in done.out


def test_bench(width: int, capsys: pytest.CaptureFixture[str]) -> None:
    rows = rows_of(eager=0.1, default=0.00081)
    bench_table(rows, "T").show()
    text = capsys.readouterr().out
    assert_fits(text, width)
    for row in rows:
        (line,) = (x for x in text.splitlines() if re.match(rf"\d+ +{row.contender} ", x))
        assert f"{row.peak_mb:.0f}" in line.split()


def paste(lines: list[str], cwd: Path) -> None:
    """Run lines as a shell does that they are pasted into."""
    script = "\n".join([f"PATH={Path(sys.executable).parent}:$PATH", "set -e", *lines])
    done = subprocess.run(["bash", "-c", script], cwd=cwd, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_a_training_counts_epochs_and_ends_with_what_to_do_next(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("paths.runs=my runs", "test=false", "logger=[csv,tensorboard]")
    done = in_terminal(80, "train", *TINY, *options, cwd=tmp_path, cache=cache)
    assert done.code == 0, done.out
    assert_fits(done.out, 80)
    assert "v_num" not in done.out  # Lightning would show by which name the first logger knows the run
    (run,) = (tmp_path / "my runs" / "default").iterdir()
    counted = re.findall(r"^epoch (\d) of (\d)( |:)", done.out, re.MULTILINE)
    assert {(epoch, last) for epoch, last, kind in counted if kind == " "} == {("1", "2"), ("2", "2")}  # the bar
    assert [epoch for epoch, _, kind in counted if kind == ":"] == ["1", "2"]  # the log
    best = torch.load(run / "checkpoints" / "best.ckpt", weights_only=True)["epoch"] + 1
    history = (run / "metrics.csv").read_text().splitlines()
    column = history[0].split(",").index("val/abs_rel")
    value = min(float(line.split(",")[column]) for line in history[1:])
    tail = done.out[done.out.index("best epoch") :].splitlines()
    assert tail[0] == f"best epoch: {best} of 2: val/abs_rel {value:.4f}"
    commands = [line.strip() for line in tail if line.startswith("  hudepth-")]
    assert [line.split()[0] for line in commands] == ["hudepth-test", "hudepth-predict"]
    (tmp_path / "photos").mkdir()
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(tmp_path / "photos" / "a.png")
    monkeypatch.setenv("HUDEPTH_CACHE", str(cache))
    paste(commands, tmp_path)
    assert set(results(run)) == {"paper", "eigen"}
    assert (tmp_path / "predictions" / "a_depth.png").is_file()


@pytest.mark.slow
def test_a_test_fits(trained: Path, cache: Path) -> None:
    protocols = f"protocol=[{','.join(SIX)}]"
    done = in_terminal(80, "test", f"checkpoint={trained.name}", protocols, cwd=trained.parent, cache=cache)
    assert done.code == 0, done.out
    assert_fits(done.out, 80)
    check_results(done.out, results(trained))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "arguments"),
    [
        ("data", ("audit", *ROOMS)),
        ("data", ("info", *ROOMS)),
        ("data", ("calibrate", "checkpoint={run}", *ROOMS, "data.source.seed=3")),
        ("report", ("table", "runs=[{run}]", "protocol=[paper,eigen]")),
        ("report", ("compare", "a={run}", "b={run}")),
        ("predict", ("checkpoint={run}", "input={run}/images")),
        ("export", ("checkpoint={run}", "format=[onnx,int8,bundle]", "calibration=8", "compared=2")),
        ("bench", ("model=tiny", "size=[32,48]", "backends=[default]", "batches=[1]", "repeats=1", "seconds=0.01")),
        ("demo", ("checkpoint=nowhere",)),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_every_command_fits_80_columns(
    task: str, arguments: tuple[str, ...], trained: Path, tmp_path: Path, cache: Path
) -> None:
    named = (each.replace("{run}", str(trained)) for each in arguments)
    done = in_terminal(80, task, *named, cwd=tmp_path, cache=cache)
    assert done.code == (1 if task == "demo" else 0), done.out
    assert_fits(done.out, 80)
