"""Pairs of a depth store as batches of tensors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset, DistributedSampler, Sampler

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.machine import copy_to
from hudepth.base.types import RawBatch
from hudepth.data.distill.pictures import Pictures
from hudepth.data.distill.teacher import TeacherDepths
from hudepth.data.order import BlockShuffle
from hudepth.data.sources.base import Source
from hudepth.data.splits import Split
from hudepth.data.store import DepthStore

Pairs = TypeVar("Pairs", bound=Dataset[RawBatch])
_AT_ONCE = 256
"""Pairs that are copied to a device in one go."""


class StoreDataset(Dataset[RawBatch]):
    """Some pairs of a depth store, by their positions: also the native ground truth or a teacher's depths on request.

    It is asked for whole batches (``__getitems__``), so that pixels are read straight into the batch's memory.
    """

    def __init__(
        self, store: DepthStore, indices: Sequence[int], *, native: bool = False, teacher: TeacherDepths | None = None
    ) -> None:
        self.store, self.indices = store, list(indices)
        self.native, self.teacher = native, teacher

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, position: int) -> RawBatch:
        """Return a batch of one."""
        return self.__getitems__([position])

    def __getitems__(self, positions: Sequence[int]) -> RawBatch:
        """Return the batch at these positions of the subset."""
        rows = [self.indices[position] for position in positions]
        image, stored_depth = map(torch.from_numpy, self.store.read(rows))
        index = torch.tensor(rows, dtype=torch.int64)  # also if there are none, which would make it float
        batch = RawBatch(image=image, stored_depth=stored_depth, index=index)
        batch["per_m"] = self.store.per_m
        if self.native:
            batch["native_depth"] = [torch.from_numpy(self.store.read_native(row))[None] for row in rows]
        if self.teacher is not None:
            batch["teacher_m"] = torch.from_numpy(self.teacher.read(rows))
        return batch

    def pair_id(self, index: int) -> str:
        """Return the id of the pair that a batch calls ``index``."""
        return self.store.records[index].id

    def order(self, *, block: int | None, seed: int, rank: int, world_size: int) -> Sampler[int]:
        """Return the shuffled positions of an epoch, in blocks if ``block`` is given (:class:`BlockShuffle`).

        They depend only on seed and epoch (Lightning sets the epoch), so that a resumed run sees the same order.
        """
        if block is None:
            return DistributedSampler(self, world_size, rank, shuffle=True, seed=seed)
        ahead = self.store.read_ahead
        return BlockShuffle(self.indices, block=block, seed=seed, rank=rank, world_size=world_size, read_ahead=ahead)


class PicturedDataset(StoreDataset):
    """Training pairs, then pictures without truth: their depth is unmeasured, and the teacher's is all there is.

    In a batch, pictures come after pairs, and their ``index`` counts on from the length of the store.
    """

    def __init__(self, pairs: StoreDataset, pictures: Pictures) -> None:
        super().__init__(pairs.store, pairs.indices, teacher=pairs.teacher)
        self.pictures = pictures

    def __len__(self) -> int:
        return len(self.indices) + len(self.pictures)

    def __getitems__(self, positions: Sequence[int]) -> RawBatch:
        """Return the batch of these pairs and pictures."""
        count = len(self.indices)
        rows = [position - count for position in positions if position >= count]
        batch = super().__getitems__([position for position in positions if position < count])
        if not rows:
            return batch
        images, depths = map(torch.from_numpy, self.pictures.read(rows))
        unmeasured = torch.zeros(depths.shape, dtype=torch.int16)  # torch joins no unsigned numbers of 16 bits
        stored = torch.cat([batch["stored_depth"].view(torch.int16), unmeasured])
        batch["image"] = torch.cat([batch["image"], images])
        batch["stored_depth"] = stored.view(torch.uint16)
        batch["index"] = torch.cat([batch["index"], torch.tensor(rows) + len(self.store)])
        batch["teacher_m"] = torch.cat([batch["teacher_m"], depths])
        return batch

    def pair_id(self, index: int) -> str:
        """Return the id of the pair, or the picture, that a batch calls ``index``."""
        beyond = index - len(self.store)
        return super().pair_id(index) if beyond < 0 else self.pictures.ids[beyond]


class DeviceDataset(StoreDataset):
    """Pairs of another data set that lie in a device's memory as bytes: nothing is copied there while training.

    Raises torch.OutOfMemoryError if they do not fit.
    """

    def __init__(self, pairs: StoreDataset, device: torch.device) -> None:
        super().__init__(pairs.store, pairs.indices)
        height, width = self.store.size
        self._image = torch.empty((len(self), height, width, 3), dtype=torch.uint8, device=device)
        self._depth = torch.empty((len(self), height, width), dtype=torch.int16, device=device)
        self._rows = torch.tensor(self.indices, device=device)
        for start in range(0, len(self), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            image, depth = map(torch.from_numpy, self.store.read(self.indices[part]))
            self._image[part] = image
            self._depth[part] = depth.view(torch.int16)  # few operations take unsigned numbers

    def __getitems__(self, positions: Sequence[int]) -> RawBatch:
        """Return the batch at these positions, gathered on the device."""
        places = copy_to(torch.tensor(positions), self._rows.device)
        image, depth, rows = (x.index_select(0, places) for x in (self._image, self._depth, self._rows))
        return RawBatch(image=image, stored_depth=depth.view(torch.uint16), index=rows, per_m=self.store.per_m)


def check_together(
    source: Source,
    *,
    stream: int | None,
    teacher: Path | None,
    pictures: Path | None,
    on_device: str,
    shuffle_block: int | None,
) -> None:
    """Raise ConfigError for options of a data module that exclude each other."""
    clashes = {
        f"data.stream: {source.name} has only the pairs of its files. Pass data.stream=null.":
            stream and source.pairs_per_scene is None,
        "data.stream: a teacher has no depths of new pairs. Pass data.stream=null.": stream and teacher,
        "data.on_device: generated pairs and those with a teacher are not kept there. Pass data.on_device=auto.":
            on_device == "true" and (stream or teacher),
        "distill.pictures: they have no depth without a teacher. Pass distill.teacher=<folder>.":
            pictures and teacher is None,
        "data.shuffle_block: pictures are not in the store. Pass data.shuffle_block=null.": pictures and shuffle_block,
    }  # fmt: skip
    if found := next((text for text, clash in clashes.items() if clash), None):
        raise ConfigError(found)


def stored_pairs(store: DepthStore, split: Split, *, teacher: Path | None, pictures: Path | None) -> StoreDataset:
    """Return the training pairs of a store with a teacher's depths and further pictures, folders that may be None."""
    if teacher is None:
        return StoreDataset(store, split.train)
    pairs = StoreDataset(store, split.train, teacher=TeacherDepths(teacher, store, split.train))
    return pairs if pictures is None else PicturedDataset(pairs, Pictures(pictures, teacher, store, split))


def on_device(pairs: Pairs, device: torch.device) -> Pairs | DeviceDataset:
    """Return the pairs in a device's memory if they take less than half of what is free there, else as they are.

    Pairs that are generated or have a teacher stay as they are.
    """
    if not isinstance(pairs, StoreDataset) or pairs.teacher is not None:
        return pairs
    needed = len(pairs) * math.prod(pairs.store.size) * 5  # 3 bytes of image, 2 of depth
    free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else math.inf
    try:
        if needed < free / 2:
            return DeviceDataset(pairs, device)
    except torch.OutOfMemoryError:  # somebody else took it meanwhile
        pass
    log.info(
        "data.on_device: the training pairs take %.1f GB, and %.1f GB are free on %s; they are read from the disk",
        needed / 1e9, free / 1e9, device,
    )  # fmt: skip
    return pairs


class LateLoader(DataLoader[RawBatch]):
    """A DataLoader whose processes start at the first batch, not at ``iter``.

    Lightning calls ``iter`` before it restores a run and sets the sampler's epoch; processes would already be reading
    in the order of epoch 0.
    """

    def __iter__(self) -> Iterator[RawBatch]:  # type: ignore[override]  # Lightning only calls next
        """Yield the batches."""
        yield from super().__iter__()


def as_is(batch: Any) -> Any:
    """Collate nothing: the data set already returned a batch."""
    return batch
