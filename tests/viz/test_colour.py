from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import colormaps

from hudepth.base.errors import ConfigError
from hudepth.viz.colour import MIN_LEGEND, UNMEASURED_GREY, auto_scale, colour_depth

TURBO = np.array([colormaps["turbo_r"](i / 255)[:3] for i in range(256)]) * 255


@given(st.floats(0.01, 12), st.sampled_from([(0.0, 10.0), (0.5, 4.0)]))
def test_a_depth_has_the_colour_of_its_place_on_the_scale(depth_m: float, scale_m: tuple[float, float]) -> None:
    near, far = scale_m
    colour = colour_depth(np.full((1, 1), depth_m, np.float32), scale_m=scale_m, legend=False)[0, 0]
    place = float(np.clip((depth_m - near) / (far - near), 0, 1)) * 255
    closest = TURBO[[int(np.floor(place)), int(np.ceil(place))]]  # matplotlib's own table, an independent one
    assert np.abs(closest - colour).max(axis=1).min() <= 4


def test_near_is_red_and_far_is_blue_and_unmeasured_is_grey() -> None:
    near, far, none = colour_depth(np.array([[1.5, 8.5, 0]], np.float32), scale_m=(0, 10), legend=False)[0].astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert (none == UNMEASURED_GREY).all()


def test_a_legend_that_would_not_be_legible_is_left_out() -> None:
    for height, there in ((MIN_LEGEND - 1, False), (MIN_LEGEND, True)):
        assert (colour_depth(np.ones((height, 20), np.float32), scale_m=(0, 10)).shape[1] > 20) is there


@pytest.mark.parametrize("height", [48, 480, 1080])
def test_the_legend_stands_beside_it_and_is_the_same_for_every_picture(height: int) -> None:
    first = colour_depth(np.full((height, 20), 2.0, np.float32), scale_m=(0, 10))
    second = colour_depth(np.full((height, 20), 5.0, np.float32), scale_m=(0, 10))
    assert first.shape[0] == height
    assert first.shape[1] > 20
    assert (first[:, 20:] == second[:, 20:]).all()
    assert not (first[:, :20] == second[:, :20]).all()


@pytest.mark.parametrize("scale", [(3, 3), (5, 1), (-1, 2), (0, float("inf")), (0, float("nan"))])
def test_a_scale_that_is_none(scale: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"^scale_m: .* Pass scale_m="):
        colour_depth(np.ones((2, 2), np.float32), scale_m=scale)


@given(
    near=st.floats(0.3, 5), span=st.floats(0, 8), height=st.integers(2, 400), width=st.integers(2, 400),
    seed=st.integers(0, 9),
)  # fmt: skip
def test_a_scale_of_its_own(near: float, span: float, height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = (near + span * rng.random((height, width))).astype(np.float32)
    low, high = auto_scale(depth)
    assert 0 <= low < high
    assert high - low >= 0.199 * (low + high) / 2
    if span > 2 * near and height * width > 1000:
        expected = np.percentile(depth, (2, 98))
        assert (low, high) == pytest.approx(expected, rel=0, abs=0.05 * span)
    depth[0, 0] = 0  # unmeasured pixels do not count
    assert auto_scale(depth) == pytest.approx((low, high), rel=0.5)


def test_the_scale_of_nothing_and_of_a_wall() -> None:
    assert auto_scale(np.zeros((3, 3), np.float32)) == (0.0, 1.0)
    assert auto_scale(np.full((3, 3), 2.0, np.float32)) == pytest.approx((1.8, 2.2))


@pytest.mark.parametrize("scale", [(0.0, 10.0), (1.87, 2.13), (0.02, 0.05), (3.0, 80.0)])
def test_the_legend_spans_the_scale(scale: tuple[float, float]) -> None:
    """Its colours, from top to bottom, are those of the depths from near to far."""
    depth = np.linspace(*scale, 300, dtype=np.float32)[:, None].repeat(4, axis=1)
    picture = colour_depth(depth, scale_m=scale).astype(int)
    bar = next(picture[:, x] for x in range(6, picture.shape[1]) if np.ptp(picture[20:280, x], axis=0).min() > 100)
    inside = bar[30:270]
    assert np.abs(inside[0] - picture[30 - 10, 0]).max() < 60
    assert np.abs(inside - picture[np.linspace(10, 290, 300).astype(int)[30:270], 0]).mean() < 25
