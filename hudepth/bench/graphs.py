"""Exported graphs: how they are made, each in a process of its own, and run.

PyTorch is not imported at the top, so that the memory of ONNX Runtime and OpenVINO is their own.
"""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hudepth.bench.worker import Runner, Spec
from hudepth.inference.runtimes import onnx_session, openvino_model


class GraphRunner(Runner):
    """Runs a graph on the CPU as hudepth-predict does; ``compute`` takes images [b, 3, h, w] to depth [b, 1, h, w]."""

    def __init__(self, compute: Callable[[NDArray[np.float32]], Any]) -> None:
        self._compute = compute

    def load(self, images: NDArray[np.float32]) -> None:
        """Set the batch of all following passes."""
        self._images = np.ascontiguousarray(images)

    def run(self) -> None:
        """Compute one pass."""
        self._result = self._compute(self._images)

    def result(self) -> NDArray[np.float32]:
        """Return unit depth [b, 1, h, w]."""
        return np.asarray(self._result)


def onnxruntime(spec: Spec) -> GraphRunner:
    """Run the ONNX file ``graph`` in ONNX Runtime.

    Its threads spin for some 20 ms after a pass, which slows the next contender's untimed pass; without spinning, a
    pass is slower.
    """
    session = onnx_session(Path(spec.options["graph"]), threads=spec.threads)
    name = session.get_inputs()[0].name
    return GraphRunner(lambda images: session.run(None, {name: images})[0])


def openvino(spec: Spec) -> GraphRunner:
    """Run the ONNX or IR file ``graph`` in OpenVINO, in ``precision``."""
    graph, precision = Path(spec.options["graph"]), spec.options["precision"]
    _, request = openvino_model(graph, threads=spec.threads, precision=precision)
    return GraphRunner(lambda images: np.array(request.infer({0: images}, share_inputs=True)[0]))


def export(spec: Spec) -> GraphRunner:
    """Export the merged network to the ONNX file ``graph``; further options are ``name`` and ``max_depth_m``."""
    from hudepth.bench.torch_runners import build_merged
    from hudepth.export.graphs import export_onnx
    from hudepth.inference.model_info import ModelInfo
    from hudepth.models.cost import parameters

    net, options = build_merged(spec), spec.options
    stated = {key: options[key] for key in ("name", "size", "max_depth_m")}
    info = ModelInfo(**stated, parameters=parameters(net, trainable_only=False), epoch=0, processing=False)
    export_onnx(net, Path(options["graph"]), info=info)
    return GraphRunner(np.asarray)


def quantise(spec: Spec) -> GraphRunner:
    """Quantise the graph ``onnx`` to ``graph`` (``.xml``) for OpenVINO, on too few images to be accurate."""
    os.environ["CI"] = "true"  # in this process: stops NNCF from collecting statistics
    library: Any = importlib.import_module("openvino")
    nncf: Any = importlib.import_module("nncf")
    nncf.set_log_level(logging.ERROR)
    images = np.load(spec.images)
    graph, data = library.Core().read_model(spec.options["onnx"]), nncf.Dataset([image[None] for image in images])
    quantised = nncf.quantize(graph, data, preset=nncf.QuantizationPreset.MIXED, subset_size=len(images))
    library.save_model(quantised, spec.options["graph"], compress_to_fp16=False)
    return GraphRunner(np.asarray)
