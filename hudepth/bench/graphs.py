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


class BoundRunner(Runner):
    """Runs a session of ONNX Runtime on a GPU, where images and depth stay."""

    def __init__(self, session: Any) -> None:
        self._session, self._binding = session, session.io_binding()
        self._input, self._output = (nodes[0].name for nodes in (session.get_inputs(), session.get_outputs()))

    def load(self, images: NDArray[np.float32]) -> None:
        """Copy the batch of all following passes to the GPU."""
        runtime: Any = importlib.import_module("onnxruntime")
        self._images = runtime.OrtValue.ortvalue_from_numpy(np.ascontiguousarray(images), "cuda", 0)
        self._binding.clear_binding_inputs()
        self._binding.clear_binding_outputs()  # of another size
        self._binding.bind_ortvalue_input(self._input, self._images)
        self._binding.bind_output(self._output, "cuda", 0)

    def run(self) -> None:
        """Compute one pass."""
        self._session.run_with_iobinding(self._binding)
        self._binding.synchronize_outputs()

    def result(self) -> NDArray[np.float32]:
        """Return unit depth [b, 1, h, w]."""
        return np.asarray(self._binding.copy_outputs_to_cpu()[0])


_FURTHER: dict[str, list[Any]] = {
    "CUDAExecutionProvider": [("CUDAExecutionProvider", {"use_tf32": "0"})],
    "TensorrtExecutionProvider": ["TensorrtExecutionProvider", "CUDAExecutionProvider"],
}
"""The providers of a session on a GPU, by the first."""


def onnxruntime(spec: Spec) -> Runner:
    """Run the ONNX file ``graph`` in ONNX Runtime, on the GPU if there is an option ``provider``.

    On a CPU, its threads spin for some 20 ms after a pass, which slows the next contender's untimed pass; without
    spinning, a pass is slower.
    """
    if provider := spec.options.get("provider"):
        runtime: Any = importlib.import_module("onnxruntime")
        if hasattr(runtime, "preload_dlls"):
            runtime.preload_dlls()  # of CUDA and cuDNN, which come with PyTorch
        session = onnx_session(Path(spec.options["graph"]), threads=spec.threads, providers=_FURTHER[provider])
        if provider not in session.get_providers():  # it falls back to the CPU without an error
            raise RuntimeError(
                f"ONNX Runtime could not start {provider}; is its version of CUDA or TensorRT installed?"
            )
        return BoundRunner(session)
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
