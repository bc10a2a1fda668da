from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from hudepth.base import verbs
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.instantiate import instantiate
from hudepth.models import ResNet18UNet
from hudepth.models.resnet import ResNet18Encoder
from hudepth.runs.checkpoint import KEY, VERSION, load_checkpoint

CONFIGS = {"resnet18_unet": 0, "hybrid_unet_text": 4}
"""Files of conf/model, and how many transformer layers each has."""


def conv(channels_in: int, channels_out: int, side: int, *, bias: bool = False) -> int:
    return channels_in * channels_out * side**2 + bias * channels_out


def norm(channels: int) -> int:
    return 2 * channels


def basic_blocks(channels_in: int, channels_out: int) -> int:
    """Two residual blocks; the first has a 1 x 1 shortcut where the width changes."""
    count = conv(channels_in, channels_out, 3) + 3 * conv(channels_out, channels_out, 3) + 4 * norm(channels_out)
    return count + (conv(channels_in, channels_out, 1) + norm(channels_out)) * (channels_in != channels_out)


def up_block(channels_in: int, channels_skip: int, channels_out: int) -> int:
    first = conv(channels_in + channels_skip, channels_out, 3, bias=True)
    return first + conv(channels_out, channels_out, 3, bias=True) + 2 * norm(channels_out)


def transformer(channels: int) -> int:
    attention = 4 * (channels * channels + channels)  # queries, keys, values, output
    feed_forward = channels * 4 * channels + 4 * channels + 4 * channels * channels + channels
    return attention + feed_forward + 2 * norm(channels)


# Module, output of a 224 x 224 image without the batch, parameters.
TABLE = [
    ("encoder.conv1", (64, 112, 112), conv(3, 64, 7)),
    ("encoder.bn1", (64, 112, 112), norm(64)),
    ("encoder.layer1", (64, 56, 56), basic_blocks(64, 64)),
    ("encoder.layer2", (128, 28, 28), basic_blocks(64, 128)),
    ("encoder.layer3", (256, 14, 14), basic_blocks(128, 256)),
    ("encoder.layer4", (512, 7, 7), basic_blocks(256, 512)),
    ("attention", (512, 7, 7), 4 * transformer(512)),
    ("up1", (256, 14, 14), up_block(512, 256, 256)),
    ("up2", (128, 28, 28), up_block(256, 128, 128)),
    ("up3", (64, 56, 56), up_block(128, 64, 64)),
    ("up4", (64, 112, 112), up_block(64, 64, 64)),
    ("head.up", (32, 224, 224), conv(64, 32, 4, bias=True)),
    ("head.conv", (1, 224, 224), conv(32, 1, 3, bias=True)),
]
RESNET18 = 11_176_512
"""Parameters of torchvision's resnet18 (11,689,512) without those of fc (512 x 1000 + 1000)."""


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def configured(name: str) -> dict[str, Any]:
    return dict(yaml.safe_load((verbs.conf_folder() / "model" / f"{name}.yaml").read_text()))


@pytest.fixture(scope="module")
def net() -> ResNet18UNet:
    torch.manual_seed(0)
    return ResNet18UNet(attention_layers=4)


@pytest.fixture(scope="module")
def shapes(net: ResNet18UNet) -> dict[str, tuple[int, ...]]:
    seen = {}
    handles = [
        module.register_forward_hook(lambda _, __, out, name=name: seen.__setitem__(name, out.shape))
        for name, module in net.named_modules()
        if name in {row[0] for row in TABLE}
    ]
    with torch.no_grad():
        net.train()(torch.randn(2, 3, 224, 224))
    for handle in handles:
        handle.remove()
    return seen


@pytest.mark.parametrize(("name", "shape", "parameters"), TABLE, ids=[row[0] for row in TABLE])
def test_row(net: ResNet18UNet, shapes: dict[str, Any], name: str, shape: tuple[int, ...], parameters: int) -> None:
    assert shapes[name] == (2, *shape)
    assert count(net.get_submodule(name)) == parameters


def test_the_rows_are_all_there_is(net: ResNet18UNet) -> None:
    total = sum(row[2] for row in TABLE)
    assert count(net) == total == 27_029_377
    assert all(parameter.requires_grad for parameter in net.parameters())
    assert sum(row[2] for row in TABLE if row[0].startswith("encoder")) == count(net.encoder) == RESNET18


@pytest.mark.parametrize(("name", "layers"), CONFIGS.items())
def test_configured_networks(name: str, layers: int) -> None:
    config = configured(name)
    built = instantiate(config, only=nn.Module)
    expected = 14_419_841 + layers * transformer(512)
    assert count(built) == expected
    assert f" {expected:,} parameters." in (verbs.conf_folder() / "model" / f"{name}.yaml").read_text()
    assert len(built.attention) == layers


def test_the_encoder_names_its_parts_as_torchvision_does() -> None:
    """From torchvision's code: conv1, bn1, four layers of two blocks, a shortcut where a layer changes the width."""
    norms = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    expected = {"conv1.weight", *(f"bn1.{n}" for n in norms)}
    for layer in (1, 2, 3, 4):
        for block in (0, 1):
            at = f"layer{layer}.{block}"
            expected |= {f"{at}.conv{i}.weight" for i in (1, 2)} | {f"{at}.bn{i}.{n}" for i in (1, 2) for n in norms}
            if layer > 1 and block == 0:
                expected |= {f"{at}.downsample.0.weight", *(f"{at}.downsample.1.{n}" for n in norms)}
    assert set(ResNet18Encoder(layers=4).state_dict()) == expected


def test_layer4_changes_nothing_before_it() -> None:
    torch.manual_seed(0)
    short = ResNet18Encoder().eval()
    long = ResNet18Encoder(layers=4).eval()
    long.load_state_dict(short.state_dict(), strict=False)
    image = torch.randn(1, 3, 64, 96)
    three, four = short(image), long(image)
    assert len(three) == 4
    assert all(torch.equal(a, b) for a, b in zip(three[:4], four[:4], strict=True))
    assert long.layer4 is not None
    assert torch.equal(four[4], long.layer4(four[3]))


def test_the_parts_are_joined_as_a_unet(net: ResNet18UNet) -> None:
    net.eval()
    encoder, image = net.encoder, torch.randn(1, 3, 64, 96)
    skip0 = encoder.relu(encoder.bn1(encoder.conv1(image)))
    skip1 = encoder.layer1(encoder.maxpool(skip0))
    skip2 = encoder.layer2(skip1)
    skip3 = encoder.layer3(skip2)
    assert encoder.layer4 is not None
    x = encoder.layer4(skip3)
    for block in net.attention:
        x = block(x)
    x = net.up4(net.up3(net.up2(net.up1(x, skip3), skip2), skip1), skip0)
    assert torch.equal(net(image), torch.sigmoid(net.head.conv(net.head.up(x))))
    assert all(part.std() > 0.1 for part in (skip0, skip1, skip2, skip3))  # so that a part that is left out shows


SMALL = ResNet18UNet().eval()


@pytest.mark.slow
@given(rows=st.integers(1, 4), columns=st.integers(1, 4), batch=st.integers(1, 2))
def test_any_size_that_is_a_multiple_of_32(rows: int, columns: int, batch: int) -> None:
    with torch.inference_mode():
        unit_depth = SMALL(torch.randn(batch, 3, 32 * rows, 32 * columns))
    assert unit_depth.shape == (batch, 1, 32 * rows, 32 * columns)
    assert 0 <= unit_depth.min() < unit_depth.max() <= 1


@given(height=st.integers(1, 200), width=st.integers(1, 200))
def test_any_other_size_is_told_the_nearest(height: int, width: int) -> None:
    if height % 32 == 0 and width % 32 == 0:
        return
    with pytest.raises(ConfigError) as caught:
        SMALL(torch.zeros(1, 3, height, width))
    asked, _, mend = str(caught.value).partition(" Pass data.size=")
    assert asked == (
        f"data.size: images of {height} x {width} (height x width), but both sides must be multiples of 32."
    )
    for size in mend.removesuffix(".").split(" or "):
        near = [int(side) for side in size.strip("[]").split(",")]
        assert all(side % 32 == 0 and side > 0 for side in near)
        assert all(abs(a - b) < 32 for a, b in zip(near, (height, width), strict=True))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"attention_layers": -1}, r"model\.attention_layers: -1 "),
        ({"attention_layers": 1, "attention_heads": 7}, r"model\.attention_heads: 7 "),
        ({"attention_layers": 1, "attention_activation": "rely"}, r"model\.attention_activation: .*'relu'"),
        ({"attention_layers": 1, "attention_positions": "sin"}, r"model\.attention_positions: .*'sine'"),
        ({"output": "sigmoyd"}, r"model\.output: .*'sigmoid'"),
    ],
)
def test_unknown_option(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        ResNet18UNet(**options)


@pytest.mark.slow
def test_options_change_the_output() -> None:
    image, outputs = torch.randn(1, 3, 64, 64), []
    for options in (
        {}, {"attention_heads": 4}, {"attention_activation": "gelu"}, {"attention_positions": "sine"},
        {"upsample": "bilinear"}, {"output": "softplus"},
    ):  # fmt: skip
        torch.manual_seed(0)
        outputs.append(ResNet18UNet(attention_layers=1, **options).eval()(image))  # type: ignore[arg-type]
    assert all(not torch.equal(a, b) for i, a in enumerate(outputs) for b in outputs[:i])


@pytest.mark.slow
def test_without_attention_far_corners_are_out_of_reach() -> None:
    """What the transformer layers add: each pixel sees the whole image."""
    for layers, seen in ((0, False), (1, True)):
        net = ResNet18UNet(attention_layers=layers).eval().double()
        image = torch.randn(1, 3, 576, 32, dtype=torch.float64, requires_grad=True)
        net(image)[..., 0, 0].sum().backward()
        assert image.grad is not None
        assert bool(image.grad[..., :32, :].any())
        assert bool(image.grad[..., -32:, :].any()) is seen


def test_gradient_reaches_every_parameter(net: ResNet18UNet) -> None:
    net.train().zero_grad()
    net(torch.randn(2, 3, 64, 64)).square().mean().backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0] == []
    net.zero_grad()


@pytest.fixture
def state() -> dict[str, Tensor]:
    torch.manual_seed(1)
    return ResNet18Encoder(layers=4).state_dict()


def saved(tmp_path: Path, content: Any) -> str:
    torch.save(content, tmp_path / "resnet.pth")
    return str(tmp_path / "resnet.pth")


def test_a_full_file_loads_whole(tmp_path: Path, state: dict[str, Tensor], caplog: pytest.LogCaptureFixture) -> None:
    full = {**state, "fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}
    loaded = ResNet18UNet(weights=saved(tmp_path, full)).encoder.state_dict()
    assert loaded.keys() == state.keys()
    assert all(torch.equal(loaded[name], state[name]) for name in state)
    assert not caplog.records


def test_a_file_without_layer4_loads_the_rest_and_says_so(
    tmp_path: Path, state: dict[str, Tensor], caplog: pytest.LogCaptureFixture
) -> None:
    short = {name: value for name, value in state.items() if not name.startswith("layer4.")}
    path = saved(tmp_path, short)
    with caplog.at_level(logging.INFO, logger="hudepth"):
        encoder = ResNet18UNet(weights=path).encoder
    assert [(r.levelname, r.getMessage()) for r in caplog.records] == [
        ("WARNING", f"model.weights: '{path}' has no layer4, which starts at random")
    ]
    loaded = encoder.state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in short.items())
    # He initialisation by fan-out: 512 x 3 x 3 outputs of each input value
    assert loaded["layer4.1.conv2.weight"].std().item() == pytest.approx((2 / (512 * 9)) ** 0.5, rel=0.05)


def test_half_a_layer4_is_a_mistake(tmp_path: Path, state: dict[str, Tensor]) -> None:
    path = saved(tmp_path, {name: value for name, value in state.items() if not name.startswith("layer4.1.")})
    with pytest.raises(CheckpointError, match=r"model\.weights: .* 10 tensors missing.*'layer4\.1\.bn1\.bias'"):
        ResNet18UNet(weights=path)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGS)
def test_a_checkpoint_gives_the_network_back(name: str, tmp_path: Path) -> None:
    """Without trust, so that it is laid out without memory first."""
    model = configured(name)
    net = instantiate(model, only=nn.Module).eval()
    own = {"version": VERSION, "config": {"model": {**model, "weights": "/gone.pth"}}, "split": {}, "data": {}}
    tensors = {f"net.{key}": value for key, value in net.state_dict().items()}
    torch.save({"epoch": 0, "state_dict": tensors, KEY: own}, tmp_path / "x.ckpt")
    image = torch.randn(1, 3, 64, 32)
    with torch.inference_mode():
        assert torch.equal(load_checkpoint(str(tmp_path / "x.ckpt")).build_net(trust=[])(image), net(image))
