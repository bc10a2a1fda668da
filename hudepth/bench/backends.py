"""The ways to run a network: what each needs, and what must be exported first."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

REFERENCE = "eager"
"""Always measured: ratios and differences are relative to it."""
_TORCH, _GRAPH = "hudepth.bench.torch_runners:network", "hudepth.bench.graphs"
ONNX, INT8 = "model.onnx", "int8.xml"


@dataclass(frozen=True)
class Backend:
    """A way to run the network; ``extras`` of hudepth install its ``packages``."""

    factory: str
    """``module:function`` that makes its runner."""
    about: str
    packages: tuple[str, ...] = ()
    extras: str = ""
    graph: str | None = None
    """The file that must be exported for it."""
    provider: str = ""
    """The execution provider that ONNX Runtime must have."""
    precision: str = "float32"
    """What it computes in; only float32 can be exact."""
    gpu: bool = False
    """Whether it needs an NVIDIA GPU."""
    options: dict[str, Any] = field(default_factory=dict)


_MERGED = {"merged": True, "channels_last": True}
_REPLAYED: dict[str, Any] = {"options": {**_MERGED, "replayed": True}, "gpu": True}
_ONNX = ("onnxruntime", "onnx", "onnxscript")
_OPENVINO = ("openvino", "onnx", "onnxscript")
BACKENDS = {
    "eager": Backend(_TORCH, "PyTorch, the network as trained, contiguous"),
    "channels_last": Backend(_TORCH, "the same network, channels-last", options={"channels_last": True}),
    "default": Backend(_TORCH, "PyTorch, merged for inference, as hudepth-predict runs it", options=_MERGED),
    "cuda_graph": Backend(_TORCH, "the merged network, replayed as a CUDA graph", **_REPLAYED),
    "tf32": Backend(_TORCH, "the same graph in TF32: not exact", precision="tf32", **_REPLAYED),
    "fp16": Backend(_TORCH, "the same graph in float16: not exact", precision="float16", **_REPLAYED),
    "bf16": Backend(_TORCH, "the same graph in bfloat16: not exact", precision="bfloat16", **_REPLAYED),
    "compile": Backend(
        _TORCH, "the merged network through torch.compile, once per batch size", options={**_MERGED, "compile": True}
    ),
    "onnxruntime": Backend(
        f"{_GRAPH}:onnxruntime", "the merged network, exported to ONNX, on the CPU",
        packages=_ONNX, extras="onnx", graph=ONNX,
    ),
    "onnxruntime_cuda": Backend(
        f"{_GRAPH}:onnxruntime", "the same file in ONNX Runtime on the GPU, without TF32",
        packages=_ONNX, extras="onnx", graph=ONNX, provider="CUDAExecutionProvider", gpu=True,
    ),
    "tensorrt": Backend(
        f"{_GRAPH}:onnxruntime", "the same file in TensorRT through ONNX Runtime, which may use TF32: not exact",
        packages=_ONNX, extras="onnx", graph=ONNX, provider="TensorrtExecutionProvider", precision="tf32", gpu=True,
    ),
    "openvino": Backend(
        f"{_GRAPH}:openvino", "the same file in OpenVINO, float32",
        packages=_OPENVINO, extras="onnx,openvino", graph=ONNX,
    ),
    "openvino_bf16": Backend(
        f"{_GRAPH}:openvino", "the same file in OpenVINO, bfloat16: not exact",
        packages=_OPENVINO, extras="onnx,openvino", graph=ONNX, precision="bfloat16",
    ),
    "int8": Backend(
        f"{_GRAPH}:openvino", "OpenVINO, quantised on a few built-in rooms: measures speed, not accuracy",
        packages=(*_OPENVINO, "nncf"), extras="onnx,openvino", graph=INT8, precision="int8",
        options={"precision": "float32"},
    ),
}  # fmt: skip
"""By name, in the order of the table."""
ON_GPU = [name for name, each in BACKENDS.items() if each.gpu or each.factory == _TORCH]
ON_CPU = [name for name, each in BACKENDS.items() if not each.gpu]
"""What is measured on a GPU and on a CPU unless ``backends`` says otherwise."""
GRAPHS = {ONNX: f"{_GRAPH}:export", INT8: f"{_GRAPH}:quantise"}
"""The files that backends read, and what makes each."""
PRODUCT = "hudepth.bench.torch_runners:product"
"""Measures the machine."""


def lacking(backend: Backend, device: str) -> str:
    """Return a line that says what a backend lacks on this machine; empty if it can be measured."""
    if backend.gpu and device != "cuda":
        return "left out, since it needs an NVIDIA GPU and device=cuda."
    if line := missing(backend.packages, backend.extras):
        return line
    if backend.provider and backend.provider not in importlib.import_module("onnxruntime").get_available_providers():
        fix = "Run pip uninstall -y onnxruntime; pip install onnxruntime-gpu."
        return f"left out, since ONNX Runtime has no {backend.provider} here. {fix}"
    return ""


def missing(packages: Sequence[str], extras: str) -> str:
    """Return a line that names the packages that are not installed and how to install them; empty if all are."""
    absent = [name for name in packages if importlib.util.find_spec(name) is None]
    if not absent:
        return ""
    return f"left out, since {' and '.join(absent)} cannot be imported. Run pip install 'hudepth[{extras}]'."
