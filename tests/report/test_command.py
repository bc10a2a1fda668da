from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import pytest

from tests.commands import Command, script


@pytest.mark.slow
def test_figures_of_a_run(command: Command, trained: Path, tmp_path: Path) -> None:
    done = command("report", "figures", f"run={trained}", f"output={tmp_path / 'out'}", "panels=2")
    assert done.code == 0, done.err
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["curves.png", "panels.png"]
    for name in ("curves.png", "panels.png"):
        picture = cv2.imread(str(tmp_path / "out" / name))
        assert picture is not None
        assert picture.std() > 10


def test_figures_go_into_the_run_by_default(command: Command, trained: Path, tmp_path: Path) -> None:
    run = tmp_path / "runs" / "tiny" / "here"
    shutil.copytree(trained, run)
    done = command("report", "figures", "run=last", "panels=0")
    assert done.code == 0, done.err
    assert [path.name for path in (run / "figures").iterdir()] == ["curves.png"]


def test_figures_without_the_checkpoint_are_the_curves(command: Command, trained: Path, tmp_path: Path) -> None:
    study = tmp_path / "study"
    study.mkdir()
    for name in ("config.yaml", "metrics.csv"):
        shutil.copy(trained / name, study)
    done = command("report", "figures", f"run={study}")
    assert done.code == 0
    assert [path.name for path in (study / "figures").iterdir()] == ["curves.png"]
    assert "no panels: checkpoint: " in done.err + done.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], r"a verb is missing.* or figures\."),
        (["figure"], r"no verb 'figure'\. Did you mean 'figures'\?"),
        (["verb=x"], r"verb: 'x' is not one of compare, table, sweep, figures"),
        (["figures"], r"checkpoint=last: no run"),
        (["figures", "run=nowhere"], r"run: 'nowhere' .* run=last"),
        (["figures", "panels=many"], r"panels: 'many' is not a whole number"),
        (["figures", "rum=x"], r"no key 'rum'\. Did you mean 'run'\?"),
        (["table"], r"runs is not set"),
        (["table", "runs=[nowhere]"], r"no folder 'nowhere'"),
        (["table", "runs=nowhere"], r"no folder 'nowhere'"),
        (["compare", "b=."], r"a is not set\. Pass a=<run directory"),
        (["compare", "a=.", "b=.", "protocol=[paper,eigen]"], r"protocol: compare takes one, not 2"),
    ],
)
def test_mistakes(arguments: list[str], message: str, command: Command) -> None:
    done = command("report", *arguments)
    assert done.code == 1
    assert re.match(f"hudepth-report: {message}", done.err.splitlines()[-1])


@pytest.mark.slow
def test_the_installed_script_compares_two_runs_from_another_folder(trained: Path, cache: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        **script("report", "compare", f"a={trained}", f"b={trained}", "protocol=paper", cwd=tmp_path, cache=cache),
        check=False,
    )
    assert done.returncode == 0, done.stdout
    document = json.loads((tmp_path / "compare" / "compare.json").read_text())
    assert document
    assert "b - a" in done.stdout


def test_a_table_of_several_runs_says_in_what_they_differ(command: Command, trained: Path, tmp_path: Path) -> None:
    study = Path(__file__).parents[2] / "experiments" / "badcl_official"
    done = command("report", "table", f"runs=[{trained},{study}]", "protocol=[paper,eigen]")
    assert done.code == 0, done.err
    with (tmp_path / "table" / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == [
        "tiny, paper",
        "tiny, eigen",
        "badcl_official, paper",
        "badcl_official, eigen",
    ]
    assert rows[0]["protocol"] == "paper, network_size [32,48]"
    assert rows[2]["protocol"] == "paper, network_size [224,224]"
    assert rows[1]["protocol"] == rows[3]["protocol"] == "eigen"
    stated = json.loads((study / "test" / "eigen" / "metrics.json").read_text())["metrics"]["model"]
    assert float(rows[3]["rmse"]) == pytest.approx(stated["rmse"], rel=1e-6)
    assert float(rows[3]["rmse_low"]) < stated["rmse"] < float(rows[3]["rmse_high"])
    text = (tmp_path / "table" / "table.md").read_text()
    assert f"| {stated['abs_rel']:.3f} [" in text
    assert "0.224" in done.out


@pytest.mark.slow
def test_compare_shows_the_images_that_differ(command: Command, trained: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(trained, other)
    done = command("report", "compare", f"a={trained}", f"b={other}", "protocol=paper", "panels=1", "output=out")
    assert done.code == 0, done.err
    picture = cv2.imread(str(tmp_path / "out" / "images.png"))
    assert picture is not None
    assert picture.std() > 10
    (other / "checkpoints" / "best.ckpt").write_bytes(b"damaged")
    done = command("report", "compare", f"a={trained}", f"b={other}", "protocol=paper", "panels=1", "output=out2")
    assert done.code == 0, done.err
    assert not (tmp_path / "out2" / "images.png").exists()
    assert "no images.png: " in done.err + done.out


def test_compare_draws_no_images_of_other_data(command: Command, trained: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        shutil.copytree(trained, tmp_path / "runs" / name / trained.name)
        file = tmp_path / "runs" / name / trained.name / "test" / "paper" / "metrics.json"
        document = json.loads(file.read_text())
        document["data"]["fingerprint"] = "0" * 64  # other rooms, whose images have the same names
        file.write_text(json.dumps(document))
    a, b = (tmp_path / "runs" / name / trained.name for name in ("one", "two"))
    done = command("report", "compare", f"a={a}", f"b={b}", "protocol=paper")
    assert done.code == 0, done.err
    assert "no images.png: " in done.err
    assert {path.name for path in (tmp_path / "compare").iterdir()} == {"compare.json", "compare.csv", "compare.png"}


def test_a_table_leaves_out_a_damaged_run_by_name(command: Command, trained: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(trained, damaged)
    file = damaged / "test" / "paper" / "metrics.json"
    document = json.loads(file.read_text())
    document["metrics"]["model"]["rmse"] = 1e308
    file.write_text(json.dumps(document))
    done = command("report", "table", f"runs=[{trained},{damaged}]", "protocol=paper")
    assert done.code == 0, done.err
    assert f"left out: '{file}' is not a test result: its rmse is beyond" in done.err
    with (tmp_path / "table" / "table.csv").open(newline="") as table:
        assert [row["name"] for row in csv.DictReader(table)] == ["tiny"]
    done = command("report", "table", f"runs=[{damaged}]", "protocol=paper")
    assert done.code == 1
    assert str(file) in done.err.splitlines()[-1]
