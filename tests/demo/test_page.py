from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from hudepth.base.errors import DataError
from hudepth.demo.answers import Answer, Limits, answer
from hudepth.demo.session_files import Files
from hudepth.inference.model import DepthModel
from hudepth.inference.model_info import ModelInfo

from .conftest import encoded


@pytest.fixture
def visitor() -> Any:
    """Who asks; Gradio takes seconds to import, so only these tests do."""
    return pytest.importorskip("gradio", reason="gradio is not installed").Request(session_hash="one")


def buttons(update: tuple[Any, ...]) -> list[tuple[Any, bool]]:
    return [(each["value"], each["interactive"]) for each in update[1:]]


def test_the_depth_comes_before_the_files(model: DepthModel, visitor: Any) -> None:
    from hudepth.demo.page import handler

    with Files() as files:
        path = files.uploads / "a.png"
        path.write_bytes(encoded(60, 80))
        steps = handler(lambda upload, view: answer(upload, model, Limits(2**20, 10**6), view), files)(
            str(path), "62", visitor
        )
        first = next(steps)
        assert json.loads(json.dumps(first[0]))["width"] == 80
        assert first[0]["camera"][0] == pytest.approx(40 / math.tan(math.radians(31)))
        assert buttons(first) == [(None, False)] * 5
        assert list(files.results.iterdir()) == []
        second = next(steps)
        endings = [Path(value).suffix for value, there in buttons(second) if there]
        assert endings == [".jpg", ".png", ".npy", ".ply", ".glb"]
        assert next(steps, None) is None
        (emptied,) = handler(lambda *_: None, files)(None, "", visitor)  # type: ignore[arg-type,return-value]
        assert emptied[0] is None
        assert [p for p in files.root.rglob("*") if p.is_file()] == []


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        (DataError("'<b>': no"), "'<b>': no"),
        (MemoryError(), "This machine has too little memory"),
        (torch.OutOfMemoryError("CUDA out of memory."), "The graphics card has too little memory"),
    ],
)
def test_what_goes_wrong_is_for_the_page(error: Exception, shown: str, visitor: Any) -> None:
    from hudepth.demo.page import handler

    def fails(*_: object) -> Answer:
        raise error

    with Files() as files:
        (step,) = handler(fails, files)(str(files.uploads / "a.png"), "", visitor)
    assert step[0]["error"].startswith(shown)
    assert buttons(step) == [(None, False)] * 5


def test_a_full_disk_costs_the_files_alone(model: DepthModel, monkeypatch: pytest.MonkeyPatch, visitor: Any) -> None:
    from hudepth.demo.page import handler

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with Files() as files:
        path = files.uploads / "a.png"
        path.write_bytes(encoded(60, 80))
        monkeypatch.setattr(files, "write", full)
        (step,) = handler(lambda upload, _: answer(upload, model, Limits(2**20, 10**6)), files)(
            str(path), None, visitor
        )
    assert step[0]["height"] == 60


def test_the_headline_says_what_the_numbers_are_worth() -> None:
    from hudepth.demo.page import headline

    text = headline(ModelInfo("Net", (32, 48), 10.0, 4_650_000, 5, {"source": "<i>"}))
    assert "Net of 4,650,000 parameters, trained on &lt;i&gt; for 5 epochs; 32 x 48, up to 10 m." in text
    assert "Do not trust" in text


def test_a_field_of_view_is_chosen_or_typed(visitor: Any) -> None:
    from hudepth.demo.page import LENSES, stated_camera

    assert [stated_camera(view) for view in ("", " ")] == [None, None]
    assert [stated_camera(option) for _, option in LENSES] == [option for _, option in LENSES]
    typed = {
        "62": "fov=62",
        " 53,5 ": "fov=53.5",
        "70 degrees": "fov=70",
        "70\N{DEGREE SIGN}": "fov=70",
        "1.6e2": "fov=160",
    }
    assert {view: stated_camera(view) for view in typed} == typed
    for view in ("wide", "4", "161", "nan", "inf", "f=800", "-60", "x" * 5000):
        with pytest.raises(DataError, match=r"^Field of view: '.{1,40}' is not from 5 to 160 degrees"):
            stated_camera(view)
