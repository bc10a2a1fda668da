"""Depth encodings against per-pixel arithmetic, and every refusal with its text."""

from __future__ import annotations

import math
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.encoding import ENCODINGS, DepthRange, check_range, resolve_encoding, to_metres

SHAPES = st.tuples(st.integers(1, 4), st.integers(1, 4))
UINT8 = arrays(np.uint8, SHAPES)
UINT16 = arrays(np.uint16, SHAPES)


def oracle(raw: np.ndarray, exact: object) -> np.ndarray:
    """Apply a rational formula to every pixel and round once; what is not positive is unmeasured."""
    values = [float(exact(int(value))) for value in raw.ravel()]  # type: ignore[operator]
    return np.array([max(value, 0.0) for value in values], np.float32).reshape(raw.shape)


@given(raw=UINT16)
def test_uint16_mm_is_thousandths(raw: np.ndarray) -> None:
    depth = to_metres(raw, "uint16_mm")
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, oracle(raw, lambda value: Fraction(value, 1000)))


def test_uint8_10m_maps_255_to_10_metres() -> None:
    raw = np.arange(256, dtype=np.uint8).reshape(16, 16)
    depth = to_metres(raw, "uint8_10m")
    assert depth.dtype == np.float32
    np.testing.assert_array_max_ulp(depth, oracle(raw, lambda value: Fraction(value * 10, 255)), maxulp=1)
    assert (depth[0, 0], depth[-1, -1]) == (0.0, 10.0)


@given(raw=st.one_of(UINT8, UINT16))
def test_paper_literal_divides_any_integer_by_1000(raw: np.ndarray) -> None:
    depth = to_metres(raw, "paper_literal")
    np.testing.assert_array_equal(depth, oracle(raw, lambda value: Fraction(value, 1000)))


@given(raw=UINT8, scale=st.floats(1e-4, 1.0), offset=st.floats(-10, 10))
def test_linear_measures_every_positive_result(raw: np.ndarray, scale: float, offset: float) -> None:
    depth = to_metres(raw, "linear", scale_m=scale, offset=offset)
    expected = oracle(raw, lambda value: (value + offset) * scale)
    np.testing.assert_array_equal(depth, expected)


def test_linear_zero_is_a_measurement() -> None:
    depth = to_metres(np.array([[0, 1]], np.uint8), "linear", scale_m=0.02, offset=0.5)
    np.testing.assert_array_equal(depth, np.array([[0.01, 0.03]], np.float32))


def test_linear_zero_without_offset_is_unmeasured() -> None:
    assert to_metres(np.zeros((1, 1), np.uint8), "linear", scale_m=0.02)[0, 0] == 0.0


@given(raw=arrays(st.sampled_from([np.float16, np.float32, np.float64]), SHAPES))
def test_float_m_keeps_values_and_drops_what_is_no_depth(raw: np.ndarray) -> None:
    depth = to_metres(raw, "float_m")
    assert depth.dtype == np.float32
    for got, value in zip(depth.ravel(), raw.ravel(), strict=True):
        with np.errstate(over="ignore"):
            single = float(np.float32(value))
        assert got == (single if math.isfinite(single) and single > 0 else 0.0)


def test_not_a_number_infinite_and_negative_are_unmeasured() -> None:
    raw = np.array([[np.nan, np.inf, -np.inf, -1.0, 0.0, 2.5]])
    np.testing.assert_array_equal(to_metres(raw, "float_m"), np.array([[0, 0, 0, 0, 0, 2.5]], np.float32))


def test_the_stored_array_is_left_alone() -> None:
    raw = np.array([[np.nan, -1.0, 2.0]], np.float32)
    before = raw.copy()
    to_metres(raw, "float_m")
    np.testing.assert_array_equal(raw, before)


@pytest.mark.parametrize(
    ("dtype", "scale", "auto_uint8", "expected"),
    [
        ("u1", True, None, "linear"),
        ("u2", True, "uint8_10m", "linear"),
        ("u2", False, None, "uint16_mm"),
        (">u2", False, None, "uint16_mm"),
        ("u2", False, "uint8_10m", "uint16_mm"),
        ("f2", False, None, "float_m"),
        ("f8", False, None, "float_m"),
        ("u1", False, "uint8_10m", "uint8_10m"),
    ],
)
def test_auto_resolves(dtype: str, scale: bool, auto_uint8: str | None, expected: str) -> None:
    assert resolve_encoding("auto", dtype=np.dtype(dtype), has_scale=scale, auto_uint8=auto_uint8) == expected


@pytest.mark.parametrize("encoding", [name for name in ENCODINGS if name != "auto"])
def test_a_named_encoding_stays(encoding: str) -> None:
    assert resolve_encoding(encoding, dtype=np.dtype("u1"), has_scale=True, auto_uint8=None) == encoding


def test_auto_converts_by_dtype() -> None:
    np.testing.assert_array_equal(to_metres(np.full((1, 1), 2500, np.uint16), "auto"), np.float32(2.5))
    np.testing.assert_array_equal(
        to_metres(np.full((1, 1), 51, np.uint8), "auto", auto_uint8="uint8_10m"), np.float32(2.0)
    )
    np.testing.assert_array_equal(to_metres(np.full((1, 1), 51, np.uint8), "auto", scale_m=0.1), np.float32(5.1))


REFUSED = [
    (
        np.array([[3, 255]], np.uint8),
        "uint16_mm",
        None,
        "'0.png': 8-bit data declared as millimetres (largest value 255 = 0.255 m). "
        "Use data.encoding=uint8_10m for value/255*10 m, "
        "or data.encoding=paper_literal to read it so on purpose.",
    ),
    (
        np.zeros((1, 1), np.float32),
        "uint16_mm",
        None,
        "'0.png': float32 data declared as uint16_mm. Use data.encoding=float_m.",
    ),
    (
        np.zeros((1, 1), np.uint16),
        "uint8_10m",
        None,
        "'0.png': uint16 data declared as uint8_10m. Use data.encoding=uint16_mm.",
    ),
    (
        np.zeros((1, 1), np.uint8),
        "float_m",
        None,
        "'0.png': uint8 data declared as float_m. Use data.encoding=uint8_10m.",
    ),
    (
        np.zeros((1, 1), np.float64),
        "paper_literal",
        None,
        "'0.png': float64 data declared as paper_literal. Use data.encoding=float_m.",
    ),
    (
        np.zeros((1, 1), np.uint8),
        "auto",
        None,
        "'0.png': the unit of uint8 depth is unknown. Pass data.encoding=uint8_10m (value/255*10 m) "
        "or paper_literal (value/1000 m).",
    ),
    (
        np.zeros((1, 1), np.int32),
        "auto",
        None,
        "'0.png': the unit of int32 depth is unknown. Pass data.encoding=uint16_mm.",
    ),
    (
        np.zeros((1, 1), np.uint8),
        "linear",
        None,
        "'0.png': data.encoding=linear needs a scale for each image, and there is none. "
        "Add the column depth_scale_m to the index, or pass another data.encoding.",
    ),
    (
        np.zeros((1, 1), np.uint8),
        "linear",
        -0.5,
        "'0.png': depth scale -0.5 m with offset 0.0. The scale must be positive and both must be finite.",
    ),
    (
        np.zeros((1, 1), np.uint8),
        "linear",
        math.nan,
        "'0.png': depth scale nan m with offset 0.0. The scale must be positive and both must be finite.",
    ),
    (
        np.zeros((1, 1), bool),
        "float_m",
        None,
        "'0.png': depth values of type bool are not numbers. Store integers or floats.",
    ),
    (
        np.zeros((2, 3, 1), np.uint16),
        "auto",
        None,
        "'0.png': depth has shape (2, 3, 1). Store one value per pixel, as [H, W].",
    ),
]


@pytest.mark.parametrize(("raw", "encoding", "scale_m", "message"), REFUSED)
def test_refuses(raw: np.ndarray, encoding: str, scale_m: float | None, message: str) -> None:
    with pytest.raises(DataError) as caught:
        to_metres(raw, encoding, scale_m=scale_m, where="'0.png'")
    assert str(caught.value) == message


def test_unknown_encoding() -> None:
    with pytest.raises(ConfigError, match=r"data\.encoding: .*Did you mean 'uint16_mm'"):
        to_metres(np.zeros((1, 1), np.uint16), "uint16_m")


def test_range_is_of_the_measured_pixels() -> None:
    depths = [np.array([[0, 1, 2]], np.float32), np.array([[0], [4], [9], [8]], np.float32)]
    found = check_range(depths, indoor=True, encoding="float_m", name="folder")
    assert found == DepthRange(min_m=1.0, median_m=4.0, max_m=9.0, valid_fraction=5 / 7)


@pytest.mark.parametrize(("depth_m", "shown"), [(0.255, "0.255"), (2500.0, "2.5e+03"), (0.29, "0.29")])
def test_range_refuses_an_implausible_room(depth_m: float, shown: str) -> None:
    depths = [np.full((2, 2), depth_m, np.float32)]
    with pytest.raises(DataError) as caught:
        check_range(depths, indoor=True, encoding="uint16_mm", name="folder")
    assert str(caught.value) == (
        f"data.encoding=uint16_mm: 'folder' has a median depth of {shown} m, indoor sets lie in 0.3 to 20 m. "
        "Pass another data.encoding (uint8_10m, float_m, linear, paper_literal), "
        "or data.source.indoor=false for outdoor pairs."
    )
    assert check_range(depths, indoor=False, encoding="uint16_mm", name="folder").median_m == np.float32(depth_m)


def test_range_lets_the_paper_through() -> None:
    depths = [np.full((2, 2), 0.1, np.float32)]
    assert check_range(depths, indoor=True, encoding="paper_literal", name="x").median_m == np.float32(0.1)


@pytest.mark.parametrize("depths", [[], [np.zeros((2, 2), np.float32)]])
def test_range_refuses_depth_without_measurement(depths: list[np.ndarray]) -> None:
    with pytest.raises(DataError) as caught:
        check_range(depths, indoor=False, encoding="paper_literal", name="folder")
    assert str(caught.value) == (
        f"data.encoding=paper_literal: no pixel of 'folder' is measured in {len(depths)} depth maps. "
        "Check data.root, or pass another data.encoding (uint16_mm, uint8_10m, float_m, linear)."
    )


def test_sources_do_without_torch() -> None:
    names = ("files", "manifest", "nyu_mat", "densedepth", "nyu_raw", "folder")
    imports = "; ".join(f"import hudepth.data.sources.{name}" for name in names)
    code = f"import sys; {imports}; import hudepth.data.encoding; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
