from __future__ import annotations

import copy
import math
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.losses import L1
from hudepth.losses.auxiliary import AuxiliaryHeads, depth_edges, surface_normals
from hudepth.models import LiteUNet, TinyUNet
from hudepth.training.module import DepthModule

SIZE = (32, 64)


def plane(normal: tuple[float, float, float], *, height: int, width: int) -> Tensor:
    """Depth of a plane 2 m away along the axis, ray by ray, through the camera of NYU."""
    focal = 518.857901 / 640 * width, 519.469611 / 480 * height
    rays = np.array(
        [[((u - (width - 1) / 2) / focal[0], (v - (height - 1) / 2) / focal[1], 1) for u in range(width)]
         for v in range(height)]
    )  # fmt: skip
    return torch.from_numpy(2 * normal[2] / (rays @ np.array(normal)))[None, None].float()


@given(x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5), scale=st.floats(0.1, 10))
def test_all_normals_of_a_plane_are_its_own_and_face_the_camera(x: float, y: float, scale: float) -> None:
    depth = scale * plane((x, y, -1.0), height=12, width=16)
    normal = torch.tensor([x, y, -1.0]) / math.hypot(x, y, 1)
    found = surface_normals(depth)
    torch.testing.assert_close(found, normal[None, :, None, None].expand(1, 3, 10, 14), rtol=0, atol=1e-3)


@pytest.mark.parametrize(("ratio", "expected"), [(1.1, 0), (1.2, 2)])
def test_an_edge_is_where_depth_jumps_far_enough(ratio: float, expected: int) -> None:
    depth = torch.full((1, 1, 8, 10), 0.3)
    depth[..., 5:] *= ratio
    found = depth_edges(depth)[0, 0]
    assert found.shape == (6, 8)
    assert found.sum(dim=1).tolist() == [expected] * 6
    assert not expected or found[:, 3:5].all()  # columns 4 and 5 of the map


class Half(nn.Module):
    """A network with a head, whose input is what the test says."""

    def __init__(self, features: Tensor) -> None:
        super().__init__()
        self.head = nn.Module()
        self.head.up = nn.ConvTranspose2d(features.shape[1], 1, 4, stride=2, padding=1)
        self.head.forward = self.head.up.forward  # type: ignore[method-assign]
        self.features = features

    def forward(self, image: Tensor) -> Tensor:
        result: Tensor = self.head(self.features)
        return result


def attached(**weights: float) -> tuple[AuxiliaryHeads, Half]:
    net = Half(torch.rand(2, 5, 8, 12))
    heads = AuxiliaryHeads(**weights).attach(net)
    for parameter in heads.parameters():
        nn.init.zeros_(parameter)
    return heads, net


def test_the_losses_of_known_predictions() -> None:
    heads, net = attached(normals=2.0, edges=3.0)
    with torch.no_grad():
        heads.heads["normals"].bias.copy_(torch.tensor([0.0, 3.0, -4.0]))
        heads.heads["edges"].bias.fill_(math.log(3))  # three quarters sure of an edge everywhere
    net(torch.zeros(()))
    total, terms = heads(torch.full((2, 1, 16, 24), 0.4), torch.ones(2, 1, 16, 24, dtype=torch.bool))
    assert terms["normals"].item() == pytest.approx(1 - 0.8)  # a wall at right angles
    assert terms["edges"].item() == pytest.approx(math.log(4))
    assert total.item() == pytest.approx(2 * 0.2 + 3 * math.log(4))


def test_what_was_not_measured_does_not_count() -> None:
    heads, net = attached()
    nn.init.normal_(heads.heads["normals"].weight)
    nn.init.normal_(heads.heads["edges"].weight)
    depth, valid = torch.rand(2, 1, 16, 24) + 0.5, torch.ones(2, 1, 16, 24, dtype=torch.bool)
    valid[:, :, 4:9, 7:20] = False
    losses = []
    for hidden in (0.0, 7.0, math.nan):
        net(torch.zeros(()))
        losses.append(heads(torch.where(valid, depth, hidden), valid).total)
    assert losses[0].isfinite()
    assert losses[0].equal(losses[1])
    assert losses[0].equal(losses[2])
    net(torch.zeros(()))
    assert heads(depth, torch.zeros_like(valid)).total.item() == 0


def test_clipped_depth_does_not_count() -> None:
    """A wall that recedes beyond the maximum depth is no wall that faces the camera."""
    heads, net = attached(edges=0.0)
    depth = plane((0.6, 0.0, -0.8), height=16, width=24)
    depth = (depth / depth[..., 12:13]).clamp(max=1).expand(2, 1, 16, 24)
    clipped = depth == 1
    assert clipped.any()
    assert not clipped.all()
    with torch.no_grad():
        heads.heads["normals"].bias.copy_(torch.tensor([0.6, 0.0, -0.8]))
    net(torch.zeros(()))
    assert heads(depth, torch.ones_like(clipped)).total.item() == pytest.approx(0, abs=1e-3)


def test_a_weight_of_0_leaves_a_head_out() -> None:
    heads, net = attached(edges=0.0)
    assert list(heads.heads) == ["normals"]
    net(torch.zeros(()))
    assert list(heads(torch.rand(2, 1, 16, 24), torch.ones(2, 1, 16, 24, dtype=torch.bool)).terms) == ["normals"]
    for weights in ({"normals": 0.0, "edges": 0.0}, {"normals": -1.0}):
        with pytest.raises(ConfigError, match="auxiliary"):
            AuxiliaryHeads(**weights)


def test_a_network_without_such_a_map_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"auxiliary: TinyUNet has no decoder's map to use\. Pass auxiliary=none\."):
        AuxiliaryHeads().attach(TinyUNet())


def test_training_trains_them_and_validation_does_not_ask_them() -> None:
    torch.manual_seed(0)
    module = DepthModule(
        LiteUNet(), L1(), max_depth_m=10.0, optimizer=partial(torch.optim.SGD, lr=0.1), auxiliary=AuxiliaryHeads()
    )
    names = [name for group in module.configure_optimizers().param_groups for name in group["param_names"]]
    assert {"auxiliary.heads.normals.weight", "auxiliary.heads.edges.bias", "head.conv.weight"} <= set(names)
    depth = torch.rand(2, 1, *SIZE)
    batch = {"image": torch.randn(2, 3, *SIZE), "unit_depth": depth, "valid": depth > 0.1, "index": torch.arange(2)}
    module._step(batch, "train").backward()
    assert all(parameter.grad is not None for parameter in module.auxiliary.parameters())  # type: ignore[union-attr]
    assert module.net.encoder.stem[0].weight.grad.abs().sum() > 0
    (logged,) = module.losses_so_far()
    assert {"train/loss/normals", "train/loss/edges"} <= set(logged)
    module.eval()
    module._step(batch, "val")
    copy.deepcopy(module.net)  # which a map that is kept would prevent
