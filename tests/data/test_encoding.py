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
from hudepth.data.encoding import ENCODINGS, PER_M, resolve_encoding, to_metres

SHAPES = st.tuples(st.integers(1, 4), st.integers(1, 4))
UINT8 = arrays(np.uint8, SHAPES)
UINT16 = arrays(np.uint16, SHAPES)


def oracle(raw: np.ndarray, exact: object) -> np.ndarray:
    """Apply a rational formula to every pixel and round once; what is not positive is unmeasured."""
    values = [float(exact(int(value))) for value in raw.ravel()]  # type: ignore[operator]
    return np.array([max(value, 0.0) for value in values], np.float32).reshape(raw.shape)


@pytest.mark.parametrize(("encoding", "per_m"), [item for item in PER_M.items() if item[0] != "float_m"])
@given(raw=UINT16)
def test_integers_are_divided(encoding: str, per_m: int, raw: np.ndarray) -> None:
    depth = to_metres(raw, encoding, invalid=[])
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, oracle(raw, lambda value: Fraction(value, per_m)))


@given(mm=UINT16)
def test_sunrgbd_turns_the_bits_back(mm: np.ndarray) -> None:
    raw = mm << 3 | mm >> 13
    np.testing.assert_array_equal(to_metres(raw, "sunrgbd", invalid=[]), to_metres(mm, "uint16_mm", invalid=[]))


@given(raw=UINT16, focal_times_baseline=st.floats(0.1, 1000), offset=st.floats(-10, 10))
def test_disparity_is_inverse(raw: np.ndarray, focal_times_baseline: float, offset: float) -> None:
    depth = to_metres(raw, "disparity", scale_m=focal_times_baseline, offset=offset, invalid=[])
    shifted = [int(value) + offset for value in raw.ravel()]
    expected = np.array([focal_times_baseline / d if d > 0 else 0.0 for d in shifted], np.float32).reshape(raw.shape)
    np.testing.assert_array_equal(depth, np.where(np.isfinite(expected), expected, 0))


@pytest.mark.parametrize(("encoding", "value"), [("mm", 2500), ("cm", 250), ("float_m", 2.5)])
def test_units_of_floats(encoding: str, value: float) -> None:
    np.testing.assert_array_equal(to_metres(np.array([[value]], np.float32), encoding), np.float32(2.5))


@pytest.mark.parametrize("dtype", ["u2", ">u2", "i2", "i4", "u4", "i8"])
def test_the_largest_integer_is_no_reading_unless_said(dtype: str) -> None:
    raw = np.array([[1000, np.iinfo(dtype).max, 1500]], dtype)
    assert (to_metres(raw, "mm")[0] > 0).tolist() == [True, False, True]
    assert (to_metres(raw, "mm", invalid=[])[0] > 0).all()
    assert (to_metres(raw, "mm", invalid=[1500])[0] > 0).tolist() == [True, True, False]


def test_invalid_values_are_as_the_files_round_them() -> None:
    assert to_metres(np.array([[0.1, 2.0]], np.float32), "float_m", invalid=[0.1])[0].tolist() == [0, 2]
    assert to_metres(np.array([[7, 255]], np.uint8), "cm")[0].tolist() == np.float32([0.07, 2.55]).tolist()


def test_uint8_10m_maps_255_to_10_metres() -> None:
    raw = np.arange(256, dtype=np.uint8).reshape(16, 16)
    depth = to_metres(raw, "uint8_10m")
    assert depth.dtype == np.float32
    np.testing.assert_array_max_ulp(depth, oracle(raw, lambda value: Fraction(value * 10, 255)), maxulp=1)
    assert (depth[0, 0], depth[-1, -1]) == (0.0, 10.0)


@given(raw=UINT8)
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
        "'0.png': float32 data declared as uint16_mm. Use data.encoding=float_m, mm or cm.",
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
        "'0.png': float64 data declared as paper_literal. Use data.encoding=float_m, mm or cm.",
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
        "'0.png': data.encoding=linear needs a scale, and there is none. Pass data.depth_scale_m="
        "<metres per stored unit>, add the column depth_scale_m to the index, or pass another data.encoding.",
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


def test_sources_do_without_torch() -> None:
    names = ("files", "manifest", "nyu_mat", "densedepth", "nyu_raw", "folder")
    imports = "; ".join(f"import hudepth.data.sources.{name}" for name in names)
    code = f"import sys; {imports}; import hudepth.data.encoding; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
