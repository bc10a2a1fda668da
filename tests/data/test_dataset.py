"""Batches straight from the store, and shards that neither lose nor repeat a pair."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from hudepth.data import dataset
from hudepth.data.dataset import DeviceDataset, StoreDataset, as_is, on_device
from hudepth.data.order import BlockShuffle, ShardSampler
from hudepth.data.sources.base import Record
from hudepth.data.store import DepthStore, StoreWriter

N, SIZE = 6, (3, 5)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> DepthStore:
    path = tmp_path_factory.mktemp("store") / "a.h5"
    writer = StoreWriter(path, size=SIZE, native=True)
    rng = np.random.default_rng(0)
    for i in range(N):
        native = cv2.imencode(".png", np.full((4 + i, 7), 1000 * i + 1, np.uint16))[1].ravel()
        image, depth = rng.integers(0, 256, (*SIZE, 3), np.uint8), rng.integers(0, 65536, SIZE, np.uint16)
        writer.append(Record(str(i), "", i), image, depth, native)
    writer.close({})
    return DepthStore(path)


def test_a_batch_holds_the_rows_asked_for(store: DepthStore) -> None:
    pairs = StoreDataset(store, [5, 0, 3])
    assert len(pairs) == 3
    batch = pairs.__getitems__([2, 0, 2])
    images, depths = store.read([3, 5, 3])
    assert sorted(batch) == ["image", "index", "per_m", "stored_depth"]
    assert (batch["image"].dtype, batch["stored_depth"].dtype) == (torch.uint8, torch.uint16)
    np.testing.assert_array_equal(batch["image"].numpy(), images)
    np.testing.assert_array_equal(batch["stored_depth"].numpy(), depths)
    assert batch["index"].tolist() == [3, 5, 3]


def test_one_item_is_a_batch_of_one(store: DepthStore) -> None:
    batch = StoreDataset(store, [4, 2])[1]
    assert batch["image"].shape == (1, *SIZE, 3)
    assert batch["index"].tolist() == [2]


def test_native_truth_comes_in_its_own_sizes(store: DepthStore) -> None:
    batch = StoreDataset(store, range(N), native=True).__getitems__([4, 1])
    assert [depth.shape for depth in batch["native_depth"]] == [(1, 8, 7), (1, 5, 7)]
    assert [depth.unique().tolist() for depth in batch["native_depth"]] == [
        [float(np.float32(4.001))], [float(np.float32(1.001))],
    ]  # fmt: skip


def test_a_position_beyond_the_subset_is_an_error(store: DepthStore) -> None:
    with pytest.raises(IndexError):
        StoreDataset(store, [0, 1])[2]


def test_as_is_hands_batches_through_a_loader(store: DepthStore) -> None:
    batches: list[Any] = list(DataLoader(StoreDataset(store, range(N)), batch_size=4, collate_fn=as_is))
    assert [batch["index"].tolist() for batch in batches] == [[0, 1, 2, 3], [4, 5]]


@given(length=st.integers(0, 50), world_size=st.integers(1, 12))
def test_shards_partition_exactly(length: int, world_size: int) -> None:
    shards = [ShardSampler(length, rank=rank, world_size=world_size) for rank in range(world_size)]
    positions = [list(shard) for shard in shards]
    assert sorted(position for each in positions for position in each) == list(range(length))
    assert [len(shard) for shard in shards] == [len(each) for each in positions]
    assert max(map(len, positions)) - min(map(len, positions)) <= 1
    assert all(each == sorted(each) for each in positions)
    assert [list(shard) for shard in shards] == positions  # a second pass goes the same way


def test_the_store_is_found_again_after_pickling(store: DepthStore, tmp_path: Path) -> None:
    pairs = StoreDataset(store, [1, 2], native=True)
    before = pairs[0]
    torch.save(pairs, tmp_path / "dataset")
    after = torch.load(tmp_path / "dataset", weights_only=False)[0]
    assert torch.equal(before["image"], after["image"])
    assert torch.equal(before["native_depth"][0], after["native_depth"][0])


@given(
    rows=st.lists(st.integers(0, 10_000), min_size=1, max_size=200, unique=True),
    block=st.integers(1, 50),
    world_size=st.integers(1, 4),
    epoch=st.integers(0, 3),
)
def test_block_shuffle_deals_every_pair_once(rows: list[int], block: int, world_size: int, epoch: int) -> None:
    samplers = [
        BlockShuffle(rows, block=block, seed=1, rank=rank, world_size=world_size, group=3) for rank in range(world_size)
    ]
    for sampler in samplers:
        sampler.set_epoch(epoch)
    dealt = [list(sampler) for sampler in samplers]
    assert {len(each) for each in dealt} == {len(sampler) for sampler in samplers}
    together = [position for each in zip(*dealt, strict=True) for position in each]
    assert sorted(together[: len(rows)]) == list(range(len(rows)))
    assert together[len(rows) :] == together[: len(together) - len(rows)]  # what is left over begins anew


def test_block_shuffle_reads_in_pieces_and_anew_each_epoch() -> None:
    rows = list(range(1000, 0, -1))  # the split's order is not the store's
    sampler = BlockShuffle(rows, block=10, seed=1, group=5)
    first = [rows[position] for position in sampler]
    for start in range(0, 1000, 50):
        blocks = {(row - 1) // 10 for row in first[start : start + 50]}
        assert len(blocks) == 5  # whole blocks, five at a time
    assert first != sorted(first)
    assert first[:50] != sorted(first[:50], reverse=True)
    assert first == [rows[position] for position in sampler]
    sampler.set_epoch(1)
    assert first != [rows[position] for position in sampler]


def test_block_shuffle_tells_what_it_will_ask_for() -> None:
    told: list[tuple[int, int]] = []
    sampler = BlockShuffle(
        range(100), block=10, seed=1, group=3, world_size=2, rank=1, read_ahead=lambda *each: told.append(each)
    )
    seen = 0
    for position in sampler:
        assert any(first <= position <= last for first, last in told)
        seen += 1
    assert seen == 50
    assert sorted(told) == [(start, start + 9) for start in range(0, 100, 10)]
    assert next(iter(sampler)) >= 0
    assert len(told) == 13  # three blocks more, and no more than three


def test_a_store_takes_hints(store: DepthStore) -> None:
    before = store.read([0, 1])
    store.read_ahead(0, len(store) - 1)
    assert all((a == b).all() for a, b in zip(before, store.read([0, 1]), strict=True))


def test_pairs_on_a_device_are_the_same(store: DepthStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "_AT_ONCE", 2)
    pairs = StoreDataset(store, [5, 0, 3, 1, 4])
    moved = on_device(pairs, torch.device("cpu"))
    assert isinstance(moved, DeviceDataset)
    assert len(moved) == 5
    for positions in ([4], [2, 0, 2], [0, 1, 2, 3, 4]):
        found, expected = moved.__getitems__(positions), pairs.__getitems__(positions)
        assert set(found) == set(expected)
        for key, value in expected.items():
            other: Any = found[key]  # type: ignore[literal-required]
            assert (
                other.dtype == value.dtype and other.equal(value) if isinstance(value, torch.Tensor) else other == value
            )


@pytest.mark.parametrize("free", [100, 10**12], ids=["too little", "taken meanwhile"])
def test_pairs_that_do_not_fit_are_read_from_the_disk(
    store: DepthStore, free: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: Any) -> None:
        raise torch.OutOfMemoryError

    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (free, free))
    monkeypatch.setattr(dataset, "DeviceDataset", full)
    pairs = StoreDataset(store, [0, 1])
    with caplog.at_level("INFO"):
        assert on_device(pairs, torch.device("cuda")) is pairs
    assert "data.on_device: the training pairs take 0.0 GB" in caplog.text
