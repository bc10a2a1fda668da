"""hudepth-demo: a local web page that shows the depth of a picture."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import numpy as np

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.images import MAX_PIXELS
from hudepth.base.options import Range, parse
from hudepth.demo.answers import Limits, answer
from hudepth.demo.gate import host_names
from hudepth.demo.server import free_port, serve
from hudepth.inference.model import ModelOptions, load_model


@dataclass(frozen=True, kw_only=True)
class DemoOptions(ModelOptions):
    """Options of hudepth-demo; conf/demo.yaml explains them."""

    host: str = "127.0.0.1"
    port: Annotated[int, Range(0, 65535)] = 7860
    max_upload_mb: Annotated[float, Range(0, 1024, above=True)] = 20
    max_pixels: Annotated[int, Range(1, MAX_PIXELS)] = 40_000_000
    max_kept_mb: Annotated[float, Range(0, 2**20, above=True)] = 200
    allowed_hosts: list[str] = field(default_factory=list)


def demo(config: dict[str, Any]) -> None:
    """Serve the page as conf/demo.yaml states until Ctrl-C; raises HudepthError."""
    if importlib.util.find_spec("gradio") is None:
        raise ConfigError("gradio is not installed. Run pip install 'hudepth[demo]'.")
    options = parse(DemoOptions, {**config, "runs": config["paths"]["runs"]})
    hosts = host_names(options.allowed_hosts)
    upload, kept = (int(megabytes * 2**20) for megabytes in (options.max_upload_mb, options.max_kept_mb))
    limits = Limits(upload, options.max_pixels, kept)
    free_port(options.host, options.port)  # before the seconds that loading takes
    model = load_model(options)
    model.predict(np.zeros((*model.info.size, 3), np.uint8))  # the first run is slow; visitors should not wait for it
    serve(
        lambda path, camera: answer(path, model, limits, camera),
        host=options.host, port=options.port, limits=limits, info=model.info, allowed_hosts=hosts,
        ready=partial(log.info, "model: %s; open %s (Ctrl-C stops)", model.info),
        camera=_camera_words(options.camera),
    )  # fmt: skip


def _camera_words(camera: str | tuple[float, ...]) -> str:
    if camera == "auto":
        return "from the file, if it says"
    return "the training camera's" if camera == "training" else f"as set: {camera}"
