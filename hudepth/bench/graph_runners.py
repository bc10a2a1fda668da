"""The backends that run an exported graph. PyTorch is not imported here, so that their memory is their own."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hudepth.bench.worker import Spec


class OnnxRunner:
    """ONNX Runtime on the CPU, with the options that predicting uses.

    Its threads wait actively for some 20 ms after a pass, which the untimed pass of the next contender takes the brunt
    of; without that a pass is slower.

    Args:
        spec: with the option ``graph``, an ONNX file.
    """

    def __init__(self, spec: Spec) -> None:
        runtime = importlib.import_module("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = spec.threads
        options.log_severity_level = 3  # errors
        self._session = runtime.InferenceSession(spec.options["graph"], options, providers=["CPUExecutionProvider"])
        self._input = self._session.get_inputs()[0].name

    def describe(self) -> dict[str, Any]:
        """Nothing that is not known from elsewhere."""
        return {}

    def load(self, images: NDArray[np.float32]) -> None:
        """Take the batch of all passes from now on."""
        self._images = np.ascontiguousarray(images)

    def run(self) -> None:
        """Compute a pass."""
        (self._result,) = self._session.run(None, {self._input: self._images})

    def result(self) -> NDArray[np.float32]:
        """Return unit depth [b, 1, h, w]."""
        return np.asarray(self._result)


class OpenVinoRunner:
    """OpenVINO on the CPU, with the options that predicting uses.

    Args:
        spec: with the options ``graph``, an ONNX or IR file, and ``precision``, OpenVINO's name of it.
    """

    def __init__(self, spec: Spec) -> None:
        core = importlib.import_module("openvino").Core()
        options = {
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": spec.options["precision"],
            "INFERENCE_NUM_THREADS": spec.threads,
        }
        compiled = core.compile_model(core.read_model(spec.options["graph"]), "CPU", options)
        self._request = compiled.create_infer_request()

    def describe(self) -> dict[str, Any]:
        """Nothing that is not known from elsewhere."""
        return {}

    def load(self, images: NDArray[np.float32]) -> None:
        """Take the batch of all passes from now on."""
        self._images = np.ascontiguousarray(images)

    def run(self) -> None:
        """Compute a pass."""
        self._result = np.array(self._request.infer({0: self._images}, share_inputs=True)[0])

    def result(self) -> NDArray[np.float32]:
        """Return unit depth [b, 1, h, w]."""
        return np.asarray(self._result)
