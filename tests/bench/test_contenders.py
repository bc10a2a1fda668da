from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hudepth.bench import contenders as module
from hudepth.bench.backends import BACKENDS, GRAPHS, ON_CPU, ON_GPU, PRODUCT, missing
from hudepth.bench.contenders import Contenders
from hudepth.bench.subject import Subject
from hudepth.bench.worker import ContenderError, Spec, Worker


def test_every_factory_is_there() -> None:
    for factory in (*(backend.factory for backend in BACKENDS.values()), *GRAPHS.values(), PRODUCT):
        name, _, function = factory.partition(":")
        assert callable(getattr(importlib.import_module(name), function))


def test_what_is_not_installed_names_the_extra() -> None:
    assert missing(("torch",), "any") == ""
    line = missing(("torch", "absent_one", "absent_two"), "openvino")
    assert line == (
        "left out, since absent_one and absent_two cannot be imported. Run pip install 'hudepth[openvino]'."
    )


class FakeWorker(Worker):
    """Cannot build what its class is told not to."""

    broken: tuple[str, ...] = ()

    def __init__(self, spec: Spec, *, log: Path) -> None:
        self.spec, self.name = spec, spec.name

    def build(self) -> dict[str, Any]:
        if self.name in self.broken:
            raise ContenderError("no memory")
        Path(self.spec.options.get("graph", "/dev/null")).touch()
        return {}

    def dismiss(self) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture
def notes() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def entered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, notes: list[tuple[str, str]]) -> Contenders:
    monkeypatch.setattr(module, "Worker", FakeWorker)
    monkeypatch.setattr(module, "images_file", lambda folder, size: folder / "images.npy")
    subject = Subject("Net", {}, [], tmp_path / "state.pt", (224, 320), 10.0, 1, 2, 3)
    return Contenders(subject, tmp_path, 2, "cpu", lambda name, line: notes.append((name, line)))


def test_what_cannot_be_built_is_a_note_and_the_rest_is_there(
    entered: Contenders, notes: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeWorker, "broken", ("default", "int8.xml"))
    with entered as contenders:
        contenders.enter(ON_CPU)
        assert len(contenders.started) == len(ON_CPU) == sum(1 for _ in contenders.build())
    assert [worker.name for worker in contenders.workers] == [entry.name for entry in contenders.entries]
    left = [name for name in ON_CPU if name not in ("default", "int8")]
    assert [entry.name for entry in contenders.entries] == left
    assert notes == [
        ("default", "cannot be built: no memory"),
        ("int8", "cannot be built: no memory"),
    ]


def test_what_needs_a_gpu_is_left_out_without_one(entered: Contenders, notes: list[tuple[str, str]]) -> None:
    with entered as contenders:
        contenders.enter(["eager", "cuda_graph", "bf16", "tensorrt"])
        assert [entry.name for _, entry in contenders.started] == ["eager"]
    line = "left out, since it needs an NVIDIA GPU and device=cuda."
    assert notes == [(name, line) for name in ("cuda_graph", "bf16", "tensorrt")]


def test_on_a_gpu_each_has_the_yardstick_of_its_precision(
    entered: Contenders, notes: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    runtime = SimpleNamespace(get_available_providers=lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"])
    monkeypatch.setitem(sys.modules, "onnxruntime", runtime)  # type: ignore[arg-type]
    monkeypatch.setattr("hudepth.bench.backends.missing", lambda *_: "")
    entered.device = "cuda"
    with entered as contenders:
        contenders.enter([*ON_GPU, "openvino"])
        yardsticks = {entry.name: entry.yardstick for _, entry in contenders.started}
        options = {worker.name: worker.spec.options for worker, _ in contenders.started}
    plain = dict.fromkeys(("eager", "channels_last", "default", "cuda_graph", "compile", "onnxruntime_cuda"), "float32")
    assert yardsticks == {**plain, "tf32": "tf32", "fp16": "float16", "bf16": "bfloat16", "openvino": None}
    (left_out,) = notes
    assert left_out[0] == "tensorrt"
    assert "no TensorrtExecutionProvider here. Run pip" in left_out[1]
    assert options["onnxruntime_cuda"]["provider"] == "CUDAExecutionProvider"
    assert options["fp16"]["precision"] == "float16"
    assert options["fp16"]["replayed"]


def test_a_rival_runs_its_own_network_in_the_same_backends(entered: Contenders, tmp_path: Path) -> None:
    (tmp_path / "rival").mkdir()
    rival = Subject("Rival", {"width": 3}, [], tmp_path / "rival" / "state.pt", (32, 48), 10.0, 4, 5, 6)
    with entered as contenders:
        contenders.enter(["eager", "openvino"])
        contenders.enter(["eager", "openvino"], rival=rival)
        kinds = {entry.name: (entry.kind, entry.size, entry.parameters) for _, entry in contenders.started}
        options = {worker.name: worker.spec.options for worker, _ in contenders.started}
        assert sum(1 for _ in contenders.build()) == 4
    own, other = ("backend", (224, 320), 1), ("peer", (32, 48), 4)
    assert kinds == {"eager": own, "openvino": own, "Rival, eager": other, "Rival, openvino": other}
    assert options["Rival, eager"]["model"] == {"width": 3}
    assert options["Rival, eager"]["state"] == str(tmp_path / "rival" / "state.pt")
    assert options["Rival, openvino"]["graph"] == str(tmp_path / "rival" / "model.onnx")
    assert options["openvino"]["graph"] == str(tmp_path / "model.onnx")
