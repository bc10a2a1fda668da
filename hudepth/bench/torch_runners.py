"""The backends in PyTorch: the same network in different layouts and forms."""

from __future__ import annotations

import os
import time

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from hudepth.base.instantiate import instantiate
from hudepth.base.machine import set_float32_products
from hudepth.bench.worker import Runner, Spec
from hudepth.cuda import graphs
from hudepth.models.inference import HalfForm, inference_form

MATRIX = {"cpu": 2048, "cuda": 8192}
"""Side of the matrices whose product measures the machine: on a GPU, smaller ones do not reach its rate."""
PRODUCTS = 3
"""How many products are timed."""


class TorchRunner(Runner):
    """A network, image [b, 3, h, w] to depth, in inference mode; ``channels_last`` is the layout of its images."""

    def __init__(self, net: nn.Module, *, device: torch.device, channels_last: bool) -> None:
        self.net, self.device, self.channels_last = net.to(device), device, channels_last

    def load(self, images: NDArray[np.float32]) -> None:
        """Set the batch of all following passes."""
        layout = torch.channels_last if self.channels_last else torch.contiguous_format
        self.images = torch.from_numpy(images).to(self.device).contiguous(memory_format=layout)

    @torch.inference_mode()
    def run(self) -> None:
        """Compute one pass."""
        self.output = self.net(self.images)
        self._wait()

    def result(self) -> NDArray[np.float32]:
        """Return unit depth [b, 1, h, w]."""
        return np.asarray(self.output.float().cpu().numpy())

    def reset_peak(self) -> None:
        """Restart the peak of the memory, and of a GPU's."""
        super().reset_peak()
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)

    def peak_mb(self) -> float:
        """Return the peak memory [MB]: on a GPU of its tensors, else of the process."""
        return torch.cuda.max_memory_allocated(self.device) / 1e6 if self.device.type == "cuda" else super().peak_mb()

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


class CompiledRunner(TorchRunner):
    """A network compiled from scratch for each batch size: PyTorch gives up after eight shapes of one function."""

    def load(self, images: NDArray[np.float32]) -> None:
        """Set the batch, and discard what was compiled for others."""
        super().load(images)
        torch.compiler.reset()
        self.plain = getattr(self, "plain", self.net)
        self.net = torch.compile(self.plain, dynamic=False)  # type: ignore[assignment]


class ReplayedRunner(TorchRunner):
    """A network on a GPU, recorded for each batch size as a CUDA graph."""

    def __init__(self, net: nn.Module, *, device: torch.device, channels_last: bool) -> None:
        super().__init__(net, device=device, channels_last=channels_last)
        self.recording: graphs.Recording | None = None

    @torch.inference_mode()
    def load(self, images: NDArray[np.float32]) -> None:
        """Set the batch, and record a pass of it."""
        self.recording = self.output = None  # the last batch's memory would count
        super().load(images)
        with graphs.beside():
            for _ in range(graphs.WARM_UPS):
                self.net(self.images)
        self.recording = graphs.record(lambda: self.net(self.images))
        self.output = self.recording.results

    def run(self) -> None:
        """Compute one pass."""
        assert self.recording is not None
        self.recording.replay()
        self._wait()


class ProductRunner(TorchRunner):
    """The product of two square matrices, which measures the machine."""

    @torch.inference_mode()
    def matmul_gflop_per_s(self, precision: str) -> float:
        """Return the best rate of several products in ``float32``, ``tf32``, ``float16`` or ``bfloat16``."""
        side = MATRIX[self.device.type]
        dtype = torch.float32 if precision == "tf32" else getattr(torch, precision)
        set_float32_products(tf32=precision == "tf32")
        matrix = torch.rand(side, side, device=self.device).to(dtype)  # ones would take less power, and run faster
        times = []
        for _ in range(1 + PRODUCTS):
            self._wait()
            start = time.perf_counter()
            torch.mm(matrix, matrix)
            self._wait()
            times.append(time.perf_counter() - start)
        return 2 * side**3 / min(times[1:]) / 1e9


def product(spec: Spec) -> ProductRunner:
    """Measure the machine, in a process of its own so that the matrices do not count as a network's memory."""
    torch.set_num_threads(spec.threads)
    return ProductRunner(nn.Identity(), device=_device(spec), channels_last=False)


def network(spec: Spec) -> TorchRunner:
    """Run the network.

    Options are ``merged`` (as hudepth-predict does), ``channels_last``, ``compile``, ``replayed`` (on a GPU) and
    ``precision``: ``float32`` (the default, without TF32), ``tf32``, ``float16`` or ``bfloat16``.
    """
    device, channels_last = _device(spec), bool(spec.options.get("channels_last"))
    precision = spec.options.get("precision", "float32")
    set_float32_products(tf32=precision == "tf32")
    net = build_merged(spec) if spec.options.get("merged") else build_net(spec)
    if spec.options.get("compile"):
        os.environ["TORCHINDUCTOR_COMPILE_THREADS"] = "1"  # else it keeps idle processes alive
        return CompiledRunner(net, device=device, channels_last=channels_last)
    if channels_last:
        net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if precision in ("float16", "bfloat16"):
        net = HalfForm(net, getattr(torch, precision))
    kind = ReplayedRunner if spec.options.get("replayed") else TorchRunner
    return kind(net, device=device, channels_last=channels_last)


def build_net(spec: Spec) -> nn.Module:
    """Build the network in evaluation mode; options are ``model``, ``trust`` and ``state`` (file of its tensors)."""
    torch.set_num_threads(spec.threads)
    net: nn.Module = instantiate(spec.options["model"], trust=spec.options["trust"])
    net.load_state_dict(torch.load(spec.options["state"], weights_only=True))
    return net.eval()


def build_merged(spec: Spec) -> nn.Module:
    """Build the merged network."""
    return inference_form(build_net(spec), size=spec.options["size"])


def _device(spec: Spec) -> torch.device:
    return torch.device(spec.options.get("device", "cpu"))
