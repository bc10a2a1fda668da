"""Which backends there are, what each needs, and what a run of some of them needs made first."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from hudepth.base.errors import ConfigError, did_you_mean

REFERENCE = "eager"
"""Always measured: ratios and differences are to it."""
_TORCH, _GRAPH = "hudepth.bench.torch_runners", "hudepth.bench.graph_runners"
ONNX, INT8 = "model.onnx", "int8.xml"


@dataclass(frozen=True)
class Backend:
    """A way to run the network."""

    factory: str
    """``module:function`` that makes its runner."""
    what: str
    """For the notes."""
    packages: tuple[str, ...] = ()
    extras: str = ""
    """Of hudepth, that install them."""
    graph: str | None = None
    """The file that must be exported for it."""
    options: dict[str, Any] = field(default_factory=dict)


_OPENVINO = ("openvino", "onnx", "onnxscript")
BACKENDS = {
    "eager": Backend(f"{_TORCH}:eager", "PyTorch, the network as it was trained, contiguous"),
    "channels_last": Backend(f"{_TORCH}:channels_last", "the same network, channels-last"),
    "default": Backend(f"{_TORCH}:default", "PyTorch, merged for inference: what predicting and testing use"),
    "compile": Backend(f"{_TORCH}:compiled", "the merged form through torch.compile, for each batch size by itself"),
    "onnxruntime": Backend(
        f"{_GRAPH}:OnnxRunner", "the merged form, exported to ONNX",
        packages=("onnxruntime", "onnx", "onnxscript"), extras="onnx", graph=ONNX,
    ),
    "openvino": Backend(
        f"{_GRAPH}:OpenVinoRunner", "the same file in OpenVINO, in float32",
        packages=_OPENVINO, extras="onnx,openvino", graph=ONNX, options={"precision": "float32"},
    ),
    "openvino_bf16": Backend(
        f"{_GRAPH}:OpenVinoRunner", "the same file in OpenVINO, in bfloat16: not exact",
        packages=_OPENVINO, extras="onnx,openvino", graph=ONNX, options={"precision": "bfloat16"},
    ),
    "int8": Backend(
        f"{_GRAPH}:OpenVinoRunner", "OpenVINO, quantised on a handful of built-in rooms: for its speed, not its depth",
        packages=(*_OPENVINO, "nncf"), extras="onnx,openvino", graph=INT8, options={"precision": "float32"},
    ),
}  # fmt: skip
"""By name, in the table's order."""
GRAPHS = {ONNX: "hudepth.bench.graphs:onnx", INT8: "hudepth.bench.graphs:int8"}
"""Files that backends read, and what makes each."""
PRODUCT = f"{_TORCH}:product"
"""What measures the machine."""


def check_backends(value: Any) -> list[str]:
    """Return the backends asked for, in the table's order, :data:`REFERENCE` among them.

    Raises:
        ConfigError: if there is no such backend.
    """
    names = [str(item) for item in value] if isinstance(value, list) else [str(value)]
    for name in names:
        if name not in BACKENDS:
            known = ", ".join(BACKENDS)
            raise ConfigError(f"backends: no '{name}'.{did_you_mean(name, BACKENDS)} Pass some of {known}.")
    return [name for name in BACKENDS if name == REFERENCE or name in names]


def missing(packages: Sequence[str], extras: str) -> str:
    """Return a line that says what is not installed and how to install it; empty if all is there."""
    absent = [name for name in packages if importlib.util.find_spec(name) is None]
    if not absent:
        return ""
    return f"left out, since {' and '.join(absent)} cannot be imported. Run pip install 'hudepth[{extras}]'."
