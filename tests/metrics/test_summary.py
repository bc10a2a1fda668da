from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import DataError
from hudepth.metrics.depth import METRIC_NAMES, depth_metrics_from_sums, depth_sums
from hudepth.metrics.summary import (
    DEPTH_NAMES,
    LOG_BIAS,
    ImageTable,
    per_image_csv,
    read_per_image,
    summarise,
)

STUDY = Path(__file__).parents[2] / "experiments" / "badcl_official" / "test"


def make_table(values: dict[str, list[float]], *, pixels: list[int]) -> ImageTable:
    n = len(pixels)
    return ImageTable(
        ids=[f"{i:03d}" for i in range(n)],
        scenes=[f"room_{i // 2}" for i in range(n)],
        categories=["room"] * n,
        pixels=np.array(pixels, dtype=np.int64),
        values={name: np.array(column, dtype=np.float64) for name, column in values.items()},
    )


def scored(seed: int, *, images: int = 5, side: int = 9) -> tuple[ImageTable, dict[str, torch.Tensor]]:
    """Return images of random depth with random holes as a table, and their sums."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(0.5, 10, (images, 1, side, side))
    pred = target * rng.lognormal(rng.normal(0, 0.2, (images, 1, 1, 1)), 0.3, target.shape)
    valid = rng.random(target.shape) < rng.uniform(0.1, 1, (images, 1, 1, 1))
    valid[:, 0, 0, 0] = True
    valid[1] = False
    sums = depth_sums(torch.tensor(pred), torch.tensor(target), torch.tensor(valid))
    metrics = depth_metrics_from_sums(sums, silog_lambda=0.85, silog_factor=10)
    metrics[LOG_BIAS] = sums["log"] / sums["count"]
    columns = {name: values.tolist() for name, values in metrics.items()}
    return make_table(columns, pixels=[int(count) for count in sums["count"].tolist()]), sums


def test_depth_names_are_those_of_the_metrics() -> None:
    assert (*METRIC_NAMES, LOG_BIAS) == DEPTH_NAMES


@given(seed=st.integers(0, 1000))
def test_pooling_agrees_with_pooled_sums(seed: int) -> None:
    table, sums = scored(seed)
    pooled = depth_metrics_from_sums(
        {name: total.sum() for name, total in sums.items()}, silog_lambda=0.85, silog_factor=10
    )
    expected = {name: value.item() for name, value in pooled.items()}
    expected["rmse_pooled"] = expected["rmse"]
    got = summarise(table, averaging="pooled", silog_lambda=0.85, silog_factor=10)
    assert got == pytest.approx(expected, rel=1e-12, abs=0)


@given(seed=st.integers(0, 1000))
def test_over_images_agrees_with_the_mean_of_the_images(seed: int) -> None:
    table, sums = scored(seed)
    each = depth_metrics_from_sums(sums, silog_lambda=0.85, silog_factor=10)
    expected = {name: math.fsum(values[[0, 2, 3, 4]].tolist()) / 4 for name, values in each.items()}
    expected["rmse_pooled"] = (sums["squared"].sum() / sums["count"].sum()).sqrt().item()
    assert each["abs_rel"][1].isnan()
    # per-image silog already holds lambda and factor: those given here change nothing
    assert summarise(table, averaging="image", silog_lambda=0, silog_factor=1) == pytest.approx(expected, rel=1e-12)


def test_two_images_by_hand() -> None:
    table = make_table(
        {"abs_rel": [0.1, 0.3], "rmse": [3, 4], "rmse_log": [0.3, 0.5], "log_bias": [0.2, -0.2], "silog": [1, 2]},
        pixels=[1, 3],
    )
    pooled = {"rmse_pooled": math.sqrt(14.25)}  # (9 + 3 * 16) / 4
    assert summarise(table, averaging="image") == pytest.approx(
        {"abs_rel": 0.2, "rmse": 3.5, "rmse_log": 0.4, "silog": 1.5} | pooled
    )
    # pooled: (9 + 3 * 16) / 4, (0.09 + 3 * 0.25) / 4 = 0.21, bias (0.2 - 3 * 0.2) / 4 = -0.1
    expected = {"abs_rel": 0.25, "rmse": math.sqrt(14.25), "rmse_log": math.sqrt(0.21)} | pooled
    got = summarise(table, averaging="pooled")
    assert got == pytest.approx(expected | {"silog": 100 * math.sqrt(0.21 - 0.01)})
    got = summarise(table, averaging="pooled", silog_lambda=0.5, silog_factor=1)
    assert got == pytest.approx(expected | {"silog": math.sqrt(0.21 - 0.005)})


def test_a_constant_factor_leaves_no_negative_variance() -> None:
    bias = [math.log(1.7), math.log(1.7)]
    table = make_table({"rmse_log": bias, "log_bias": [x * (1 + 1e-15) for x in bias], "silog": [0, 0]}, pixels=[3, 7])
    assert summarise(table, averaging="pooled")["silog"] == 0


def test_pooled_silog_is_left_out_without_log_bias() -> None:
    table = make_table({"abs_rel": [0.1], "rmse_log": [0.2], "silog": [15.0]}, pixels=[5])
    assert set(summarise(table, averaging="pooled")) == {"abs_rel", "rmse_log"}
    assert set(summarise(table, averaging="image")) == {"abs_rel", "rmse_log", "silog"}


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_ssim_and_boundary_metrics_are_means_of_the_images_that_define_them(averaging: str) -> None:
    nan = math.nan
    values = {
        "abs_rel": [0.1, nan, 0.3],
        "ssim": [0.8, 0.1, nan],
        "edge_f1_0.25": [0.2, nan, 0.6],
        "dbe_acc_px": [nan] * 3,
    }
    table = make_table(values, pixels=[1, 0, 99])
    got = summarise(table, averaging=averaging)
    assert got["ssim"] == 0.8  # the second image has no pixel, the third no window
    assert got["edge_f1_0.25"] == pytest.approx(0.4)
    assert math.isnan(got["dbe_acc_px"])
    assert math.isfinite(got["abs_rel"])


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_a_prediction_of_nan_is_not_hidden(averaging: str) -> None:
    table = make_table({"abs_rel": [0.1, math.nan], "rmse": [0.5, math.nan], "ssim": [0.9, 0.8]}, pixels=[4, 4])
    got = summarise(table, averaging=averaging)
    assert math.isnan(got["abs_rel"])
    assert math.isnan(got["rmse"])
    assert got["ssim"] == pytest.approx(0.85)


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_no_pixel_anywhere_is_nan(averaging: str) -> None:
    got = summarise(make_table({"abs_rel": [math.nan], "ssim": [math.nan]}, pixels=[0]), averaging=averaging)
    assert all(math.isnan(value) for value in got.values())


def test_what_is_written_is_read(tmp_path: Path) -> None:
    table, _ = scored(3)
    table.ids[2] = 'a, "quoted"\nname'
    table.scenes[4] = ""
    path = tmp_path / "per_image.csv"
    path.write_text(per_image_csv(table), encoding="utf-8")
    read = read_per_image(path)
    assert (read.ids, read.scenes, read.categories) == (table.ids, table.scenes, table.categories)
    assert read.pixels.tolist() == table.pixels.tolist()
    assert list(read.values) == list(table.values)
    for name, values in table.values.items():
        np.testing.assert_allclose(read.values[name], values, rtol=5e-9)
    for averaging in ("image", "pooled"):
        assert summarise(read, averaging=averaging) == pytest.approx(summarise(table, averaging=averaging), rel=1e-7)


def test_numbers_have_nine_significant_digits() -> None:
    table = make_table({"abs_rel": [1 / 3, math.nan], "ssim": [1.0, 2e-7 / 3]}, pixels=[238560, 0])
    assert per_image_csv(table) == (
        "id,scene,category,pixels,abs_rel,ssim\n"
        "000,room_0,room,238560,0.333333333,1\n"
        "001,room_0,room,0,nan,6.66666667e-08\n"
    )


@pytest.mark.parametrize("protocol", ["eigen", "paper"])
def test_a_published_table_gives_the_published_metrics(protocol: str) -> None:
    stated = json.loads((STUDY / protocol / "metrics.json").read_text())
    table = read_per_image(STUDY / protocol / "per_image.csv")
    assert stated["protocol"]["averaging"] == "image"
    found = summarise(table, averaging="image")
    found.pop("rmse_pooled")  # the table was published without it
    assert found == pytest.approx(stated["metrics"]["model"], rel=1e-6)


HEADER = "id,scene,category,pixels,abs_rel,rmse\n"
AGAIN = "Run hudepth-test again."


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "' cannot be read as a table of images ([Errno 2] No such file or directory: '{path}')."),
        ("", "', line 1: the header is not"),
        ("id,scene,pixels,abs_rel\n", "', line 1: the header is not"),
        ("id,scene,category,pixels\n", "', line 1: the header is not"),
        (
            "id,scene,category,pixels,rmse,rmse\n",
            "', line 1: the header is not",
        ),
        (HEADER, "' contains no image"),
        (HEADER + "0,s,c,9,0.1,0.2\n1,s,c,9,0.1\n", "', line 3: 5 values under 6 names."),
        (HEADER + "0,s,c,9,0.1,0.2\n\n", "', line 3: 0 values under 6 names."),
        (HEADER + "0,s,c,9.5,0.1,0.2\n", "', line 2: pixels '9.5' is not a count"),
        (HEADER + "0,s,c,99999999999999999999,0.1,0.2\n", "', line 2: pixels '99999999999999999999' is not a count"),
        (HEADER + "0,s,c,-9,0.1,0.2\n", "', line 2: pixels '-9' is not a count"),
        (HEADER + "0,s,c,9,0.1,0.2x\n", "', line 2: rmse '0.2x' is not a number"),
        (HEADER + "0,s,c,9,0.1,0.2\n0,s,c,9,0.1,0.2\n", "', line 3: a second row of image '0'."),
    ],
)
def test_damage_is_named(tmp_path: Path, content: str | None, why: str) -> None:
    path = tmp_path / "per_image.csv"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(DataError) as caught:
        read_per_image(path)
    assert str(caught.value).startswith(f"'{path}{why.format(path=path)}")
    assert str(caught.value).endswith(AGAIN)


def test_binary_is_no_table(tmp_path: Path) -> None:
    path = tmp_path / "per_image.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="cannot be read as a table of images"):
        read_per_image(path)
