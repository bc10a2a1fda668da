"""ResNet-18 as an encoder: up to layer3, as in table A1, or to layer4 (He et al., CVPR 2016).

Parameter names are torchvision's, so its ImageNet file loads unchanged.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any, Literal
from urllib.error import URLError

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError
from hudepth.models.encoder import Encoder, Stage, draw_kernels, run_stage
from hudepth.models.weights import load_fitting, read_state

IMAGENET_URL = "https://download.pytorch.org/models/resnet18-f37072fd.pth"
"""torchvision's ResNet18_Weights.IMAGENET1K_V1; the name contains the first digits of the file's sha256."""

LAYER4, CLASSIFIER = "layer4.", "fc."
"""Prefixes of the tensors of a full ResNet-18 that table A1 leaves out."""


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut, which is a 1x1 convolution where the shape changes."""

    def __init__(self, channels_in: int, channels_out: int, *, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels_out)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels_out)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or channels_in != channels_out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels_in, channels_out, 1, stride=stride, bias=False), nn.BatchNorm2d(channels_out)
            )

    def forward(self, x: Float[Tensor, "b c_in h w"]) -> Float[Tensor, "b c_out h2 w2"]:
        """Return the block's output, at half the size if the stride is 2."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.relu(self.bn2(self.conv2(x)) + shortcut)
        return x


class ResNet18Encoder(Encoder):
    """ResNet-18 without fc: up to layer3 (``layers=3``, table A1) or to layer4 (``layers=4``, the paper's text).

    ``norm``: see :class:`hudepth.models.Encoder`.
    """

    def __init__(self, *, layers: Literal[3, 4] = 3, norm: str = "trained") -> None:
        super().__init__(norm=norm)
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.stages = (Stage("stem", 64, 2, ("conv1", "bn1")),)
        width = 64
        for i, channels in enumerate((64, 128, 256, 512)[:layers], start=1):
            first = BasicBlock(width, channels, stride=1 if i == 1 else 2)
            self.add_module(f"layer{i}", nn.Sequential(first, BasicBlock(channels, channels)))
            self.stages = (*self.stages, Stage(f"layer{i}", channels, 2 ** (i + 1), (f"layer{i}",)))
            width = channels
        draw_kernels(self)
        self.train()  # applies frozen norms from the start

    @classmethod
    def from_pretrained(cls, weights: str | None, **options: Any) -> ResNet18Encoder:
        """Build the encoder and load ImageNet weights.

        An encoder with layer4 also takes a file without it: its layer4 then stays random, with a warning.

        Args:
            weights: ``imagenet`` (torchvision's file, downloaded once and checked by its hash), the path of a file with
                torchvision's parameter names, or None or ``none`` for random values.
            **options: of the constructor.

        Raises:
            CheckpointError: if the file cannot be downloaded or read, or a tensor is missing, unknown or misshapen.
        """
        encoder = cls(**options)
        if weights not in (None, "none"):
            encoder._load(str(weights))
        return encoder

    def forward(self, image: Float[Tensor, "b 3 h w"], *, run: Callable[..., Any] = run_stage) -> list[Tensor]:
        """Return the feature maps at 1/2, 1/4, 1/8 and 1/16 of the image's size, and at 1/32 with layer4."""
        features = [self.relu(self.bn1(self.conv1(image)))]
        x = self.maxpool(features[0])
        for stage in self.stages[1:]:
            x = run(getattr(self, stage.name), x)
            features.append(x)
        return features

    def _load(self, weights: str) -> None:
        state = _download_imagenet() if weights == "imagenet" else read_state(weights, fix=_FIX)
        own = self.state_dict()
        has_layer4 = any(name.startswith(LAYER4) for name in own)
        ignored = (CLASSIFIER,) if has_layer4 else (CLASSIFIER, LAYER4)
        state = {name: value for name, value in state.items() if not name.startswith(ignored)}
        without_layer4 = not any(name.startswith(LAYER4) for name in state)
        if without_layer4:
            state |= {name: value for name, value in own.items() if name.startswith(LAYER4)}
        load_fitting(self, state, weights=weights, fix=_FIX)
        if has_layer4 and without_layer4:
            log.warning("model.weights: '%s' has no layer4, which starts at random", weights)


_FIX = "Pass a ResNet-18 state_dict with torchvision's parameter names, or model.weights=none."


def _download_imagenet() -> dict[str, Tensor]:
    timeout = socket.getdefaulttimeout()
    socket.setdefaulttimeout(20)  # seconds; urllib waits forever by default
    try:
        state: dict[str, Tensor] = torch.hub.load_state_dict_from_url(
            IMAGENET_URL, map_location="cpu", check_hash=True, weights_only=True
        )
    except (URLError, OSError, RuntimeError) as error:
        raise CheckpointError(
            f"model.weights=imagenet: could not download {IMAGENET_URL} ({error}). "
            "Pass model.weights=<path to resnet18-f37072fd.pth>, or model.weights=none to train from scratch."
        ) from error
    finally:
        socket.setdefaulttimeout(timeout)
    return state
