from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest

from hudepth.bench import contenders as module
from hudepth.bench.backends import BACKENDS, GRAPHS, PRODUCT, missing
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
        contenders.enter(list(BACKENDS))
        assert len(contenders.started) == len(BACKENDS) == sum(1 for _ in contenders.build())
    assert [worker.name for worker in contenders.workers] == [entry.name for entry in contenders.entries]
    left = [name for name in BACKENDS if name not in ("default", "int8")]
    assert [entry.name for entry in contenders.entries] == left
    assert notes == [
        ("default", "cannot be built: no memory"),
        ("int8", "cannot be built: no memory"),
    ]
