"""The backends that run an exported graph. PyTorch is not imported here, so that their memory is their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hudepth.bench.worker import Spec
from hudepth.inference.runtimes import onnx_session, openvino_model


class OnnxRunner:
    """ONNX Runtime on the CPU, with the options that predicting uses.

    Its threads wait actively for some 20 ms after a pass, which the untimed pass of the next contender takes the brunt
    of; without that a pass is slower.

    Args:
        spec: with the option ``graph``, an ONNX file.
    """

    def __init__(self, spec: Spec) -> None:
        self._session = onnx_session(Path(spec.options["graph"]), threads=spec.threads)
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
        spec: with the options ``graph``, an ONNX or IR file, and ``precision``.
    """

    def __init__(self, spec: Spec) -> None:
        graph, precision = Path(spec.options["graph"]), spec.options["precision"]
        _, self._request = openvino_model(graph, threads=spec.threads, precision=precision)

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
