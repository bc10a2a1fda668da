"""From what the loader reads to what a network takes, on whatever device the batch is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor

from hudepth.base.normalise import normalise_image
from hudepth.base.types import Batch, RawBatch
from hudepth.cuda.functions import Replayed
from hudepth.data.augment import Augmentation
from hudepth.data.transforms.warp import resize


def preprocess(
    batch: RawBatch,
    *,
    max_depth_m: float,
    size: tuple[int, int] | None = None,
    augment: Callable[..., tuple[Tensor, Tensor]] | None = None,
) -> Batch:
    """Normalise a batch: ImageNet statistics for the image; depth divided, clipped, masked.

    Args:
        max_depth_m: maximum depth [m]; depth is clipped to it and divided by it.
        size: (height, width) of the result; unchanged by default.
        augment: changes the image in [0, 1] and the unit depth, and resizes them to ``size``.
    """
    image = batch["image"].permute(0, 3, 1, 2).to(torch.float32, memory_format=torch.contiguous_format) / 255
    unit_depth = batch["stored_depth"].to(torch.float32)[:, None] / (batch.get("per_m", 1000) * max_depth_m)
    had_truth = unit_depth > 0
    if "teacher_m" in batch:
        teacher = batch["teacher_m"][:, None] / max_depth_m
        unit_depth = torch.cat([unit_depth, teacher], dim=1)  # moved like the ground truth
    size = size or (image.shape[-2], image.shape[-1])
    image, depths = (augment or resize)(image, unit_depth, size=size)
    unit_depth = depths[:, :1]
    valid = unit_depth > 0
    result = Batch(image=normalise_image(image), unit_depth=unit_depth.clamp(max=1), valid=valid, index=batch["index"])
    if augment is not None:
        result["emptied"] = had_truth.any() & ~valid.any()
    if "teacher_m" in batch:
        result["teacher"] = depths[:, 1:]
    if "native_depth" in batch:
        result["native_depth"] = batch["native_depth"]
    return result


class TrainingBatches:
    """Augments and normalises training batches: on a GPU as a CUDA graph, since it is many small kernels."""

    def __init__(self, augment: Augmentation | None, *, max_depth_m: float) -> None:
        self.augment, self.max_depth_m = augment, max_depth_m
        self._replayed = Replayed("augmentation")

    def __call__(self, batch: RawBatch, *, size: tuple[int, int], aspect: float, generator: torch.Generator) -> Batch:
        """Return the batch at ``size``; ``aspect`` and ``generator`` are those of :class:`Augmentation`."""
        tensors: dict[str, Tensor] = {name: x for name, x in batch.items() if isinstance(x, Tensor)}
        if self.augment is not None:
            where: dict[str, Any] = {"generator": generator, "device": batch["image"].device}
            tensors |= self.augment.draw(len(batch["image"]), size=size, **where)
        per_m = batch.get("per_m", 1000)

        def compute(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
            raw = cast(RawBatch, {**tensors, "per_m": per_m})
            augment = self.augment and partial(self.augment.apply, aspect=aspect, draws=tensors)
            return dict(preprocess(raw, max_depth_m=self.max_depth_m, size=size, augment=augment))  # type: ignore[arg-type]

        return cast(Batch, self._replayed(compute, tensors, setting=(size, aspect, per_m)))
