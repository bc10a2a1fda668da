"""Resizing as a product of matrices: against OpenCV, which hudepth-predict resizes with."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from hudepth.base.images import resize_image
from hudepth.export.any_size import AnySize, area_weights, linear_weights


@given(many=st.integers(1, 60), few=st.integers(1, 60))
def test_weights_are_those_of_opencv(many: int, few: int) -> None:
    line = np.random.default_rng(0).random((many, 1)).astype(np.float32)
    for weights, method in ((area_weights, cv2.INTER_AREA), (linear_weights, cv2.INTER_LINEAR)):
        if method == cv2.INTER_AREA and few > many:
            continue  # OpenCV interpolates then
        matrix = weights(torch.arange(many), few)
        assert matrix.shape == (few, many)
        np.testing.assert_allclose(matrix.sum(dim=1), 1, atol=1e-5)
        expected = cv2.resize(line, (1, few), interpolation=method).reshape(few)
        np.testing.assert_allclose((matrix @ torch.from_numpy(line))[:, 0], expected, atol=2e-5)


class Red(nn.Module):
    """Depth is the red channel."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        assert image.dtype == torch.uint8
        self.seen = image
        return image[..., 0].float()


@pytest.mark.parametrize("size", [(12, 16), (24, 32), (31, 47), (100, 90), (5, 40), (7, 7), (12, 100)])
def test_images_are_resized_as_for_prediction(size: tuple[int, int]) -> None:
    photo = np.random.default_rng(1).integers(256, size=(*size, 3), dtype=np.uint8)
    red = Red()
    depth = AnySize(red, (12, 16))(torch.from_numpy(photo)[None])[0].numpy()
    small = resize_image(photo, (12, 16))
    seen = red.seen[0].numpy()
    assert np.abs(seen.astype(int) - small).max() <= 1
    shrinks = size[0] >= 12 and size[1] >= 16
    assert (seen != small).mean() < (0.02 if shrinks else 0.2)  # OpenCV interpolates with weights of 11 bits
    np.testing.assert_allclose(depth, cv2.resize(seen[..., 0].astype(np.float32), size[::-1]), atol=1e-3)
