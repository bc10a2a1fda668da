"""Progressive resolution: small images first, which cost a fraction of an epoch, the store's size last."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hudepth.base.errors import ConfigError


@dataclass(frozen=True)
class Stage:
    """A part of a training."""

    size: tuple[int, int]
    """(height, width) of training images."""
    until: float
    """Share of the epochs after which it ends."""


def read_stages(progressive: Sequence[Mapping[str, Any]], *, size: tuple[int, int]) -> list[Stage]:
    """Read ``data.progressive``.

    Args:
        progressive: mappings of ``size`` and ``until``, in order.
        size: (height, width) of the images in the store, which is that of what comes after the last stage.

    Returns:
        The stages whose images are smaller than the store's: a plan that was made for larger ones may be given, too.

    Raises:
        ConfigError: if it is no such list, or its shares do not rise within (0, 1).
    """
    stages: list[Stage] = []
    before = 0.0
    for number, entry in enumerate(progressive):
        key = f"data.progressive[{number}]"
        try:
            height, width = (operator.index(side) for side in entry["size"])
            stage = Stage((height, width), float(entry["until"]))
        except (TypeError, ValueError, KeyError) as error:
            raise ConfigError(
                f"{key}: {entry!r} is no stage. Pass data.progressive=[{{size:[112,112],until:0.5}}], for example."
            ) from error
        if not before < stage.until < 1:
            raise ConfigError(
                f"{key}.until: {stage.until:g} is not a share of the epochs between {before:g} and 1, where this "
                "stage ends; shares rise from stage to stage, and the last part is at data.size."
            )
        before = stage.until
        if min(height, width) < 1:
            raise ConfigError(f"{key}.size: [{height},{width}] is no size of an image. Pass multiples of 16.")
        if height <= size[0] and width <= size[1] and stage.size != size:
            stages.append(stage)
    return stages


def size_at(stages: Sequence[Stage], epoch: int, *, epochs: int | None, final: tuple[int, int]) -> tuple[int, int]:
    """Return the (height, width) of training images in an epoch.

    Args:
        stages: of the training.
        epoch: from 0.
        epochs: of the training; None or -1, which is endless, has no shares: then only ``final`` is used.
        final: what follows the last stage; the last epoch always has it.
    """
    if epochs is None or epochs < 1 or epoch >= epochs - 1:
        return final
    return next((stage.size for stage in stages if epoch < round(stage.until * epochs)), final)
