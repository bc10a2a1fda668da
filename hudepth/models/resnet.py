"""ResNet-18 up to and including layer3, the encoder of table A1, or layer4 (He et al., CVPR 2016).

Parameter names are torchvision's, so that its ImageNet file loads as it is.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast
from urllib.error import URLError

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError, did_you_mean
from hudepth.models.options import choose

IMAGENET_URL = "https://download.pytorch.org/models/resnet18-f37072fd.pth"
"""torchvision's ResNet18_Weights.IMAGENET1K_V1; the name carries the first digits of the file's sha256."""

LAYER4 = "layer4."
"""Prefix of the layer that table A1 leaves out."""

NORMS = {"trained": False, "frozen": True}
"""Values of ``model.trunk_norm``: whether batch norm keeps the statistics it starts with."""

CLASSIFIER = "fc."
"""Prefix of the part of a full ResNet-18 file that no trunk has."""


class Features(NamedTuple):
    """What the trunk hands to attention and decoder, finest first."""

    stem: Float[Tensor, "b 64 h/2 w/2"]
    layer1: Float[Tensor, "b 64 h/4 w/4"]
    layer2: Float[Tensor, "b 128 h/8 w/8"]
    layer3: Float[Tensor, "b 256 h/16 w/16"]
    layer4: Float[Tensor, "b 512 h/32 w/32"] | None = None
    """None where the trunk ends with layer3."""


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
        """Return the block's output, of half the size where the stride is 2."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        x = self.relu(self.bn2(self.conv2(x)) + shortcut)
        return x


def run_stage(module: nn.Module, *inputs: Tensor) -> Any:
    """Return ``module(*inputs)``."""
    return module(*inputs)


class ResNet18Trunk(nn.Module):
    """ResNet-18 without fc, and by default without layer4.

    Args:
        weights: ``imagenet`` (torchvision's file, downloaded once and checked by its hash), the path of a file with
            torchvision's parameter names, or ``none`` for random values.
        layers: 3 ends with layer3 (table A1), 4 with layer4 (the paper's text).
        norm: batch norm: ``trained``, or ``frozen``: normalise by the statistics of the start, in training too. Its
            scale and shift are trained either way.

    Raises:
        ConfigError: for an unknown ``norm``.
        CheckpointError: if the weights cannot be had or do not fit.
    """

    def __init__(self, *, weights: str | None = None, layers: Literal[3, 4] = 3, norm: str = "trained") -> None:
        super().__init__()
        self.norm_frozen = choose("model.trunk_norm", norm, NORMS)
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.layer1 = nn.Sequential(BasicBlock(64, 64), BasicBlock(64, 64))
        self.layer2 = nn.Sequential(BasicBlock(64, 128, stride=2), BasicBlock(128, 128))
        self.layer3 = nn.Sequential(BasicBlock(128, 256, stride=2), BasicBlock(256, 256))
        self.layer4: nn.Sequential | None = None
        if layers == 4:
            self.layer4 = nn.Sequential(BasicBlock(256, 512, stride=2), BasicBlock(512, 512))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        if weights not in (None, "none"):
            load_trunk_weights(self, weights)
        self.train()  # frozen norms are to be so from the start

    def train(self, mode: bool = True) -> ResNet18Trunk:
        """Switch to training mode, but for batch norm if that is frozen."""
        super().train(mode)
        if self.norm_frozen:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    def forward(self, image: Float[Tensor, "b 3 h w"], *, run: Callable[..., Any] = run_stage) -> Features:
        """Return the feature maps at 1/2, 1/4, 1/8 and 1/16 of the image's size, and at 1/32 with layer4.

        Args:
            image: RGB, normalised with ImageNet's statistics.
            run: how a stage is run, for example :func:`hudepth.models.recompute.recomputed`.
        """
        stem = self.relu(self.bn1(self.conv1(image)))
        layer1 = run(self.layer1, self.maxpool(stem))
        layer2 = run(self.layer2, layer1)
        layer3 = run(self.layer3, layer2)
        return Features(stem, layer1, layer2, layer3, None if self.layer4 is None else run(self.layer4, layer3))


def load_trunk_weights(trunk: ResNet18Trunk, weights: str) -> None:
    """Load ImageNet weights into ``trunk``; fc and a layer4 that the trunk lacks are ignored, all else must fit.

    A trunk with layer4 also takes a file without: its layer4 then stays random, which a line of the log says.

    Args:
        trunk: the module to fill.
        weights: ``imagenet`` or a path.

    Raises:
        CheckpointError: if the file cannot be downloaded or read, or a tensor is missing, unknown or misshapen.
    """
    state = _download_imagenet() if weights == "imagenet" else _read_weights(Path(weights).expanduser())
    own = trunk.state_dict()
    ignored = (CLASSIFIER,) if trunk.layer4 is not None else (CLASSIFIER, LAYER4)
    state = {name: value for name, value in state.items() if not name.startswith(ignored)}
    without_layer4 = not any(name.startswith(LAYER4) for name in state)
    if without_layer4:
        state |= {name: value for name, value in own.items() if name.startswith(LAYER4)}
    missing = sorted(own.keys() - state.keys())
    unknown = sorted(state.keys() - own.keys())
    misshapen = sorted(name for name in own.keys() & state.keys() if own[name].shape != state[name].shape)
    for problem, names in (("missing", missing), ("unknown", unknown), ("of another shape", misshapen)):
        if names:
            raise CheckpointError(
                f"model.weights: '{weights}' does not fit: {len(names)} tensors {problem}, the first is '{names[0]}'. "
                "Pass a ResNet-18 file with torchvision's parameter names, or model.weights=none."
            )
    trunk.load_state_dict(state)
    if trunk.layer4 is not None and without_layer4:
        log.warning("model.weights: '%s' has no layer4, which starts at random", weights)


def _read_weights(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        hint = did_you_mean(str(path), ["imagenet", "none"])
        raise CheckpointError(
            f"model.weights: no file '{path}'.{hint} Pass imagenet, none, or the path of a ResNet-18 file."
        )
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise CheckpointError(
            f"model.weights: '{path}' is not a file of plain tensors ({type(error).__name__}). "
            "Pass a ResNet-18 state_dict with torchvision's parameter names, or model.weights=none."
        ) from error
    plain = isinstance(state, dict) and all(isinstance(n, str) and isinstance(v, Tensor) for n, v in state.items())
    if not plain:
        raise CheckpointError(
            f"model.weights: '{path}' holds no state_dict. Pass a ResNet-18 file with torchvision's parameter names."
        )
    return cast("dict[str, Tensor]", state)


def _download_imagenet() -> dict[str, Tensor]:
    timeout = socket.getdefaulttimeout()
    socket.setdefaulttimeout(20)  # seconds; urllib's own default is to wait forever
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
