from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.camera import NYU_FOCAL, Intrinsics
from hudepth.inference.image_fit import Fit, camera_factor, fit_image, unfit_depth

sides = st.integers(1, 90)


@given(sides, sides, st.sampled_from(["stretch", "letterbox"]), st.floats(0.3, 3))
def test_any_image_fills_its_box_and_comes_back_at_its_size(height: int, width: int, fit: Fit, aspect: float) -> None:
    image = np.full((height, width, 3), 7, np.uint8)
    fitted = fit_image(image, (32, 48), fit=fit, aspect=aspect)
    assert fitted.rgb.shape == (32, 48, 3)
    assert (fitted.rgb[fitted.box] == 7).all()
    outside = np.ones((32, 48), bool)
    outside[fitted.box] = False
    assert (fitted.rgb[outside] == (124, 116, 104)).all()  # ImageNet's mean: nothing, to the network
    assert outside.any() <= (fit == "letterbox")
    depth = np.full((32, 48), 9.0, np.float32)
    depth[fitted.box] = 2.5
    back = unfit_depth(depth, fitted.box, (height, width))
    assert back.shape == (height, width)
    assert back.dtype == np.float32
    np.testing.assert_allclose(back, 2.5, rtol=1e-6)  # nothing of the padding leaks in


def test_letterbox_keeps_the_proportions_of_training() -> None:
    wide = fit_image(np.zeros((90, 160, 3), np.uint8), (224, 224), fit="letterbox", aspect=4 / 3)
    rows, columns = wide.box
    assert (columns.start, columns.stop) == (0, 224)
    assert rows.stop - rows.start == 168  # 16:9 in 4:3: three quarters of the height
    tall = fit_image(np.zeros((160, 90, 3), np.uint8), (224, 224), fit="letterbox", aspect=4 / 3)
    assert tall.box[1].stop - tall.box[1].start == round(224 * 90 / 160 * 3 / 4)
    same = fit_image(np.zeros((480, 640, 3), np.uint8), (224, 224), fit="letterbox", aspect=4 / 3)
    assert same.box == (slice(0, 224), slice(0, 224))


def test_depth_is_resized_bilinearly_about_pixel_centres() -> None:
    depth = np.array([[1.0, 3.0]], np.float32)
    back = unfit_depth(depth, (slice(0, 1), slice(0, 2)), (1, 4))
    assert back[0].tolist() == [1.0, 1.5, 2.5, 3.0]


@pytest.mark.parametrize("fit", ["stretch", "letterbox"])
def test_the_training_camera_needs_no_factor_and_a_narrower_one_its_ratio(fit: Fit) -> None:
    def factor(camera: Intrinsics, height: int, width: int) -> float:
        fitted = fit_image(np.zeros((height, width, 3), np.uint8), (224, 224), fit=fit, aspect=4 / 3)
        return camera_factor(camera, fitted, (height, width), NYU_FOCAL)

    nyu = Intrinsics.of_nyu(480, 640)
    assert factor(nyu, 480, 640) == pytest.approx(1)
    assert factor(nyu.scale(0.5, 0.5), 240, 320) == pytest.approx(1)  # a smaller copy has the same field of view
    middle = Intrinsics(nyu.fx, nyu.fy, nyu.cx - 160, nyu.cy - 120)
    assert factor(middle, 240, 320) == pytest.approx(2**0.75)  # the middle of a picture, enlarged
    wide, high = Intrinsics(nyu.fx / 2, nyu.fy, 319.5, 239.5), Intrinsics(nyu.fx, nyu.fy / 2, 319.5, 239.5)
    assert (factor(wide, 480, 640), factor(high, 480, 640)) == pytest.approx((2**-0.15, 2**-0.6))
