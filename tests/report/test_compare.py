from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hudepth.base.errors import ConfigError, DataError
from hudepth.base.options import parse
from hudepth.metrics.bootstrap import Difference, paired_differences
from hudepth.metrics.summary import ImageTable, per_image_csv, summarise
from hudepth.report.compare import CompareOptions, compare, differing, verdict
from hudepth.runs.results import find_result

STUDY = Path(__file__).parents[2] / "experiments" / "badcl_official"


def save(run: Path, change: Callable[[ImageTable], ImageTable]) -> Path:
    """Write the published result, changed, as that of another run."""
    result = find_result(STUDY, "eigen")
    table = change(result.table)
    folder = run / "test" / "eigen"
    folder.mkdir(parents=True)
    metrics = {k: v if math.isfinite(v) else None for k, v in summarise(table, averaging="image").items()}
    document = {**result.document, "metrics": {"model": metrics}}
    (folder / "metrics.json").write_text(json.dumps(document))
    (folder / "per_image.csv").write_text(per_image_csv(table))
    return run


def better(table: ImageTable) -> ImageTable:
    """Return a table of 10 % smaller abs_rel and larger delta1, unsettled rmse and the rest as it was."""
    rng = np.random.default_rng(0)
    spread = rng.normal(1, 0.1, len(table.ids))
    values = dict(table.values)
    values["abs_rel"] = values["abs_rel"] * (spread - 0.1)
    values["delta1"] = 1 - (1 - values["delta1"]) * 0.9
    values["rmse"] = values["rmse"] * spread
    return replace(table, values=values)


@pytest.fixture
def other(tmp_path: Path) -> Path:
    return save(tmp_path / "runs" / "other", better)


def run_compare(output: Path, a: Path, b: Path, **options: Any) -> dict[str, Any]:
    compare(CompareOptions(a, b, output=output, repeats=500, **options))
    document = json.loads((output / "compare.json").read_text())
    assert isinstance(document, dict)
    return document


def test_document(tmp_path: Path, other: Path) -> None:
    document = run_compare(tmp_path / "out", STUDY, other)
    a, b = find_result(STUDY, "eigen"), find_result(other, "eigen")
    assert document["a"]["path"] == str(a.path)
    assert document["b"]["checkpoint"]["epoch"] == 13
    assert document["images"] == 654
    assert document["protocol"] == a.stamp
    assert document["data"] == a.data
    assert document["uncertainty"] == {
        "method": "expanded percentile bootstrap by scene",
        "level": 0.95,
        "repeats": 500,
        "seed": 0,
        "scenes": 215,
    }
    expected = paired_differences(a.table, b.table, averaging="image", repeats=500, seed=0)
    assert list(document["metrics"]) == [name for name in expected if name in a.metrics]
    for name, row in document["metrics"].items():
        assert (row["a"], row["b"]) == (a.metrics[name], b.metrics[name])
        assert (row["difference"], row["low"], row["high"]) == (
            expected[name].value,
            expected[name].low,
            expected[name].high,
        )
    verdicts = {name: row["verdict"] for name, row in document["metrics"].items()}
    assert verdicts == {
        **dict.fromkeys(document["metrics"], "no difference shown"),
        "abs_rel": "b better",
        "delta1": "b better",
    }


def test_the_other_way_round(tmp_path: Path, other: Path) -> None:
    there = run_compare(tmp_path / "there", STUDY, other)["metrics"]
    back = run_compare(tmp_path / "back", other, STUDY)["metrics"]
    for name, row in there.items():
        mirrored = {"a better": "b better", "b better": "a better"}
        assert back[name]["verdict"] == mirrored.get(row["verdict"], row["verdict"])
        assert back[name]["difference"] == -row["difference"]
        assert back[name]["low"] == pytest.approx(-row["high"], abs=1e-12)


def test_images_are_in_the_order_of_their_difference(tmp_path: Path, other: Path) -> None:
    run_compare(tmp_path / "out", STUDY, other)
    with (tmp_path / "out" / "compare.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "id", "scene", "category", "pixels", "abs_rel_a", "abs_rel_b", "abs_rel_difference", "rmse_a", "rmse_b",
        "rmse_difference",
    ]  # fmt: skip
    assert len(rows) == 654
    sizes = [abs(float(row["abs_rel_difference"])) for row in rows]
    assert sizes == sorted(sizes, reverse=True)
    a, b = find_result(STUDY, "eigen"), find_result(other, "eigen")
    assert differing(a, b, 20) == [row["id"] for row in rows[:20]]
    for row in rows:
        i = a.table.ids.index(row["id"])
        assert row["scene"] == a.table.scenes[i]
        for name in ("abs_rel", "rmse"):
            x, y = a.table.values[name][i], b.table.values[name][i]
            assert [float(row[f"{name}_{k}"]) for k in ("a", "b", "difference")] == pytest.approx(
                [x, y, y - x], rel=1e-6
            )


def test_table_and_picture(tmp_path: Path, other: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_compare(tmp_path / "out", STUDY, other)
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines[:4] == [
        f"a: {STUDY}/test/eigen",
        f"b: {other}/test/eigen",
        "eigen protocol, 654 test images of 215 scenes of nyu_labeled, official split",
        "",
    ]
    assert lines[4].split() == ["metric", "a", "b", "b", "-", "a", "95", "%", "interval", "better"]
    abs_rel, rmse, delta1 = (next(x for x in lines if x.startswith(name)) for name in ("abs_rel", "rmse [", "delta1"))
    assert abs_rel.split()[:3] == ["abs_rel", "↓", "0.2241"]
    assert abs_rel.endswith("  b")
    assert rmse.startswith("rmse [m] ↓")
    assert rmse.endswith("  -")
    assert " ".join(" ".join(lines).split()).endswith("-: no difference shown.")
    assert delta1.startswith("delta1 ↑")
    assert (tmp_path / "out" / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_beside_itself(tmp_path: Path) -> None:
    document = run_compare(tmp_path / "out", STUDY, STUDY)
    assert {(row["difference"], row["verdict"]) for row in document["metrics"].values()} == {(0, "no difference shown")}


def test_a_prediction_of_nan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def broken(table: ImageTable) -> ImageTable:
        values = {name: column.copy() for name, column in table.values.items()}
        values["abs_rel"][5] = math.nan
        return replace(table, values=values)

    run = save(tmp_path / "run", broken)
    row = run_compare(tmp_path / "out", STUDY, run)["metrics"]["abs_rel"]
    assert (row["b"], row["difference"], row["low"], row["verdict"]) == (None, None, None, "undefined")
    a, b = find_result(STUDY, "eigen"), find_result(run, "eigen")
    assert differing(a, b, 1) == [a.table.ids[5]]
    assert "undefined" in capsys.readouterr().out


def test_one_scene_shows_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [save(tmp_path / name, lambda table: replace(table, scenes=["room"] * 654)) for name in ("a", "b")]
    rows = run_compare(tmp_path / "out", *runs)["metrics"].values()
    assert {row["verdict"] for row in rows} == {"undefined"}
    assert "654 test images of 1 scene of nyu_labeled" in capsys.readouterr().out
    runs = [save(tmp_path / name, lambda table: replace(table, scenes=[""] * 654)) for name in ("c", "d")]
    run_compare(tmp_path / "out", *runs)
    assert "654 test images without scenes of nyu_labeled" in capsys.readouterr().out


@pytest.mark.slow
def test_metrics_that_only_new_results_have_are_left_out(tmp_path: Path) -> None:
    run = save(tmp_path / "new", lambda t: replace(t, values={**t.values, "edge_f1_0.25": t.values["ssim"]}))
    assert "edge_f1_0.25" not in run_compare(tmp_path / "out", STUDY, run)["metrics"]
    both = run_compare(tmp_path / "both", run, run)["metrics"]
    assert both["edge_f1_0.25"]["difference"] == 0


@pytest.mark.parametrize(
    ("name", "low", "high", "expected"),
    [
        ("abs_rel", -0.2, -0.1, "b better"),
        ("abs_rel", 0.1, 0.2, "a better"),
        ("dbe_acc_px", 0.1, 0.2, "a better"),
        ("delta3", 0.1, 0.2, "b better"),
        ("ssim", -0.2, -0.1, "a better"),
        ("edge_f1_0.25", 0.1, 0.2, "b better"),
        ("edge_precision_1", 0.1, 0.2, "b better"),
        ("edge_recall_0.5", 0.1, 0.2, "b better"),
        ("si_boundary_f1", 0.1, 0.2, "b better"),
        ("rmse", -0.1, 0.1, "no difference shown"),
        ("rmse", 0.0, 0.1, "no difference shown"),
        ("rmse", math.nan, math.nan, "undefined"),
    ],
)
def test_verdict(name: str, low: float, high: float, expected: str) -> None:
    assert verdict(name, Difference((low + high) / 2, low, high)) == expected


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"a": None}, r"a is not set"),
        ({"b": None}, r"b is not set"),
        ({"repeats": 10}, r"repeats: 10 .*100.* 2000"),
        ({"repeats": "many"}, r"repeats: 'many'"),
        ({"repeats": True}, r"repeats: true"),
        ({"seed": -1}, r"seed: -1"),
    ],
)
def test_wrong_options(options: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        parse(CompareOptions, {"a": str(STUDY), "b": str(STUDY), **options})


def test_results_that_cannot_be_paired_leave_no_files(tmp_path: Path) -> None:
    shutil.copytree(STUDY / "test", tmp_path / "run" / "test")
    file = tmp_path / "run" / "test" / "eigen" / "metrics.json"
    file.write_text(file.read_text().replace("d22e3bd42d94", "000000000000"))
    with pytest.raises(DataError, match="were tested on different data"):
        run_compare(tmp_path / "out", STUDY, tmp_path / "run")
    assert not (tmp_path / "out").exists()


def test_an_output_that_cannot_be_written(tmp_path: Path, other: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"output: .*file/out"):
        run_compare(tmp_path / "file" / "out", STUDY, other)


def test_the_default_folder(tmp_path: Path, other: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    compare(CompareOptions(STUDY, other, repeats=100))
    assert sorted(path.name for path in Path("compare").iterdir()) == ["compare.csv", "compare.json", "compare.png"]
