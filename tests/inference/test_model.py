from __future__ import annotations

import numpy as np
import pytest
import torch

import hudepth
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.inference.model import DepthModel
from hudepth.inference.model_info import ModelInfo


class Columns:
    """Predicts the brightness of a pixel plus a tenth of its column: what mirroring changes."""

    name = "columns"

    def __init__(self, info: ModelInfo) -> None:
        self.info = info

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        return (rgb.mean(-1) + 0.1 * np.arange(rgb.shape[2])).astype(np.float32)


@pytest.mark.parametrize("count", [1, 3])
def test_flipping_averages_with_the_mirrored_image_mirrored_back(grey: DepthModel, count: int) -> None:
    backend = Columns(grey.info)
    images = list(np.random.default_rng(0).integers(0, 255, (count, *grey.info.size, 3), np.uint8))
    plain = DepthModel(backend).predict_many(images, batch_size=2)
    flipped = DepthModel(backend, flip=True).predict_many(images, batch_size=2)
    width = grey.info.size[1]
    for image, before, after in zip(images, plain, flipped, strict=True):
        np.testing.assert_allclose(before.metres, image.mean(-1) + 0.1 * np.arange(width), rtol=1e-5)
        np.testing.assert_allclose(after.metres, image.mean(-1) + 0.1 * (width - 1) / 2, rtol=1e-5)


def test_the_bundled_pretrained_model_sees_depth() -> None:
    model = hudepth.load("nyu")
    assert model.info.size == (160, 160)
    floor = np.zeros((240, 320, 3), np.uint8)
    floor[:] = np.linspace(60, 200, 240).astype(np.uint8)[:, None, None]
    metres = model.predict(floor).metres
    assert metres.shape == (240, 320)
    assert 0.3 < metres.min() < metres.max() < 10


def test_a_missing_bundled_model_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hudepth.runs.bundles.find_spec", lambda _: None)
    with pytest.raises(CheckpointError, match=r"checkpoint: .*'nyu'"):
        hudepth.load("nyu")


def test_tensors_are_pictures_and_lists_are_cameras(grey: DepthModel) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    depth = grey.predict(rgb)
    for tensor in (torch.from_numpy(rgb), torch.from_numpy(rgb).permute(2, 0, 1)):
        np.testing.assert_array_equal(grey.predict(tensor).metres, depth.metres)
    given = depth.point_cloud((60.0, 61.0, 32.0, 24.0)).points_m
    matrix = np.array([[60, 0, 32], [0, 61, 24], [0, 0, 1]])
    for camera in ([60.0, 61.0, 32.0, 24.0], np.array([60, 61, 32, 24]), matrix):
        np.testing.assert_array_equal(depth.point_cloud(camera).points_m, given)
    with pytest.raises(TypeError, match=r"intrinsics: .*list"):
        depth.point_cloud([60.0, 61.0])
    with pytest.raises(ConfigError, match=r"intrinsics: .*64 x 48"):
        depth.point_cloud([4.2, 4.2, 2.0, 3.0])
