"""A network that needs no training."""

from __future__ import annotations

from pathlib import Path

import torch

from hudepth.models import TinyUNet
from hudepth.runs.checkpoint import KEY, VERSION


def write_tiny_checkpoint(path: Path, *, source: str = "rooms") -> Path:
    """Write the checkpoint of a tiny network with random weights, which takes images of 32 x 48."""
    torch.manual_seed(0)
    net = TinyUNet(channels=4)
    torch.nn.init.normal_(net.decode.weight, std=2.0)  # so that depth differs from pixel to pixel
    own = {
        "version": VERSION,
        "config": {
            "model": {"_target_": "hudepth.models.TinyUNet", "channels": 4},
            "data": {"size": [32, 48], "max_depth_m": 10.0},
        },
        "split": {},
        "data": {"source": source},
    }
    state = {f"net.{name}": tensor for name, tensor in net.state_dict().items()}
    torch.save({"epoch": 4, "state_dict": state, KEY: own}, path)
    return path
