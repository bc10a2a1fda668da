from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.speed import measure_peers
from experiments.speed.measure_peers import compare, draw, select, start_peers
from hudepth.bench import contenders as module
from hudepth.bench.contenders import Contenders
from hudepth.bench.rows import Row
from hudepth.bench.subject import Subject
from tests.bench.test_contenders import FakeWorker
from tests.bench.test_rows import rows_of

SIZE = (224, 224)


def peer_row(name: str, size: tuple[int, int], images_per_s: float) -> Row:
    row = replace(rows_of(eager=1 / images_per_s)[0], contender=name, kind="peer", height=size[0], width=size[1])
    return replace(row, difference_mm=None, times_eager=images_per_s / 10)


def test_peers_are_compared_in_words() -> None:
    rows = rows_of(eager=0.1, default=0.08, openvino=0.04)  # 10, 12.5 and 25 images/s
    rows += [
        peer_row("Small, 224", SIZE, 11.0), peer_row("Small, 480 x 640", (480, 640), 1.0),
        peer_row("Large, 384", (384, 384), 5.0),
    ]  # fmt: skip
    assert compare(rows, size=SIZE)[1:] == [
        "Small (random weights, eager): at 224 1.10 x eager and 0.88 x default; at 480 x 640 0.10 x eager and 0.08 x "
        "default.",
        "Large (random weights, eager): at 384 0.50 x eager and 0.40 x default.",
        "Of the peers, at the size nearest to this model's: Small is faster than eager; none is faster than default; "
        "none is faster than openvino.",
    ]
    assert compare(rows[:3], size=SIZE) == []
    (axis,) = draw(select(rows)).axes
    assert [text.get_text() for text in axis.get_yticklabels()] == [
        "this model, openvino", "this model, default", "Small, 224", "this model, eager", "Large, 384",
        "Small, 480 x 640",
    ]  # fmt: skip


@pytest.fixture
def notes() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def contenders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, notes: list[tuple[str, str]]) -> Contenders:
    monkeypatch.setattr(module, "Worker", FakeWorker)
    monkeypatch.setattr(module, "images_file", lambda folder, size: folder / "images.npy")
    subject = Subject("Net", {}, [], tmp_path / "state.pt", (224, 320), 10.0, 1, 2, 3)
    return Contenders(subject, tmp_path, 2, "cpu", lambda name, line: notes.append((name, line)))


def test_peers_come_at_the_nearest_size_and_at_their_own(contenders: Contenders) -> None:
    with contenders:
        start_peers(contenders, names=["MobileNet UNet"])
        list(contenders.build())
    assert [(entry.name, entry.size, entry.kind) for entry in contenders.entries] == [
        ("MobileNet UNet, 224 x 320", (224, 320), "peer"),
        ("MobileNet UNet, 224", SIZE, "peer"),
    ]


def test_a_peer_whose_package_is_missing_is_a_note(
    contenders: Contenders, notes: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with contenders:
        start_peers(contenders, names=["DPT-hybrid"])
        assert list(contenders.build()) == []
    assert notes[0][0] == "DPT-hybrid"
    assert "transformers cannot be imported" in notes[0][1]


@pytest.mark.slow
def test_a_peer_next_to_the_bundled_model(tmp_path: Path) -> None:
    words = ["--backends", "eager", "--repeats", "1", "--seconds", "0", "--peers", "MobileNet UNet"]
    measure_peers.main([*words, "--output", str(tmp_path)])
    rows = json.loads((tmp_path / "bench.json").read_text())["rows"]
    assert [row["kind"] for row in rows] == ["backend", "peer", "peer"]
    assert (tmp_path / "peers.png").is_file()
