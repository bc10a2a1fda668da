from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest

from hudepth.base.errors import ConfigError
from hudepth.bench import field as module
from hudepth.bench.backends import BACKENDS, GRAPHS, PRODUCT, check_backends, missing
from hudepth.bench.field import Field, Subject
from hudepth.bench.worker import ContenderError, Spec, Worker


def test_the_reference_is_always_there_and_the_order_is_the_tables() -> None:
    assert check_backends(["openvino", "default", "openvino"]) == ["eager", "default", "openvino"]
    assert check_backends("int8") == ["eager", "int8"]
    assert check_backends([]) == ["eager"]


def test_unknown_backends_are_refused_in_a_line() -> None:
    with pytest.raises(ConfigError) as error:
        check_backends(["eager", "open_vino"])
    assert str(error.value) == f"backends: no 'open_vino'. Did you mean 'openvino'? Pass some of {', '.join(BACKENDS)}."


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
        return {"parameters": 3, "flops": 4, "layout": "contiguous"}

    def dismiss(self) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture
def notes() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def entered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, notes: list[tuple[str, str]]) -> Field:
    monkeypatch.setattr(module, "Worker", FakeWorker)
    monkeypatch.setattr(module, "images_file", lambda folder, size: folder / "images.npy")
    subject = Subject("Net", {}, [], tmp_path / "state.pt", (224, 320), 10.0, 1, 2, 3)
    return Field(subject, tmp_path, 2, "cpu", lambda name, line: notes.append((name, line)))


def test_what_cannot_be_built_is_a_note_and_the_rest_is_there(
    entered: Field, notes: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeWorker, "broken", ("default", "int8.xml"))
    with entered as field:
        assert field.enter(list(BACKENDS)) == len(BACKENDS) == sum(1 for _ in field.build())
    assert [worker.name for worker in field.workers] == [entry.name for entry in field.entries]
    left = [name for name in BACKENDS if name not in ("default", "int8")]
    assert [entry.name for entry in field.entries] == left
    assert notes == [
        ("default", "cannot be built: no memory"),
        ("int8", "cannot be built: no memory"),
    ]


def test_peers_come_at_the_nearest_size_and_at_their_own(entered: Field, notes: list[tuple[str, str]]) -> None:
    with entered as field:
        field.enter([], ["DPT-hybrid", "MobileNet UNet"])
        list(field.build())
    assert [(entry.name, entry.size, entry.flops) for entry in field.entries] == [
        ("DPT-hybrid, 256", (256, 256), 4),  # square, of about as many pixels
        ("DPT-hybrid, 384", (384, 384), 4),
        ("MobileNet UNet, 224 x 320", (224, 320), 4),
        ("MobileNet UNet, 224", (224, 224), 4),
    ]
    assert notes == []
    line = "random weights, eager, contiguous; 3 parameters, 0.00 GFLOP an image"
    assert {entry.about for entry in field.entries} == {line}


def test_a_peer_whose_package_is_missing_is_a_note(
    entered: Field, notes: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with entered as field:
        field.enter([], ["DPT-hybrid", "MobileNet UNet"])
        list(field.build())
    assert notes[0] == (
        "DPT-hybrid", "left out, since transformers cannot be imported. Run pip install 'hudepth[peers]'."
    )  # fmt: skip
    assert [entry.label for entry in field.entries] == ["MobileNet UNet", "MobileNet UNet"]
