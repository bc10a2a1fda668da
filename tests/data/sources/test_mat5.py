"""The MATLAB 5 reader against scipy, and against files that are damaged on purpose."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hudepth.base.errors import DataError
from hudepth.data.sources import mat5
from hudepth.data.sources.mat5 import read_mat5

DTYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")


def saved(variables: Mapping[str, object], *, compressed: bool) -> bytes:
    buffer = io.BytesIO()
    pytest.importorskip("scipy.io").savemat(buffer, variables, do_compression=compressed)
    return buffer.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", DTYPES)
def test_reads_what_scipy_writes(dtype: str, compressed: bool) -> None:
    array = np.arange(24).reshape(2, 3, 4).astype(dtype)
    found = read_mat5(saved({"a": array, "long_name": array[0, :, :1]}, compressed=compressed), where="x")
    assert list(found) == ["a", "long_name"]
    np.testing.assert_array_equal(found["a"], array)
    assert found["a"].dtype == array.dtype
    np.testing.assert_array_equal(found["long_name"], array[0, :, :1])


def test_other_kinds_of_variables_are_stepped_over() -> None:
    variables = {
        "text": "abc",
        "cell": np.array([[1, "a"]], dtype=object),
        "struct": {"x": 1.0},
        "complex": np.array([[1 + 2j]]),
        "flags": np.array([[True, False]]),
        "empty": np.zeros((0, 3)),
    }
    found = read_mat5(saved(variables, compressed=True), where="x")
    assert set(found) == {"flags", "empty"}
    assert found["empty"].shape == (0, 3)


def element(order: str, kind: int, body: bytes) -> bytes:
    return struct.pack(f"{order}II", kind, len(body)) + body + b"\0" * (-len(body) % 8)


def by_hand(order: str, *, dims: tuple[int, int] = (2, 1), values: bytes | None = None) -> bytes:
    """Build a file byte by byte: the 2 x 1 double matrix x = [1; 300], its values stored as uint16."""
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(f"{order}HH", 0x0100, 0x4D49)
    body = b"".join(
        [
            element(order, 6, struct.pack(f"{order}II", 6, 0)),
            element(order, 5, struct.pack(f"{order}ii", *dims)),
            struct.pack(f"{order}I", 1 << 16 | 1) + b"x\0\0\0",  # small element
            element(order, 4, values or struct.pack(f"{order}HH", 1, 300)),
        ]
    )
    return header + element(order, 14, body)


@pytest.mark.parametrize("order", ["<", ">"])
def test_reads_both_byte_orders(order: str) -> None:
    found = read_mat5(by_hand(order), where="x")
    np.testing.assert_array_equal(found["x"], [[1.0], [300.0]])
    assert found["x"].dtype == np.float64


DAMAGED = "'s.mat': the MATLAB 5 file is truncated or damaged. Copy the file again."


@pytest.mark.parametrize("dims", [(3, 1), (-2, -1), (2**31 - 1, 2**31 - 1)])
def test_dimensions_must_fit(dims: tuple[int, int]) -> None:
    with pytest.raises(DataError) as caught:
        read_mat5(by_hand("<", dims=dims), where="'s.mat'")
    assert str(caught.value) == DAMAGED


@given(cut=st.integers(129, len(by_hand("<")) - 1))
def test_truncated(cut: int) -> None:
    with pytest.raises(DataError) as caught:
        read_mat5(by_hand("<")[:cut], where="'s.mat'")
    assert str(caught.value) == DAMAGED


@settings(max_examples=200)
@given(noise=st.binary(max_size=80))
def test_noise_never_raises_anything_else(noise: bytes) -> None:
    try:
        found = read_mat5(by_hand("<")[:128] + noise, where="'s.mat'")
    except DataError:
        return
    assert found == {}


def test_truncated_compression() -> None:
    body = zlib.compress(by_hand("<")[128:])[:-6]
    data = by_hand("<")[:128] + struct.pack("<II", 15, len(body)) + body
    with pytest.raises(DataError) as caught:
        read_mat5(data, where="'s.mat'")
    assert str(caught.value) == DAMAGED


def test_decompression_is_bounded_over_all_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = by_hand("<")
    body = zlib.compress(plain[128:])
    variable = struct.pack("<II", 15, len(body)) + body
    monkeypatch.setattr(mat5, "MAX_BYTES", 2 * len(plain[128:]))
    assert set(read_mat5(plain[:128] + 2 * variable, where="x")) == {"x"}
    with pytest.raises(DataError) as caught:
        read_mat5(plain[:128] + 3 * variable, where="'s.mat'")
    assert str(caught.value) == "'s.mat': holds more than 0 MiB. It cannot be a list of splits."


@pytest.mark.parametrize("data", [b"", b"\x89HDF\r\n\x1a\n" + b"\0" * 200, b"MATLAB 7.3".ljust(126) + b"IM"])
def test_other_files(data: bytes) -> None:
    with pytest.raises(DataError) as caught:
        read_mat5(data, where="'s.mat'")
    assert str(caught.value) == "'s.mat': not a MATLAB 5 file. Save it with save('-v6') or save('-v7')."


def test_official_split(nyu_root: Path) -> None:
    path = nyu_root / "splits.mat"
    found = read_mat5(path.read_bytes(), where=str(path))
    train, test = found["trainNdxs"].ravel(), found["testNdxs"].ravel()
    assert (len(train), len(test)) == (795, 654)
    assert sorted([*train, *test]) == list(range(1, 1450))
    expected = pytest.importorskip("scipy.io").loadmat(path)
    for name, array in found.items():
        np.testing.assert_array_equal(array, expected[name])
