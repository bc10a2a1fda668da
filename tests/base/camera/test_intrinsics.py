from __future__ import annotations

import pytest

from hudepth.base.camera import Intrinsics
from hudepth.base.errors import ConfigError


def test_at_nyus_own_size_it_is_nyus_camera() -> None:
    camera = Intrinsics.of_nyu(480, 640)
    found = (camera.fx, camera.fy, camera.cx, camera.cy)
    assert found == pytest.approx((518.857901, 519.469611, 325.582449, 253.736166))


def test_a_photograph_of_another_shape_has_square_pixels() -> None:
    camera = Intrinsics.of_photo(800, 547)
    assert camera.fx == camera.fy == pytest.approx(518.857901 * 800 / 640)
    assert (camera.cx, camera.cy) == (273, 399.5)
    assert Intrinsics.of_photo(960, 1280) == Intrinsics.of_nyu(960, 1280)


@pytest.mark.parametrize("values", [(4.2, 4.2, 2, 3), (500, 4.2, 48, 64), (5000, 5000, 48, 64), (100, 100, 300, 64)])
def test_a_camera_of_another_picture(values: tuple[float, float, float, float]) -> None:
    with pytest.raises(ConfigError, match=r"camera: .*96 x 128.*pixels"):
        Intrinsics(*values).check_fit(128, 96)
    Intrinsics(100, 110, 48, 64).check_fit(128, 96)


def test_the_field_of_view_is_the_same_at_any_size() -> None:
    full, half = Intrinsics.of_nyu(480, 640), Intrinsics.of_nyu(240, 224)
    # The outer edge of the image (-0.5) lies in the same direction at every size.
    assert (half.cx + 0.5) / half.fx == pytest.approx((full.cx + 0.5) / full.fx)
    assert (224 - 0.5 - half.cx) / half.fx == pytest.approx((640 - 0.5 - full.cx) / full.fx)
    assert (half.cy + 0.5) / half.fy == pytest.approx((full.cy + 0.5) / full.fy)
