from __future__ import annotations

import pytest

from hudepth.base.camera import Intrinsics


def test_at_nyus_own_size_it_is_nyus_camera() -> None:
    camera = Intrinsics.of_nyu(480, 640)
    found = (camera.fx, camera.fy, camera.cx, camera.cy)
    assert found == pytest.approx((518.857901, 519.469611, 325.582449, 253.736166))


def test_the_field_of_view_is_the_same_at_any_size() -> None:
    full, half = Intrinsics.of_nyu(480, 640), Intrinsics.of_nyu(240, 224)
    # The outer edge of the image (-0.5) lies in the same direction at every size.
    assert (half.cx + 0.5) / half.fx == pytest.approx((full.cx + 0.5) / full.fx)
    assert (224 - 0.5 - half.cx) / half.fx == pytest.approx((640 - 0.5 - full.cx) / full.fx)
    assert (half.cy + 0.5) / half.fy == pytest.approx((full.cy + 0.5) / full.fy)
