from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import colormaps

from hudepth.base.errors import ConfigError
from hudepth.viz.colour import UNMEASURED_GREY, colour_depth

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


@pytest.mark.parametrize("height", [7, 48, 480, 1080])
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
