from __future__ import annotations

import numpy as np
import torch

from hudepth.base.normalise import IMAGENET_MEAN, IMAGENET_STD, NormaliseBytes, denormalise_image, normalise_image


def test_normalise_agrees_with_numpy() -> None:
    image = np.random.default_rng(0).random((2, 3, 4, 5))
    # torchvision's constants, written out: a slip in the module would cancel against itself
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    expected = (image - mean[:, None, None]) / std[:, None, None]
    np.testing.assert_allclose(normalise_image(torch.from_numpy(image)).numpy(), expected, rtol=1e-14)


def test_denormalise_inverts_normalise() -> None:
    image = torch.rand(2, 3, 4, 5, dtype=torch.float64)
    torch.testing.assert_close(denormalise_image(normalise_image(image)), image, rtol=0, atol=1e-15)


def test_statistics_are_plain_floats() -> None:
    assert all(type(value) is float for value in (*IMAGENET_MEAN, *IMAGENET_STD))


def test_bytes_are_normalised_as_images_are() -> None:
    rgb = torch.randint(0, 256, (2, 5, 7, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    image = NormaliseBytes()(rgb)
    assert torch.allclose(image, normalise_image(rgb.permute(0, 3, 1, 2).float() / 255), atol=1e-6)
    assert image.is_contiguous(memory_format=torch.channels_last)  # as the bytes lie: nothing was copied about
