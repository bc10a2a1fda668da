from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.speed.lite import compare
from hudepth.bench.rounds import Sample


def sample(name: str, *seconds: float) -> Sample:
    return Sample(name, 1, 0.0, np.zeros(1, np.float32), rounds=[[each, each, 9.0] for each in seconds])


def test_ratios_are_of_the_same_backend_and_round() -> None:
    samples = [
        sample("eager", 0.1, 0.2, 0.1), sample("openvino", 0.01, 0.01, 0.01),
        sample("HybridUNet, eager", 0.2, 0.6, 0.25), sample("GLPN (MiT-b0), openvino", 0.02, 0.04, 0.03),
        sample("MobileNet UNet, int8", 1.0, 1.0, 1.0),
    ]  # fmt: skip
    assert compare(samples) == [
        "lite is 2.5 (2.0 to 3.0) times as fast as HybridUNet in eager.",
        "lite is 3.0 (2.0 to 4.0) times as fast as GLPN (MiT-b0) in openvino.",
    ]


@pytest.mark.slow
def test_small_networks_answer_in_openvino() -> None:
    pytest.importorskip("openvino")
    import torch

    from experiments.speed.peers import PEERS, in_openvino
    from hudepth.bench.worker import Spec

    torch.manual_seed(0)
    net = PEERS["MobileNet UNet"].build((64, 96)).eval()
    images = torch.randn(2, 3, 64, 96)
    torch.manual_seed(0)
    runner = in_openvino(Spec("x", "", Path("none"), 1, {"peer": "MobileNet UNet", "size": (64, 96)}))
    runner.load(images.numpy())
    runner.run()
    with torch.inference_mode():
        np.testing.assert_allclose(runner.result(), net(images).numpy(), rtol=1e-3, atol=1e-4)
