"""From a configuration to a model that predicts: what predict and the page share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hudepth.errors import ConfigError
from hudepth.inference.model import DepthModel, load
from hudepth.tasks.config import size_option
from hudepth.viz.point_cloud import Intrinsics

OPTIONS = ("backend", "device", "precision", "threads", "size", "fit", "flip", "trust")
"""Keys that are arguments of :func:`hudepth.inference.model.load`."""


def load_model(config: Mapping[str, Any]) -> DepthModel:
    """Load the model that a configuration names.

    Args:
        config: with ``checkpoint``, ``paths`` and any of :data:`OPTIONS`.

    Raises:
        HudepthError: with one line for the user.
    """
    options = {name: config[name] for name in OPTIONS if name in config}
    if "size" in options:
        options["size"] = size_option(options["size"])
    return load(str(config["checkpoint"]), **options, runs=config["paths"]["runs"])


def intrinsics(value: Any) -> Intrinsics | None:
    """Return the camera that a configuration states, if it does.

    Args:
        value: ``[fx, fy, cx, cy]`` or None.

    Raises:
        ConfigError: if it is neither.
    """
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 4 or not all(isinstance(entry, int | float) for entry in value):
        raise ConfigError(f"intrinsics: {value} is not [fx,fy,cx,cy]. Pass four numbers, in pixels of the images.")
    fx, fy, cx, cy = (float(entry) for entry in value)
    return Intrinsics(fx, fy, cx, cy)
