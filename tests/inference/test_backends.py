"""Exported files of hudepth are read in tests/export; here are those that are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

import hudepth
from hudepth.base.errors import CheckpointError


def test_an_onnx_file_of_another_model(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Identity", ["x"], ["y"])], "g", [value],
                                   [onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])])  # fmt: skip
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)])
    model.ir_version = 9
    onnx.save(model, str(tmp_path / "other.onnx"))
    for backend in ("onnxruntime", "openvino"):
        with pytest.raises(CheckpointError, match=r"other.onnx' was not exported by hudepth"):
            hudepth.load(tmp_path / "other.onnx", backend=backend)


@pytest.mark.parametrize("content", [b"", b"text", b"\x08\x09" * 50], ids=["empty", "text", "binary"])
@pytest.mark.parametrize("name", ["x.onnx", "x.xml", "x.pt2", "x.zip", "x.safetensors"])
def test_damaged_files(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        hudepth.load(tmp_path / name, trust=["pt2"])
    assert "\n" not in str(caught.value)
