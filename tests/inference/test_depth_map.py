from __future__ import annotations

import errno
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hudepth.base.errors import DataError
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
    cloud = depth.point_cloud((500.0, 500.0, 32.0, 24.0))
    assert len(cloud.points_m) == metres.size
    assert "as given" in cloud.comment


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of file sizes")
@pytest.mark.parametrize("name", FORMATS)
def test_every_format_says_why_it_cannot_be_written(name: str, tmp_path: Path) -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    metres = np.random.default_rng(0).random((48, 64), np.float32)
    depth = DepthMap(metres, np.zeros((48, 64, 3), np.uint8), 10.0)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (512, before[1]))  # the first bytes can be written
        with pytest.raises(OSError, match="too large") as caught:
            write_depth(tmp_path / "x", depth, [name], Style((0.0, 10.0)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.errno == errno.EFBIG
    assert not list(tmp_path.iterdir())
