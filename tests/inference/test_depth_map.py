from __future__ import annotations

import errno
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hudepth.base.errors import ConfigError, DataError
from hudepth.inference.depth_files import FORMATS, Style, write_depth
from hudepth.inference.depth_map import DepthMap

shapes = hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)
depths = hnp.arrays(np.float32, shapes, elements=st.floats(0, 65.5, width=32))


@given(depths)
def test_png16_is_within_half_a_millimetre(metres: np.ndarray) -> None:
    image = np.zeros((*metres.shape, 3), np.uint8)
    stored = cv2.imdecode(np.frombuffer(DepthMap(metres, image, 10.0).to_png16(), np.uint8), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    kept = metres.astype(np.float64)
    wrong = np.abs(stored / 1000 - kept)
    tiny = (kept > 0) & (kept < 0.0005)  # measured, so never 0, which says unmeasured
    assert (wrong[~tiny] <= 0.0005 + 1e-6).all()
    assert (stored[tiny] == 1).all()
    assert ((stored == 0) == (metres == 0)).all()


def test_png16_does_not_cut_depth() -> None:
    depth = DepthMap(np.array([[1.0, 80.0]], np.float32), np.zeros((1, 2, 3), np.uint8), 80.0)
    with pytest.raises(DataError, match=r"depth of 80 m, 16-bit millimetres hold 65\.535 m\. Use formats=\[npy\]"):
        depth.to_png16()


def test_pictures_and_points() -> None:
    metres = np.linspace(1, 4, 48 * 64, dtype=np.float32).reshape(48, 64)
    image = np.full((48, 64, 3), 200, np.uint8)
    depth = DepthMap(metres, image, 10.0)
    coloured, side = depth.colourise(), depth.side_by_side()
    assert (side[:, :64] == image).all()
    assert (side[:, 64:] == coloured).all()
    assert depth.colourise(legend=False).shape == image.shape
    assert not np.array_equal(depth.colourise(scale_m=(1, 4)), coloured)
    cloud = depth.point_cloud((500.0, 500.0, 32.0, 24.0), edges=True)
    assert len(cloud.points_m) == metres.size
    assert "as given" in cloud.comment


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of file sizes")
@pytest.mark.parametrize("name", FORMATS)
def test_every_format_says_why_it_cannot_be_written(name: str, tmp_path: Path) -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    metres = np.random.default_rng(0).random((48, 64), np.float32)
    depth = DepthMap(metres, np.zeros((48, 64, 3), np.uint8), 10.0, uncertainty_m=metres)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (512, before[1]))  # the first bytes can be written
        with pytest.raises(OSError, match="too large") as caught:
            write_depth(tmp_path / "x", depth, [name], Style((0.0, 10.0)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.errno == errno.EFBIG
    assert not list(tmp_path.iterdir())


def make_map(*, seed: int = 0) -> DepthMap:
    random = np.random.default_rng(seed)
    return DepthMap(
        (1 + random.random((12, 16))).astype(np.float32), random.integers(256, size=(12, 16, 3), dtype=np.uint8), 10.0
    )


def test_maps_are_compared_by_what_they_hold_and_shown_in_a_line() -> None:
    depth = make_map()
    assert depth == make_map()
    assert depth != make_map(seed=1)
    assert depth != replace(depth, max_depth_m=5.0)
    assert depth != replace(depth, metres=depth.metres + 1)
    assert depth != 1
    with pytest.raises(TypeError, match="unhashable"):
        hash(depth)
    low, high = depth.metres.min(), depth.metres.max()
    assert repr(depth).startswith(f"DepthMap(12 x 16, {low:.2f} to {high:.2f} m, ")


def test_the_suffix_says_what_is_saved(tmp_path: Path) -> None:
    depth = make_map()
    for name in ("a.png", "a.npy", "a.ply", "a.glb", "a.jpg", "b.JPEG"):
        depth.save(tmp_path / name)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), depth.metres)
    stored = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(stored / 1000, depth.metres, atol=5.1e-4)
    assert (tmp_path / "a.ply").read_bytes() == depth.point_cloud().to_ply()
    assert (tmp_path / "a.glb").read_bytes() == depth.point_cloud().to_glb()
    assert cv2.imread(str(tmp_path / "a.jpg")).shape == depth.colourise().shape
    with pytest.raises(ConfigError, match=r"save: 'a\.tiff' has none of the endings \.png, \.npy"):
        depth.save(tmp_path / "a.tiff")
    deep = replace(depth, metres=depth.metres + 100)
    with pytest.raises(DataError, match="16-bit"):
        deep.save(tmp_path / "a.png")
    assert cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED).max() < 2001  # nothing was overwritten


def test_points_that_are_written(tmp_path: Path) -> None:
    metres = np.full((12, 16), 2.0, np.float32)
    metres[:, 8:] = 6.0
    depth = replace(make_map(), metres=metres)
    counts = []
    for style in (Style(edges=True), Style(), Style(points=50)):
        write_depth(tmp_path / "a", depth, ["ply"], style)
        head = (tmp_path / "a_depth.ply").read_bytes().partition(b"end_header")[0].decode()
        counts.append(next(int(line.split()[2]) for line in head.splitlines() if line.startswith("element vertex")))
    assert counts == [192, 168, 50]
