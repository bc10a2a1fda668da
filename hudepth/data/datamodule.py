"""From a source to batches: prepare the store once, split it, load it, normalise it on the device."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import torch
from lightning.pytorch import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from torch.nn import functional
from torch.utils.data import DataLoader

from hudepth.base.console import log
from hudepth.base.errors import DataError
from hudepth.base.images import MAX_NATIVE_PIXELS
from hudepth.base.options import Choice, Range, TrainSize, convert
from hudepth.base.types import Batch, RawBatch
from hudepth.data.augment import Augmentation
from hudepth.data.dataset import DeviceDataset, LateLoader, StoreDataset, as_is, check_together, on_device, stored_pairs
from hudepth.data.order import ShardSampler, epoch_seed
from hudepth.data.prepare import OnError, prepare, share_beyond
from hudepth.data.preprocess import TrainingBatches, preprocess
from hudepth.data.resolution import read_stages, size_at
from hudepth.data.sources.base import Source
from hudepth.data.splits import Split, check_split, make_split
from hudepth.data.store import DepthStore
from hudepth.data.stream import StreamDataset

_COUNT = Annotated[int, Range(1)]
EVALUATION_BATCH = 4
"""Batches that evaluation takes at once on a GPU: it keeps nothing for gradients, and small batches leave it idle."""
MAX_WORKERS = 1024
"""Loader and preparing processes at most; more would only take the memory of the machine."""
_WORKERS = Annotated[int, Range(1, MAX_WORKERS)]
_ON_DEVICE = Annotated[str, Choice(("auto", "true", "false"))]


class DepthDataModule(LightningDataModule):
    """Batches of image, unit depth and valid mask. Raises ConfigError for values out of range.

    Args:
        size: (height, width) of training images, or one number for a square; the paper's is 224 x 224.
        split, split_seed, fractions: see :func:`hudepth.data.splits.make_split`; by default the paper's.
        max_depth_m: maximum depth [m] (the paper: 10); depth is clipped to it and divided by it.
        batch_size: pairs per step (the paper: 8); evaluation on a GPU takes four times as many at once.
        progressive: smaller sizes to start with, each until a share of the epochs:
            ``[{size: [112, 112], until: 0.4}]``; see :func:`hudepth.data.resolution.read_stages`.
        teacher: folder of another model's depths; see :class:`hudepth.data.distill.teacher.TeacherDepths`.
        pictures: folder of pictures without truth; see :class:`hudepth.data.distill.pictures.Pictures`.
        num_workers: loader processes; 0 reads in the training process, which is fast enough for a CPU.
        on_device: keep the training pairs in the device's memory; ``auto``: on a GPU, if half of what is free suffices.
        seed: of the order of training pairs and of augmentation, which depend only on it and the epoch.
        shuffle_block: for stores larger than memory: shuffle blocks of so many neighbouring pairs, then the pairs
            within a few blocks (:class:`hudepth.data.order.BlockShuffle`).
        stream: train on so many new pairs each epoch, which the source generates, instead of stored ones; see
            :class:`hudepth.data.stream.StreamDataset`. Validation and test use stored ones.
        cache, native, on_error, prepare_workers: of the depth store; see :func:`hudepth.data.prepare.prepare`.

    """

    _told = False
    _draws: tuple[int, torch.Generator] | None = None

    def __init__(
        self,
        source: Source,
        *,
        size: int | Sequence[int] = (224, 224),
        split: str = "random",
        split_seed: int = 42,
        fractions: Sequence[float] = (0.7, 0.1, 0.2),
        max_depth_m: float = 10.0,
        batch_size: int = 8,
        progressive: Sequence[Mapping[str, Any]] | None = None,
        augment: Augmentation | None = None,
        teacher: str | Path | None = None,
        pictures: str | Path | None = None,
        num_workers: int = 0,
        on_device: bool | str = "auto",
        seed: int = 42,
        shuffle_block: int | None = None,
        stream: int | None = None,
        cache: str | Path = "~/.cache/hudepth",
        native: bool = True,
        on_error: str = "raise",
        prepare_workers: int | None = None,
    ) -> None:
        super().__init__()
        self.split_kind: str = convert("data.split", split, str)
        self.fractions = tuple(convert("data.fractions", fractions, list[float]))
        check_split(self.split_kind, self.fractions)
        self.source, self.augment = source, augment
        self.teacher_folder: Path | None = convert("distill.teacher", teacher, Path | None)
        self.pictures_folder: Path | None = convert("distill.pictures", pictures, Path | None)
        self.size: tuple[int, int] = convert("data.size", size, TrainSize)
        self.stages = read_stages(progressive or [], size=self.size)
        self.split_seed: int = convert("data.split_seed", split_seed, int)
        self.seed: int = convert("data.seed", seed, int)
        self.max_depth_m: float = convert("data.max_depth_m", max_depth_m, Annotated[float, Range(0, above=True)])
        self.batch_size: int = convert("data.batch_size", batch_size, _COUNT)
        self.num_workers: int = convert("data.num_workers", num_workers, Annotated[int, Range(0, MAX_WORKERS)])
        self.on_device: str = convert("data.on_device", str(on_device).lower(), _ON_DEVICE)
        self.prepare_workers: int | None = convert("data.prepare_workers", prepare_workers, _WORKERS | None)
        self.shuffle_block: int | None = convert("data.shuffle_block", shuffle_block, _COUNT | None)
        self.stream: int | None = convert("data.stream", stream, _COUNT | None)
        self.native: bool = convert("data.native", native, bool)
        self.on_error: str = convert("data.on_error", on_error, OnError)
        self.cache: Path = convert("data.cache", cache, Path)
        if self.on_error == "skip":
            source.unpaired = []
        added = {"stream": self.stream, "teacher": self.teacher_folder, "pictures": self.pictures_folder}
        check_together(source, **added, on_device=self.on_device, shuffle_block=self.shuffle_block)
        self._training_batches = TrainingBatches(augment, max_depth_m=self.max_depth_m)

    @cached_property
    def store(self) -> DepthStore:
        """The depth store, prepared if necessary."""
        kept = partial(prepare, size=self.size, cache=self.cache, native=self.native, on_error=self.on_error)
        return kept(self.source, workers=self.prepare_workers)

    @cached_property
    def split(self) -> Split:
        """Which pairs of the store train, validate and test; assign one read from a split.json to use it instead."""
        records = self.store.records
        return make_split(records, kind=self.split_kind, seed=self.split_seed, fractions=self.fractions)

    @cached_property
    def training_pairs(self) -> StoreDataset | StreamDataset:
        """What is trained on: generated pairs, or stored ones with what a teacher adds, prepared if necessary."""
        if self.stream is None:
            return stored_pairs(self.store, self.split, teacher=self.teacher_folder, pictures=self.pictures_folder)
        return StreamDataset(self.source, size=self.size, count=self.stream)

    def prepare_data(self) -> None:
        """Prepare the depth store and what a teacher adds; the first time, warn if most depths are clipped."""
        _ = self.training_pairs
        beyond, text = self._clipped()
        if beyond > 0.01 and not self._told:
            log.log(logging.WARNING if beyond > 0.5 else logging.INFO, text)
        self._told = True

    def _clipped(self) -> tuple[float, str]:
        """Return the share of measured pixels beyond the maximum depth, and a line about it."""
        beyond = share_beyond(self.store, self.max_depth_m)
        text = f"{beyond:.0%} of measured pixels are beyond data.max_depth_m={self.max_depth_m:g} and count as that."
        fix = f" Pass a larger data.max_depth_m: depths reach {self.store.info.get('depth_max_m', math.nan):g} m."
        return beyond, text + fix * (beyond > 0.5)

    def train_dataloader(self) -> DataLoader[RawBatch]:
        """Shuffled training batches; the last, shorter one is kept.

        Raises DataError if there are no training pairs, or over 90 % of the ground truth is clipped to a constant.
        """
        beyond, text = self._clipped()
        if beyond > 0.9:
            raise DataError(text)
        if not (self.split.train and self.split.val):
            raise DataError(
                f"data.split={self.split.kind}: all pairs are test, none train or validate. Pass another data.split."
            )
        pairs, (rank, world_size) = self.training_pairs, self._shard()
        if self._device.type == "cuda" if self.on_device == "auto" else self.on_device == "true":
            pairs = on_device(pairs, self._device)
        order = pairs.order(block=self.shuffle_block, seed=self.seed, rank=rank, world_size=world_size)
        return self._loader(pairs, order, self.batch_size)

    @property
    def _device(self) -> torch.device:
        return torch.device("cpu") if self.trainer is None else self.trainer.strategy.root_device

    def val_dataloader(self) -> DataLoader[RawBatch]:
        """Validation batches, in the store's order."""
        return self._evaluation_loader(StoreDataset(self.store, self.split.val))

    def test_dataloader(self) -> DataLoader[RawBatch]:
        """Test batches, in the split's order, with native-resolution ground truth if the store has it."""
        return self._evaluation_loader(StoreDataset(self.store, self.split.test, native=self.store.has_native))

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """All sizes (height, width) of a training; the last one is that of the store."""
        return [*(stage.size for stage in self.stages), self.size]

    @property
    def train_size(self) -> tuple[int, int]:
        """The (height, width) of training images in the current epoch."""
        epoch, epochs = (0, None) if self.trainer is None else (self.trainer.current_epoch, self.trainer.max_epochs)
        return size_at(self.stages, epoch, epochs=epochs, final=self.size)

    def on_after_batch_transfer(self, batch: RawBatch, dataloader_idx: int) -> Batch:
        """Normalise on the device, which saves three quarters of the transfer, and augment training batches.

        While training at a smaller size than the store's, validation batches also contain the image at that size.
        """
        training = self.trainer is not None and self.trainer.training
        if training:
            return self._training_batches(batch, size=self.train_size, aspect=self._aspect, generator=self._generator())
        result = preprocess(batch, max_depth_m=self.max_depth_m)
        if self.trainer is not None and self.trainer.state.fn == TrainerFn.FITTING and self.train_size != self.size:
            result["small_image"] = functional.interpolate(result["image"], self.train_size, mode="area")
        return result

    @property
    def _aspect(self) -> float:
        """Width over height of the training images before they were resized."""
        height, width = next(iter(self.store.info.get("native_sizes") or []), self.size)
        return float(width / height)

    def _generator(self) -> torch.Generator:
        """Return the generator of augmentation, seeded each epoch so that a resumed run draws the same."""
        assert self.trainer is not None
        epoch, rank = self.trainer.current_epoch, self.trainer.global_rank
        if self._draws is None or self._draws[0] != epoch:
            self._draws = (epoch, torch.Generator().manual_seed(epoch_seed("augment", self.seed, epoch, rank)))
        return self._draws[1]

    def _evaluation_loader(self, dataset: StoreDataset) -> DataLoader[RawBatch]:
        rank, world_size = self._shard()
        count = self.batch_size * (EVALUATION_BATCH if self._device.type == "cuda" else 1)
        if dataset.native:
            largest = max((h * w for h, w in self.store.info.get("native_sizes") or []), default=1)
            count = min(count, max(1, MAX_NATIVE_PIXELS // largest))
        return self._loader(dataset, ShardSampler(len(dataset), rank=rank, world_size=world_size), count)

    def _loader(self, dataset: StoreDataset | StreamDataset, sampler: Any, batch_size: int) -> DataLoader[RawBatch]:
        there = isinstance(dataset, DeviceDataset)
        return LateLoader(
            dataset,
            batch_size,
            sampler=sampler,
            num_workers=0 if there else self.num_workers,
            collate_fn=as_is,
            pin_memory=torch.cuda.is_available() and not there,
            persistent_workers=self.num_workers > 0 and not there,
        )

    def _shard(self) -> tuple[int, int]:
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)
