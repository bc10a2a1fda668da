from __future__ import annotations

import math

import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from hudepth.metrics.student import EXPANDED_FROM, student_quantile


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95, 0.99])
@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 5, 9, 30, 199, 200, 214, 1000, 100_000])
def test_quantiles_are_those_of_scipy(freedom: int, level: float) -> None:
    expected = scipy.stats.t.ppf(0.5 + level / 2, freedom)
    assert student_quantile(freedom, level=level) == pytest.approx(expected, rel=1e-8)


@given(freedom=st.integers(1, EXPANDED_FROM + 20), level=st.floats(0.01, 0.995))
def test_any_level_and_number(freedom: int, level: float) -> None:
    assert student_quantile(freedom, level=level) == pytest.approx(
        scipy.stats.t.ppf(0.5 + level / 2, freedom), rel=1e-7
    )


def test_the_two_that_everybody_knows() -> None:
    assert student_quantile(1) == pytest.approx(12.7062047364, rel=1e-10)
    assert student_quantile(2) == pytest.approx(4.30265272991, rel=1e-10)


@pytest.mark.parametrize(("freedom", "level"), [(0, 0.95), (-3, 0.95), (4, 0.0), (4, 1.0), (4, math.nan)])
def test_what_there_is_none_of(freedom: int, level: float) -> None:
    with pytest.raises(ValueError, match="no t of"):
        student_quantile(freedom, level=level)
