"""The first pass of an exported file that somebody else may have made: in a process of its own, under limits.

A graph holds no code, but it may loop for ever, or ask for more memory than there is. What it takes and returns is
found out here, too, so that a description that does not fit is refused before anything runs in this process.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hudepth.base.errors import CheckpointError, first_line
from hudepth.inference.runtimes import onnx_description, onnx_session, openvino_description, openvino_model

TIMEOUT_S = 25
MAX_BYTES = 3 << 30
"""Of memory that the trial may fill, where the system can limit it."""
MAX_VALUES = 3 * 8192**2  # of an input
LOOPS = {"Loop", "If", "Scan", "TensorIterator", "While"}
"""Operators whose work may depend on the image, so that a trial shows nothing about the next one."""


def try_graph(path: Path, *, backend: str, threads: int) -> dict[str, Any]:
    """Run a graph once, on zeros.

    Returns ``inputs`` and ``outputs``, data type and shape of each, and ``description``. Raises CheckpointError if the
    graph is damaged, does not end in time, takes too much memory, or holds loops.
    """
    command = [sys.executable, "-m", __name__, str(path.resolve()), backend, str(threads)]
    home = Path(__file__).parents[2]  # Python looks for modules where it starts: not where the file may lie
    fix = f"If you exported it yourself, pass trust=[{path.suffix[1:].lower()}] to run it without limits."
    try:
        done = subprocess.run(command, capture_output=True, cwd=home, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        raise CheckpointError(f"'{path}' is refused: it computes nothing within {TIMEOUT_S} s. {fix}") from None
    try:
        found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        why = f"its first pass ended with code {done.returncode}, perhaps for more than {MAX_BYTES >> 30} GiB of memory"
        raise CheckpointError(f"'{path}' is refused: {why}. {fix}") from None
    if "error" in found:
        why = f"it is damaged or of another kind ({found['error']})"
        raise CheckpointError(f"'{path}' cannot be read as a model: {why}.")
    return found


def _limit_memory() -> None:
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (MAX_BYTES, MAX_BYTES))
    except (ImportError, OSError, ValueError):  # not a Unix, or one with a lower limit
        pass


def _refuse_loops(kinds: Iterable[str]) -> None:
    if found := sorted(LOOPS & set(kinds)):
        raise ValueError(f"it holds {' and '.join(found)}: a depth network needs no control flow")


def _zeros(kind: str, shape: list[Any]) -> Any:
    sides = [side if isinstance(side, int) and side > 0 else 1 for side in shape]
    if np.prod(sides, dtype=float) > MAX_VALUES:
        raise ValueError(f"it takes an image of {' x '.join(map(str, sides))}")
    return np.zeros(sides, kind)


def _try_onnx(path: Path, threads: int) -> tuple[str, Any, Any]:
    if importlib.util.find_spec("onnx"):
        import onnx

        model = onnx.load(str(path), load_external_data=False)
        nodes = [*model.graph.node, *(node for function in model.functions for node in function.node)]
        _refuse_loops(node.op_type for node in nodes)
    session = onnx_session(path, threads=threads)
    taken = session.get_inputs()
    inputs = [(each.type[7:-1].replace("float", "float32"), each.shape) for each in taken]  # tensor(float)
    outputs = session.run(None, {each.name: _zeros(*kind) for each, kind in zip(taken, inputs, strict=True)})
    return onnx_description(session), inputs, outputs


def _try_openvino(path: Path, threads: int) -> tuple[str, Any, Any]:
    model, request = openvino_model(path, threads=threads, precision="float32")
    _refuse_loops(each.get_type_name() for each in model.get_ops())
    inputs = []
    for each in model.inputs:
        sides = [side.get_length() if side.is_static else -1 for side in each.partial_shape]
        inputs.append((each.element_type.to_dtype().name, sides))
    results = request.infer({number: _zeros(*kind) for number, kind in enumerate(inputs)})
    outputs = [np.asarray(results[number]) for number in range(len(model.outputs))]
    return openvino_description(model), inputs, outputs


def _main(path: str, backend: str, threads: str) -> None:
    _limit_memory()
    try:
        text, inputs, outputs = (_try_openvino if backend == "openvino" else _try_onnx)(Path(path), int(threads))
        returned = [(str(getattr(each, "dtype", "?")), list(getattr(each, "shape", []))) for each in outputs]
        found: dict[str, Any] = {"description": text, "inputs": inputs, "outputs": returned}
    except BaseException as error:  # the libraries have dozens of ways to fail
        found = {"error": first_line(error)}
    print(f"\n{json.dumps(found)}", flush=True)
    os._exit(0)  # what a library does at its end is of no interest


if __name__ == "__main__":
    _main(*sys.argv[1:])
