"""Processes started by torchrun or SLURM agree on one run directory before anything else happens.

Processes that Lightning starts inherit it from the first one. These do not know of each other, so they join here,
through the rendezvous that Lightning would use later.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from torch import distributed

from hudepth.base.errors import ConfigError

JOIN_TIMEOUT = timedelta(minutes=30)
"""How long processes wait for each other; the first one may have data to prepare."""


def environment() -> TorchElasticEnvironment | SLURMEnvironment | None:
    """Return the launcher of this process; None if it runs alone."""
    for kind in (TorchElasticEnvironment, SLURMEnvironment):
        if kind.detect():
            found: TorchElasticEnvironment | SLURMEnvironment = kind()
            return found if found.world_size() > 1 else None
    return None


def shared_path(make: Callable[[], Path], options: Mapping[str, Any]) -> Path:
    """Return the run directory of all processes of a launch; the first one makes it.

    Args:
        make: makes the directory.
        options: the ``trainer`` part of the configuration.

    Returns:
        What ``make`` returned in the first process.

    Raises:
        ConfigError: if ``trainer`` requests another number of processes than were launched.
    """
    launched = environment()
    if launched is None:
        return make()
    _check_counts(launched, options)
    if not distributed.is_initialized():
        on_gpu = torch.cuda.is_available() and str(options.get("accelerator")) in ("auto", "gpu", "cuda")
        if on_gpu:
            torch.cuda.set_device(launched.local_rank())
        os.environ.setdefault("MASTER_ADDR", launched.main_address)  # torchrun sets both, SLURM neither
        os.environ.setdefault("MASTER_PORT", str(launched.main_port))
        distributed.init_process_group(
            "cpu:gloo,cuda:nccl" if on_gpu else "gloo",
            rank=launched.global_rank(),
            world_size=launched.world_size(),
            timeout=JOIN_TIMEOUT,
        )
    box: list[Any] = [None]
    if launched.global_rank() == 0:
        try:
            box = [str(make())]
        except ConfigError as error:  # the others must fail, too, instead of waiting for ever
            box = [error]
    distributed.broadcast_object_list(box, src=0, device=torch.device("cpu"))
    if isinstance(box[0], ConfigError):
        raise box[0]
    return Path(box[0])


def _check_counts(launched: TorchElasticEnvironment | SLURMEnvironment, options: Mapping[str, Any]) -> None:
    world, nodes = launched.world_size(), int(options.get("num_nodes", 1))
    devices = options.get("devices", 1)
    if str(devices).isdigit() and int(devices) * nodes != world:
        raise ConfigError(
            f"trainer.devices={devices} trainer.num_nodes={nodes}: that is {int(devices) * nodes} processes, but "
            f"{world} were launched together. Pass trainer.devices=<processes of each machine> "
            "trainer.num_nodes=<machines>."
        )
