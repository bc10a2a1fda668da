"""Write the network as ONNX, ``torch.export`` or OpenVINO."""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hudepth import __version__
from hudepth.base.files import written_whole
from hudepth.export.any_size import AnySize
from hudepth.inference.backends import DepthPipeline
from hudepth.inference.image_fit import FOCAL_POWERS
from hudepth.inference.model_info import ModelInfo
from hudepth.inference.runtimes import KEY, package

OPSET = 18
INPUT = "image"
OUTPUTS = {True: "depth_m", False: "unit_depth"}  # by whether the graph includes pre- and post-processing


def export_graph(net: nn.Module, info: ModelInfo) -> tuple[nn.Module, Tensor]:
    """Return the module to export and an example input; ``info`` states whether processing is part of the graph."""
    height, width = info.size
    if info.processing:
        image = torch.randint(0, 256, (2, height, width, 3), dtype=torch.uint8)
        return DepthPipeline(net, info).eval(), image
    return net, torch.rand(2, 3, height, width)


def describe(info: ModelInfo) -> dict[str, str]:
    """Return the metadata of a file: hudepth's own description, and one for people and other programs."""
    height, width = info.size
    if info.processing:
        image = f"uint8 [batch, {height}, {width}, 3], RGB, the whole image resized to this size"
        depth = f"float32 [batch, {height}, {width}], distance along the optical axis in metres"
    else:
        mean_std = "less (0.485, 0.456, 0.406), over (0.229, 0.224, 0.225)"
        image = f"float32 [batch, 3, {height}, {width}], RGB in [0, 1] {mean_std}"
        depth = f"float32 [batch, 1, {height}, {width}], depth / {info.max_depth_m:g} m"
    averaged = f"the whole image to {width} x {height}, averaged over areas where it shrinks (OpenCV's INTER_AREA)"
    return {
        KEY: info.to_json(),
        "resize": f"{averaged}, else bilinear; another method shifts depth by centimetres",
        "input": f"{INPUT}: {image}",
        "output": f"{OUTPUTS[info.processing]}: {depth}",
        **_describe_camera(info),
        **({"calibration": str(info.calibration)} if info.calibration else {}),
        "max_depth_m": f"{info.max_depth_m:g}",
        "trained_on": json.dumps(info.trained_on, sort_keys=True),
        "producer": f"hudepth {__version__}",
    }


def describe_any_size(info: ModelInfo) -> dict[str, str]:
    """Return the metadata of a file that resizes by itself: for people and other programs only."""
    stated = describe(info)
    for key in (KEY, "resize"):
        del stated[key]
    stated["input"] = f"{INPUT}: uint8 [batch, height, width, 3], RGB, of any size"
    stated["output"] = f"{OUTPUTS[True]}: float32 [batch, height, width], distance along the optical axis in metres"
    return stated


def _describe_camera(info: ModelInfo) -> dict[str, str]:
    """Return what a picture of another camera than that of the training needs; nothing if that is not known."""
    if info.training_focal is None:
        return {}
    (across, down), (x, y) = info.training_focal, FOCAL_POWERS
    ratios = f"(fx / width / {across:.4f})^{x:g} * (fy / height / {down:.4f})^{y:g}"
    return {"camera": f"for pictures of focal lengths fx, fy [pixels], multiply depth by {ratios}"}


def export_onnx(net: nn.Module, path: Path, *, info: ModelInfo, any_size: bool = False) -> None:
    """Write a network (normalised image to unit depth) as ONNX; raises ConfigError if onnx or onnxscript is missing.

    ``any_size``: with resizing as part of the graph, which must include processing. hudepth does not read such a file.
    """
    for name in ("onnx", "onnxscript"):
        package(name, extra="onnx")
    graph, image = export_graph(net, info)
    sides = ("batch", "height", "width") if any_size else ("batch",)
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            AnySize(graph, info.size).eval() if any_size else graph, (image,), dynamo=True, opset_version=OPSET,
            dynamic_shapes=({axis: torch.export.Dim(side, min=1) for axis, side in enumerate(sides)},),
            input_names=[INPUT], output_names=[OUTPUTS[info.processing]], verbose=False,
        )  # fmt: skip
    assert program is not None
    model = program.model_proto
    described = describe_any_size(info) if any_size else describe(info)
    for key, value in described.items():
        model.metadata_props.add(key=key, value=value)
    model.producer_name = "hudepth"
    with written_whole(path) as part:
        part.write_bytes(model.SerializeToString())


def export_program(net: nn.Module, path: Path, *, info: ModelInfo) -> None:
    """Write a ``torch.export`` program (``.pt2``) for any batch size, whole or not at all; see :func:`export_onnx`."""
    graph, image = export_graph(net, info)
    memory = io.BytesIO()  # not the file: torch ends the process if the disk is full
    with _quiet(), torch.no_grad():
        program = torch.export.export(graph, (image,), dynamic_shapes=({0: torch.export.Dim("batch", min=1)},))
        torch.export.save(program, memory, extra_files={f"{KEY}.json": info.to_json()})
    with written_whole(path) as part:
        part.write_bytes(memory.getbuffer())


def export_openvino(onnx: Path, path: Path, *, info: ModelInfo) -> None:
    """Convert an ONNX file to OpenVINO's ``.xml`` and ``.bin``; raises ConfigError if OpenVINO is not installed."""
    save_openvino(package("openvino", extra="openvino").Core().read_model(onnx), path, info=info)


def save_openvino(model: Any, path: Path, *, info: ModelInfo) -> None:
    """Write an OpenVINO model and its description."""
    for key, value in describe(info).items():
        model.set_rt_info(value, [key])
    path.parent.mkdir(parents=True, exist_ok=True)
    openvino = package("openvino", extra="openvino")
    openvino.save_model(model, path, compress_to_fp16=False)  # half precision would cost more than a millimetre


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide the exporter's remarks about optional packages."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "torch.export", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
