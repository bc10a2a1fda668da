"""The ways to run a network: what each needs, and what must be exported first."""

from __future__ import annotations

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
    options: dict[str, Any] = field(default_factory=dict)


_MERGED = {"merged": True, "channels_last": True}
_OPENVINO = ("openvino", "onnx", "onnxscript")
BACKENDS = {
    "eager": Backend(_TORCH, "PyTorch, the network as trained, contiguous"),
    "channels_last": Backend(_TORCH, "the same network, channels-last", options={"channels_last": True}),
    "default": Backend(_TORCH, "PyTorch, merged for inference, as hudepth-predict runs it", options=_MERGED),
    "compile": Backend(
        _TORCH, "the merged network through torch.compile, once per batch size", options={**_MERGED, "compile": True}
    ),
    "onnxruntime": Backend(
        f"{_GRAPH}:onnxruntime", "the merged network, exported to ONNX",
        packages=("onnxruntime", "onnx", "onnxscript"), extras="onnx", graph=ONNX,
    ),
    "openvino": Backend(
        f"{_GRAPH}:openvino", "the same file in OpenVINO, float32",
        packages=_OPENVINO, extras="onnx,openvino", graph=ONNX, options={"precision": "float32"},
    ),
    "openvino_bf16": Backend(
        f"{_GRAPH}:openvino", "the same file in OpenVINO, bfloat16: not exact",
        packages=_OPENVINO, extras="onnx,openvino", graph=ONNX, options={"precision": "bfloat16"},
    ),
    "int8": Backend(
        f"{_GRAPH}:openvino", "OpenVINO, quantised on a few built-in rooms: measures speed, not accuracy",
        packages=(*_OPENVINO, "nncf"), extras="onnx,openvino", graph=INT8, options={"precision": "float32"},
    ),
}  # fmt: skip
"""By name, in the order of the table."""
GRAPHS = {ONNX: f"{_GRAPH}:export", INT8: f"{_GRAPH}:quantise"}
"""The files that backends read, and what makes each."""
PRODUCT = "hudepth.bench.torch_runners:product"
"""Measures the machine."""


def missing(packages: Sequence[str], extras: str) -> str:
    """Return a line that names the packages that are not installed and how to install them; empty if all are."""
    absent = [name for name in packages if importlib.util.find_spec(name) is None]
    if not absent:
        return ""
    return f"left out, since {' and '.join(absent)} cannot be imported. Run pip install 'hudepth[{extras}]'."
