"""table.csv, document.json, table.md and table.tex."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.tables import escape_latex
from hudepth.report.ablation.document import document, table_csv
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.tables import table_md, table_tex
from hudepth.report.ablation.words import places
from hudepth.runs.sweeps import Sweep
from tests.report.ablation.conftest import worked_out
from tests.report.ablation.synthetic import image_table, make_run

LABELS = ["paper", "no_smooth", "no_scale", "neither", "si|log & <b>"]


def test_the_csv_holds_every_number_with_all_its_digits(report: Report) -> None:
    rows = list(csv.DictReader(io.StringIO(table_csv(report))))
    assert [row["row"] for row in rows] == LABELS
    assert [row["seeds"] for row in rows] == ["3"] * 5
    assert [row["seeds_tried"] for row in rows] == ["4", "3", "3", "3", "3"]
    assert [row["reference"] for row in rows] == ["true", *["false"] * 4]
    assert [row["loss"] for row in rows] == [*["BADCL"] * 4, "SILog"]
    for cells, row in zip(rows, report.rows, strict=True):
        found = row.estimates["rmse"]
        assert float(cells["rmse"]) == found.mean
        assert (float(cells["rmse_seeds_low"]), float(cells["rmse_seeds_high"])) == (found.seeds.low, found.seeds.high)
        assert (float(cells["rmse_scenes_low"]), float(cells["rmse_scenes_high"])) == (
            found.scenes.low,
            found.scenes.high,
        )
        assert cells["rmse_best"] == ("true" if "rmse" in row.best else "false")
        if row.is_reference:
            assert cells["rmse_difference"] == cells["rmse_verdict"] == ""
        else:
            difference = row.contrasts["rmse"]
            assert float(cells["rmse_difference"]) == difference.value
            assert float(cells["rmse_difference_seeds_low"]) == difference.seeds.low
            assert float(cells["rmse_difference_scenes_high"]) == difference.scenes.high
            assert (cells["rmse_paired_seeds"], cells["rmse_verdict"]) == ("3", difference.verdict)


def test_the_document_holds_everything(report: Report, sweep: Sweep) -> None:
    found = json.loads(json.dumps(document(report, sweep), allow_nan=False))
    assert found["reference"] == "paper"
    assert [row["label"] for row in found["rows"]] == LABELS
    last = found["rows"][-1]
    assert last["config_differences"]["loss.factor"] == {"reference": "-", "here": "10"}
    assert last["differences"]["rmse"]["value"] == report.rows[-1].contrasts["rmse"].value
    assert last["metrics"]["rmse"]["by_seed"] == report.rows[-1].estimates["rmse"].values
    assert found["not_counted"] == [
        {"run": "z_failed", "row": "paper", "seed": "4", "state": "failed", "why": "loss is <nan> & more"}
    ]


def test_no_number_is_an_empty_cell_and_null(tmp_path: Path) -> None:
    table = image_table()
    table.values["rmse"][3] = math.nan
    make_run(tmp_path / "a", table=table)
    make_run(tmp_path / "b", changes={"optim.lr": 1}, state="failed")
    report = worked_out(tmp_path)
    rows = list(csv.DictReader(io.StringIO(table_csv(report))))
    assert [row["rmse"] for row in rows] == ["", ""]
    assert rows[0]["abs_rel"]
    assert rows[0]["abs_rel_seeds_low"] == rows[1]["abs_rel"] == ""
    found = document(report, Sweep(tmp_path, [], [], []))
    assert found["rows"][0]["metrics"]["rmse"]["mean"] is None
    assert found["rows"][0]["metrics"]["abs_rel"]["seeds"] is None
    assert found["rows"][1]["metrics"] == {}


def test_markdown_rows_have_one_width_and_names_cannot_break_them(report: Report) -> None:
    lines = table_md(report).splitlines()
    tables = [line for line in lines if line.startswith("|")]
    widths = {line.count("|") for line in tables[: len(LABELS) + 2]}
    assert widths == {3 + len(report.factors) + len(report.metrics) + 0}
    assert any(line.startswith("| si&#124;log & &lt;b> |") for line in lines)
    assert "Difference from paper:" in lines
    assert any(re.match(r"\| no_scale \| .* (better|worse|not shown) \|", line) for line in lines)
    assert "- not counted: 'z_failed' of row 'paper', seed 4: failed: loss is &lt;nan> & more" in lines


def structure(text: str) -> list[str]:
    """Check what LaTeX would trip over; return the lines of the tabular's body."""
    plain = re.sub(r"\\[\\{}&%$#_]", "", text)  # escaped
    depth = 0
    for letter in plain:
        depth += {"{": 1, "}": -1}.get(letter, 0)
        assert depth >= 0
    assert depth == 0
    opened = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", text):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    assert plain.count(r"\(") == plain.count(r"\)")
    body = text.partition(r"\midrule")[2].partition(r"\bottomrule")[0].strip().splitlines()
    assert all(line.endswith(r"\\") for line in body)
    outside = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert not re.search(r"(?<!\\)[$#_^~]", outside)
    assert all(ord(letter) < 128 for letter in text)
    return body


def test_the_latex_table_has_the_structure_of_one(report: Report) -> None:
    text = table_tex(report)
    body = structure(text)
    columns = re.search(r"\\begin\{tabular\}\{(\w+)\}", text)
    assert columns is not None
    for line in body:
        assert len(re.findall(r"(?<!\\)&", line)) == len(columns[1]) - 1
    assert body[-1].startswith(r"si|log \& \textless{}b\textgreater{} & 3 & ")
    assert body[0].startswith(r"paper & 3 of 4 & \textbf{")
    for word in (
        "eigen",
        "24 test images (8 scenes)",
        "official split",
        "3 seeds",
        "rmse [m]",
        "Student",
        "bootstrap",
    ):
        assert word.lower() in text.lower()
    best = sum(len(row.best) for row in report.rows)
    assert text.count(r"\textbf{") == best


@given(st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20))
def test_any_name_is_escaped_for_latex(name: str) -> None:
    escaped = escape_latex(name)
    without = re.sub(r"\\text[a-z]+\{\}|\\[&%$#_{}]", "", escaped)
    assert not re.search(r"[\\&%$#_{}~^<>]", without)


def test_decimals_follow_the_size_of_a_metric(tmp_path: Path) -> None:
    table = image_table()
    table.values["edge_f1_0.5"] = table.values["rmse"] * 1e-4
    table.values["log10"] = table.values["rmse"] * 100
    make_run(tmp_path / "a", table=table)
    found = places(worked_out(tmp_path))
    assert (found["abs_rel"], found["edge_f1_0.5"], found["log10"]) == (4, 7, 2)


def test_rows_of_other_conditions_carry_a_dagger(tmp_path: Path) -> None:
    make_run(tmp_path / "a", table=image_table())
    make_run(tmp_path / "b", changes={"optim.lr": 1}, table=image_table(), document={"protocol.crop": None})
    report = worked_out(tmp_path)
    assert "lr=1 †" in table_md(report)
    assert r"lr=1 \textsuperscript{\dag} & 1 &" in table_tex(report)
    assert structure(table_tex(report))


@pytest.mark.parametrize("name", ["row", "seeds", "differs"])
def test_a_factor_does_not_take_a_columns_name(tmp_path: Path, name: str) -> None:
    for value in (1, 2):
        make_run(tmp_path / str(value), changes={f"optim.{name}": value}, table=image_table())
    head = table_csv(worked_out(tmp_path)).splitlines()[0].split(",")
    assert len(set(head)) == len(head)
