"""Grouped AdamW: who is in which group, and that each group takes the steps it should."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.models import HybridUNet
from hudepth.training.optim import GroupedAdamW, fit_state


class Net(nn.Module):
    """A kernel, a bias and a norm in the encoder and outside it."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Conv2d(2, 3, 3), nn.BatchNorm2d(3))
        self.encoders = nn.Linear(2, 2, bias=False)  # whose name only begins like the encoder's
        self.head = nn.Conv2d(3, 1, 1)


def groups(optimizer: torch.optim.Optimizer) -> dict[str, dict[str, Any]]:
    return {group["name"]: group for group in optimizer.param_groups}


def test_groups_by_part_and_by_decay() -> None:
    net = Net()
    found = groups(
        GroupedAdamW(net.named_parameters(), encoder=net.encoder, lr=1e-3, encoder_lr_factor=0.3, weight_decay=0.05)
    )
    names = {name: group["param_names"] for name, group in found.items()}
    assert names == {
        "encoder": ["encoder.0.weight"],
        "encoder_no_decay": ["encoder.0.bias", "encoder.1.weight", "encoder.1.bias"],
        "rest": ["encoders.weight", "head.weight"],
        "rest_no_decay": ["head.bias"],
    }
    rates = {name: (group["lr"], group["weight_decay"]) for name, group in found.items()}
    assert rates == {
        "encoder": (pytest.approx(3e-4), 0.05),
        "encoder_no_decay": (pytest.approx(3e-4), 0.0),
        "rest": (1e-3, 0.05),
        "rest_no_decay": (1e-3, 0.0),
    }


def test_every_parameter_of_the_hybrid_unet_is_in_one_group() -> None:
    net = HybridUNet()
    found = groups(GroupedAdamW(net.named_parameters(), encoder=net.encoder, lr=1e-3))
    members = [id(parameter) for group in found.values() for parameter in group["params"]]
    assert len(members) == len(set(members))
    assert set(members) == {id(parameter) for parameter in net.parameters()}
    inside = {id(parameter) for parameter in net.encoder.parameters()}
    for name, group in found.items():
        for parameter in group["params"]:
            assert (id(parameter) in inside) == name.startswith("encoder")
            assert (parameter.ndim == 1) == name.endswith("_no_decay")


def test_empty_groups_are_left_out() -> None:
    assert set(groups(GroupedAdamW(nn.Linear(2, 2).named_parameters(), lr=1.0))) == {"rest", "rest_no_decay"}
    assert set(groups(GroupedAdamW(nn.Linear(2, 2, bias=False).named_parameters(), lr=1.0))) == {"rest"}


def adamw(
    weight: NDArray[Any], gradients: list[NDArray[Any]], *, lr: float, decay: float, beta1: float, beta2: float
) -> NDArray[Any]:
    """Algorithm 2 of Loshchilov and Hutter 2019, without a schedule."""
    mean, square = np.zeros_like(weight), np.zeros_like(weight)
    for t, gradient in enumerate(gradients, start=1):
        mean = beta1 * mean + (1 - beta1) * gradient
        square = beta2 * square + (1 - beta2) * gradient**2
        step = (mean / (1 - beta1**t)) / (np.sqrt(square / (1 - beta2**t)) + 1e-8)
        weight = weight - lr * step - lr * decay * weight
    return weight


@given(factor=st.floats(0.0, 3.0), decay=st.floats(0.0, 0.5), beta1=st.floats(0.0, 0.99), seed=st.integers(0, 100))
def test_steps_are_those_of_adamw(factor: float, decay: float, beta1: float, seed: int) -> None:
    torch.manual_seed(seed)
    net, lr = Net().double(), 0.01
    optimizer = GroupedAdamW(
        net.named_parameters(),
        encoder=net.encoder,
        lr=lr,
        encoder_lr_factor=factor,
        weight_decay=decay,
        betas=(beta1, 0.95),
    )
    before = {name: parameter.detach().numpy().copy() for name, parameter in net.named_parameters()}
    gradients: list[dict[str, Tensor]] = []
    for _ in range(3):
        gradients.append({name: torch.randn_like(parameter) for name, parameter in net.named_parameters()})
        for name, parameter in net.named_parameters():
            parameter.grad = gradients[-1][name]
        optimizer.step()
    for name, parameter in net.named_parameters():
        expected = adamw(
            before[name],
            [each[name].numpy() for each in gradients],
            lr=lr * (factor if name.startswith("encoder.") else 1),
            decay=decay if parameter.ndim > 1 else 0,
            beta1=beta1,
            beta2=0.95,
        )
        np.testing.assert_allclose(parameter.detach(), expected, rtol=1e-9, atol=1e-12)


def test_a_factor_of_0_keeps_the_encoder_as_it_is() -> None:
    net = Net()
    before = {name: parameter.detach().clone() for name, parameter in net.named_parameters()}
    optimizer = GroupedAdamW(
        net.named_parameters(), encoder=net.encoder, lr=0.1, encoder_lr_factor=0.0, weight_decay=0.5
    )
    for parameter in net.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    for name, parameter in net.named_parameters():
        assert parameter.equal(before[name]) == name.startswith("encoder.")


def test_its_state_goes_into_a_checkpoint_and_back() -> None:
    net = Net()
    optimizer = GroupedAdamW(net.named_parameters(), encoder=net.encoder, lr=0.1, encoder_lr_factor=0.5)
    for parameter in net.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    again = GroupedAdamW(net.named_parameters(), encoder=net.encoder, lr=0.2)
    again.load_state_dict(optimizer.state_dict())
    assert groups(again)["encoder"]["lr"] == pytest.approx(0.05)
    assert again.state[net.head.weight]["exp_avg"].equal(optimizer.state[net.head.weight]["exp_avg"])


@pytest.mark.parametrize("factor", [-0.1, math.nan, math.inf])
def test_a_factor_that_is_none(factor: float) -> None:
    with pytest.raises(ConfigError) as caught:
        GroupedAdamW(Net().named_parameters(), lr=1e-3, encoder_lr_factor=factor)
    assert str(caught.value).startswith(f"optim.encoder_lr_factor: {factor} ")


def stepped(layout: torch.memory_format, state: dict[str, Any] | None = None) -> tuple[torch.optim.AdamW, Tensor]:
    """Take a step of a fused AdamW with the same weights and gradients in a layout, from a state if there is one."""
    torch.manual_seed(0)
    weight, gradient = torch.randn(4, 3, 2, 2), torch.randn(4, 3, 2, 2)
    parameter = nn.Parameter(weight.to(memory_format=layout))
    optimizer = torch.optim.AdamW([parameter], lr=0.1, fused=True)
    if state:
        optimizer.load_state_dict(state)
        fit_state(optimizer)
    parameter.grad = gradient.to(memory_format=layout)
    optimizer.step()
    return optimizer, parameter.detach()


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_a_state_of_another_layout_counts_the_same(layout: torch.memory_format) -> None:
    expected = [stepped(layout, stepped(other)[0].state_dict())[1] for other in (layout, torch.contiguous_format)]
    found = stepped(layout, stepped(torch.channels_last)[0].state_dict())[1]
    for each in expected:
        torch.testing.assert_close(found, each, rtol=0, atol=0)


def test_a_state_of_another_shape_is_refused() -> None:
    optimizer, _ = stepped(torch.contiguous_format)
    next(iter(optimizer.state.values()))["exp_avg"] = torch.zeros(7)
    with pytest.raises(ValueError, match="exp_avg is 7, its parameter 4 x 3 x 2 x 2"):
        fit_state(optimizer)


def test_a_state_of_other_shapes_is_its_optimisers_business() -> None:
    parameter = nn.Parameter(torch.randn(4, 3))
    optimizer = torch.optim.Adafactor([parameter])
    parameter.grad = torch.randn(4, 3)
    optimizer.step()
    shapes = {key: value.shape for key, value in optimizer.state[parameter].items()}
    fit_state(optimizer)
    assert {key: value.shape for key, value in optimizer.state[parameter].items()} == shapes
    assert torch.Size([4, 3]) not in shapes.values()
