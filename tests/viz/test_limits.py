from __future__ import annotations

import math

import pytest

from hudepth.viz.limits import usual_range


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ([1, 2, 3], (1, 3)),
        ([1, 2, 3, 1000], (1, 3)),
        ([-900, 1, 2, 3, math.nan, math.inf], (1, 3)),
        ([2, 2, 2, 9], (2, 9)),
        ([], (0, 1)),
        ([5], (5, 5)),
    ],
)
def test_what_is_far_out_does_not_set_the_scale(values: list[float], ends: tuple[float, float]) -> None:
    assert usual_range(values) == ends
