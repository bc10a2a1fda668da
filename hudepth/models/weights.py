"""Initial weights of encoders: files of plain tensors, which must fit to the last one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError, did_you_mean


def read_state(weights: str, *, fix: str) -> dict[str, Tensor]:
    """Read the state_dict in the file that ``model.weights`` names, be it a checkpoint or of a wrapped network.

    Raises CheckpointError, with the fix, if there is no such file or it holds anything but tensors.
    """
    path = Path(weights).expanduser()
    if not path.is_file():
        hint = did_you_mean(str(path), ["imagenet", "none"])
        raise CheckpointError(f"model.weights: no file '{path}'.{hint} Pass imagenet, none, or the path of a file.")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise CheckpointError(
            f"model.weights: '{path}' is not a file of plain tensors ({type(error).__name__}). {fix}"
        ) from error
    if isinstance(state, dict) and isinstance(inner := state.get("state_dict"), dict):
        log.info("model.weights: '%s' is a checkpoint; its state_dict is read", path)
        state = inner
    for wrapper in ("module.", "_orig_mod."):  # of DataParallel and torch.compile
        if isinstance(state, dict) and state and all(str(name).startswith(wrapper) for name in state):
            log.info(
                "model.weights: '%s' was saved from a wrapped network; '%s' is removed from its names", path, wrapper
            )
            state = {str(name).removeprefix(wrapper): value for name, value in state.items()}
    if not (isinstance(state, dict) and all(isinstance(n, str) and isinstance(v, Tensor) for n, v in state.items())):
        raise CheckpointError(f"model.weights: '{path}' does not contain a state_dict. {fix}")
    return cast("dict[str, Tensor]", state)


def load_fitting(encoder: nn.Module, state: Mapping[str, Tensor], *, weights: str, fix: str) -> None:
    """Load tensors into an encoder. Raises CheckpointError, with the fix, if one is missing, unknown or misshapen."""
    own = encoder.state_dict()
    # torchvision's first files lack the counters of batch norm, which only matter without a momentum
    state = {name: value for name, value in own.items() if name.endswith("num_batches_tracked")} | dict(state)
    misshapen = {name for name in own.keys() & state.keys() if own[name].shape != state[name].shape}
    for problem, names in (
        ("missing", own.keys() - state.keys()),
        ("unknown", state.keys() - own.keys()),
        ("of another shape", misshapen),
    ):
        if names:
            found = f"{len(names)} tensors {problem}, the first is '{min(names)}'"
            raise CheckpointError(f"model.weights: '{weights}' does not fit: {found}. {fix}")
    encoder.load_state_dict(state)
