from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hudepth.base.errors import DataError
from hudepth.metrics.summary import per_image_csv
from hudepth.runs.comparison import stamp_differences
from hudepth.runs.results import Result, find_result

STUDY = Path(__file__).parents[2] / "experiments" / "badcl_official"
FINGERPRINT = "d22e3bd4"
SPLIT = "359cc4ee"


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """A copy of the published study's test results, to write to."""
    shutil.copytree(STUDY / "test", tmp_path / "study" / "test")
    return tmp_path / "study"


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    document = json.loads((folder / "metrics.json").read_text())
    change(document)
    (folder / "metrics.json").write_text(json.dumps(document))


@pytest.fixture(scope="module")
def eigen() -> Result:
    return find_result(STUDY, "eigen")


def message(function: Callable[[], object]) -> str:
    with pytest.raises(DataError) as caught:
        function()
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("place", ["", "test", "test/eigen"])
def test_a_result_is_found_from_the_run_and_from_its_folders(study: Path, place: str) -> None:
    result = find_result(str(study / place), "eigen")
    assert result.path == study / "test" / "eigen"
    assert result.protocol_name == "eigen"
    assert result.stamp["crop"] == [45, 471, 41, 601]
    assert result.data["source"] == "nyu_labeled"
    assert result.split["kind"] == "official"
    assert result.metrics["abs_rel"] == 0.22414364776637116
    assert result.averaging == {"averaging": "image", "silog_lambda": 1.0, "silog_factor": 100.0}
    assert len(result.table.ids) == result.document["images"] == 654


def test_intervals_and_log_bias_may_be_there(study: Path, eigen: Result) -> None:
    folder = study / "test" / "eigen"
    edit(folder, lambda d: d.update(intervals={"model": {"abs_rel": [0.21, 0.24]}}, uncertainty={"scenes": 215}))
    table = replace(eigen.table, values={**eigen.table.values, "log_bias": eigen.table.values["mae"]})
    (folder / "per_image.csv").write_text(per_image_csv(table))
    result = find_result(study, "eigen")
    assert result.document["intervals"]["model"]["abs_rel"] == [0.21, 0.24]
    assert result.table.values["log_bias"].shape == (654,)
    assert stamp_differences(eigen, result) == []


def test_null_is_nan(study: Path) -> None:
    edit(study / "test" / "eigen", lambda d: d["metrics"]["model"].update(abs_rel=None))
    assert math.isnan(find_result(study, "eigen").metrics["abs_rel"])


def test_no_result_of_the_protocol(study: Path) -> None:
    got = message(lambda: find_result(study, "eigne"))
    assert re.search(r"'eigne'.* eigen, paper.*Did you mean 'eigen'.*hudepth-test .*protocol=eigne", got), got
    empty = study / "empty"
    empty.mkdir()
    assert f"Run hudepth-test checkpoint={empty} protocol=eigen." in message(lambda: find_result(empty, "eigen"))
    assert f"no folder '{study}/gone'" in message(lambda: find_result(study / "gone", "eigen"))


def test_the_folder_of_another_protocol(study: Path) -> None:
    folder = study / "test" / "paper"
    assert "Pass protocol=paper." in message(lambda: find_result(folder, "eigen"))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{", r"cannot be read \(Expecting property name .*\)\."),
        ("\xff", r"cannot be read \('utf-8' codec .*\)\."),
        ("[" * 100_000, r"cannot be read \(nested too deep\)\."),
        ("[]", r"is not a .* no metrics\.model\."),
        ('{"metrics": {"model": {}}}', r"is not a .* no images\."),
        ('{"metrics": {"mean_depth": {}}}', r"is not a .* no metrics\.model\."),
        ('{"metrics": {"model": {}}, "split": "random"}', r"is not a .* split .*\."),
    ],
)
def test_damaged_json(study: Path, text: str, why: str) -> None:
    file = study / "test" / "eigen" / "metrics.json"
    file.write_bytes(text.encode("latin-1"))
    got = message(lambda: find_result(study, "eigen"))
    assert re.fullmatch(rf"'{re.escape(str(file))}' {why} Run hudepth-test again\.", got), got


@pytest.mark.parametrize("key", ["protocol.silog.lambda", "data.fingerprint", "split.sha256"])
def test_an_incomplete_stamp(study: Path, key: str) -> None:
    folder = study / "test" / "eigen"

    def remove(document: dict[str, Any]) -> None:
        *parts, last = key.split(".")
        for part in parts:
            document = document[part]
        del document[last]

    edit(folder, remove)
    assert f"it has no {key}." in message(lambda: find_result(study, "eigen"))


@pytest.mark.parametrize("model", [{"abs_rel": "small"}, [0.2], {"abs_rel": [0.2]}])
def test_metrics_that_are_no_numbers(study: Path, model: Any) -> None:
    edit(study / "test" / "eigen", lambda d: d["metrics"].update(model=model))
    assert "metrics.json' is not a test result" in message(lambda: find_result(study, "eigen"))


def test_a_table_that_is_missing_or_of_another_test(study: Path) -> None:
    folder = study / "test" / "eigen"
    table = folder / "per_image.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(lines[:-1]))
    assert re.match(rf"'{table}' .*653.*metrics.json.*654", message(lambda: find_result(study, "eigen")))
    shutil.copy(study / "test" / "paper" / "per_image.csv", table)
    got = message(lambda: find_result(study, "eigen"))
    assert re.match(rf"'{table}' gives abs_rel 0\.\d+, .*0.224144.*Run hudepth-test again\.", got), got
    table.write_text("".join(lines).replace("238560", "many", 1))
    assert message(lambda: find_result(study, "eigen")).startswith(f"'{table}', line 2: pixels 'many'")
    table.unlink()
    assert "no per_image.csv" in message(lambda: find_result(study, "eigen"))


def test_metrics_beyond_reason(study: Path) -> None:
    edit(study / "test" / "eigen", lambda document: document["metrics"]["model"].update(mae=1e308))
    assert "mae" in message(lambda: find_result(study, "eigen"))
