from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import ConfigError
from hudepth.metrics.protocol import Protocol

EIGEN: dict[str, Any] = {
    "name": "eigen",
    "resolution": "native",
    "crop": [45, 471, 41, 601],
    "min_depth_m": 1e-3,
    "max_depth_m": 10.0,
    "clamp": True,
}


@pytest.mark.parametrize(
    ("size", "rows", "columns"),
    [
        ((480, 640), (45, 471), (41, 601)),
        ((240, 320), (22, 236), (20, 300)),
        ((224, 224), (21, 220), (14, 210)),
        ((960, 1280), (90, 942), (82, 1202)),
        ((24, 32), (2, 24), (2, 30)),
    ],
)
def test_crop_is_scaled(size: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]) -> None:
    protocol = Protocol(**EIGEN)
    assert protocol.window(*size) == (slice(*rows), slice(*columns))
    assert Protocol(name="x").window(*size) == (slice(0, size[0]), slice(0, size[1]))


@given(st.integers(16, 1000), st.integers(16, 1000))
def test_crop_stays_inside_and_covers_its_share(height: int, width: int) -> None:
    rows, columns = Protocol(**EIGEN).window(height, width) or (slice(0), slice(0))
    assert 0 <= rows.start < rows.stop <= height
    assert 0 <= columns.start < columns.stop <= width
    assert (rows.stop - rows.start) / height == pytest.approx(426 / 480, abs=1.001 / height)
    assert (columns.stop - columns.start) / width == pytest.approx(560 / 640, abs=1.001 / width)


# --- the stamp --------------------------------------------------------------------------------------------------

CHANGES: dict[str, list[Any]] = {
    "name": ["other"],
    "resolution": ["network"],
    "crop": [None, [45, 471, 41, 600], [44, 471, 41, 601]],
    "crop_size": [None, [481, 640], [480, 641]],
    "crop_shares": [[0.4, 1.0, 0.0, 1.0], [0.40810811, 0.99189189, 0.03594771, 0.96405229]],
    "resize": ["bicubic", "nearest"],
    "flip": [True],
    "alignment": ["median", "least_squares", "affine_inverse"],
    "valid": ["closed", "measured"],
    "min_depth_m": [0.0, 1.0000001e-3, 2e-3],
    "max_depth_m": [None, 9.0, 10.0000001, 80.0],
    "clamp": [False],
    "averaging": ["pooled"],
    "silog_lambda": [0.5, 0.85],
    "silog_factor": [1.0, 10.0],
    "ssim_data_range_m": [9.0, 10.000001],
    "ssim_window": [7],
    "extra": [{"source": "BTS"}],
}


FURTHER = {"boundary", "strata"}
"""Fields that add measures and change none."""


def test_every_field_has_a_change() -> None:
    assert set(CHANGES) == {field.name for field in dataclasses.fields(Protocol)} - FURTHER


@pytest.mark.parametrize("field", sorted(FURTHER))
def test_what_adds_measures_keeps_the_stamp(field: str) -> None:
    assert Protocol(**{**EIGEN, field: True}).stamp() == Protocol(**EIGEN).stamp()


@pytest.mark.parametrize(("field", "value"), [(field, value) for field, values in CHANGES.items() for value in values])
def test_whatever_changes_a_number_changes_the_stamp(field: str, value: object) -> None:
    before = {**EIGEN, "crop": None} if field == "crop_shares" else EIGEN  # which stands in for it
    assert Protocol(**{**before, field: value}).stamp() != Protocol(**before).stamp()


@given(
    st.builds(
        Protocol,
        name=st.from_regex(r"\w[\w.+-]*", fullmatch=True),
        resolution=st.sampled_from(["network", "native"]),
        crop=st.none() | st.just((45, 471, 41, 601)),
        min_depth_m=st.floats(0, 1),
        max_depth_m=st.none() | st.floats(1.5, 100),
        clamp=st.booleans(),
        averaging=st.sampled_from(["image", "pooled"]),
        silog_lambda=st.floats(0, 1),
        valid=st.sampled_from(["open", "closed", "measured"]),
        flip=st.booleans(),
    )
)
def test_a_stamp_is_json(protocol: Protocol) -> None:
    assert json.loads(json.dumps(protocol.stamp(), allow_nan=False)) == protocol.stamp()


def test_the_stamp_of_the_usual_benchmark() -> None:
    assert Protocol(**EIGEN, extra={"averaging": "lie", "source": "BTS"}).stamp() == {
        "name": "eigen",
        "resolution": "native",
        "resize": "bilinear, align_corners=False",
        "crop": [45, 471, 41, 601],
        "crop_size": [480, 640],
        "valid": "measured, 0.001 m < truth < 10 m",
        "clamp_m": [0.001, 10.0],
        "averaging": "image",
        "alignment": "none",
        "test_time_flip": False,
        "silog": {"lambda": 1.0, "factor": 100.0},
        "ssim": {
            "window": 11,
            "sigma": 1.5,
            "data_range_m": 10.0,
            "averaging": "image, windows of valid pixels only",
        },
        "units": {"mae": "m", "rmse": "m", "sq_rel": "m", "mse": "m^2", "others": "1"},
        "source": "BTS",
    }


# --- options out of range ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"resolution": "natve"}, "resolution"),
        ({"averaging": "pool"}, "averaging"),
        ({"crop": [1, 2, 3]}, "crop"),
        ({"crop": [9, 9, 0, 9]}, "crop"),
        ({"crop": [-9, 9, 0, 9]}, "crop"),
        ({"crop": [0, 300, 0, 320], "crop_size": [240, 320]}, "crop"),
        ({"crop": [9, 9, 0, 9], "crop_size": None}, "crop"),
        ({"resize": "cubic"}, "resize"),
        ({"alignment": "medain"}, "alignment"),
        ({"valid": "opn"}, "valid"),
        ({"crop_size": [480]}, "crop_size"),
        ({"min_depth_m": -0.1}, "min_depth_m"),
        ({"min_depth_m": 3.0, "max_depth_m": 2.0}, "max_depth_m"),
        ({"silog_lambda": 1.5}, "silog_lambda"),
        ({"ssim_window": 0}, "ssim_window"),
        ({"ssim_data_range_m": 0.0}, "ssim_data_range_m"),
        ({"max_depth_m": math.inf}, "max_depth_m"),
        ({"silog_factor": math.nan}, "silog_factor"),
        ({"extra": {"a": math.inf}}, "extra"),
    ],
)
def test_options_out_of_range(options: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError, match=rf"^protocol\.x\.{key}: "):
        Protocol(name="x", **options)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("crop", 5),
        ("crop", [0.5, 9, 0, 9]),
        ("crop", [0, 9, 0, "a"]),
        ("crop_size", [1.5, 9]),
        ("resize", 5),
        ("min_depth_m", None),
        ("max_depth_m", "ten"),
        ("ssim_window", 2.5),
        ("flip", "maybe"),
        ("extra", 5),
    ],
)
def test_options_of_another_kind(field: str, value: object) -> None:
    protocol = Protocol(name="x")
    object.__setattr__(protocol, field, value)  # as from a configuration, bypassing the type checker of the tests
    with pytest.raises(ConfigError, match=rf"^protocol\.x\.{field}: "):
        protocol.__post_init__()


@pytest.mark.parametrize("name", ["", "..", "a/b", "/tmp/a", "a\\b", "a\n"])
def test_a_name_is_that_of_a_folder(name: str) -> None:
    with pytest.raises(ConfigError, match=r"^protocol: [\s\S]* folder"):
        Protocol(name=name)


def test_a_crop_that_leaves_nothing_of_a_small_image() -> None:
    protocol = Protocol(name="x", crop=[0, 1, 0, 640])
    assert protocol.window(480, 640) == (slice(0, 1), slice(0, 640))
    assert protocol.window(120, 160) is None


def test_a_crop_in_plain_pixels_must_fit() -> None:
    protocol = Protocol(name="x", crop=[20, 460, 24, 616], crop_size=None)
    assert protocol.window(480, 640) == protocol.window(900, 616) == (slice(20, 460), slice(24, 616))
    assert protocol.window(459, 640) is None
    assert protocol.window(480, 615) is None


@pytest.mark.parametrize(
    ("rule", "counts"),
    [
        ("open", [False, False, True, False, False]),
        ("closed", [False, True, True, True, False]),
        ("measured", [True] * 5),
    ],
)
def test_which_depths_count(rule: str, counts: list[bool]) -> None:
    protocol = Protocol(name="x", valid=rule, min_depth_m=1.0, max_depth_m=4.0)
    assert protocol.within_caps(torch.tensor([0.5, 1.0, 2.0, 4.0, 5.0])).tolist() == counts
