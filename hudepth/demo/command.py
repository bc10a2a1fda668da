"""hudepth-demo: a page on this machine that shows the depth of a picture."""

from __future__ import annotations

import importlib.util
from functools import partial
from typing import Any

import numpy as np
from omegaconf import DictConfig

from hudepth.base.camera import intrinsics
from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.options import plain, whole_number
from hudepth.demo.answers import Limits, answer
from hudepth.demo.server import free_port, serve
from hudepth.inference.model import DepthModel
from hudepth.inference.options import load_model

MEGABYTE = 2**20


def demo(cfg: DictConfig) -> None:
    """Serve the page until Ctrl-C.

    Args:
        cfg: what conf/demo.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user.
    """
    config = plain(cfg)
    if importlib.util.find_spec("gradio") is None:
        raise ConfigError("gradio is not installed. Run pip install 'hudepth[demo]'.")
    limits, camera = _limits(config), intrinsics(config["intrinsics"])
    host, port = str(config["host"]), _port(config)
    free_port(host, port)  # before the seconds that loading takes
    model = _load(config)

    def ready(address: str) -> None:
        log.info("model: %s; open %s (Ctrl-C ends)", describe(model), address)

    serve(
        partial(answer, model=model, limits=limits, intrinsics=camera),
        host=host, port=port, limits=limits, info=model.info, ready=ready,
        camera="as given" if camera else "NYU Depth V2's, since intrinsics= was not given",
    )  # fmt: skip


def describe(model: DepthModel) -> str:
    """Say what a model is, in a few words."""
    info = model.info
    source = info.trained_on.get("source", "unknown data")
    size = f"{info.size[0]} x {info.size[1]}"
    return f"{info.name}, trained on {source}, {size}, up to {info.max_depth_m:g} m, in {model.backend.name}"


def _load(config: dict[str, Any]) -> DepthModel:
    """Load the model and run it once, so that the first visitor does not wait for what is set up on first use."""
    model = load_model(config)
    model.predict(np.zeros((*model.info.size, 3), np.uint8))
    return model


def _port(config: dict[str, Any]) -> int:
    port = whole_number(config, "port", default=7860)
    if port > 65535:
        raise ConfigError(f"port: {port} is above 65535. Leave it out for 7860, or pass 0 for any that is free.")
    return port


def _limits(config: dict[str, Any]) -> Limits:
    megabytes = config["max_upload_mb"]
    if isinstance(megabytes, bool) or not isinstance(megabytes, int | float) or not 0 < megabytes <= 1024:
        raise ConfigError(f"max_upload_mb: {megabytes} is not above 0 and at most 1024. Leave it out for 20.")
    pixels = whole_number(config, "max_pixels", default=40_000_000, least=1)
    return Limits(upload_bytes=int(megabytes * MEGABYTE), pixels=pixels)
