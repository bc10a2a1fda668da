"""The backends in PyTorch: the same network, laid out and merged in different ways."""

from __future__ import annotations

import copy
import os
import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from hudepth.base.instantiate import instantiate
from hudepth.bench.worker import Spec
from hudepth.models.cost import counted_flops
from hudepth.models.inference import inference_form

MATRIX, PRODUCTS = 2048, 3
"""Side of the matrices whose product is the machine's measure, and how many products are timed."""


class TorchRunner:
    """A network in inference mode.

    Args:
        net: image [b, 3, h, w] to depth, in evaluation mode.
        device: where it runs.
        channels_last: how images are laid out.
    """

    def __init__(self, net: nn.Module, *, device: torch.device, channels_last: bool) -> None:
        self.net, self.device, self.channels_last = net.to(device), device, channels_last

    def describe(self) -> dict[str, Any]:
        """Nothing that is not known from elsewhere."""
        return {}

    def load(self, images: NDArray[np.float32]) -> None:
        """Take the batch of all passes from now on."""
        layout = torch.channels_last if self.channels_last else torch.contiguous_format
        self.images = torch.from_numpy(images).to(self.device).contiguous(memory_format=layout)

    @torch.inference_mode()
    def run(self) -> None:
        """Compute a pass."""
        self.output = self.net(self.images)
        self._wait()

    def result(self) -> NDArray[np.float32]:
        """Return unit depth [b, 1, h, w]."""
        return np.asarray(self.output.float().cpu().numpy())

    def reset_peak(self) -> None:
        """Count a GPU's memory anew."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)

    def peak_mb(self) -> float | None:
        """Return the most memory of a GPU [MB] that tensors took; None without one."""
        return torch.cuda.max_memory_allocated(self.device) / 1e6 if self.device.type == "cuda" else None

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


class CompiledRunner(TorchRunner):
    """A network compiled for each batch size by itself: PyTorch gives up after eight shapes of one."""

    def load(self, images: NDArray[np.float32]) -> None:
        """Take a batch, and forget what was compiled for others."""
        super().load(images)
        torch.compiler.reset()
        self.plain = getattr(self, "plain", self.net)
        self.net = torch.compile(self.plain, dynamic=False)  # type: ignore[assignment]


class ProductRunner(TorchRunner):
    """The product of two single-precision matrices, the measure of the machine."""

    @torch.inference_mode()
    def matmul_gflop_per_s(self) -> float:
        """Return the best rate of several products."""
        matrix = torch.ones(MATRIX, MATRIX, device=self.device)
        times = []
        for _ in range(1 + PRODUCTS):
            self._wait()
            start = time.perf_counter()
            torch.mm(matrix, matrix)
            self._wait()
            times.append(time.perf_counter() - start)
        return 2 * MATRIX**3 / min(times[1:]) / 1e9


def product(spec: Spec) -> ProductRunner:
    """The machine's measure, in a process of its own so that no network's memory holds the matrices."""
    torch.set_num_threads(spec.threads)
    return ProductRunner(nn.Identity(), device=_device(spec), channels_last=False)


def eager(spec: Spec) -> TorchRunner:
    """The network as it was trained, contiguous."""
    return TorchRunner(build_net(spec), device=_device(spec), channels_last=False)


def channels_last(spec: Spec) -> TorchRunner:
    """The network as it was trained, channels-last."""
    net = build_net(spec).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return TorchRunner(net, device=_device(spec), channels_last=True)


def default(spec: Spec) -> TorchRunner:
    """The form that predicting and testing use."""
    return TorchRunner(merged(spec), device=_device(spec), channels_last=True)


def compiled(spec: Spec) -> CompiledRunner:
    """The same form through ``torch.compile``."""
    os.environ["TORCHINDUCTOR_COMPILE_THREADS"] = "1"  # else it keeps processes that would wait beside the others
    return CompiledRunner(merged(spec), device=_device(spec), channels_last=True)


def build_net(spec: Spec) -> nn.Module:
    """Build the network of a specification with the weights it names, in evaluation mode.

    Args:
        spec: with the options ``model``, ``trust`` and ``state`` (file of its tensors).
    """
    torch.set_num_threads(spec.threads)
    net: nn.Module = instantiate(spec.options["model"], trust=spec.options["trust"])
    net.load_state_dict(torch.load(spec.options["state"], weights_only=True))
    return net.eval()


def merged(spec: Spec) -> nn.Module:
    """Build the form that predicting and testing use."""
    height, width = spec.options["size"]
    return inference_form(build_net(spec), size=(height, width))


def parameters(net: nn.Module) -> int:
    """Return how many parameters a network has."""
    return sum(parameter.numel() for parameter in net.parameters())


def operations(net: nn.Module, size: tuple[int, int]) -> int:
    """Return the operations of an image by PyTorch's counter, without computing them.

    Args:
        net: in any form; it is not changed.
        size: (height, width) of the image.
    """
    weightless = copy.deepcopy(net).to("meta").requires_grad_(requires_grad=True)  # else fused attention is missed
    return counted_flops(weightless, torch.empty(1, 3, *size, device="meta"))


def _device(spec: Spec) -> torch.device:
    return torch.device(spec.options.get("device", "cpu"))
