from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hudepth.base.errors import DataError
from hudepth.metrics.summary import ImageTable
from hudepth.runs.comparison import common_images, merge, paired, stamp_differences
from hudepth.runs.results import Result, find_result

STUDY = Path(__file__).parents[2] / "experiments" / "badcl_official"
FINGERPRINT = "d22e3bd4"
SPLIT = "359cc4ee"


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
    other = with_document(eigen, data__source="rooms", data__fingerprint="a" * 64, protocol__crop=None)
    assert f"data.fingerprint: {FINGERPRINT} against aaaaaaaa" in message(lambda: paired(eigen, other))
    other = with_document(eigen, protocol__crop=None, protocol__averaging="pooled")
    got = message(lambda: paired(eigen, other))
    assert "crop: [45,471,41,601] against none; protocol.averaging: image against pooled" in got
    table = eigen.table
    ids = [*table.ids[:100], *(f"other{i}" for i in range(554))]
    other = replace(with_document(eigen, split__kind="random"), table=replace(table, ids=ids))
    assert "654 of split random, 100 of them in both" in message(lambda: paired(eigen, other))
    other = replace(eigen, table=replace(table, pixels=table.pixels + 1))
    assert "pixel counts" in message(lambda: paired(eigen, other))


def test_rows_of_one_table(eigen: Result) -> None:
    other = with_document(eigen, metrics__model__abs_rel=0.1)
    del other.document["metrics"]["model"]["ssim"]
    assert merge({"one": eigen}, metrics=["abs_rel"]) == [{"name": "one", "abs_rel": eigen.metrics["abs_rel"]}]
    rows = merge({"one": eigen, "two": other}, metrics=["abs_rel", "ssim"])
    assert [list(row) for row in rows] == [["name", "abs_rel", "ssim"]] * 2
    assert rows[1]["abs_rel"] == 0.1
    assert math.isnan(float(rows[1]["ssim"]))


def test_an_unknown_metric(eigen: Result) -> None:
    assert "Did you mean 'abs_rel'?" in message(lambda: merge({"one": eigen}, metrics=["absrel"]))


def test_rows_that_do_not_compare(eigen: Result) -> None:
    paper = find_result(STUDY, "paper")
    got = message(lambda: merge({"one": eigen, "two": eigen, "three": paper}, metrics=["abs_rel"]))
    assert re.search(r"'one' and 'three'.*protocol.name: eigen against paper; .* 6 more\.", got), got


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
    assert message(lambda: common_images(one, other)).count("share no test image")
    changed = with_document(other, protocol__crop=None)
    assert "protocol.crop: [45,471,41,601] against none" in message(lambda: common_images(one, changed))


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
