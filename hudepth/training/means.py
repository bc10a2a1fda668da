"""Means over an epoch's images, summed on the device: nothing waits for it until the epoch ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from hudepth.base.masked import widest_float

Sums = Mapping[tuple[str, ...], Tensor]
"""By the names of values: the sum of each over images, then the number of images."""


class EpochMeans:
    """Means of named values, each the mean over a batch, over all images of an epoch."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, ...], Tensor] = {}  # of each value, then the number of images

    def add(self, values: Mapping[str, Tensor], *, images: int) -> None:
        """Add scalars of a batch; other batches may have others."""
        names = tuple(values)
        new = torch.stack([value.detach() for value in values.values()])
        if names not in self._sums:
            self._sums[names] = new.new_zeros(len(names) + 1, dtype=widest_float(new.device))
        sums = self._sums[names]  # stays where it is: a CUDA graph adds to it
        sums[:-1].add_(new, alpha=images)
        sums[-1:].add_(images)

    def so_far(self) -> Sums:
        """Return a copy of the sums, on the device."""
        return {names: sums.clone() for names, sums in self._sums.items()}

    def take(self, reduce: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
        """Return the means and begin again; ``reduce`` sums a tensor over processes."""
        found = means({names: reduce(sums) for names, sums in self.so_far().items()})
        for sums in self._sums.values():
            sums.zero_()
        return found


def means(sums: Sums) -> dict[str, Tensor]:
    """Return the mean of each value."""
    totals: dict[str, Tensor] = {}
    for names, values in sums.items():
        for name, total in zip(names, values[:-1], strict=True):
            totals[name] = totals.get(name, 0) + torch.stack([total, values[-1]])
    return {name: (total / count).float() for name, (total, count) in totals.items() if count}
