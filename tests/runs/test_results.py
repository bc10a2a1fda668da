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
from hudepth.metrics.summary import ImageTable, per_image_csv
from hudepth.runs.results import Result, common_images, find_result, merge, paired, stamp_differences

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


def with_document(result: Result, **changes: Any) -> Result:
    """Change values at dotted keys, with ``__`` for the dot."""
    document = json.loads(json.dumps(result.document))
    for key, value in changes.items():
        *parts, last = key.split("__")
        inner = document
        for part in parts:
            inner = inner[part]
        inner[last] = value
    return replace(result, document=document)


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
    expected = (
        f"'{study}' holds no test result of protocol 'eigne'. It holds eigen, paper. Did you mean 'eigen'? "
        f"Run hudepth-test checkpoint={study} protocol=eigne."
    )
    assert message(lambda: find_result(study, "eigne")) == expected
    empty = study / "empty"
    empty.mkdir()
    assert message(lambda: find_result(empty, "eigen")) == (
        f"'{empty}' holds no test result of protocol 'eigen'. Run hudepth-test checkpoint={empty} protocol=eigen."
    )
    assert message(lambda: find_result(study / "gone", "eigen")) == (
        f"no folder '{study}/gone'. Pass a run directory or a folder of test results."
    )


def test_the_folder_of_another_protocol(study: Path) -> None:
    folder = study / "test" / "paper"
    assert message(lambda: find_result(folder, "eigen")) == (
        f"'{folder}' is a test result of protocol 'paper', not of 'eigen'. Pass protocol=paper."
    )


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{", r"cannot be read \(Expecting property name .*\)\."),
        ("\xff", r"cannot be read \('utf-8' codec .*\)\."),
        ("[" * 100_000, r"cannot be read \(maximum recursion depth .*\)\."),
        ("[]", r"is no test result: it has no metrics\.model\."),
        ('{"metrics": {"model": {}}}', r"is no test result: it has no images\."),
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
    assert message(lambda: find_result(study, "eigen")) == (
        f"'{folder}/metrics.json' is no test result: it has no {key}. Run hudepth-test again."
    )


@pytest.mark.parametrize("model", [{"abs_rel": "small"}, [0.2], {"abs_rel": [0.2]}])
def test_metrics_that_are_no_numbers(study: Path, model: Any) -> None:
    edit(study / "test" / "eigen", lambda d: d["metrics"].update(model=model))
    assert "metrics.json' is no test result (" in message(lambda: find_result(study, "eigen"))


def test_a_table_that_is_missing_or_of_another_test(study: Path) -> None:
    folder = study / "test" / "eigen"
    table = folder / "per_image.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(lines[:-1]))
    assert message(lambda: find_result(study, "eigen")) == (
        f"'{table}' holds 653 images, but metrics.json beside it speaks of 654. Run hudepth-test again."
    )
    shutil.copy(study / "test" / "paper" / "per_image.csv", table)
    got = message(lambda: find_result(study, "eigen"))
    assert re.fullmatch(
        rf"'{table}' gives abs_rel 0\.\d+, but metrics.json beside it says 0.224144: they are not of one test. "
        r"Run hudepth-test again\.",
        got,
    ), got
    table.write_text("".join(lines).replace("238560", "many", 1))
    assert message(lambda: find_result(study, "eigen")).startswith(f"'{table}', line 2: pixels 'many' is no count.")
    table.unlink()
    assert message(lambda: find_result(study, "eigen")) == (
        f"'{folder}' has a metrics.json but no per_image.csv. Run hudepth-test again."
    )


def test_what_differs_is_named_with_both_values(eigen: Result) -> None:
    assert stamp_differences(eigen, eigen) == []
    other = with_document(
        eigen,
        protocol__crop=None,
        protocol__silog__lambda=0.5,
        protocol__source="own",
        data__fingerprint="a" * 64,
        split__sha256="b" * 64,
        network_size=[240, 320],
    )
    assert stamp_differences(eigen, other) == [
        "protocol.crop: [45,471,41,601] against none",
        "protocol.silog.lambda: 1.0 against 0.5",
        f"data.fingerprint: {FINGERPRINT} against aaaaaaaa",
        f"split.sha256: {SPLIT} against bbbbbbbb",
        "protocol.source: none against own",
    ]


def test_network_size_decides_the_truth_at_network_resolution_only() -> None:
    paper = find_result(STUDY, "paper")
    other = with_document(paper, network_size=[240, 320], max_depth_m=80.0)
    assert stamp_differences(paper, other) == [
        "network_size: [224,224] against [240,320]",
        "max_depth_m: 10.0 against 80.0",
    ]


def test_pairs_are_in_the_order_of_the_first(eigen: Result) -> None:
    table = eigen.table
    backwards = replace(
        table,
        ids=table.ids[::-1],
        scenes=table.scenes[::-1],
        categories=table.categories[::-1],
        pixels=table.pixels[::-1],
        values={name: values[::-1] for name, values in table.values.items()},
    )
    # another split with the same test images is welcome
    other = replace(with_document(eigen, split__sha256="b" * 64), table=backwards)
    first, second = paired(eigen, other)
    assert first is table
    assert (second.ids, second.scenes, second.categories) == (table.ids, table.scenes, table.categories)
    assert all((second.values[name] == values).all() for name, values in table.values.items())


def test_what_cannot_be_paired(eigen: Result) -> None:
    where = f"'{eigen.path}' and '{eigen.path}'"
    other = with_document(eigen, data__source="rooms", data__fingerprint="a" * 64, protocol__crop=None)
    assert message(lambda: paired(eigen, other)) == (
        f"{where} were tested on different data (data.source: nyu_labeled against rooms; data.fingerprint: "
        f"{FINGERPRINT} against aaaaaaaa), so their images cannot be paired. "
        "Test both on one set: hudepth-test checkpoint=<run> data=<name>."
    )
    other = with_document(eigen, protocol__crop=None, protocol__averaging="pooled")
    assert message(lambda: paired(eigen, other)) == (
        f"{where} were tested under different protocols (protocol.crop: [45,471,41,601] against none; "
        "protocol.averaging: image against pooled). Run hudepth-test on both again with the same settings."
    )
    table = eigen.table
    ids = [*table.ids[:100], *(f"other{i}" for i in range(554))]
    other = replace(with_document(eigen, split__kind="random"), table=replace(table, ids=ids))
    assert message(lambda: paired(eigen, other)) == (
        f"{where} were tested on different images: 654 of split official and 654 of split random, 100 of them in "
        "both. Compare runs of one data.split, or test both on data neither was trained on: "
        "hudepth-test checkpoint=<run> data=<name>."
    )
    other = replace(eigen, table=replace(table, pixels=table.pixels + 1))
    assert message(lambda: paired(eigen, other)) == (
        f"{where} name other scenes or numbers of pixels for the same images. Run hudepth-test on both again."
    )


def test_rows_of_one_table(eigen: Result) -> None:
    other = with_document(eigen, metrics__model__abs_rel=0.1)
    del other.document["metrics"]["model"]["ssim"]
    assert merge({"one": eigen}, metrics=["abs_rel"]) == [{"name": "one", "abs_rel": eigen.metrics["abs_rel"]}]
    rows = merge({"one": eigen, "two": other}, metrics=["abs_rel", "ssim"])
    assert [list(row) for row in rows] == [["name", "abs_rel", "ssim"]] * 2
    assert rows[1]["abs_rel"] == 0.1
    assert math.isnan(float(rows[1]["ssim"]))


def test_an_unknown_metric(eigen: Result) -> None:
    got = message(lambda: merge({"one": eigen}, metrics=["absrel"]))
    assert got == "no result has a metric 'absrel'. Did you mean 'abs_rel'?"


def test_rows_that_do_not_compare(eigen: Result) -> None:
    paper = find_result(STUDY, "paper")
    assert message(lambda: merge({"one": eigen, "two": eigen, "three": paper}, metrics=["abs_rel"])) == (
        "the results of 'one' and 'three' do not compare: protocol.name: eigen against paper; "
        "protocol.resolution: native against network; protocol.resize: bilinear, align_corners=False against none; "
        "6 more. Run hudepth-test on them again with the same settings, or say in the table what differs."
    )


def test_rows_marked_with_what_differs(eigen: Result) -> None:
    paper = find_result(STUDY, "paper")
    pooled = with_document(eigen, protocol__averaging="pooled")
    frames = with_document(eigen, split__kind="random", split__sha256="b" * 64)
    rooms = with_document(eigen, data__source="rooms", data__fingerprint="a" * 64)

    def marks(**results: Result) -> dict[str, list[Any]]:
        rows = merge(results, metrics=["abs_rel"], mark=True)
        return {key: [row[key] for row in rows] for key in rows[0] if key not in ("name", "abs_rel")}

    assert marks(one=eigen, two=eigen) == {}
    assert marks(one=eigen, two=paper) == {"protocol": ["eigen", "paper"]}
    assert marks(one=eigen, two=pooled) == {"protocol": ["eigen, averaging image", "eigen, averaging pooled"]}
    assert marks(one=eigen, two=frames) == {"split": ["official", "random"]}
    again = with_document(frames, split__sha256="c" * 64)
    assert marks(one=eigen, two=frames, three=again) == {
        "split": [f"official, sha256 {SPLIT}", "random, sha256 bbbbbbbb", "random, sha256 cccccccc"]
    }
    assert marks(one=eigen, two=rooms, three=frames) == {
        "data": ["nyu_labeled", "rooms", "nyu_labeled"],
        "split": ["official", "official", "random"],
    }


def test_common_images_of_two_splits(eigen: Result) -> None:
    ids = eigen.table.ids
    half = replace(eigen, table=_rows(eigen, list(range(300, 654))[::-1]))
    half = with_document(half, split__sha256="0" * 64, split__kind="random")
    ours, theirs = common_images(replace(eigen, table=_rows(eigen, list(range(400)))), half)
    assert ours.ids == theirs.ids == ids[300:400]
    assert (ours.values["rmse"] == eigen.table.values["rmse"][300:400]).all()
    assert (theirs.values["rmse"] == ours.values["rmse"]).all()
    assert theirs.scenes == eigen.table.scenes[300:400]


def test_common_images_must_compare(eigen: Result) -> None:
    one = replace(eigen, table=_rows(eigen, [0, 1]))
    other = replace(eigen, table=_rows(eigen, [2, 3]))
    assert message(lambda: common_images(one, other)).endswith("share no test image.")
    changed = with_document(other, protocol__crop=None)
    assert "do not compare: protocol.crop: [45,471,41,601] against none." in message(
        lambda: common_images(one, changed)
    )


def _rows(result: Result, rows: list[int]) -> ImageTable:
    table = result.table
    return replace(
        table,
        ids=[table.ids[i] for i in rows],
        scenes=[table.scenes[i] for i in rows],
        categories=[table.categories[i] for i in rows],
        pixels=table.pixels[rows],
        values={name: values[rows] for name, values in table.values.items()},
    )
