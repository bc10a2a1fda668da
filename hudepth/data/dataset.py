"""Pairs of a depth store as batches of tensors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch.utils.data import Dataset, Sampler

from hudepth.data.store import DepthStore
from hudepth.data.teacher import TeacherDepths
from hudepth.types import RawBatch


class StoreDataset(Dataset[RawBatch]):
    """Some pairs of a depth store.

    It is asked for whole batches (``__getitems__``), so that pixels are read straight into the batch's memory.

    Args:
        store: where the pairs lie.
        indices: which of them, as positions in the store.
        native: also read the truth at its native resolution.
        teacher: also read a teacher's depths.
    """

    def __init__(
        self,
        store: DepthStore,
        indices: Sequence[int],
        *,
        native: bool = False,
        teacher: TeacherDepths | None = None,
    ) -> None:
        self.store = store
        self.indices = list(indices)
        self.native = native
        self.teacher = teacher

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, position: int) -> RawBatch:
        """Return a batch of one."""
        return self.__getitems__([position])

    def __getitems__(self, positions: Sequence[int]) -> RawBatch:
        """Return the batch at these positions of the subset."""
        rows = [self.indices[position] for position in positions]
        image, depth_mm = self.store.read(rows)
        batch = RawBatch(image=torch.from_numpy(image), depth_mm=torch.from_numpy(depth_mm), index=torch.tensor(rows))
        if self.native:
            batch["native_depth"] = [torch.from_numpy(self.store.read_native(row))[None] for row in rows]
        if self.teacher is not None:
            batch["teacher_m"] = torch.from_numpy(self.teacher.read(rows))
        return batch


def as_is(batch: Any) -> Any:
    """Collate nothing: the data set already returned a batch."""
    return batch


class ShardSampler(Sampler[int]):
    """Every ``world_size``-th position, in order and without padding, so that sums over processes stay exact.

    (torch's DistributedSampler repeats samples to make all shards equally long, which evaluation must not.)
    """

    def __init__(self, length: int, *, rank: int, world_size: int) -> None:
        self._positions = range(rank, length, world_size)

    def __len__(self) -> int:
        return len(self._positions)

    def __iter__(self) -> Iterator[int]:
        return iter(self._positions)
