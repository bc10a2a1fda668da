"""Pairs that are made as they are needed: the same from any process, new ones each epoch, none of them stored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base.errors import ConfigError
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.order import NewEachEpoch
from hudepth.data.sources.folder import FolderSource
from hudepth.data.sources.rooms import RoomsSource
from hudepth.data.stream import StreamDataset

SIZE = (32, 32)


def rooms(**options: Any) -> RoomsSource:
    return RoomsSource(**{"scenes": 4, "frames_per_scene": 2, "size": (32, 48), **options})


def stream_data(cache: Path, **options: Any) -> DepthDataModule:
    split = {"split": "scene", "fractions": (0.25, 0.25, 0.5)}
    return DepthDataModule(rooms(), cache=cache, **{"size": SIZE, "batch_size": 4, "stream": 12, **split, **options})


def epoch(data: DepthDataModule, number: int) -> list[dict[str, torch.Tensor]]:
    loader = data.train_dataloader()
    loader.sampler.set_epoch(number)  # type: ignore[attr-defined]
    return [dict(batch) for batch in loader]  # type: ignore[arg-type]


def test_a_pair_is_what_its_source_renders() -> None:
    source = rooms()
    batch = StreamDataset(source, size=SIZE, count=8).__getitems__([13, 2])
    assert batch["index"].tolist() == [13, 2]
    for number, image, stored in zip([13, 2], batch["image"], batch["stored_depth"], strict=True):
        raw = source.read(source.generated(number))
        small = cv2.resize(raw.image, SIZE[::-1], interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(image.numpy().astype(int), small, atol=1)
        truth = cv2.resize(raw.depth, SIZE[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        np.testing.assert_allclose(stored.numpy() / batch["per_m"], truth, atol=5.1e-4)


def test_a_generated_room_is_none_of_the_listed_ones() -> None:
    source = rooms()
    listed = {record.id for record in source.records()}
    generated = [source.generated(number) for number in range(40)]
    assert len({record.id for record in generated} | listed) == 40 + len(listed)
    assert [record.frame for record in generated[:4]] == [0, 1, 0, 1]
    more = rooms(scenes=5)
    np.testing.assert_array_equal(source.read(generated[1]).depth, more.read(more.records()[9]).depth)


@given(count=st.integers(1, 60), block=st.integers(1, 9), group=st.integers(1, 5), world=st.integers(1, 4))
def test_epochs_share_no_number(count: int, block: int, group: int, world: int) -> None:
    def numbers(epoch: int) -> list[int]:
        shards = []
        for rank in range(world):
            order = NewEachEpoch(count, block=block, seed=3, rank=rank, world_size=world, group=group)
            order.set_epoch(epoch)
            shards.append(list(order))
        assert {len(shard) for shard in shards} == {-(-count // world)}
        return sorted({number for shard in shards for number in shard})

    assert numbers(0) == list(range(count))
    assert numbers(2) == list(range(2 * count, 3 * count))


def test_an_epoch_is_the_same_from_any_number_of_processes_and_unlike_the_one_before(tmp_path: Path) -> None:
    here, there = (epoch(stream_data(tmp_path, num_workers=workers), 1) for workers in (0, 2))
    assert [batch["index"].tolist() for batch in here] == [batch["index"].tolist() for batch in there]
    assert all(torch.equal(one["image"], other["image"]) for one, other in zip(here, there, strict=True))
    assert sorted(number for batch in here for number in batch["index"].tolist()) == list(range(12, 24))


def test_nothing_of_the_stream_is_stored(tmp_path: Path) -> None:
    data = stream_data(tmp_path)
    data.prepare_data()
    before = {path: path.stat().st_size for path in tmp_path.iterdir()}
    assert len(epoch(data, 0)) == 3
    assert {path: path.stat().st_size for path in tmp_path.iterdir()} == before
    assert len(data.store) == 8
    assert data.training_pairs.pair_id(13) == "further_room_0000006/01"


def test_files_cannot_be_streamed(tmp_path: Path) -> None:
    (tmp_path / "image").mkdir()
    with pytest.raises(ConfigError, match=r"^data\.stream: folder has only the pairs of its files"):
        DepthDataModule(FolderSource(tmp_path), size=SIZE, stream=4)


def test_a_teacher_has_no_depths_of_new_pairs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^data\.stream: a teacher"):
        stream_data(tmp_path, teacher=tmp_path)
