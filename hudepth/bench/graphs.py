"""Exported graphs for the backends that need one, each made in a process of its own and for one run only."""

from __future__ import annotations

import importlib
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hudepth.bench.worker import Spec


class Exporter:
    """Has made a file when it is built, and computes nothing."""

    def describe(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load(self, images: NDArray[np.float32]) -> None:
        """Nothing to do."""

    def run(self) -> None:
        """Nothing to do."""

    def result(self) -> NDArray[np.float32]:
        """Nothing."""
        return np.zeros(0, np.float32)


def onnx(spec: Spec) -> Exporter:
    """Export the merged form of a network.

    Args:
        spec: of the network, with the further options ``graph`` (file to write), ``name`` and ``max_depth_m``.
    """
    from hudepth.bench.torch_runners import merged
    from hudepth.export.graphs import export_onnx
    from hudepth.inference.info import ModelInfo

    net, options = merged(spec), spec.options
    info = ModelInfo(
        name=options["name"], size=options["size"], max_depth_m=options["max_depth_m"],
        parameters=sum(p.numel() for p in net.parameters()), epoch=0, processing=False,
    )  # fmt: skip
    export_onnx(net, Path(options["graph"]), info=info)
    return Exporter()


def int8(spec: Spec) -> Exporter:
    """Quantise a graph for OpenVINO on the images: as fast as any int8 form, but on too few images to be as good.

    Args:
        spec: with the options ``onnx`` (a graph of normalised images) and ``graph`` (``.xml`` to write).
    """
    os.environ["CI"] = "true"  # of this process: NNCF then asks nothing and reports nothing
    openvino: Any = importlib.import_module("openvino")
    nncf: Any = importlib.import_module("nncf")
    nncf.set_log_level(logging.ERROR)
    images = np.load(spec.images)
    quantised = nncf.quantize(
        openvino.Core().read_model(spec.options["onnx"]), nncf.Dataset([image[None] for image in images]),
        preset=nncf.QuantizationPreset.MIXED, subset_size=len(images),
    )  # fmt: skip
    openvino.save_model(quantised, spec.options["graph"], compress_to_fp16=False)
    return Exporter()
