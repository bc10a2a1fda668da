from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from hudepth.models import HybridUNet
from hudepth.models.recompute import recomputed


def step(net: nn.Module, image: Tensor) -> tuple[Tensor, int]:
    """Train a step; return the output and how many bytes were kept for the gradients."""
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        output = net(image)
    output.square().mean().backward()
    return output.detach(), sum(kept.values())


def pair(**options: Any) -> tuple[HybridUNet, HybridUNet]:
    torch.manual_seed(0)
    plain = HybridUNet(**options)
    other = HybridUNet(**options, recompute=True)
    other.load_state_dict(plain.state_dict())
    return plain, other


@pytest.mark.parametrize("arithmetic", ["plain", "merged"])
def test_training_is_the_same_and_keeps_less(arithmetic: str) -> None:
    plain, other = pair(arithmetic=arithmetic)
    image = torch.randn(2, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    for _ in range(2):  # the second step shows what the first left in batch norm
        plain.zero_grad()
        other.zero_grad()
        (expected, all_kept), (output, less_kept) = step(plain, image), step(other, image)
        assert torch.equal(output, expected)
        for ours, theirs in zip(other.parameters(), plain.parameters(), strict=True):
            assert torch.equal(ours.grad, theirs.grad)  # type: ignore[arg-type]
    assert less_kept < 0.5 * all_kept
    for name, value in plain.state_dict().items():
        assert torch.equal(other.state_dict()[name], value), name


def test_nothing_is_recomputed_without_training() -> None:
    _, other = pair()
    other.eval()
    calls: list[nn.Module] = []
    other.up1.register_forward_hook(lambda module, *_: calls.append(module))
    other(torch.zeros(1, 3, 32, 32)).sum().backward()
    assert len(calls) == 1


def test_statistics_come_back_though_the_second_pass_fails() -> None:
    class Once(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.norm, self.calls = nn.BatchNorm2d(2), 0

        def forward(self, x: Tensor) -> Tensor:
            self.calls += 1
            if self.calls > 1:
                raise RuntimeError("second pass")
            result: Tensor = self.norm(x)
            return result

    module = Once()
    output = recomputed(module, torch.randn(2, 2, 4, 4, requires_grad=True))
    before = copy.deepcopy(module.norm.state_dict())
    with pytest.raises(RuntimeError, match="second pass"):
        output.sum().backward()
    assert module.norm.momentum == 0.1
    for name, value in module.norm.state_dict().items():
        assert torch.equal(value, before[name]), name
