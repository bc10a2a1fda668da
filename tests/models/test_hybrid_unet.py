from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.base.verbs import conf_folder
from hudepth.models import HybridUNet
from hudepth.models.inference import inference_form
from hudepth.models.lite_unet import LiteUNet
from hudepth.models.unet import UNet

# Every row of table A1 with a shape: (module here, output without the batch, parameters or None where it states none).
TABLE_A1 = [
    ("", (1, 224, 224), None),
    ("encoder.conv1", (64, 112, 112), 9_408),
    ("encoder.bn1", (64, 112, 112), 128),
    ("encoder.relu", (64, 112, 112), None),
    ("encoder.maxpool", (64, 56, 56), None),
    ("encoder.layer1", (64, 56, 56), None),
    ("encoder.layer1.0", (64, 56, 56), 73_984),
    ("encoder.layer1.1", (64, 56, 56), 73_984),
    ("encoder.layer2", (128, 28, 28), None),
    ("encoder.layer2.0", (128, 28, 28), 230_144),
    ("encoder.layer2.1", (128, 28, 28), 295_424),
    ("encoder.layer3", (256, 14, 14), None),
    ("encoder.layer3.0", (256, 14, 14), 919_040),
    ("encoder.layer3.1", (256, 14, 14), 1_180_672),
    ("attention_skip", (128, 28, 28), None),
    ("attention_skip.attention", (784, 128), 66_048),
    ("attention_skip.norm1", (784, 128), 256),
    ("attention_skip.feed_forward", (784, 128), 131_712),
    ("attention_skip.norm2", (784, 128), 256),
    ("attention_deepest", (256, 14, 14), None),
    ("attention_deepest.attention", (196, 256), 263_168),
    ("attention_deepest.norm1", (196, 256), 512),
    ("attention_deepest.feed_forward", (196, 256), 525_568),
    ("attention_deepest.norm2", (196, 256), 512),
    ("up1", (128, 28, 28), None),
    ("up1.conv1", (128, 28, 28), 442_496),
    ("up1.bn1", (128, 28, 28), 256),
    ("up1.conv2", (128, 28, 28), 147_584),
    ("up1.bn2", (128, 28, 28), 256),
    ("up2", (64, 56, 56), None),
    ("up2.conv1", (64, 56, 56), 110_656),
    ("up2.bn1", (64, 56, 56), 128),
    ("up2.conv2", (64, 56, 56), 36_928),
    ("up2.bn2", (64, 56, 56), 128),
    ("up3", (64, 112, 112), None),
    ("up3.conv1", (64, 112, 112), 73_792),
    ("up3.bn1", (64, 112, 112), 128),
    ("up3.conv2", (64, 112, 112), 36_928),
    ("up3.bn2", (64, 112, 112), 128),
    ("head.up", (32, 224, 224), 32_800),
    ("head.conv", (1, 224, 224), 289),
]
TOTAL = 4_653_313
SKIP_BLOCK = 66_048 + 256 + 131_712 + 256
DEEPEST_BLOCK = 263_168 + 512 + 525_568 + 512


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.fixture(scope="module")
def net() -> HybridUNet:
    torch.manual_seed(0)
    return HybridUNet()


@pytest.fixture(scope="module")
def shapes(net: HybridUNet) -> dict[str, list[tuple[int, ...]]]:
    """Shapes that each module of the network returned in one forward pass of two images."""
    seen: dict[str, list[tuple[int, ...]]] = {}

    def note(name: str):  # type: ignore[no-untyped-def]
        def hook(module: nn.Module, inputs: tuple[Tensor, ...], output: object) -> None:
            first = output[0] if isinstance(output, tuple) else output
            if isinstance(first, Tensor):
                seen.setdefault(name, []).append(tuple(first.shape))

        return hook

    handles = [module.register_forward_hook(note(name)) for name, module in net.named_modules()]
    net.train()  # in eval mode PyTorch's fused attention would pass hooks of its parts by
    net(torch.randn(2, 3, 224, 224))
    for handle in handles:
        handle.remove()
    return seen


@pytest.mark.parametrize(("name", "shape", "parameters"), TABLE_A1, ids=[row[0] or "network" for row in TABLE_A1])
def test_row_of_table_a1(
    net: HybridUNet,
    shapes: dict[str, list[tuple[int, ...]]],
    name: str,
    shape: tuple[int, ...],
    parameters: int | None,
) -> None:
    assert shapes[name] == [(2, *shape)] * len(shapes[name])
    if parameters is not None:
        assert count(net.get_submodule(name)) == parameters


def test_the_rows_of_table_a1_are_all_there_is(net: HybridUNet) -> None:
    assert sum(row[2] or 0 for row in TABLE_A1) == TOTAL
    assert count(net) == TOTAL
    assert all(parameter.requires_grad for parameter in net.parameters())


@pytest.mark.parametrize(
    ("attention", "missing"),
    [
        ("both", 0),
        ("deepest", SKIP_BLOCK),
        ("skip", DEEPEST_BLOCK),
        ("none", SKIP_BLOCK + DEEPEST_BLOCK),
    ],
)
def test_attention_option_leaves_out_whole_blocks(attention: str, missing: int) -> None:
    net = HybridUNet(attention=attention).eval()
    assert count(net) == TOTAL - missing
    assert net(torch.randn(1, 3, 32, 32)).shape == (1, 1, 32, 32)


@pytest.mark.parametrize("heads", [1, 2, 8, 128])
def test_heads_change_the_function_but_not_its_size(heads: int) -> None:
    net = HybridUNet(attention_heads=heads)
    assert count(net) == TOTAL
    assert net.attention_skip.attention.num_heads == heads  # type: ignore[union-attr]


@pytest.mark.parametrize("upsample", ["nearest", "bilinear"])
def test_upsample_option_reaches_all_up_blocks(upsample: str) -> None:
    net = HybridUNet(upsample=upsample)  # type: ignore[arg-type]
    assert [up.upsample for up in (net.up1, net.up2, net.up3)] == [upsample] * 3
    assert count(net) == TOTAL


def test_options_change_the_output() -> None:
    image = torch.randn(1, 3, 64, 64)
    outputs = []
    for options in ({}, {"attention_heads": 4}, {"attention_activation": "gelu"}, {"upsample": "bilinear"}):
        torch.manual_seed(0)
        outputs.append(HybridUNet(**options).eval()(image))  # type: ignore[arg-type]
    assert all(not torch.equal(a, b) for i, a in enumerate(outputs) for b in outputs[:i])


@pytest.mark.parametrize(
    ("output", "low", "high"), [("sigmoid", 0.0, 1.0), ("relu", 0.0, None), ("softplus", 0.0, None)]
)
def test_output_range(output: str, low: float, high: float | None) -> None:
    net = HybridUNet(attention="none", output=output).eval()
    nn.init.normal_(net.head.conv.weight, std=10)
    unit_depth = net(torch.randn(1, 3, 32, 32))
    assert unit_depth.min() >= low
    assert unit_depth.unique().numel() > 10
    if high is not None:
        assert unit_depth.max() <= high
    else:
        assert unit_depth.max() > 1


def test_identity_output_is_what_the_others_are_made_of() -> None:
    torch.manual_seed(1)
    image = torch.randn(1, 3, 32, 32)
    made = {}
    for output in ("identity", "sigmoid", "relu", "softplus"):
        torch.manual_seed(0)
        net = HybridUNet(attention="none", output=output).eval()
        nn.init.normal_(net.head.conv.weight)  # so that both signs come up
        made[output] = net(image)
    raw = made["identity"]
    assert raw.min() < 0 < raw.max()
    torch.testing.assert_close(made["sigmoid"], 1 / (1 + (-raw).exp()))
    torch.testing.assert_close(made["relu"], raw.clamp(min=0))
    torch.testing.assert_close(made["softplus"], (1 + raw.exp()).log())


@pytest.mark.parametrize(
    ("height", "width", "nearest"),
    [
        (225, 224, "[224,224] or [240,224]"),
        (224, 300, "[224,288] or [224,304]"),
        (17, 31, "[16,16] or [32,32]"),
        (8, 64, "[16,64]"),
        (1, 1, "[16,16]"),
    ],
)
def test_size_that_does_not_fit_names_the_nearest(net: HybridUNet, height: int, width: int, nearest: str) -> None:
    with pytest.raises(ConfigError) as caught:
        net(torch.zeros(1, 3, height, width))
    assert str(caught.value) == (
        f"data.size: images of {height} x {width} (height x width), but both sides must be multiples of 16. "
        f"Pass data.size={nearest}."
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"attention": "deep"}, r"model\.attention: .*'deep'.* 'deepest'"),
        ({"attention_heads": 7}, r"model\.attention_heads: 7 .*\[1, 2, 4, 8, 16, 32, 64\]"),
        ({"attention_heads": 0}, r"model\.attention_heads: 0 .*\[1, 2, 4, 8, 16, 32, 64\]"),
        ({"attention_activation": "gelo"}, r"model\.attention_activation: .*'gelu'"),
        ({"output": "sigmoidal"}, r"model\.output: .*'sigmoid'"),
    ],
)
def test_unknown_option(options: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        HybridUNet(**options)  # type: ignore[arg-type]


def test_unknown_upsample() -> None:
    bare = HybridUNet.__init__
    while hasattr(bare, "__wrapped__"):  # the checker of the tests would refuse the type before the constructor does
        bare = bare.__wrapped__
    with pytest.raises(ConfigError, match=r"model\.upsample: .*'bilinear'"):
        bare(HybridUNet.__new__(HybridUNet), upsample="bilinar")  # type: ignore[arg-type]


def test_gradient_reaches_every_parameter() -> None:
    torch.manual_seed(0)
    net = HybridUNet().train()
    # A mean over squares: batch norms and layer norms pass no gradient of a plain sum of their outputs.
    net(torch.randn(2, 3, 64, 64)).square().mean().backward()
    unreached = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert unreached == []
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


def test_the_parts_are_joined_as_the_table_says(net: HybridUNet) -> None:
    """Skip 2 is layer2's output after its transformer block, skip 1 layer1's output, skip 0 the stem's."""
    net.eval()
    image = torch.randn(1, 3, 64, 48)
    encoder = net.encoder
    skip0 = encoder.relu(encoder.bn1(encoder.conv1(image)))
    skip1 = encoder.layer1(encoder.maxpool(skip0))
    layer2 = encoder.layer2(skip1)
    deepest = net.attention_deepest(encoder.layer3(layer2))
    x = net.up3(net.up2(net.up1(deepest, net.attention_skip(layer2)), skip1), skip0)
    expected = torch.sigmoid(net.head.conv(net.head.up(x)))
    assert torch.equal(net(image), expected)
    for part in (skip0, skip1, layer2, deepest):
        assert part.std() > 0.1  # so that a part that is left out shows


@pytest.mark.parametrize("size", [(32, 64), (96, 48), (16, 16)])
def test_any_size_that_is_a_multiple_of_16(net: HybridUNet, size: tuple[int, int]) -> None:
    net.eval()
    assert net(torch.randn(1, 3, *size)).shape == (1, 1, *size)


def test_images_of_a_batch_do_not_see_each_other(net: HybridUNet) -> None:
    net.eval()
    images = torch.randn(3, 3, 64, 48)
    with torch.inference_mode():
        together = net(images)
        alone = torch.cat([net(image[None]) for image in images])
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-6)


def test_every_pixel_sees_the_whole_image(net: HybridUNet) -> None:
    """What attention adds: without it a far corner is out of reach of the first pixel's receptive field."""
    net.eval()
    image = torch.randn(1, 3, 512, 16)
    other = image.clone()
    other[..., -16:, :] += 3
    plain = HybridUNet(attention="none").eval()
    with torch.inference_mode():
        assert not torch.equal(net(image)[..., 0, 0], net(other)[..., 0, 0])
        assert torch.equal(plain(image)[..., 0, 0], plain(other)[..., 0, 0])


def test_training_and_evaluation_attention_paths_agree(net: HybridUNet) -> None:
    x = torch.randn(2, 256, 4, 6)
    block = net.attention_deepest
    with torch.inference_mode():
        fused = block.eval()(x)  # PyTorch takes its fused path
    torch.testing.assert_close(block.train()(x), fused.clone(), rtol=1e-4, atol=1e-5)


def test_nothing_but_the_table_is_saved(net: HybridUNet, tmp_path: Path) -> None:
    torch.save(net.state_dict(), tmp_path / "net.pt")
    again = HybridUNet()
    again.load_state_dict(torch.load(tmp_path / "net.pt", weights_only=True), strict=True)
    image = torch.randn(1, 3, 32, 32)
    assert torch.equal(again.eval()(image), net.eval()(image))


# --- merged arithmetic --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"upsample": "bilinear"}, {"output": "bins"}])
@pytest.mark.parametrize("training", [True, False])
def test_merged_arithmetic_is_the_same_function(options: dict[str, Any], training: bool) -> None:
    """Results, gradients and running statistics, on the same weights; in float64, where rounding hides nothing."""
    torch.manual_seed(0)
    options = {"attention": "none", "output": "identity", **options}
    plain = HybridUNet(**options).double().train(training)
    merged = HybridUNet(**options, arithmetic="merged").double().train(training)
    for net in (plain, merged):
        net.output.float()  # where bins expect their depths
    merged.load_state_dict(plain.state_dict(), strict=True)
    assert merged.head.merged == (options["output"] != "bins")  # 64 channels are not joined
    assert [up.merged for up in (merged.up1, merged.up2, merged.up3)] == ["upsample" not in options] * 3
    image = torch.randn(2, 3, 32, 48, dtype=torch.float64)
    results = [net(image) for net in (plain, merged)]
    exact = options["output"] != "bins"  # whose last step is in float32
    torch.testing.assert_close(results[1], results[0], rtol=1e-9 if exact else 1e-5, atol=1e-11 if exact else 1e-7)
    weights = torch.randn_like(results[0])
    for result in results:
        (result * weights).sum().backward()
    tolerance = 1e-7 if exact else 1e-4
    for (name, ours), theirs in zip(merged.named_parameters(), plain.parameters(), strict=True):
        assert ours.grad is not None
        assert theirs.grad is not None
        assert (ours.grad - theirs.grad).norm() <= tolerance * theirs.grad.norm() + 1e-9, name
    for (name, mine), yours in zip(merged.named_buffers(), plain.buffers(), strict=True):
        assert mine.allclose(yours, rtol=1e-9, atol=1e-12), name


def test_merged_arithmetic_adds_no_parameter_and_changes_no_name() -> None:
    plain, merged = HybridUNet(), HybridUNet(arithmetic="merged")
    assert count(merged) == TOTAL
    shapes = [{name: value.shape for name, value in net.state_dict().items()} for net in (plain, merged)]
    assert shapes[0] == shapes[1]


def test_merged_arithmetic_under_autocast_is_as_good_as_the_plain_one() -> None:
    torch.manual_seed(0)
    plain = HybridUNet(attention="none", output="identity").eval()
    merged = HybridUNet(attention="none", output="identity", arithmetic="merged").eval()
    merged.load_state_dict(plain.state_dict())
    image = torch.randn(1, 3, 32, 32)
    exact = plain(image)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        errors = [(net(image).float() - exact).square().mean().sqrt() for net in (plain, merged)]
    assert errors[1] < 2 * errors[0] < 0.2 * exact.std()


# --- further outputs and frozen norms -----------------------------------------------------------------------------


@pytest.mark.parametrize(("output", "more"), [("log", 0), ("bins", 63 * (32 * 9 + 1))])
@pytest.mark.parametrize("arithmetic", ["plain", "merged"])
def test_outputs_in_the_logarithm(output: str, more: int, arithmetic: Any) -> None:
    torch.manual_seed(0)
    net = HybridUNet(output=output, arithmetic=arithmetic).eval()
    assert count(net) == TOTAL + more
    nn.init.normal_(net.head.conv.weight, std=30)  # so that all of the range comes up
    unit_depth = net(torch.randn(1, 3, 32, 32))
    assert unit_depth.shape == (1, 1, 32, 32)
    assert 0.0099999 < unit_depth.min() < 0.02
    assert 0.5 < unit_depth.max() <= 1


def test_bins_have_18207_parameters_more() -> None:
    assert count(HybridUNet(output="bins")) - count(HybridUNet()) == 18_207


def statistics(net: HybridUNet) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in net.named_buffers() if name.split(".")[-1] != "centres"}


def train_a_step(net: HybridUNet) -> set[str]:
    """Return the names of the statistics that a step of training changed."""
    before = statistics(net)
    net(3 + torch.randn(2, 3, 32, 32)).square().mean().backward()
    return {name for name, value in statistics(net).items() if not value.equal(before[name])}


def test_frozen_norms_keep_the_encoders_statistics_and_still_learn() -> None:
    torch.manual_seed(0)
    net = HybridUNet(attention="none", encoder_norm="frozen").eval().train()
    changed = train_a_step(net)
    assert changed == {name for name in statistics(net) if not name.startswith("encoder.")}
    unreached = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert unreached == []
    assert train_a_step(HybridUNet(attention="none").train()) == set(statistics(net))


def test_frozen_norms_use_the_statistics_they_start_with() -> None:
    torch.manual_seed(0)
    net = HybridUNet(encoder_norm="frozen").train()
    image = torch.randn(2, 3, 32, 32)
    trained = net.encoder(image)
    judged = net.eval().encoder(image)
    assert all(a.equal(b) for a, b in zip(trained[:4], judged[:4], strict=True))
    assert net.train().up1.bn1.training  # the decoder's norms are as ever


def test_norms_are_frozen_from_the_start() -> None:
    """A new module is in training mode, and Lightning leaves modes as it finds them."""
    torch.manual_seed(0)
    changed = train_a_step(HybridUNet(attention="none", encoder_norm="frozen"))
    assert not any(name.startswith("encoder.") for name in changed)


def test_unknown_encoder_norm() -> None:
    with pytest.raises(ConfigError, match=r"model\.encoder_norm: .*'frozen'"):
        HybridUNet(encoder_norm="frosen")


def test_unknown_arithmetic() -> None:
    bare = HybridUNet.__init__
    while hasattr(bare, "__wrapped__"):  # the checker of the tests would refuse the type before the constructor does
        bare = bare.__wrapped__
    with pytest.raises(ConfigError, match=r"model\.arithmetic: .*'merged'"):
        bare(HybridUNet.__new__(HybridUNet), arithmetic="merge")  # type: ignore[arg-type]


@pytest.mark.parametrize("arithmetic", ["plain", "merged"])
def test_a_network_without_numbers_knows_its_shapes(arithmetic: str) -> None:
    with torch.device("meta"):
        net = HybridUNet(arithmetic=arithmetic)
        assert net(torch.empty(2, 3, 32, 48)).shape == (2, 1, 32, 48)


def test_context_adds_what_the_mean_of_the_deepest_map_says() -> None:
    """With an independent computation of it, in place of the module; table A1 has none."""
    torch.manual_seed(0)
    net, without = HybridUNet(context=True).eval(), HybridUNet().eval()
    added = sum(parameter.numel() for parameter in net.context.parameters())
    assert added == 256 * 128 + 128 + 128 * 256 + 256
    assert "65,920 parameters more" in (conf_folder() / "model" / "hybrid_unet.yaml").read_text()
    assert added == 65_920
    without.load_state_dict(net.state_dict(), strict=False)
    first, _, second = net.context.layers
    weights = [(layer.weight[:, :, 0, 0], layer.bias) for layer in (first, second)]

    def context(x: Tensor) -> Tensor:
        mean = x.flatten(2).mean(2)
        hidden = (mean @ weights[0][0].T + weights[0][1]).clamp(min=0)
        return x + (hidden @ weights[1][0].T + weights[1][1])[:, :, None, None]

    image = torch.randn(2, 3, 32, 48)
    plain = without(image)
    without.context.forward = context  # type: ignore[method-assign]
    torch.testing.assert_close(net(image), without(image))
    assert not torch.equal(plain, without(image))


@pytest.mark.parametrize("make", [HybridUNet, LiteUNet])
def test_the_scale_head_shifts_each_map_by_a_number_before_its_output(make: Callable[..., UNet]) -> None:
    torch.manual_seed(0)
    net, without = make(scale_head=True, output="identity"), make(output="identity").eval()
    image = torch.randn(2, 3, 32, 64)
    for norm in net.modules():
        if isinstance(norm, nn.BatchNorm2d):
            norm.momentum = None
    net.train()(image)  # without statistics of its maps, an untrained network hardly sees the image
    net.eval()
    without.load_state_dict(net.state_dict(), strict=False)
    torch.testing.assert_close(net(image), without(image))  # it starts at 0
    assert net.scale is not None
    nn.init.normal_(net.scale.layers[-1].weight)
    shift = net(image) - without(image)
    means = shift.mean(dim=(1, 2, 3), keepdim=True)
    torch.testing.assert_close(shift, means.expand_as(shift), rtol=1e-4, atol=1e-4)
    assert abs(float(means[0] - means[1])) > 1e-3
    torch.testing.assert_close(inference_form(net, size=(32, 64))(image), net(image), rtol=1e-4, atol=1e-4)


def test_bins_have_no_map_that_a_scale_head_could_shift() -> None:
    with pytest.raises(ConfigError, match=r"^model\.scale_head: model\.output=bins"):
        HybridUNet(scale_head=True, output="bins")
