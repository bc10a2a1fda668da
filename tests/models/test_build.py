from __future__ import annotations

from typing import Any

import pytest
from torch import nn

from hudepth.base.errors import ConfigError
from hudepth.models import TinyUNet
from hudepth.models.build import build_network


def test_a_network_of_hudepth() -> None:
    assert isinstance(build_network({"_target_": "hudepth.models.TinyUNet", "channels": 4}), TinyUNet)


@pytest.mark.parametrize(
    "model",
    [
        {"_target_": "torch.nn.LSTM", "input_size": 8, "hidden_size": 8, "num_layers": 10**8},
        {"_target_": "torch.nn.L1Loss"},
        {"_target_": "hudepth.losses.BADCL"},
        {"_target_": "hudepth.data.augment.Augmentation"},
        {"_target_": "hudepth.models.ResNet18UNet", "attention_layers": 10**8},
        {"_target_": None},
        {},
    ],
)
def test_what_is_no_network_of_hudepth(model: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as caught:
        build_network(model)
    assert "\n" not in str(caught.value)


def test_trust_allows_more() -> None:
    linear = {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3}
    assert isinstance(build_network(linear, trust=["torch.nn"]), nn.Linear)
