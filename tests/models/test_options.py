from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.models.options import NEAREST_UNIT_DEPTH, OUTPUTS, DepthBins, LogDepth, choose


def make_case(channels: int, seed: int = 0, *, spread: float = 3.0) -> Tensor:
    return spread * torch.randn(2, channels, 3, 4, generator=torch.Generator().manual_seed(seed))


@given(seed=st.integers(0, 1000), spread=st.floats(0.1, 30.0))
def test_log_depth_agrees_with_the_formula(seed: int, spread: float) -> None:
    """0.01 to the power of a sigmoid that falls, which is 0.01 ** (1 - share) of a share that rises."""
    x = make_case(1, seed, spread=spread)
    share = 1 / (1 + np.exp(-x.double().numpy()))
    np.testing.assert_allclose(LogDepth()(x), 0.01 ** (1 - share), rtol=1e-5)


def test_log_depth_by_hand() -> None:
    x = torch.tensor([-math.inf, -math.log(3), 0.0, math.log(3), math.inf]).reshape(1, 1, 1, 5)
    found = LogDepth()(x).flatten().tolist()
    assert found == pytest.approx([0.01, 10**-1.5, 0.1, 10**-0.5, 1.0], rel=1e-6)


@given(seed=st.integers(0, 1000), spread=st.floats(0.1, 30.0))
def test_bins_agree_with_the_formula(seed: int, spread: float) -> None:
    """The expectation of 64 depths from 1 cm to 1 m in equal ratios, over a softmax."""
    x = make_case(64, seed, spread=spread)
    centres = 0.01 * 100 ** (np.arange(64) / 63)
    odds = np.exp(x.double().numpy() - x.double().numpy().max(axis=1, keepdims=True))
    expected = np.einsum("bkhw,k->bhw", odds / odds.sum(axis=1, keepdims=True), centres)[:, None]
    found = DepthBins()(x)
    assert found.shape == (2, 1, 3, 4)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("chosen", [0, 31, 63])
def test_a_sure_bin_is_its_depth(chosen: int) -> None:
    x = torch.zeros(1, 64, 1, 1)
    x[0, chosen] = 100
    assert DepthBins()(x).item() == pytest.approx(0.01 * 100 ** (chosen / 63), rel=1e-6)


def test_depths_of_bins_are_no_parameters_and_not_saved() -> None:
    bins = DepthBins()
    assert list(bins.parameters()) == []
    assert bins.state_dict() == {}
    assert bins.to(torch.float64).centres.dtype == torch.float64  # but go where the network goes


@pytest.mark.parametrize(("build", "channels"), [(LogDepth, 1), (DepthBins, 64)])
@given(data=st.lists(st.floats(-1e4, 1e4, width=32), min_size=64, max_size=64))
def test_depths_stay_between_the_nearest_and_1(
    build: Callable[[], nn.Module], channels: int, data: list[float]
) -> None:
    x = torch.tensor(data).reshape(-1, channels, 1, 1).requires_grad_()
    depth = build()(x)
    assert depth.min() >= NEAREST_UNIT_DEPTH * (1 - 1e-6)
    assert depth.max() <= 1 + 1e-6
    (gradient,) = torch.autograd.grad(depth.sum(), x)
    assert gradient.isfinite().all()


@pytest.mark.parametrize(("build", "channels"), [(LogDepth, 1), (DepthBins, 64)])
def test_half_precision_costs_only_the_rounding_of_the_input(build: Callable[[], nn.Module], channels: int) -> None:
    x = make_case(channels).bfloat16()
    depth = build()(x)
    assert depth.dtype == torch.float32
    assert depth.equal(build()(x.float()))


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.float16])
def test_bins_of_a_network_in_another_precision(dtype: torch.dtype) -> None:
    x = make_case(64).to(dtype)
    torch.testing.assert_close(DepthBins().to(dtype)(x), DepthBins()(x.float()), rtol=5e-3, atol=0, check_dtype=False)


def test_every_output_takes_what_it_asks_for() -> None:
    for build in OUTPUTS.values():
        output = build()
        assert output(make_case(getattr(output, "channels_in", 1))).shape == (2, 1, 3, 4)


def test_choosing() -> None:
    choices = {"one": 1, "two": 2}
    assert choose("model.x", "two", choices) == 2
    with pytest.raises(ConfigError, match=r"model\.x: 'tow' .*one, two.* 'two'"):
        choose("model.x", "tow", choices)
