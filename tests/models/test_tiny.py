from __future__ import annotations

import pytest
import torch

from hudepth.base.errors import ConfigError
from hudepth.models import TinyUNet


@pytest.mark.parametrize("channels", [1, 8, 16])
def test_size(channels: int) -> None:
    net = TinyUNet(channels=channels)
    expected = 3 * 256 * channels + channels + 2 * channels + 256 * channels + 1
    assert sum(p.numel() for p in net.parameters()) == expected


def test_takes_and_returns_what_the_hybrid_unet_does() -> None:
    unit_depth = TinyUNet()(torch.randn(2, 3, 32, 48))
    assert unit_depth.shape == (2, 1, 32, 48)
    assert 0 <= unit_depth.min() < unit_depth.max() <= 1


def test_gradient_reaches_every_parameter() -> None:
    net = TinyUNet()
    net(torch.randn(2, 3, 32, 32)).square().mean().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in net.parameters())


def test_a_few_steps_fit_a_picture() -> None:
    torch.manual_seed(0)
    net, image, truth = TinyUNet(), torch.randn(2, 3, 32, 32), torch.rand(2, 1, 32, 32)
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-2)
    losses = []
    for _ in range(60):
        loss = (net(image) - truth).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_size_that_does_not_fit() -> None:
    with pytest.raises(ConfigError) as caught:
        TinyUNet()(torch.zeros(1, 3, 30, 32))
    assert str(caught.value) == (
        "data.size: images of 30 x 32 (height x width), but both sides must be multiples of 16. "
        "Pass data.size=[16,32] or [32,32]."
    )
