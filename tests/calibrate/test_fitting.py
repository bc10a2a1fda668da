from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import DataError
from hudepth.calibrate.fitting import Measured, abs_rel, choose, fit_power, fit_scale, try_kinds
from hudepth.inference.calibration import Calibration


def images(
    count: int, *, scale: float, power: float = 1.0, noise: float = 0.0, scene_noise: float = 0.0, per_scene: int = 1
) -> list[Measured]:
    """Images whose depth is scale * prediction ** power, times log-normal noise of pixels and of scenes."""
    random = np.random.default_rng(0)
    made = []
    for number in range(count):
        pred = random.uniform(0.5, 6, 100 + 50 * number)
        shift = np.random.default_rng([1, number // per_scene]).normal(0, scene_noise)
        truth = scale * pred**power * np.exp(random.normal(0, noise, pred.size) + shift)
        made.append(Measured(f"{number}", f"s{number // per_scene}", pred, truth))
    return made


@given(st.floats(0.2, 5), st.floats(0.5, 2))
def test_what_was_done_to_depth_is_found_and_undone(scale: float, power: float) -> None:
    exact = images(4, scale=scale, power=power)
    found = fit_power(exact)
    assert found is not None
    assert (found.scale, found.power) == pytest.approx((scale, power), rel=1e-6)
    assert max(abs_rel(image, found) for image in exact) < 1e-6
    alone = fit_scale(images(4, scale=scale))
    assert alone is not None
    assert (alone.scale, alone.power) == (pytest.approx(scale), 1.0)


def test_a_fit_is_least_squares_of_log_depth_with_equal_weight_for_images() -> None:
    """Against numpy's own least squares, each row weighted by one over the image's pixels."""
    noisy = images(5, scale=1.3, power=0.8, noise=0.3)
    found = fit_power(noisy)
    assert found is not None
    weights = np.concatenate([np.full(image.pred_m.size, image.pred_m.size**-0.5) for image in noisy])
    x = np.log(np.concatenate([image.pred_m for image in noisy]))
    y = np.log(np.concatenate([image.truth_m for image in noisy]))
    a, b = np.linalg.lstsq(np.stack([weights, weights * x], axis=1), weights * y, rcond=None)[0]
    assert (math.log(found.scale), found.power) == pytest.approx((a, b))


def test_one_depth_tells_no_power() -> None:
    flat = [Measured("a", "a", np.full(9, 2.0), np.full(9, 3.0)), Measured("b", "b", np.full(9, 2.1), np.full(9, 3.1))]
    assert fit_power(flat) is None
    assert set(try_kinds(flat)) == {"scale"}


def test_pictures_are_corrected_by_fits_on_other_scenes() -> None:
    """By hand, for three images of one pixel each: the scale is the geometric mean of the other two."""
    ratios = (1.0, 2.0, 4.0)
    made = [Measured(str(i), "", np.array([1.0]), np.array([ratio])) for i, ratio in enumerate(ratios)]
    trial = try_kinds(made)["scale"]
    left_out = [math.sqrt(8) - 1, abs(2.0 - 2) / 2, abs(math.sqrt(2) - 4) / 4]
    assert trial.abs_rel == pytest.approx(np.mean(left_out))
    assert trial.calibration.scale == pytest.approx(2.0)
    assert trial.change.value == pytest.approx(np.mean(left_out) - np.mean([0, 0.5, 0.75]))
    assert math.isnan(trial.change.high)  # three scenes give no interval


def test_frames_of_a_scene_are_left_out_together() -> None:
    """Two scenes that differ: a fit that saw a frame of the same scene would do well."""
    made = [image for scene in (0, 1) for image in images(4, scale=(1.0, 3.0)[scene])]
    made = [Measured(f"{i}", f"scene{i // 4}", image.pred_m, image.truth_m) for i, image in enumerate(made)]
    trial = try_kinds(made)["scale"]
    assert trial.abs_rel == pytest.approx((2.0 + 2 / 3) / 2)
    assert choose({"scale": trial}) is None


def test_a_wrong_scale_is_corrected_and_a_right_one_is_left_alone() -> None:
    wrong = try_kinds(images(24, scale=1.4, noise=0.1, scene_noise=0.1, per_scene=2))
    assert wrong["scale"].change.high < 0
    assert choose(wrong) == "scale"  # the power lowers the error by less than 2 %
    assert choose(try_kinds(images(24, scale=1.0, noise=0.1, scene_noise=0.2))) is None
    assert choose(try_kinds(images(24, scale=1.0, power=0.6, noise=0.05))) == "scale and power"


def test_one_scene_cannot_be_checked() -> None:
    with pytest.raises(DataError, match=r"^data: all depths are of one scene"):
        try_kinds(images(3, scale=2.0, per_scene=3))


@given(st.floats(1e-3, 1e3), st.floats(0.1, 10), st.floats(0, 10))
def test_a_calibration_is_a_scale_and_shift_of_log_depth(scale: float, power: float, depth: float) -> None:
    found = Calibration(scale, power).apply(depth)
    if depth > 1e-6:
        assert math.log(found) == pytest.approx(math.log(scale) + power * math.log(depth), abs=1e-6)
    assert Calibration(scale).apply(depth) == depth * scale
