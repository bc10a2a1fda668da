"""Progressive resolution: small images first, which cost a fraction of an epoch, the store's size last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from hudepth.base.errors import ConfigError
from hudepth.base.options import Range, Size, convert


@dataclass(frozen=True)
class Stage:
    """A part of a training."""

    size: Size
    until: Annotated[float, Range(0, 1, above=True, below=True)]
    """Share of the epochs after which it ends."""


def read_stages(progressive: Sequence[Mapping[str, Any]], *, size: tuple[int, int]) -> list[Stage]:
    """Read ``data.progressive``: mappings of ``size`` and ``until``, in order.

    Returns the stages whose images are smaller than the store's ``size``; others are skipped, so one plan serves more
    sizes. Raises ConfigError if an entry is malformed, or the shares do not rise.
    """
    stages: list[Stage] = convert("data.progressive", progressive, list[Stage])
    for number, (before, stage) in enumerate(zip([0.0, *(stage.until for stage in stages)], stages, strict=False)):
        if stage.until <= before:
            raise ConfigError(
                f"data.progressive[{number}].until: {stage.until:g} is not between {before:g} and 1. Stages end at "
                "rising shares of the epochs; the rest of the training is at data.size."
            )
    return [s for s in stages if s.size[0] <= size[0] and s.size[1] <= size[1] and s.size != size]


def size_at(stages: Sequence[Stage], epoch: int, *, epochs: int | None, final: tuple[int, int]) -> tuple[int, int]:
    """Return the (height, width) of training images in an epoch, counted from 0.

    ``final`` is the size after the last stage, in the last epoch, and of unlimited training (``epochs`` None or -1).
    """
    if epochs is None or epochs < 1 or epoch >= epochs - 1:
        return final
    return next((stage.size for stage in stages if epoch < round(stage.until * epochs)), final)
