from __future__ import annotations

import importlib.util

import pytest
import torch

from experiments.speed.mobile_unet import ENCODER, MobileUNet
from experiments.speed.peers import PEERS
from hudepth.models.cost import image_flops, parameters

PUBLISHED_MILLIONS = {
    "Depth Anything V2 small": 24.8,
    "DPT-hybrid": 123,
    "GLPN (MiT-b4)": 62,
    "GLPN (MiT-b0)": 3.7,
    "MobileNet UNet": 3.96,  # FastDepth before pruning
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PEERS)
def test_peers_have_their_size_and_answer_at_every_size_they_are_asked_at(name: str) -> None:
    peer = PEERS[name]
    if peer.package and importlib.util.find_spec(peer.package) is None:
        pytest.skip(f"{peer.package} is not installed")
    sizes = (peer.native, peer.nearest((224, 224)), peer.nearest((240, 320)))
    for size in sizes:
        with torch.device("meta"):
            net = peer.build(size).eval()
            depth = net(torch.empty(1, 3, *size))
        assert depth.shape[-2:] == size
        assert parameters(net) / 1e6 == pytest.approx(PUBLISHED_MILLIONS[name], rel=0.02)
    assert sizes[1] == (224, 224)


def test_sizes_are_the_nearest_multiples() -> None:
    peer = PEERS["Depth Anything V2 small"]
    assert peer.nearest((240, 320)) == (238, 322)
    assert peer.nearest((1, 224)) == (14, 224)
    assert PEERS["DPT-hybrid"].nearest((240, 320)) == (288, 288)


def test_mobile_unet_by_hand() -> None:
    net = MobileUNet().eval()
    channels, count, cost, side = 32, 32 * 3 * 9 + 64, 32 * 27 * 112**2, 112
    for stage in ENCODER:
        for wider, stride in stage:
            side //= stride
            count += channels * 9 + 2 * channels + channels * wider + 2 * wider
            cost += (channels * 9 + channels * wider) * side**2
            channels = wider
    for wider in (512, 256, 128, 64, 32):
        count += channels * 25 + 2 * channels + channels * wider + 2 * wider
        cost += (channels * 25 + channels * wider) * side**2
        channels, side = wider, 2 * side
    count, cost = count + 33, cost + 32 * 224**2
    assert parameters(net) == count == 3_960_929
    assert image_flops(net, (224, 224)) == 2 * cost
    with torch.inference_mode():
        assert net(torch.rand(2, 3, 64, 96)).shape == (2, 1, 64, 96)
