"""Exported files of hudepth are read in tests/export; here are those that are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hudepth
from hudepth.base.errors import CheckpointError
from hudepth.inference import trial
from hudepth.inference.model_info import ModelInfo


def test_an_onnx_file_of_another_model(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Identity", ["x"], ["y"])], "g", [value],
                                   [onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])])  # fmt: skip
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)])
    model.ir_version = 9
    onnx.save(model, str(tmp_path / "other.onnx"))
    for backend in ("onnxruntime", "openvino"):
        with pytest.raises(CheckpointError, match=r"other.onnx' has no description by hudepth"):
            hudepth.load(tmp_path / "other.onnx", backend=backend)


@pytest.mark.slow
@pytest.mark.parametrize("content", [b"", b"text", b"\x08\x09" * 50], ids=["empty", "text", "binary"])
@pytest.mark.parametrize("name", ["x.onnx", "x.xml", "x.pt2", "x.zip", "x.safetensors"])
def test_damaged_files(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        hudepth.load(tmp_path / name, trust=["pt2"])
    assert "\n" not in str(caught.value)


def crafted(
    path: Path, last: list[Any], kind: str = "FLOAT", *, shape: Any = ("b", 32, 48), side: int = 32, batch: Any = "b"
) -> Path:
    """Write a graph from bytes of 32 x 48 to their mean ``d``, then the nodes ``last``, then ``out``."""
    helper, types = pytest.importorskip("onnx").helper, pytest.importorskip("onnx").TensorProto
    nodes = [helper.make_node("Cast", ["image"], ["f"], to=types.FLOAT),
             helper.make_node("ReduceMean", ["f", "axis"], ["d"], keepdims=0), *last]  # fmt: skip
    numbers = {"axis": [3], "huge": [10**7, 1, 32, 48], "first": [0]}
    given = [helper.make_tensor(name, types.INT64, [len(each)], each) for name, each in numbers.items()]
    given += [helper.make_tensor("count", types.INT64, [], [2**62]), helper.make_tensor("true", types.BOOL, [], [True])]
    names = {"out": getattr(types, kind)} if kind != "TWO" else {"out": types.FLOAT, "d": types.FLOAT}
    outputs = [helper.make_tensor_value_info(name, each, shape) for name, each in names.items()]
    image = helper.make_tensor_value_info("image", types.UINT8, [batch, 32, 48, 3])
    model = helper.make_model(helper.make_graph(nodes, "g", [image], outputs, initializer=given),
                              opset_imports=[helper.make_opsetid("", 18)])  # fmt: skip
    model.ir_version = 9
    model.metadata_props.add(key="hudepth", value=ModelInfo("X", (side, 48), 10.0, 1, 1).to_json())
    path.write_bytes(model.SerializeToString())
    return path


def node(kind: str, *inputs: str, **more: Any) -> Any:
    return pytest.importorskip("onnx").helper.make_node(kind, list(inputs), ["out"], **more)


BACKENDS = pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])


@BACKENDS
def test_a_crafted_graph_that_is_sound(backend: str, tmp_path: Path) -> None:
    model = hudepth.load(crafted(tmp_path / "x.onnx", [node("Identity", "d")]), backend=backend)
    assert model.predict(np.full((20, 30, 3), 7, np.uint8)).metres == pytest.approx(7)


@pytest.mark.slow
@BACKENDS
@pytest.mark.parametrize(
    "kind",
    [
        "size",
        "two",
        "int64",
        "string",
        "scalar",
        "loop",
        "batch",
    ],
)
def test_graphs_that_are_not_what_they_say(kind: str, backend: str, tmp_path: Path) -> None:
    pytest.importorskip(backend)
    types = pytest.importorskip("onnx").TensorProto
    path = tmp_path / "x.onnx"
    if kind == "size":
        crafted(path, [node("Identity", "d")], side=8192)
    elif kind == "two":
        crafted(path, [node("Identity", "d")], "TWO")
    elif kind == "scalar":
        crafted(path, [node("ReduceMean", "d", keepdims=0)], shape=())
    elif kind == "loop":
        crafted(path, [endless()])
    elif kind == "batch":
        crafted(path, [node("Identity", "d")], shape=(7, 32, 48), batch=7)
    else:
        crafted(path, [node("Cast", "d", to=getattr(types, kind.upper()))], kind.upper())
    with pytest.raises(CheckpointError, match=r"x\.onnx") as caught:
        hudepth.load(path, backend=backend)
    assert "\n" not in str(caught.value)


def endless() -> Any:
    helper, types = pytest.importorskip("onnx").helper, pytest.importorskip("onnx").TensorProto
    values = [helper.make_tensor_value_info(n, k, s) for n, k, s in
              (("i", types.INT64, []), ("on", types.BOOL, []), ("x", types.FLOAT, None),
               ("still", types.BOOL, []), ("y", types.FLOAT, None))]  # fmt: skip
    steps = [helper.make_node("Identity", ["on"], ["still"]), helper.make_node("Identity", ["x"], ["y"])]
    body = helper.make_graph(steps, "body", values[:3], values[3:])
    return node("Loop", "count", "true", "d", body=body)


def test_a_graph_that_does_not_end_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "TIMEOUT_S", 0.05)
    with pytest.raises(CheckpointError, match=r"trust=\[onnx\]"):
        hudepth.load(crafted(tmp_path / "x.onnx", [node("Identity", "d")]), backend="onnxruntime")


@pytest.mark.slow
def test_a_graph_that_fills_memory(tmp_path: Path) -> None:
    bomb = [pytest.importorskip("onnx").helper.make_node("Expand", ["d", "huge"], ["x"])]
    path = crafted(tmp_path / "x.onnx", [*bomb, node("ReduceMax", "x", "first", keepdims=0)])
    with pytest.raises(CheckpointError):
        hudepth.load(path, backend="onnxruntime")


@pytest.mark.parametrize("kind", ["Neg", "Log"])
def test_depths_that_are_none_are_refused(kind: str, tmp_path: Path) -> None:
    model = hudepth.load(crafted(tmp_path / "x.onnx", [node(kind, "d")]), backend="onnxruntime")
    with pytest.raises(CheckpointError, match="not finite and positive"):
        model.predict(np.full((20, 30, 3), 7 * (kind == "Neg"), np.uint8))
