"""Open exported graphs in ONNX Runtime and OpenVINO, for prediction and benchmarks. PyTorch is not imported here."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hudepth.base.errors import ConfigError

KEY = "hudepth"  # under which exported files carry the description of their model, as JSON
OPENVINO_PRECISIONS = {"float32": "f32", "bfloat16": "bf16"}  # and its names for them; bfloat16 is not exact


def onnx_session(path: Path, *, threads: int, providers: Sequence[Any] = ("CPUExecutionProvider",)) -> Any:
    """Open an ONNX file, on the CPU unless ``providers`` are others.

    Raises ConfigError if ONNX Runtime is missing, and what that raises itself.
    """
    runtime = package("onnxruntime", extra="onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # errors
    return runtime.InferenceSession(str(path), options, providers=list(providers))


def openvino_model(path: Path, *, threads: int, precision: str) -> tuple[Any, Any]:
    """Open an IR or ONNX file in OpenVINO: the model as read, and an inference request; raises as onnx_session does."""
    core = package("openvino", extra="openvino").Core()
    options = {"INFERENCE_PRECISION_HINT": OPENVINO_PRECISIONS[precision], "INFERENCE_NUM_THREADS": threads}
    options["PERFORMANCE_HINT"] = "LATENCY"
    model = core.read_model(path)
    return model, core.compile_model(model, "CPU", options).create_infer_request()


def onnx_description(session: Any) -> str:
    """Return the model's description that hudepth stored in an ONNX file; empty if there is none."""
    return str(session.get_modelmeta().custom_metadata_map.get(KEY, ""))


def openvino_description(model: Any) -> str:
    """Return the model's description that hudepth stored in an IR or an ONNX file; empty if there is none."""
    places = ([KEY], ["framework", KEY])  # in an IR, in a model read from ONNX
    return next((str(model.get_rt_info(place).astype(str)) for place in places if model.has_rt_info(place)), "")


def package(name: str, *, extra: str) -> Any:
    """Import a package that an extra of hudepth installs; raises ConfigError if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(f"{name} is not installed. Run pip install 'hudepth[{extra}]'.") from error
