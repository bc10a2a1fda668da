from __future__ import annotations

import os
import pickle
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.error import URLError

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from hudepth.base.errors import CheckpointError
from hudepth.models.resnet import IMAGENET_URL, BasicBlock, ResNet18Encoder

RESNET = "Pass a ResNet-18 state_dict with torchvision's parameter names"


@pytest.fixture
def encoder_file() -> Path:
    """File of ImageNet weights of conv1 to layer3."""
    default = Path(__file__).parents[2] / "../shared/data/resnet18/resnet18_imagenet_conv1_to_layer3.pth"
    path = Path(os.environ.get("HUDEPTH_RESNET18", default)).resolve()
    if not path.is_file():
        pytest.skip(f"no ResNet-18 weights in '{path}'; set HUDEPTH_RESNET18 to where they are")
    return path


@pytest.fixture
def state() -> dict[str, Tensor]:
    torch.manual_seed(1)
    return ResNet18Encoder().state_dict()


def saved(tmp_path: Path, content: Any) -> str:
    torch.save(content, tmp_path / "resnet.pth")
    return str(tmp_path / "resnet.pth")


def norm(x: Tensor, bn: nn.BatchNorm2d) -> Tensor:
    assert bn.running_mean is not None
    assert bn.running_var is not None
    shape = (1, -1, 1, 1)
    x = (x - bn.running_mean.view(shape)) / (bn.running_var.view(shape) + 1e-5).sqrt()
    return x * bn.weight.view(shape) + bn.bias.view(shape)


def randomise(module: nn.Module) -> None:
    for name, value in module.state_dict().items():
        if value.is_floating_point():
            value.copy_(torch.rand_like(value) + 0.5 if "var" in name else torch.randn_like(value) * 0.3)


def block_oracle(block: BasicBlock, x: Tensor, *, stride: int) -> Tensor:
    out = norm(functional.conv2d(x, block.conv1.weight, stride=stride, padding=1), block.bn1).clamp(min=0)
    out = norm(functional.conv2d(out, block.conv2.weight, padding=1), block.bn2)
    if block.downsample is not None:
        conv, bn = block.downsample
        assert isinstance(conv, nn.Conv2d)
        assert isinstance(bn, nn.BatchNorm2d)
        x = norm(functional.conv2d(x, conv.weight, stride=stride), bn)
    return (out + x).clamp(min=0)


@pytest.mark.parametrize(("channels_in", "channels_out", "stride"), [(4, 4, 1), (4, 8, 2), (4, 8, 1), (4, 4, 2)])
def test_basic_block(channels_in: int, channels_out: int, stride: int) -> None:
    torch.manual_seed(0)
    block = BasicBlock(channels_in, channels_out, stride=stride).eval()
    randomise(block)
    assert (block.downsample is None) == (stride == 1 and channels_in == channels_out)
    x = torch.randn(2, channels_in, 8, 6)
    before = x.clone()
    torch.testing.assert_close(block(x), block_oracle(block, x, stride=stride), rtol=1e-4, atol=1e-5)
    assert torch.equal(x, before)


def test_encoder_is_resnet18_to_layer3() -> None:
    torch.manual_seed(0)
    encoder = ResNet18Encoder().eval()
    randomise(encoder)
    image = torch.randn(1, 3, 64, 48)
    features = encoder(image)
    x = norm(functional.conv2d(image, encoder.conv1.weight, stride=2, padding=3), encoder.bn1).clamp(min=0)
    torch.testing.assert_close(features[0], x, rtol=1e-4, atol=1e-4)
    x = functional.max_pool2d(x, 3, stride=2, padding=1)
    for number, (name, stride) in enumerate((("layer1", 1), ("layer2", 2), ("layer3", 2)), start=1):
        for i, block in enumerate(getattr(encoder, name)):
            x = block_oracle(block, x, stride=stride if i == 0 else 1)
        torch.testing.assert_close(features[number], x, rtol=1e-3, atol=1e-3 * x.abs().max().item())


def test_real_weights_load_exactly(encoder_file: Path) -> None:
    theirs = torch.load(encoder_file, weights_only=True)
    ours = ResNet18Encoder.from_pretrained(str(encoder_file)).state_dict()
    assert theirs.keys() <= ours.keys()
    assert sum(not torch.equal(ours[name], value) for name, value in theirs.items()) == 0
    assert sum(value.numel() for name, value in ours.items() if value.is_floating_point()) > 2_780_000


def test_parts_of_a_full_file_that_the_encoder_lacks_are_ignored(tmp_path: Path, state: dict[str, Tensor]) -> None:
    full = {**state, "layer4.0.conv1.weight": torch.zeros(2), "fc.weight": torch.zeros(3), "fc.bias": torch.zeros(1)}
    loaded = ResNet18Encoder.from_pretrained(saved(tmp_path, full)).state_dict()
    assert loaded.keys() == state.keys()
    assert all(torch.equal(loaded[name], state[name]) for name in state)


@pytest.mark.parametrize(
    "save",
    [
        lambda state: {name: value for name, value in state.items() if not name.endswith("num_batches_tracked")},
        lambda state: {f"module.{name}": value for name, value in state.items()},
        lambda state: {f"_orig_mod.{name}": value for name, value in state.items()},
        lambda state: {"state_dict": {f"module.{name}": value for name, value in state.items()}, "epoch": 3},
    ],
    ids=["without counters", "DataParallel", "torch.compile", "checkpoint"],
)
def test_the_ways_in_which_people_save_a_resnet(
    save: Callable[[dict[str, Any]], dict[str, Any]], tmp_path: Path
) -> None:
    saved = ResNet18Encoder().state_dict()
    torch.save(save(saved), tmp_path / "weights.pth")
    loaded = ResNet18Encoder.from_pretrained(str(tmp_path / "weights.pth")).state_dict()
    assert all(torch.equal(loaded[name], saved[name]) for name in saved)


@pytest.mark.parametrize("weights", [None, "none"])
def test_no_weights_are_random(weights: str | None) -> None:
    torch.manual_seed(0)
    one = ResNet18Encoder.from_pretrained(weights)
    other = ResNet18Encoder.from_pretrained(weights)
    assert not torch.equal(one.conv1.weight, other.conv1.weight)
    # He initialisation by fan-out: 64 x 7 x 7 outputs of each input value
    assert one.conv1.weight.std().item() == pytest.approx((2 / (64 * 49)) ** 0.5, rel=0.05)


def test_missing_tensors(tmp_path: Path, state: dict[str, Tensor]) -> None:
    path = saved(tmp_path, {name: value for name, value in state.items() if not name.startswith("layer3.1.")})
    with pytest.raises(CheckpointError) as caught:
        ResNet18Encoder.from_pretrained(path)
    assert str(caught.value) == (
        f"model.weights: '{path}' does not fit: 10 tensors missing, the first is 'layer3.1.bn1.bias'. {RESNET}, "
        "or model.weights=none."
    )


def test_unknown_tensors(tmp_path: Path, state: dict[str, Tensor]) -> None:
    path = saved(tmp_path, {**state, "layer3.2.conv1.weight": torch.zeros(1)})
    with pytest.raises(CheckpointError) as caught:
        ResNet18Encoder.from_pretrained(path)
    assert str(caught.value) == (
        f"model.weights: '{path}' does not fit: 1 tensors unknown, the first is 'layer3.2.conv1.weight'. {RESNET}, "
        "or model.weights=none."
    )


def test_misshapen_tensors_leave_the_encoder_as_it_was(tmp_path: Path, state: dict[str, Tensor]) -> None:
    path = saved(tmp_path, {**state, "conv1.weight": torch.zeros(64, 1, 7, 7)})
    with pytest.raises(CheckpointError) as caught:
        ResNet18Encoder.from_pretrained(path)
    assert str(caught.value) == (
        f"model.weights: '{path}' does not fit: 1 tensors of another shape, the first is 'conv1.weight'. {RESNET}, "
        "or model.weights=none."
    )


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError) as caught:
        ResNet18Encoder.from_pretrained(str(tmp_path / "x.pth"))
    assert str(caught.value) == (
        f"model.weights: no file '{tmp_path / 'x.pth'}'. Pass imagenet, none, or the path of a file."
    )


def test_misspelt_name() -> None:
    with pytest.raises(CheckpointError) as caught:
        ResNet18Encoder.from_pretrained("imagnet")
    assert str(caught.value) == (
        "model.weights: no file 'imagnet'. Did you mean 'imagenet'? Pass imagenet, none, or the path of a file."
    )


class Evil:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.marker,)


def test_code_in_a_file_is_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    path = saved(tmp_path, {"conv1.weight": Evil(marker)})
    with pytest.raises(CheckpointError) as caught:
        ResNet18Encoder.from_pretrained(path)
    assert str(caught.value) == (
        f"model.weights: '{path}' is not a file of plain tensors (UnpicklingError). "
        "Pass a ResNet-18 state_dict with torchvision's parameter names, or model.weights=none."
    )
    assert not marker.exists()
    torch.load(path, weights_only=False)  # it would have run: the test is a test
    assert marker.exists()


@pytest.mark.parametrize("content", [[1, 2], {"epoch": 3}, {3: torch.zeros(1)}, {"state_dict": {"conv1.weight": 1}}])
def test_file_without_a_state_dict(tmp_path: Path, content: object) -> None:
    path = saved(tmp_path, content)
    with pytest.raises(CheckpointError) as caught:
        ResNet18Encoder.from_pretrained(path)
    assert (
        str(caught.value) == f"model.weights: '{path}' does not contain a state_dict. {RESNET}, or model.weights=none."
    )


def test_damaged_file(tmp_path: Path) -> None:
    path = tmp_path / "x.pth"
    path.write_bytes(pickle.dumps({"a": 1}, protocol=2)[:5])
    with pytest.raises(CheckpointError, match="is not a file of plain tensors"):
        ResNet18Encoder.from_pretrained(str(path))


def offline(*args: Any, **kwargs: Any) -> Any:
    assert socket.getdefaulttimeout() == 20
    raise URLError("no route to host")


def test_imagenet_without_a_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", offline)
    before = socket.getdefaulttimeout()
    with pytest.raises(CheckpointError) as caught:
        ResNet18Encoder.from_pretrained("imagenet")
    assert str(caught.value) == (
        f"model.weights=imagenet: could not download {IMAGENET_URL} (<urlopen error no route to host>). "
        "Pass model.weights=<path to resnet18-f37072fd.pth>, or model.weights=none to train from scratch."
    )
    assert socket.getdefaulttimeout() == before


def test_imagenet_is_checked_by_its_hash(monkeypatch: pytest.MonkeyPatch, state: dict[str, Tensor]) -> None:
    asked: dict[str, Any] = {}

    def download(url: str, **options: Any) -> dict[str, Tensor]:
        asked.update(options, url=url)
        return {**state, "fc.weight": torch.zeros(1000, 512)}

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", download)
    encoder = ResNet18Encoder.from_pretrained("imagenet")
    assert torch.equal(encoder.conv1.weight, state["conv1.weight"])
    assert asked == {"url": IMAGENET_URL, "map_location": "cpu", "check_hash": True, "weights_only": True}
