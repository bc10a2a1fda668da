"""Other networks to compare speed with, built from their published configurations with random weights."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from experiments.speed.mobile_unet import MobileUNet
from hudepth.base.machine import set_float32_products
from hudepth.bench.graphs import GraphRunner
from hudepth.bench.torch_runners import TorchRunner
from hudepth.bench.worker import Spec
from hudepth.models.cost import image_flops, parameters

Size = tuple[int, int]
"""(height, width)."""


@dataclass(frozen=True)
class Peer:
    """A network to compare with."""

    build: Callable[[Size], nn.Module]
    native: Size
    """The size it was published with."""
    multiple: int
    """Its sides must be multiples of this."""
    square: bool = False
    """Whether height must be width."""
    package: str | None = "transformers"
    """The package that builds it."""

    def nearest(self, size: Size) -> Size:
        """Return the accepted size nearest to ``size``."""
        if self.square:
            size = (round(math.sqrt(size[0] * size[1])),) * 2
        height, width = (max(1, round(side / self.multiple)) * self.multiple for side in size)
        return height, width


class _Depth(nn.Module):
    """A model of transformers, reduced to image in, depth out."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, image: Tensor) -> Tensor:
        depth: Tensor = self.model(pixel_values=image).predicted_depth
        return depth


def _depth_anything(_size: Size) -> nn.Module:
    hub: Any = importlib.import_module("transformers")
    encoder = hub.Dinov2Config(
        hidden_size=384, num_hidden_layers=12, num_attention_heads=6, image_size=518, patch_size=14,
        out_indices=[3, 6, 9, 12], apply_layernorm=True, reshape_hidden_states=False,
    )  # fmt: skip
    config = hub.DepthAnythingConfig(
        backbone_config=encoder, reassemble_hidden_size=384, patch_size=14, neck_hidden_sizes=[48, 96, 192, 384],
        fusion_hidden_size=64, head_in_index=-1, head_hidden_size=32,
    )  # fmt: skip
    return _Depth(hub.DepthAnythingForDepthEstimation(config))


def _dpt_hybrid(size: Size) -> nn.Module:
    hub: Any = importlib.import_module("transformers")
    config = hub.DPTConfig(
        is_hybrid=True, image_size=size[0], hidden_size=768, neck_hidden_sizes=[256, 512, 768, 768],
        backbone_out_indices=[2, 5, 8, 11], reassemble_factors=[1, 1, 1, 0.5],
        backbone_featmap_shape=[1, 1024, size[0] // 16, size[0] // 16],
    )  # fmt: skip
    return _Depth(hub.DPTForDepthEstimation(config))


def _glpn(depths: list[int], widths: list[int]) -> Callable[[Size], nn.Module]:
    def build(_size: Size) -> nn.Module:
        hub: Any = importlib.import_module("transformers")
        return _Depth(hub.GLPNForDepthEstimation(hub.GLPNConfig(depths=depths, hidden_sizes=widths)))

    return build


PEERS = {
    "Depth Anything V2 small": Peer(_depth_anything, (518, 518), 14),
    "DPT-hybrid": Peer(_dpt_hybrid, (384, 384), 32, square=True),
    "GLPN (MiT-b4)": Peer(_glpn([3, 8, 27, 3], [64, 128, 320, 512]), (480, 640), 32),
    "GLPN (MiT-b0)": Peer(_glpn([2, 2, 2, 2], [32, 64, 160, 256]), (480, 640), 32),
    "MobileNet UNet": Peer(lambda _size: MobileUNet(), (224, 224), 32, package=None),
}
"""By name; GLPN was published with MiT-b4, and with b0 it is the smallest of its kind."""


def in_openvino(spec: Spec) -> GraphRunner:
    """Run a peer in OpenVINO, in float32; the options are those of :class:`PeerRunner`."""
    library: Any = importlib.import_module("openvino")
    size: Size = spec.options["size"]
    net = PEERS[spec.options["peer"]].build(size).eval().requires_grad_(requires_grad=False)
    graph = library.convert_model(net, example_input=torch.zeros(1, 3, *size), input=[("image", [-1, 3, *size])])
    settings = {"INFERENCE_NUM_THREADS": spec.threads, "INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": "LATENCY"}
    request = library.Core().compile_model(graph, "CPU", settings).create_infer_request()
    return GraphRunner(lambda images: np.array(request.infer({0: images}, share_inputs=True)[0]))


class PeerRunner(TorchRunner):
    """A peer in eager PyTorch, in whichever layout is faster here.

    Args:
        spec: with the options ``peer``, ``size`` and ``device``.
    """

    def __init__(self, spec: Spec) -> None:
        torch.set_num_threads(spec.threads)
        set_float32_products(tf32=False)  # as this model's are
        self.size: Size = spec.options["size"]
        net = PEERS[spec.options["peer"]].build(self.size).eval().requires_grad_(requires_grad=False)
        super().__init__(net, device=torch.device(spec.options["device"]), channels_last=False)
        self._choose_layout(np.load(spec.images)[:1])

    def describe(self) -> dict[str, Any]:
        """Return what the table and its notes state of the network."""
        count, flops = parameters(self.net, trainable_only=False), image_flops(self.net, self.size)
        layout = "channels-last" if self.channels_last else "contiguous"
        about = f"random weights, eager, {layout}; {count:,} parameters, {flops / 1e9:.2f} GFLOP per image"
        return {"parameters": count, "flops": flops, "about": about}

    def _choose_layout(self, image: Any) -> None:
        times = {}
        for self.channels_last in (False, True):
            self._lay_out()
            times[self.channels_last] = self._seconds(image)
        self.channels_last = times[True] < times[False]
        self._lay_out()

    def _lay_out(self) -> None:
        layout = torch.channels_last if self.channels_last else torch.contiguous_format
        self.net.to(memory_format=layout)  # type: ignore[call-overload]

    def _seconds(self, image: Any) -> float:
        self.load(image)
        self.run()
        times = []
        for _ in range(2):
            start = time.perf_counter()
            self.run()
            times.append(time.perf_counter() - start)
        return min(times)
