"""What is checked before a training begins: mistakes that would otherwise cost data preparation or an epoch."""

from __future__ import annotations

import re
from typing import Any

import torch
from torch import nn

from hudepth.base.devices import check_devices
from hudepth.base.errors import ConfigError, did_you_mean
from hudepth.training.module import DepthModule

MEMORY_FORMATS = {"contiguous": torch.contiguous_format, "channels_last": torch.channels_last}


def check_config(config: dict[str, Any]) -> None:
    """Check what no constructor checks in time, before anything is written.

    Raises:
        ConfigError: for values out of range, and devices that are not there.
    """
    if not isinstance(config["seed"], int):
        raise ConfigError(f"seed: {config['seed']!r} is not a whole number.")
    if config["mode"] not in ("min", "max"):
        raise ConfigError(f"mode: no '{config['mode']}'. Pass min or max: which way monitor is better.")
    layout = config.get("memory_format", "contiguous")  # runs that were begun before there was a choice have none
    if layout not in MEMORY_FORMATS:
        raise ConfigError(
            f"memory_format: no '{layout}'.{did_you_mean(str(layout), MEMORY_FORMATS)} "
            "Pass contiguous or channels_last."
        )
    if not isinstance(config.get("compile", False), bool):
        raise ConfigError(f"compile: {config['compile']!r} is neither true nor false.")
    if config.get("compile") and config["model"].get("recompute"):
        raise ConfigError("compile: torch.compile cannot compile model.recompute. Leave one of them false.")
    name = config["name"]
    if name is None or not re.fullmatch(r"[\w.-]+(/[\w.-]+)*", str(name)) or ".." in str(name).split("/"):
        raise ConfigError(f"name: {name!r} cannot name a folder of runs. Use letters, digits, '.', '_' and '-'.")
    every = config["callbacks"]["panels_every_n_epochs"]
    if not isinstance(every, int) or every < 1:
        raise ConfigError(
            f"callbacks.panels_every_n_epochs: {every!r} is less than 1. Pass callbacks.panels=0 for none."
        )
    check_devices(config["trainer"])


@torch.inference_mode()
def check_input(net: nn.Module, sizes: list[tuple[int, int]]) -> None:
    """Show the network one image of each size that it will see, before hours go into preparing others.

    Args:
        net: of the training.
        sizes: (height, width) of the training's stages; the last one is ``data.size``.

    Raises:
        HudepthError: the network's own, if it cannot take one.
    """
    net.eval()
    for number, size in enumerate(sizes):
        try:
            net(torch.zeros(1, 3, *size))
        except ConfigError as error:
            key = "data.size" if size == sizes[-1] else f"data.progressive[{number}].size"
            raise ConfigError(str(error).replace("data.size", key)) from error
    net.train()


def check_monitor(monitor: str, module: DepthModule) -> None:
    """Check that ``monitor`` is something the module logs, before an epoch is lost over it.

    Raises:
        ConfigError: if it is not.
    """
    known = module.logged_names()
    if monitor not in known:
        raise ConfigError(f"monitor: no '{monitor}'.{did_you_mean(monitor, known)} Pass one of {', '.join(known)}.")
