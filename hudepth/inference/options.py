"""From a configuration to a model that predicts: what predict and the page share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hudepth.base.options import size_option
from hudepth.inference.model import DepthModel, load

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
