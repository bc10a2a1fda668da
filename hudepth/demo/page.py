"""The page: gradio's picture, examples and downloads around our own viewer."""

from __future__ import annotations

import base64
import contextlib
import re
from collections.abc import Callable, Iterator
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import gradio as gr
import torch

from hudepth.base.console import log
from hudepth.base.errors import DataError, HudepthError
from hudepth.base.wording import gpu_line
from hudepth.demo.answers import Answer, colour_table
from hudepth.demo.session_files import Files
from hudepth.inference.model_info import ModelInfo

FONTS = ["ui-sans-serif", "system-ui", "Segoe UI", "Roboto", "Helvetica Neue", "Arial", "sans-serif"]
MONO = ["ui-monospace", "Menlo", "Consolas", "monospace"]  # system fonts; gradio's themes load others from the web
THEME = gr.themes.Default(primary_hue="blue", font=FONTS, font_mono=MONO).set(
    block_info_text_color="*neutral_600", block_info_text_color_dark="*neutral_300",
)  # fmt: skip
BUTTONS = ("Colours (JPG)", "Depth in mm (PNG)", "Depth in m (npy)", "Points (PLY)", "Points (GLB)")
LENSES = (  # of phones, which take most pictures, and the option that states each
    ("phone, ultra-wide, 13 mm", "f35=13"), ("phone, main camera, 26 mm", "f35=26"), ("phone, 2x, 52 mm", "f35=52"),
)  # fmt: skip
KEEP_S = (600, 3600)  # how often gradio deletes files that no session owns, and their maximum age [s]


def build(
    compute: Callable[[Path, str | None], Answer], files: Files, examples: list[Path], *, info: ModelInfo, camera: str
) -> gr.Blocks:
    """Lay out the page; arguments as for :func:`hudepth.demo.server.serve`. Results go to ``files``."""
    gr.set_static_paths([files.examples, files.results])  # served in place, not copied
    blocks: gr.Blocks = gr.Blocks(title="hudepth", analytics_enabled=False, delete_cache=KEEP_S, fill_width=True)
    with blocks:
        gr.HTML(headline(info), elem_id="headline")
        with gr.Row(equal_height=False):
            with gr.Column(scale=2, min_width=300):
                image = gr.Image(
                    label="Picture", type="filepath", sources=["upload", "clipboard", "webcam"], height=280,
                    buttons=["fullscreen"], alt_text="The picture you chose", elem_id="picture",
                    webcam_options=gr.WebcamOptions(mirror=False, constraints={"video": {"facingMode": "environment"}}),
                )  # fmt: skip
                view = gr.Dropdown(
                    [(camera, ""), *LENSES], value="", allow_custom_value=True, label="Field of view", elem_id="view",
                    info="Metres depend on it. Choose, or type degrees across the picture: 62.",
                )  # fmt: skip
                rooms = [[str(path)] for path in examples]
                gr.Examples(rooms, [image], label="Examples: rendered rooms", elem_id="rooms")
            with gr.Column(scale=5, min_width=320):
                html, script = data_file("viewer.html"), data_file("points.js") + data_file("viewer.js")
                colours = base64.b64encode(colour_table().tobytes()).decode()
                style: dict[str, Any] = {"apply_default_css": False, "elem_id": "viewer"}
                viewer = gr.HTML(None, html_template=html, js_on_load=script, colours=colours, **style)
                with gr.Row(elem_id="downloads"):
                    off: dict[str, Any] = {"interactive": False, "size": "md", "min_width": 80}
                    buttons = [gr.DownloadButton(label, **off) for label in BUTTONS]
        # gradio's own would open the file, with every decoder that Pillow has
        vars(image)["preprocess"] = lambda payload: payload and payload.path
        gr.on(
            [image.change, view.change], handler(compute, files), [image, view], [viewer, *buttons],
            show_progress="minimal", trigger_mode="always_last", api_visibility="private",
        )  # fmt: skip

        def forget(request: gr.Request) -> None:
            files.end(request.session_hash or "")

        blocks.unload(forget)
    return blocks


def handler(compute: Callable[[Path, str | None], Answer], files: Files) -> Callable[..., Iterator[tuple[Any, ...]]]:
    """Return the function for each new picture: it yields the depth first, then the buttons, whose files take long."""
    off = tuple(gr.update(value=None, interactive=False) for _ in BUTTONS)

    def show(upload: str | None, view: str | None, request: gr.Request) -> Iterator[tuple[Any, ...]]:
        session = request.session_hash or ""
        if upload is None:
            files.end(session)
            yield (None, *off)
            return
        files.begin(session, Path(upload))
        try:
            answer = compute(Path(upload), stated_camera(view or ""))
        except torch.OutOfMemoryError as error:
            log.warning("%s", gpu_line(error, "demo"))
            yield ({"error": "The graphics card has too little memory left. Try again later."}, *off)
            return
        except (HudepthError, MemoryError) as error:
            lack = "This machine has too little memory for the picture. Resize it."
            yield ({"error": lack if isinstance(error, MemoryError) else str(error)}, *off)
            return
        yield (answer.payload, *off)
        try:
            paths = files.write(session, answer)
        except OSError as error:
            log.warning("no files to download: %s", error)
            return
        files.trim()
        yield (gr.skip(), *(gr.update(value=path and str(path), interactive=path is not None) for path in paths))

    return show


def stated_camera(view: str) -> str | None:
    """Return the camera that a visitor chose or typed, as an option; None if it is left to the page.

    Raises DataError, with a line for the visitor, if it is neither a choice nor degrees.
    """
    view = view.strip()
    if not view or view in {option for _, option in LENSES}:
        return view or None
    with contextlib.suppress(ValueError):
        degrees = float(re.sub(r"\s*(\N{DEGREE SIGN}|degrees)$", "", view).replace(",", "."))
        if 5 <= degrees <= 160:
            return f"fov={degrees:.6g}"
    raise DataError(f"Field of view: '{view[:40]}' is not from 5 to 160 degrees. Type a number such as 62.")


def headline(info: ModelInfo) -> str:
    """Return the headline: what the page does, how far to trust its numbers, and which model this is."""
    return (
        '<div class="hd-head"><h1>Depth from one picture</h1>'
        "<p>Choose a picture, and read how far away everything in it is. "
        "Do not trust the metres in pictures unlike the training data.</p>"
        f"<p><small>{escape(str(info))}.</small></p></div>"
    )


def data_file(name: str) -> str:
    """Return the text of a file of this package."""
    return resources.files("hudepth.demo").joinpath(name).read_text(encoding="utf-8")
