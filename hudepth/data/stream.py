"""Training pairs that are made as they are needed and never stored: new ones each epoch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch.utils.data import Dataset

from hudepth.base.types import RawBatch
from hudepth.data.order import NewEachEpoch
from hudepth.data.pairs import prepare_pair, values_per_metre
from hudepth.data.sources.base import Source

SCENES_AT_ONCE = 32
"""Scenes whose pairs are mixed. A process keeps as many, so that each is built once."""


class StreamDataset(Dataset[RawBatch]):
    """``count`` generated pairs per epoch, which follow from their number alone (:meth:`Source.generated`).

    A position is the number of a pair over all epochs, as :meth:`order` yields it, so that worker processes need not
    know the epoch.

    Args:
        source: what generates the pairs.
        size: (height, width) of image and depth, resized as those of a depth store are.
        count: pairs per epoch.
    """

    def __init__(self, source: Source, *, size: tuple[int, int], count: int) -> None:
        self.source, self.size, self.count = source, size, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> RawBatch:
        """Return a batch of one."""
        return self.__getitems__([number])

    def __getitems__(self, numbers: Sequence[int]) -> RawBatch:
        """Return the batch of the pairs of these numbers."""
        records = map(self.source.generated, numbers)
        pairs = [prepare_pair(self.source, record, self.size, native=False) for record in records]
        return RawBatch(
            image=torch.from_numpy(np.stack([pair.image for pair in pairs])),
            stored_depth=torch.from_numpy(np.stack([pair.stored_depth for pair in pairs])),
            index=torch.tensor(numbers),
            per_m=values_per_metre(self.source),
        )

    def pair_id(self, index: int) -> str:
        """Return the id of the pair of this number."""
        return self.source.generated(index).id

    def order(self, *, block: int | None, seed: int, rank: int, world_size: int) -> NewEachEpoch:
        """Return the numbers of an epoch, shuffled within ``SCENES_AT_ONCE`` blocks; a block is a scene by default.

        Building a scene takes longer than a picture of it, so its pairs are asked for soon after one another.
        """
        block = block or self.source.pairs_per_scene or 1
        return NewEachEpoch(self.count, block=block, seed=seed, rank=rank, world_size=world_size, group=SCENES_AT_ONCE)
