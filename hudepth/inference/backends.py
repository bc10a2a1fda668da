"""What computes a prediction: PyTorch, ONNX Runtime or OpenVINO, behind one interface."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor, nn

from hudepth.base.errors import CheckpointError, ConfigError, first_line
from hudepth.base.machine import float32_products
from hudepth.base.normalise import NormaliseBytes
from hudepth.cuda import graphs
from hudepth.cuda.arrays import ArrayGraphs
from hudepth.inference.model_info import ModelInfo
from hudepth.inference.runtimes import (
    KEY,
    OPENVINO_PRECISIONS,
    onnx_description,
    onnx_session,
    openvino_description,
    openvino_model,
    package,
)
from hudepth.inference.trial import try_graph
from hudepth.models.inference import HalfForm, inference_form
from hudepth.runs.checkpoint import Checkpoint

BackendName = Literal["auto", "torch", "onnxruntime", "openvino"]
Precision = Literal["float32", "float16", "bfloat16"]
"""What a network computes in; depth is float32. Only float32 is exact."""
EXPORTED = {".onnx": "onnxruntime", ".xml": "openvino", ".pt2": "torch"}  # and what can always read each
PT2 = "pt2"  # what trust must contain to read a .pt2 file: PyTorch unpacks parts of it in a way that can run code

_NORMALISE = NormaliseBytes()


@runtime_checkable
class Backend(Protocol):
    """A model, ready to run."""

    info: ModelInfo
    name: str  # torch, onnxruntime or openvino

    def __call__(self, rgb: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] of RGB images at the model's size."""


class DepthPipeline(nn.Module):
    """A network (normalised image to depth / ``max_depth_m``) from RGB bytes to metres; the graph that is exported.

    Its calibration is part of it.
    """

    def __init__(self, net: nn.Module, info: ModelInfo) -> None:
        super().__init__()
        self.normalise, self.net = NormaliseBytes(), net
        self.max_depth_m, self.calibration = info.max_depth_m, info.calibration

    def forward(self, image: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b h w"]:
        """Predict depth [m], never below 0."""
        depth: Tensor = self.net(self.normalise(image))[:, 0] * self.max_depth_m
        depth = depth.clamp(min=0)
        return depth if self.calibration is None else self.calibration.apply(depth)


class TorchBackend:
    """A network in PyTorch; ``net`` maps a normalised image to unit depth, in the form in which it runs.

    On an NVIDIA GPU it is replayed as a CUDA graph, and float32 means without TF32, as on a CPU. A ``precision`` other
    than float32 is for such a GPU; ``net`` is then changed in place.
    """

    name = "torch"

    def __init__(
        self, net: nn.Module, info: ModelInfo, *, device: torch.device, precision: Precision = "float32"
    ) -> None:
        self.info, self.device, self.precision = info, device, precision
        form = net if precision == "float32" else HalfForm(net, getattr(torch, precision))
        self.pipeline = DepthPipeline(form, info).to(device)
        wanted = graphs.has_graphs(device)
        self._replayed = ArrayGraphs(self._exact, device, what="the network") if wanted else None

    def __call__(self, rgb: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] of RGB images at the model's size; raises CheckpointError if they overflow float16."""
        if self._replayed is None:
            with torch.inference_mode():
                depth: Tensor = self.pipeline(torch.from_numpy(rgb).to(self.device))
                return np.asarray(depth.cpu().numpy())
        result = self._replayed(rgb)
        if self.precision == "float16" and not np.isfinite(result).all():
            raise CheckpointError(f"{self.info.name} exceeds the range of float16. Pass precision=bfloat16 or float32.")
        return result

    def _exact(self, rgb: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b h w"]:
        with float32_products(tf32=False):
            depth: Tensor = self.pipeline(rgb)
            return depth

    @classmethod
    def of_checkpoint(
        cls,
        checkpoint: Checkpoint,
        *,
        device: torch.device,
        trust: list[str],
        size: tuple[int, int] | None = None,
        precision: Precision = "float32",
    ) -> TorchBackend:
        """Return a checkpoint's network in its fastest form; raises HudepthError if it does not take the size."""
        net = checkpoint.build_net(trust=trust)
        info = ModelInfo.of_checkpoint(checkpoint, parameters=sum(p.numel() for p in net.parameters()), size=size)
        return cls(fast_form(net.to(device), size=info.size), info, device=device, precision=precision)


def fast_form(net: nn.Module, *, size: tuple[int, int]) -> nn.Module:
    """Return :func:`hudepth.models.inference.inference_form`; a ConfigError of its size names the option ``size``."""
    try:
        return inference_form(net, size=size)
    except ConfigError as error:
        raise ConfigError(str(error).replace("data.size", "size")) from error


class GraphBackend:
    """An exported file, on the CPU; ``info`` states whether the graph holds pre- and post-processing."""

    def __init__(self, name: str, info: ModelInfo, compute: Callable[[NDArray[Any]], NDArray[Any]]) -> None:
        self.name, self.info, self._compute = name, info, compute

    def __call__(self, rgb: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] of RGB images at the model's size."""
        if self.info.processing:
            return np.asarray(self._compute(rgb))
        unit_depth = self._compute(_NORMALISE(torch.from_numpy(rgb)).contiguous().numpy())
        depth = np.maximum(unit_depth[:, 0] * np.float32(self.info.max_depth_m), np.float32(0))
        return depth if self.info.calibration is None else self.info.calibration.apply(depth)


def _read_info(path: Path, text: str) -> ModelInfo:
    if not text:
        why = "it is of another program, or made with format=onnx_any_size, which is for other programs"
        raise CheckpointError(f"'{path}' has no description by hudepth: {why}. Pass format=onnx to hudepth-export.")
    return ModelInfo.from_json(text, where=f"'{path}'")


def _check_fits(path: Path, info: ModelInfo, found: dict[str, Any]) -> None:
    """Refuse a graph that takes or returns something else than its description says."""
    height, width = info.size
    takes, returns = ("uint8", [height, width, 3]), ("float32", [height, width])
    if not info.processing:
        takes, returns = ("float32", [3, height, width]), ("float32", [1, height, width])
    for what, wanted, given in (("take", takes, found["inputs"]), ("return", returns, found["outputs"])):
        one_batch = what == "take" and any(isinstance(shape[0], int) and shape[0] >= 0 for _, shape in given if shape)
        if one_batch or [(kind, shape[1:]) for kind, shape in given] != [wanted]:
            stated = ", ".join(f"{kind} {shape}" for kind, shape in given)
            raise CheckpointError(
                f"'{path}': its description does not fit its graph, which should {what} {wanted[0]} [batch, "
                f"{', '.join(map(str, wanted[1]))}] and has {stated or 'nothing'}. Export it again with hudepth-export."
            )


def open_exported(
    path: Path, *, backend: str = "auto", threads: int, trust: list[str], precision: str = "float32"
) -> GraphBackend:
    """Open an exported file; ``auto`` reads ONNX with OpenVINO if installed, since it is faster.

    A graph is first tried under limits of time and memory, unless its suffix (``onnx``, ``xml``) is in ``trust``.

    Raises CheckpointError if it cannot be read, is not trusted (``.pt2`` needs ``pt2`` in ``trust``), was not exported
    by hudepth, or does not fit its description; ConfigError if the backend does not read it or is not installed.
    """
    usual = EXPORTED[path.suffix.lower()]
    readers = sorted({usual, "openvino"}) if usual == "onnxruntime" else [usual]
    if backend == "auto":
        backend = "openvino" if "openvino" in readers and importlib.util.find_spec("openvino") else usual
    if backend not in readers:
        raise ConfigError(f"backend={backend}: does not read '{path.name}'. Pass backend={' or '.join(readers)}.")
    if precision not in (OPENVINO_PRECISIONS if backend == "openvino" else ("float32",)):
        how = "backend=openvino and a .onnx or .xml file, or " if precision in OPENVINO_PRECISIONS else ""
        raise ConfigError(f"precision={precision}: needs {how}a checkpoint on an NVIDIA GPU.")
    if backend == "torch" and PT2 not in trust:
        fix = f"If you exported it yourself, pass trust=[{PT2}]; otherwise ask for an ONNX file or a bundle."
        raise CheckpointError(f"'{path}' is a program that could run any code when loaded. {fix}")
    if backend != "torch":
        package(backend, extra="onnx" if backend == "onnxruntime" else backend)  # in this process, for its message
    suffix = path.suffix[1:].lower()
    if suffix not in trust:
        found = try_graph(path, backend=backend, threads=threads)
        _check_fits(path, _read_info(path, found["description"]), found)
    try:
        if backend == "torch":
            text, compute = _open_program(path)
        elif backend == "openvino":
            text, compute = _open_openvino(path, threads, precision)
        else:
            text, compute = _open_onnx(path, threads)
    except ConfigError:  # a package that is not installed
        raise
    except Exception as error:
        reason = first_line(error)
        message = f"'{path}' cannot be read as a model: it is damaged or of another kind ({reason})."
        raise CheckpointError(message) from error
    return GraphBackend(backend, _read_info(path, text), compute)


Opened = tuple[str, Callable[[NDArray[Any]], NDArray[Any]]]  # description as JSON ("" if none), and what runs it


def _open_program(path: Path) -> Opened:
    extra = {f"{KEY}.json": ""}
    module = torch.export.load(path, extra_files=extra).module()

    def compute(images: NDArray[Any]) -> NDArray[Any]:
        with torch.inference_mode():
            return np.asarray(module(torch.from_numpy(images)).numpy())

    return extra[f"{KEY}.json"], compute


def _open_onnx(path: Path, threads: int) -> Opened:
    session = onnx_session(path, threads=threads)
    name = session.get_inputs()[0].name
    return onnx_description(session), lambda images: session.run(None, {name: images})[0]


def _open_openvino(path: Path, threads: int, precision: str) -> Opened:
    model, request = openvino_model(path, threads=threads, precision=precision)
    return openvino_description(model), lambda images: np.array(request.infer({0: images}, share_inputs=True)[0])
