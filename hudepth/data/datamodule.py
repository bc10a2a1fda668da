"""From a source to batches: prepares the store once, splits it, loads it, normalises it on the device."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor
from torch.nn import functional
from torch.utils.data import DataLoader, DistributedSampler, Sampler

from hudepth.base.errors import ConfigError
from hudepth.base.normalise import normalise_image
from hudepth.base.types import Batch, RawBatch
from hudepth.data.augment import Augmentation, resize
from hudepth.data.dataset import BlockShuffle, ShardSampler, StoreDataset, as_is
from hudepth.data.prepare import prepare
from hudepth.data.resolution import read_stages, size_at
from hudepth.data.sources.base import Source
from hudepth.data.splits import Split, check_split, make_split
from hudepth.data.store import DepthStore
from hudepth.data.teacher import TeacherDepths


class DepthDataModule(LightningDataModule):
    """Batches of image, unit depth and valid mask for training, validation and test.

    Args:
        source: where the pairs come from.
        size: (height, width) of training images; the paper's is 224 x 224.
        split: ``random`` (the paper), ``scene`` or ``official``; see :func:`hudepth.data.splits.make_split`.
        split_seed: seed of the split (the paper: 42).
        fractions: of train, val and test (the paper: 70 / 10 / 20 %).
        max_depth_m: depth is clipped to it and divided by it (the paper: 10 m).
        batch_size: pairs per step (the paper: 8).
        progressive: sizes to begin with, each until a share of the epochs is over, then comes ``size``:
            ``[{size: [112, 112], until: 0.4}]``.
        augment: changes training pairs at random; None leaves them as they are.
        teacher: folder of depths that another model predicted for the training images (see
            :class:`hudepth.data.teacher.TeacherDepths`); None: no teacher.
        num_workers: loader processes; 0 reads in the training process, which is fast enough for a CPU.
        seed: of the order of training pairs and of augmentation, which depend on nothing but this and the epoch.
        shuffle_block: shuffle blocks of so many neighbouring pairs, and pairs within a few of them, instead of all: for
            stores that are larger than memory (:class:`hudepth.data.dataset.BlockShuffle`).
        cache: folder of the depth stores.
        native: keep native-resolution truth in the store, for protocols like ``eigen``.
        on_error: ``raise`` at a bad pair or ``skip`` it.
        prepare_workers: processes that prepare the store; default one per core.

    Raises:
        ConfigError: for values out of range.
    """

    def __init__(
        self,
        source: Source,
        *,
        size: Sequence[int] = (224, 224),
        split: str = "random",
        split_seed: int = 42,
        fractions: Sequence[float] = (0.7, 0.1, 0.2),
        max_depth_m: float = 10.0,
        batch_size: int = 8,
        progressive: Sequence[Mapping[str, Any]] | None = None,
        augment: Augmentation | None = None,
        teacher: str | Path | None = None,
        num_workers: int = 0,
        seed: int = 42,
        shuffle_block: int | None = None,
        cache: str | Path = "~/.cache/hudepth",
        native: bool = True,
        on_error: str = "raise",
        prepare_workers: int | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(size, Sequence) or len(size) != 2 or min(size) < 1:
            raise ConfigError(f"data.size: {size} is not [height,width]. Pass data.size=[224,224].")
        check_split(split, fractions)
        for key, value, least in (
            ("batch_size", batch_size, 1),
            ("num_workers", num_workers, 0),
            ("prepare_workers", prepare_workers, 1),
            ("shuffle_block", shuffle_block, 1),
        ):
            if value is not None and value < least:
                raise ConfigError(f"data.{key}: {value} is less than {least}.")
        if not 0 < max_depth_m < math.inf:
            raise ConfigError(f"data.max_depth_m: {max_depth_m} is not a positive number of metres.")
        self.source = source
        self.size = (int(size[0]), int(size[1]))
        self.stages = read_stages(progressive or [], size=self.size)
        self.augment = augment
        self.teacher_folder = teacher
        self._teacher: TeacherDepths | None = None
        self._draws: tuple[int, torch.Generator] | None = None
        self.split_kind, self.split_seed, self.fractions = split, split_seed, tuple(fractions)
        self.max_depth_m = float(max_depth_m)
        self.batch_size, self.num_workers, self.seed = batch_size, num_workers, seed
        self.shuffle_block = shuffle_block
        self.cache, self.native = Path(cache), native
        self.on_error, self.prepare_workers = on_error, prepare_workers
        self._store: DepthStore | None = None
        self._split: Split | None = None

    @property
    def store(self) -> DepthStore:
        """The depth store, prepared if need be."""
        if self._store is None:
            self._store = prepare(
                self.source,
                size=self.size,
                cache=self.cache,
                native=self.native,
                on_error=self.on_error,
                workers=self.prepare_workers,
            )
        return self._store

    @property
    def split(self) -> Split:
        """Which pairs of the store train, validate and test; assign to use one read from a split.json."""
        if self._split is None:
            self._split = make_split(
                self.store.records, kind=self.split_kind, seed=self.split_seed, fractions=self.fractions
            )
        return self._split

    @split.setter
    def split(self, split: Split) -> None:
        self._split = split

    @property
    def teacher(self) -> TeacherDepths | None:
        """The teacher's depths of the training pairs, prepared if need be; None without a teacher."""
        if self._teacher is None and self.teacher_folder is not None:
            self._teacher = TeacherDepths(self.teacher_folder, self.store, self.split.train)
        return self._teacher

    def prepare_data(self) -> None:
        """Build the depth store and read the teacher's depths, once."""
        _ = self.store, self.teacher

    def train_dataloader(self) -> DataLoader[RawBatch]:
        """Shuffled training batches; the last, shorter one is kept."""
        rank, world_size = self._shard()
        dataset = StoreDataset(self.store, self.split.train, teacher=self.teacher)
        # Shuffles by seed + epoch alone (Lightning sets the epoch), so a resumed run sees what it would have seen.
        sampler: Sampler[int] = DistributedSampler(
            dataset, num_replicas=world_size, rank=rank, shuffle=True, seed=self.seed
        )
        if self.shuffle_block:
            sampler = BlockShuffle(
                dataset.indices, block=self.shuffle_block, seed=self.seed, rank=rank, world_size=world_size,
                read_ahead=self.store.read_ahead,
            )  # fmt: skip
        return self._loader(dataset, sampler)

    def val_dataloader(self) -> DataLoader[RawBatch]:
        """Validation batches, in the store's order."""
        return self._evaluation_loader(StoreDataset(self.store, self.split.val))

    def test_dataloader(self) -> DataLoader[RawBatch]:
        """Test batches, in the split's order, with native-resolution truth where the store has it."""
        return self._evaluation_loader(StoreDataset(self.store, self.split.test, native=self.store.has_native))

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """All sizes (height, width) that a training goes through, the last one is that of the store."""
        return [*(stage.size for stage in self.stages), self.size]

    @property
    def train_size(self) -> tuple[int, int]:
        """The (height, width) of training images in the current epoch."""
        epoch, epochs = (0, None) if self.trainer is None else (self.trainer.current_epoch, self.trainer.max_epochs)
        return size_at(self.stages, epoch, epochs=epochs, final=self.size)

    def on_after_batch_transfer(self, batch: RawBatch, dataloader_idx: int) -> Batch:
        """Normalise on the device, which spares the transfer three quarters of its bytes; augment training batches.

        While training at a smaller size than the store's, validation batches bring the image at that size, too.
        """
        training = self.trainer is not None and self.trainer.training
        if training:
            return preprocess(
                batch,
                max_depth_m=self.max_depth_m,
                size=self.train_size,
                augment=None
                if self.augment is None
                else partial(self.augment, aspect=self._aspect, generator=self._generator()),
            )
        result = preprocess(batch, max_depth_m=self.max_depth_m)
        if self.trainer is not None and self.trainer.state.fn == TrainerFn.FITTING and self.train_size != self.size:
            result["small_image"] = functional.interpolate(result["image"], self.train_size, mode="area")
        return result

    @property
    def _aspect(self) -> float:
        """Width over height of what the training images show, whatever shape they were resized to."""
        height, width = next(iter(self.store.info.get("native_sizes") or []), self.size)
        return float(width / height)

    def _generator(self) -> torch.Generator:
        """Return what augmentation draws from: it begins anew each epoch, so that a resumed run draws the same."""
        assert self.trainer is not None
        epoch, rank = self.trainer.current_epoch, self.trainer.global_rank
        if self._draws is None or self._draws[0] != epoch:
            seed = int.from_bytes(hashlib.sha256(f"augment {self.seed} {epoch} {rank}".encode()).digest()[:7])
            self._draws = (epoch, torch.Generator().manual_seed(seed))
        return self._draws[1]

    def _evaluation_loader(self, dataset: StoreDataset) -> DataLoader[RawBatch]:
        rank, world_size = self._shard()
        return self._loader(dataset, ShardSampler(len(dataset), rank=rank, world_size=world_size))

    def _loader(self, dataset: StoreDataset, sampler: Any) -> DataLoader[RawBatch]:
        return DataLoader(
            dataset,
            batch_size=self.batch_size,
            sampler=sampler,
            num_workers=self.num_workers,
            collate_fn=as_is,
            pin_memory=torch.cuda.is_available(),
            persistent_workers=self.num_workers > 0,
        )

    def _shard(self) -> tuple[int, int]:
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)


def preprocess(
    batch: RawBatch,
    *,
    max_depth_m: float,
    size: tuple[int, int] | None = None,
    augment: Callable[..., tuple[Tensor, Tensor]] | None = None,
) -> Batch:
    """Normalise what the loader read: ImageNet statistics for the image; depth divided, clipped, masked.

    Args:
        batch: RGB bytes and millimetres.
        max_depth_m: depth is clipped to it and divided by it.
        size: (height, width) of the result; default: as it is.
        augment: changes the image in [0, 1] and the unit depth, and brings them to ``size``.
    """
    image = batch["image"].permute(0, 3, 1, 2).to(torch.float32, memory_format=torch.contiguous_format) / 255
    unit_depth = batch["depth_mm"].to(torch.float32)[:, None] / (1000 * max_depth_m)
    had_truth = unit_depth > 0
    if "teacher_m" in batch:
        unit_depth = torch.cat([unit_depth, batch["teacher_m"][:, None] / max_depth_m], dim=1)  # moved as the truth is
    size = size or (image.shape[-2], image.shape[-1])
    image, depths = (augment or resize)(image, unit_depth, size=size)
    unit_depth = depths[:, :1]
    result = Batch(
        image=normalise_image(image),
        unit_depth=unit_depth.clamp(max=1),
        valid=unit_depth > 0,
        index=batch["index"],
    )
    if augment is not None:
        result["emptied"] = had_truth.any() & ~result["valid"].any()
    if "teacher_m" in batch:
        result["teacher"] = depths[:, 1:]
    if "native_depth" in batch:
        result["native_depth"] = batch["native_depth"]
    return result
