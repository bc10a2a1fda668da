"""The installed script and a real browser: what a visitor sees, what leaves the machine, what stays behind."""

from __future__ import annotations

import os
import re
import signal
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hudepth.data.store import to_mm
from hudepth.inference.depth_map import jpeg
from hudepth.inference.model import DepthModel
from hudepth.viz.colour import auto_scale
from tests.browser import chromium

from .conftest import HOSTILE, encoded, served, until

pytestmark = pytest.mark.slow

WATCH = """
import os, sys
def note(event, details):
    if event in ("socket.connect", "socket.getaddrinfo"):
        with open(os.environ["CALLS"], "a") as file:
            file.write(f"{details[1] if event == 'socket.connect' else details[0]}\\n")
sys.addaudithook(note)
"""
"""A sitecustomize.py: which addresses a process asks for."""
HERE = re.compile(r"\('(127\.0\.0\.1|::1)', \d+.*\)|127\.0\.0\.1|localhost|None|/.*")


@dataclass
class Page:
    """A running demo and where it keeps things."""

    process: subprocess.Popen[str]
    url: str
    temporary: Path
    calls: Path
    asked: list[str] = field(default_factory=list)

    def files(self) -> list[Path]:
        """What sessions left on disk."""
        (root,) = self.temporary.glob("hudepth-demo-*")
        return [p for name in ("uploads", "results") for p in (root / name).rglob("*") if p.is_file()]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def page(checkpoint: Path, browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    pytest.importorskip("gradio", reason="gradio is not installed")
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "sitecustomize.py").write_text(WATCH)
    path = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    environment = {"CALLS": str(folder / "calls"), "PYTHONPATH": path, "GRADIO_HEARTBEAT_INTERVAL": "0.5"}
    with served(checkpoint, folder, "max_upload_mb=0.1", **environment) as (process, url):
        yield Page(process, url, folder / "temporary", folder / "calls")


@pytest.fixture(scope="module")
def tab(browser: Any, page: Page) -> Any:
    tab = browser.new_page(viewport={"width": 1280, "height": 800})
    tab.on("request", lambda request: page.asked.append(request.url))
    tab.goto(page.url)
    tab.wait_for_selector(".hd-empty")
    return tab


def send(tab: Any, name: str, data: bytes) -> None:
    tab.set_input_files("#picture input[type=file]", {"name": name, "mimeType": "image/png", "buffer": data})


def caption(tab: Any, name: str) -> None:
    tab.locator(".hd-caption", has_text=name).wait_for(timeout=10_000)


PICTURE = encoded(96, 128)
PASTE = """data => {
    const held = new DataTransfer();
    held.items.add(new File([Uint8Array.from(data)], "pasted.png", { type: "image/png" }));
    document.body.dispatchEvent(new ClipboardEvent("paste", { clipboardData: held, bubbles: true }));
}"""


def test_the_depth_under_the_pointer_is_the_models(tab: Any, model: DepthModel) -> None:
    send(tab, "a.png", PICTURE)
    caption(tab, "a.png, 128 x 96")
    expected = to_mm(model.predict(PICTURE).metres)
    stage = tab.locator(".hd-stage")
    box = stage.bounding_box()
    for row, column in ((3, 100), (50, 20), (90, 120)):
        x, y = (column + 0.5) / 128 * box["width"], (row + 0.5) / 96 * box["height"]
        stage.hover(position={"x": x, "y": y})
        assert tab.inner_text(".hd-reading") == f"{expected[row, column] / 1000 + 1e-9:.2f} m"
    tab.mouse.move(1, 1)
    assert not tab.is_visible(".hd-reading")


def test_keys_move_the_reading_and_the_slider(tab: Any) -> None:
    tab.focus(".hd-stage")
    tab.keyboard.press("ArrowRight")
    assert re.fullmatch(r"\d+\.\d\d m", tab.inner_text(".hd-reading"))
    tab.focus(".hd-slider input")
    tab.keyboard.press("ArrowLeft")
    assert tab.evaluate("document.querySelector('.hd-line').style.left") == "49%"


def ticks(tab: Any) -> list[float]:
    return [float(text.removesuffix(" m")) for text in tab.locator(".hd-ticks span").all_inner_texts()]


def test_the_scale_is_the_pictures_own_or_fixed_in_metres(tab: Any, model: DepthModel) -> None:
    near, far = auto_scale(model.predict(PICTURE).metres)
    assert ticks(tab) == pytest.approx(np.linspace(near, far, 6), abs=0.051)
    assert "0 to 10 m" in tab.inner_text(".hd-fixed")
    tab.check(".hd-fixed input")
    assert ticks(tab) == [0, 2, 4, 6, 8, 10]
    tab.uncheck(".hd-fixed input")


def test_two_points_are_as_far_apart_as_in_the_point_cloud(tab: Any, model: DepthModel) -> None:
    points = model.predict(PICTURE).point_cloud(edges=True).points_m.reshape(96, 128, 3)
    box = tab.locator(".hd-stage").bounding_box()
    assert tab.inner_text(".hd-measure") == "Click two points to measure how far apart they are."
    ends = [(90, 110), (5, 8)]
    for row, column in ends:
        assert not tab.is_visible(".hd-apart")
        place = {"x": (column + 0.5) / 128 * box["width"], "y": (row + 0.5) / 96 * box["height"]}
        tab.locator(".hd-stage").click(position=place)
    metres = float(np.linalg.norm(points[ends[0]] - points[ends[1]]))
    shown = float(tab.inner_text(".hd-apart").removesuffix(" m"))
    assert shown == pytest.approx(metres, abs=0.007)  # depth goes over in millimetres
    assert f"The two points are {shown:.2f} m apart" in tab.inner_text(".hd-measure")
    assert tab.locator(".hd-mark:visible").count() == 2
    tab.focus(".hd-stage")
    tab.keyboard.press("Enter")
    assert tab.locator(".hd-mark:visible").count() == 1  # a third point begins anew
    tab.keyboard.press("Escape")
    assert tab.locator(".hd-mark:visible").count() == 0
    tab.mouse.move(1, 1)


def test_dragging_the_line_marks_nothing(tab: Any) -> None:
    box = tab.locator(".hd-stage").bounding_box()
    share = float(tab.input_value(".hd-slider input")) / 100
    tab.mouse.move(box["x"] + share * box["width"], box["y"] + 40)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 40, steps=4)
    tab.mouse.up()
    assert tab.input_value(".hd-slider input") == "25"
    assert tab.locator(".hd-mark:visible").count() == 0
    tab.mouse.move(1, 1)


def test_the_downloads_are_what_was_shown(tab: Any, model: DepthModel, tmp_path: Path) -> None:
    for number, ending in enumerate(("jpg", "png", "npy", "ply", "glb")):
        with tab.expect_download() as download:
            tab.locator("#downloads button").nth(number).click()
        assert download.value.suggested_filename == f"a_depth.{ending}"
        download.value.save_as(tmp_path / f"a_depth.{ending}")
    metres = np.load(tmp_path / "a_depth.npy")
    np.testing.assert_allclose(metres, model.predict(PICTURE).metres, rtol=1e-5, atol=1e-6)
    millimetres = cv2.imread(str(tmp_path / "a_depth.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(millimetres, to_mm(metres))
    head, _, body = (tmp_path / "a_depth.ply").read_bytes().partition(b"end_header\n")
    points = model.predict(PICTURE).point_cloud(edges=False).points_m
    assert f"element vertex {len(points)}".encode() in head
    np.testing.assert_allclose(np.frombuffer(body, [("p", "<f4", 3), ("c", "u1", 3)])["p"], points, atol=1e-5)
    files = ((tmp_path / "a_depth.jpg").read_bytes(), jpeg(model.predict(PICTURE).colourise()))
    shown, expected = (cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR).astype(int) for file in files)
    assert np.abs(shown - expected).mean() < 0.5
    magic, version, length = struct.unpack("<4sII", (tmp_path / "a_depth.glb").read_bytes()[:12])
    assert (magic, version, length) == (b"glTF", 2, (tmp_path / "a_depth.glb").stat().st_size)


def test_the_field_of_view_is_chosen_or_typed(tab: Any, model: DepthModel) -> None:
    assert "NYU Depth V2's camera assumed: set the field of view" in tab.inner_text(".hd-caption")
    box = tab.locator("#view input")
    for typed, camera, words in (("40", "fov=40", "40 degrees across"), ("100", "fov=100", "100 degrees across")):
        box.fill(typed)
        box.press("Enter")
        caption(tab, words)
        tab.locator(".hd-stage").hover(position={"x": 3, "y": 3})
        expected = to_mm(model.predict(PICTURE, camera=camera).metres)[0, 0]
        assert abs(float(tab.inner_text(".hd-reading").removesuffix(" m")) - expected / 1000) < 0.03
    box.fill("wide")
    box.press("Enter")
    tab.locator(".hd-message", has_text="'wide' is not from 5 to 160 degrees").wait_for(timeout=10_000)
    box.click()
    tab.get_by_role("option", name="phone, main camera, 26 mm").click()
    caption(tab, "26 mm on 35 mm film")
    box.click()
    tab.get_by_role("option", name="from the file, if it says").click()
    caption(tab, "NYU Depth V2's camera assumed")
    tab.mouse.move(1, 1)


def test_the_points_are_drawn_and_turn(tab: Any) -> None:
    tab.click("[data-mode=cloud]")
    canvas = tab.locator(".hd-cloud")
    tab.wait_for_timeout(300)
    if "no WebGL" in tab.inner_text(".hd-hint"):
        pytest.skip("this Chromium has no WebGL")
    before = cv2.imdecode(np.frombuffer(canvas.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert before.std() > 20
    canvas.press("ArrowLeft")
    tab.wait_for_timeout(200)
    after = cv2.imdecode(np.frombuffer(canvas.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert (before != after).mean() > 0.1
    tab.click("[data-mode=map]")


def test_a_picture_can_be_pasted(tab: Any) -> None:
    tab.evaluate(PASTE, list(PICTURE))
    caption(tab, "pasted.png, 128 x 96")


def test_a_heic_is_shown_though_the_browser_cannot(tab: Any) -> None:
    pytest.importorskip("pillow_heif", reason="pillow-heif is not installed").register_heif_opener()
    send(tab, "phone.heic", encoded(60, 80, "HEIF"))
    caption(tab, "phone.heic, 80 x 60")
    tab.wait_for_function("document.querySelector('#picture img').naturalWidth === 80", timeout=10_000)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_bad_file_is_a_message(tab: Any, name: str) -> None:
    data, expected = HOSTILE[name]
    send(tab, name, data)
    tab.locator(".hd-message", has_text=expected).wait_for(timeout=10_000)
    assert not tab.is_visible(".hd-result")


def test_a_name_is_no_markup(tab: Any) -> None:
    send(tab, "x<img src=x onerror=document.title=1>.png", b"text")
    tab.locator(".hd-message", has_text="onerror=document.title").wait_for()
    assert tab.locator(".hd-message img").count() == 0
    assert tab.locator("#headline b").count() == 0  # nor is what a checkpoint says of itself
    assert tab.title() == "hudepth"


def test_a_file_that_is_too_large_is_said_and_the_page_goes_on(tab: Any) -> None:
    send(tab, "huge.png", bytes(2**17))
    tab.get_by_text("exceed the maximum allowed size").first.wait_for(timeout=10_000)
    tab.get_by_text("Drop Image Here").wait_for()
    tab.wait_for_timeout(300)
    send(tab, "b.png", PICTURE)
    caption(tab, "b.png, 128 x 96")
    tab.locator("#rooms button").nth(1).click()
    caption(tab, "kitchen.jpg, 640 x 480")


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
@pytest.mark.parametrize(("high", "wide"), [(96, 72), (72, 96)], ids=["portrait", "landscape"])
def test_the_picture_and_its_facts_fill_the_screen(tab: Any, width: int, height: int, high: int, wide: int) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    send(tab, "shape.png", encoded(high, wide))
    caption(tab, f"shape.png, {wide} x {high}")
    tab.wait_for_timeout(300)
    viewer, stage, side = (tab.locator(each).bounding_box() for each in ("#viewer", ".hd-stage", ".hd-side"))
    assert stage["width"] / stage["height"] == pytest.approx(wide / high, rel=0.02)
    beside = side["y"] < stage["y"] + stage["height"] / 2
    assert beside == (width == 1280 and high > wide)
    empty = viewer["x"] + viewer["width"] - max(each["x"] + each["width"] for each in (stage, side))
    assert empty < 0.05 * width
    labels = tab.locator("#downloads button").evaluate_all("all => all.every(e => e.scrollWidth <= e.clientWidth)")
    assert labels, "a label is cut off"


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_nothing_is_wider_than_the_screen(tab: Any, width: int, height: int) -> None:
    tab.set_viewport_size({"width": width, "height": height})
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    assert tab.locator(".hd-stage").bounding_box()["width"] > 0.6 * min(width, height)


def test_what_a_session_had_goes_with_it(tab: Any, page: Page) -> None:
    send(tab, "c.png", PICTURE)
    caption(tab, "c.png")
    assert until(lambda: len(page.files()) == 6)  # the picture and five downloads
    tab.close()
    assert until(lambda: page.files() == [])


def test_nothing_was_asked_of_other_hosts(page: Page) -> None:
    assert len(page.asked) > 10
    assert [url for url in page.asked if not url.startswith((page.url, "data:", "blob:"))] == []
    calls = set(page.calls.read_text().splitlines())
    assert [call for call in calls if not HERE.fullmatch(call)] == []


def test_ctrl_c_ends_it_and_leaves_nothing(page: Page) -> None:
    page.process.send_signal(signal.SIGINT)
    out, _ = page.process.communicate(timeout=20)
    assert page.process.returncode == 0
    assert out == ""
    assert list(page.temporary.glob("hudepth-demo-*")) == []
