from __future__ import annotations

import pytest
import torch

from experiments.ledger.units import ERRORS, READINGS, Rooms, predictions, render_rooms, scaling_at_eps, score_readings
from hudepth.losses.badcl import BADCL


@pytest.fixture(scope="module")
def rooms() -> Rooms:
    return render_rooms(frames=3, side_px=48)


def test_rooms_are_unit_depth(rooms: Rooms) -> None:
    assert rooms.image.shape == (3, 3, 48, 48)
    assert rooms.unit_depth.shape == (3, 1, 48, 48)
    assert rooms.unit_depth.min() > 0
    assert rooms.unit_depth.max() <= 1
    assert not torch.equal(rooms.unit_depth[0], rooms.unit_depth[1])


@pytest.mark.parametrize("kind", ERRORS)
def test_each_image_has_the_asked_relative_error(rooms: Rooms, kind: str) -> None:
    error = (predictions(rooms, abs_rel=0.063)[kind] - rooms.unit_depth).abs() / rooms.unit_depth
    torch.testing.assert_close(error.mean(dim=(1, 2, 3)), torch.full((3,), 0.063), rtol=1e-4, atol=0)


def test_baselines_have_seen_no_image(rooms: Rooms) -> None:
    made = predictions(rooms)
    assert torch.equal(made["mean depth map"][0], made["mean depth map"][2])
    torch.testing.assert_close(made["mean depth map"][0], rooms.unit_depth.mean(dim=0))
    assert len(made["mean depth"].unique()) == 1


def test_misread_depth_shrinks_loss_and_rmse_but_not_abs_rel(rooms: Rooms) -> None:
    scores = {(s.reading, s.prediction): s for s in score_readings(rooms, predictions(rooms))}
    right, misread = READINGS
    assert READINGS[misread] == 0.0255  # 255 / 10 m / 1000, then as before
    for prediction in (*ERRORS, "mean depth", "truth itself"):
        a, b = scores[right, prediction], scores[misread, prediction]
        assert b.abs_rel == pytest.approx(a.abs_rel, rel=1e-4)
        assert b.loss == pytest.approx(0.0255 * a.loss, rel=1e-3)  # every term is linear in depth
        assert b.rmse_m == pytest.approx(0.0255 * a.rmse_m, rel=1e-3)
        assert b.ssim >= a.ssim


def test_loss_is_the_papers(rooms: Rooms) -> None:
    made = predictions(rooms)
    score = next(s for s in score_readings(rooms, made) if s.prediction == "smooth error")
    valid = torch.ones_like(rooms.unit_depth, dtype=torch.bool)
    expected = BADCL(boundary=3.0, smoothness=1.2, scaling=1.0)(
        made["smooth error"], rooms.unit_depth, rooms.image, valid
    )
    assert score.loss == pytest.approx(float(expected.total))


def test_scaling_at_eps_by_hand() -> None:
    truth = torch.full((1, 1, 4, 4), 0.5)
    rooms = Rooms(torch.zeros(1, 3, 4, 4), truth)
    assert scaling_at_eps(rooms, truth * 0.8, eps=1e-8) == pytest.approx((1.25, 1.25 * 0.1))
    s = 16 * 0.5 / 1e8
    assert scaling_at_eps(rooms, truth * 0.8, eps=1e8) == pytest.approx((s, s * 0.1), rel=1e-4)
