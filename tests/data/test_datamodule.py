"""From a source to batches: shapes, units, masks, and an order that depends on seed and epoch alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hudepth.base.errors import ConfigError, DataError
from hudepth.base.types import Batch, RawBatch
from hudepth.data import datamodule
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.preprocess import preprocess
from hudepth.data.sources.base import RawPair, Record, Source
from hudepth.data.sources.folder import FolderSource
from hudepth.data.sources.rooms import RoomsSource
from hudepth.data.splits import make_split

SIZE, NATIVE = (6, 8), (12, 20)
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


class NoiseSource(Source):
    """Random pairs, 24 in 12 scenes, with holes."""

    name = "noise"
    encoding = "float_m"

    def records(self) -> list[Record]:
        return [Record(f"{i:02d}", f"s{i // 2}", i % 2, "test" if i >= 18 else "train") for i in range(24)]

    def read(self, record: Record) -> RawPair:
        rng = np.random.default_rng(int(record.id))
        depth = rng.uniform(0.5, 14, NATIVE).astype(np.float32)
        depth[rng.random(NATIVE) < 0.2] = 0
        return RawPair(rng.integers(0, 256, (*NATIVE, 3), np.uint8), depth)


Make = Callable[..., DepthDataModule]


@pytest.fixture(scope="module")
def make(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Build a data module over one cache."""
    cache = tmp_path_factory.mktemp("cache")
    defaults: dict[str, Any] = {"size": SIZE, "batch_size": 4, "cache": cache, "fractions": (0.6, 0.2, 0.2)}
    return lambda **options: DepthDataModule(NoiseSource(), **{**defaults, **options})


def indices(loader: Any) -> list[list[int]]:
    return [batch["index"].tolist() for batch in loader]


def order(loader: Any) -> list[int]:
    return [i for batch in indices(loader) for i in batch]


# Batches


def test_batches_hold_the_pairs_of_their_subset(make: Make) -> None:
    data = make()
    raw = next(iter(data.val_dataloader()))
    assert raw["index"].tolist() == data.split.val
    images, depths = data.store.read(data.split.val)
    np.testing.assert_array_equal(raw["image"].numpy(), images)
    np.testing.assert_array_equal(raw["stored_depth"].numpy(), depths)
    batch = data.on_after_batch_transfer(raw, 0)
    b = len(data.split.val)
    assert {key: (value.dtype, tuple(value.shape)) for key, value in batch.items()} == {
        "image": (torch.float32, (b, 3, *SIZE)),
        "unit_depth": (torch.float32, (b, 1, *SIZE)),
        "valid": (torch.bool, (b, 1, *SIZE)),
        "index": (torch.int64, (b,)),
    }
    assert batch["image"].is_contiguous()


def test_a_batch_against_numpy(make: Make) -> None:
    data = make(max_depth_m=8.0)
    raw = next(iter(data.test_dataloader()))
    batch = data.on_after_batch_transfer(raw, 0)
    rows = data.split.test[:4]
    images, depths_mm = data.store.read(rows)
    expected = ((images.astype(np.float64) / 255 - MEAN) / STD).transpose(0, 3, 1, 2)
    np.testing.assert_allclose(batch["image"].numpy(), expected, atol=2e-6)
    metres = depths_mm[:, None].astype(np.float64) / 1000
    np.testing.assert_allclose(batch["unit_depth"].numpy(), np.minimum(metres, 8) / 8, rtol=2e-7)
    np.testing.assert_array_equal(batch["valid"].numpy(), metres > 0)
    assert 0 < batch["valid"].float().mean() < 1  # there are holes
    assert batch["unit_depth"].max() == 1  # and depths beyond 8 m
    assert batch["index"].tolist() == rows


@given(stored_depth=arrays(np.uint16, (1, 2, 3)), max_depth_m=st.floats(0.1, 100))
def test_unit_depth_is_clipped_and_zero_where_unmeasured(stored_depth: np.ndarray, max_depth_m: float) -> None:
    raw = RawBatch(
        image=torch.zeros(1, 2, 3, 3, dtype=torch.uint8),
        stored_depth=torch.from_numpy(stored_depth),
        index=torch.zeros(1).long(),
    )
    batch = preprocess(raw, max_depth_m=max_depth_m)
    expected = np.minimum(stored_depth / (1000 * max_depth_m), 1)[:, None]
    np.testing.assert_allclose(batch["unit_depth"].numpy(), expected, rtol=3e-7)
    np.testing.assert_array_equal(batch["valid"].numpy(), stored_depth[:, None] > 0)
    np.testing.assert_array_equal(batch["unit_depth"].numpy() > 0, stored_depth[:, None] > 0)
    assert batch["unit_depth"].max() <= 1


def test_preprocess_leaves_its_input_alone() -> None:
    raw = RawBatch(
        image=torch.full((1, 2, 2, 3), 7, dtype=torch.uint8),
        stored_depth=torch.full((1, 2, 2), 60_000).to(torch.uint16),
        index=torch.zeros(1).long(),
    )
    preprocess(raw, max_depth_m=10)
    assert set(raw) == {"image", "stored_depth", "index"}
    assert raw["image"].unique().tolist() == [7]
    assert raw["stored_depth"].to(torch.int64).unique().tolist() == [60_000]


def test_test_batches_bring_the_native_truth(make: Make) -> None:
    data = make(split="official")
    assert data.split.test == list(range(18, 24))
    batches: list[Batch] = [data.on_after_batch_transfer(raw, 0) for raw in data.test_dataloader()]
    found = [depth for batch in batches for depth in batch["native_depth"]]
    for row, depth in zip(data.split.test, found, strict=True):
        truth = data.source.read(data.source.records()[row]).depth
        assert depth.shape == (1, *NATIVE)
        np.testing.assert_allclose(depth[0].numpy(), truth, atol=5.1e-4)
        np.testing.assert_array_equal(depth[0].numpy() > 0, truth > 0)
    for loader in (data.train_dataloader(), data.val_dataloader()):
        assert all("native_depth" not in batch for batch in loader)


def test_large_native_truths_come_in_smaller_batches(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datamodule, "MAX_NATIVE_PIXELS", 2 * NATIVE[0] * NATIVE[1])
    data = make(split="official", batch_size=5)
    assert [len(raw["index"]) for raw in data.test_dataloader()] == [2, 2, 2]
    assert len(next(iter(data.train_dataloader()))["index"]) == 5


def test_evaluation_on_a_gpu_takes_more_pairs_at_once(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DepthDataModule, "_device", torch.device("cuda"))
    data = make(split="official", batch_size=1, on_device=False)
    sizes = [[len(raw["index"]) for raw in loader] for loader in (data.val_dataloader(), data.test_dataloader())]
    assert all(counts[:-1] == [4] * (len(counts) - 1) and counts[-1] <= 4 for counts in sizes)
    assert sum(sizes[1]) == len(data.split.test) > 4
    assert len(next(iter(data.train_dataloader()))["index"]) == 1


def test_a_store_without_native_truth_gives_none(make: Make) -> None:
    data = make(native=False)
    raw = next(iter(data.test_dataloader()))
    assert "native_depth" not in raw
    assert "native_depth" not in data.on_after_batch_transfer(raw, 0)


@pytest.mark.slow
def test_rooms_with_holes(tmp_path: Path) -> None:
    source = RoomsSource(scenes=5, frames_per_scene=2, size=(24, 32), holes=True)
    data = DepthDataModule(source, size=(16, 16), split="scene", fractions=(0.6, 0.2, 0.2), cache=tmp_path)
    raw = next(iter(data.train_dataloader()))
    batch = data.on_after_batch_transfer(raw, 0)
    assert batch["image"].shape == (6, 3, 16, 16)
    assert 0 < batch["valid"].float().mean() < 1
    assert not batch["unit_depth"][~batch["valid"]].any()
    assert 0 < batch["unit_depth"][batch["valid"]].min() < batch["unit_depth"].max() <= 1


# Order


def test_the_last_short_batch_is_kept(make: Make) -> None:
    data = make(split="random", batch_size=4, fractions=(0.6, 0.2, 0.2))
    assert [len(data.split.train), len(data.split.val), len(data.split.test)] == [14, 4, 6]
    assert list(map(len, indices(data.train_dataloader()))) == [4, 4, 4, 2]
    assert list(map(len, indices(data.test_dataloader()))) == [4, 2]
    assert len(data.train_dataloader()) == 4


def test_evaluation_goes_in_order(make: Make) -> None:
    data = make()
    assert order(data.val_dataloader()) == data.split.val
    assert order(data.test_dataloader()) == data.split.test


def epochs(data: DepthDataModule, which: range) -> list[list[int]]:
    loader = data.train_dataloader()
    found = []
    for epoch in which:
        loader.sampler.set_epoch(epoch)  # as Lightning does
        found.append(order(loader))
    return found


def test_the_training_order_depends_on_seed_and_epoch_alone(make: Make) -> None:
    torch.manual_seed(0)
    first = epochs(make(seed=1), range(4))
    torch.manual_seed(99)
    torch.rand(7)
    assert epochs(make(seed=1), range(4)) == first
    assert epochs(make(seed=1), range(2, 4)) == first[2:]  # a resumed run sees what it would have seen
    assert len({tuple(order) for order in [*first, *epochs(make(seed=5), range(4))]}) > 4
    train = sorted(make().split.train)
    assert all(sorted(order) == train for order in first)  # each pair once an epoch


@pytest.mark.parametrize("num_workers", [0, 2])
def test_an_epoch_that_is_set_after_iter_counts(make: Make, num_workers: int) -> None:
    (_, _, third) = epochs(make(), range(3))
    loader = make(num_workers=num_workers).train_dataloader()
    batches = iter(loader)  # as Lightning does before it restores a run
    loader.sampler.set_epoch(2)  # type: ignore[attr-defined]
    assert [row for batch in batches for row in batch["index"].tolist()] == third


def test_two_loader_processes_give_the_same_batches(make: Make) -> None:
    alone, helped = make(), make(num_workers=2)
    helped.store.read([0])  # a handle is open when the workers start
    for name in ("train_dataloader", "test_dataloader"):
        one, two = list(getattr(alone, name)()), list(getattr(helped, name)())
        assert len(one) == len(two)
        for a, b in zip(one, two, strict=True):
            assert list(a) == list(b)
            for key in ("image", "stored_depth", "index"):
                assert torch.equal(a[key], b[key])
            for x, y in zip(a.get("native_depth", []), b.get("native_depth", []), strict=True):
                assert torch.equal(x, y)


class FakeTrainer:
    def __init__(self, rank: int, world_size: int) -> None:
        self.global_rank, self.world_size = rank, world_size
        self.strategy = SimpleNamespace(root_device=torch.device("cpu"))


@pytest.mark.parametrize("world_size", [1, 2, 3, 5])
def test_shards_together_see_all(make: Make, world_size: int) -> None:
    train, test = [], []
    for rank in range(world_size):
        data = make()
        data.trainer = FakeTrainer(rank, world_size)  # type: ignore[assignment]
        train += order(data.train_dataloader())
        test += order(data.test_dataloader())
    assert sorted(test) == sorted(data.split.test)  # exact, for metrics
    assert set(train) == set(data.split.train)
    assert len(train) == world_size * math.ceil(len(data.split.train) / world_size)  # equal steps for all


# Preparation and options


def test_nothing_is_read_before_it_is_needed(tmp_path: Path) -> None:
    data = DepthDataModule(NoiseSource(), size=SIZE, cache=tmp_path / "cache")
    assert not (tmp_path / "cache").exists()
    data.prepare_data()
    stores = list((tmp_path / "cache").glob("*.h5"))
    assert stores == [data.store.path]
    assert data.store is data.store


def test_options_reach_the_store_and_the_split(make: Make) -> None:
    data = make(split="scene", split_seed=3, fractions=[0.5, 0.25, 0.25])
    expected = make_split(data.store.records, kind="scene", seed=3, fractions=[0.5, 0.25, 0.25])
    assert data.split == expected
    assert data.store.size == SIZE
    data.split = other = make_split(data.store.records, kind="random")
    assert data.split is other
    assert indices(data.val_dataloader()) == [other.val]


class OneBadSource(NoiseSource):
    def read(self, record: Record) -> RawPair:
        if record.id == "03":
            raise DataError("'03': damaged.")
        return super().read(record)


def test_on_error_reaches_the_preparation(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"'03': damaged\. Fix it, or pass data\.on_error=skip"):
        DepthDataModule(OneBadSource(), size=SIZE, cache=tmp_path).prepare_data()
    assert len(DepthDataModule(OneBadSource(), size=SIZE, cache=tmp_path, on_error="skip").store) == 23


@pytest.mark.parametrize(
    "options",
    [
        {"size": [224]}, {"size": [0, 224]}, {"size": [1, 2, 3]}, {"batch_size": 0}, {"num_workers": -1},
        {"prepare_workers": 0}, {"shuffle_block": 0}, {"max_depth_m": 0.0}, {"max_depth_m": math.nan},
        {"max_depth_m": math.inf}, {"split": "scenes"}, {"fractions": [0.7, 0.3]}, {"on_error": "ignore"},
    ],
)  # fmt: skip
def test_options_out_of_range_are_refused_at_once(make: Make, options: dict[str, Any]) -> None:
    (key,) = options
    with pytest.raises(ConfigError, match=rf"^data\.{key}: "):
        make(**options)


def test_one_number_makes_a_square(make: Make) -> None:
    assert make(size=224).size == (224, 224)


@pytest.mark.parametrize(("truth", "left", "emptied"), [(900, 0, True), (900, 900, False), (0, 0, False)])
def test_a_batch_is_emptied_only_if_it_had_truth_to_lose_whatever_its_teacher_says(
    truth: int, left: int, emptied: bool
) -> None:
    raw = RawBatch(
        image=torch.zeros(1, 4, 4, 3, dtype=torch.uint8),
        stored_depth=torch.full((1, 4, 4), truth).to(torch.uint16),
        index=torch.tensor([0]),
        teacher_m=torch.ones(1, 4, 4),
    )

    def augment(image: torch.Tensor, depth: torch.Tensor, *, size: tuple[int, int]) -> tuple[torch.Tensor, ...]:
        return image, torch.cat([torch.full_like(depth[:, :1], left), depth[:, 1:]], dim=1)

    assert bool(preprocess(raw, max_depth_m=10.0, augment=augment)["emptied"]) is emptied


@pytest.mark.parametrize(
    ("max_depth_m", "level", "share"),
    [(100, None, ""), (55, "INFO", "50%"), (35, "WARNING", "89%"), (20, "WARNING", "100%")],
)
def test_outdoor_depth_and_what_is_clipped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, max_depth_m: float, level: str | None, share: str
) -> None:
    depth_m = np.linspace(30, 80, 64).reshape(8, 8)
    for folder in ("images", "depths"):
        (tmp_path / folder).mkdir()
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"images/{i}.png"), np.full((8, 8, 3), 50 * i, np.uint8))
        cv2.imwrite(str(tmp_path / f"depths/{i}.png"), np.rint(depth_m * 256).astype(np.uint16))
    source = FolderSource(tmp_path, encoding="uint16_256", indoor=False)
    data = DepthDataModule(source, size=8, max_depth_m=max_depth_m, cache=tmp_path / "c", fractions=(0.5, 0.25, 0.25))
    with caplog.at_level("INFO"):
        data.prepare_data()
        data.prepare_data()  # as Lightning does for the training and for its test
    said = [record for record in caplog.records if "data.max_depth_m" in record.message]
    assert [record.levelname for record in said] == ([level] if level else [])
    assert all(share in record.message for record in said)
    batch = next(iter(data.test_dataloader()))
    expected = torch.from_numpy(np.rint(depth_m * 256).astype(np.float32) / 256)
    torch.testing.assert_close(batch["native_depth"][0][0], expected)
    unit = preprocess(batch, max_depth_m=max_depth_m)["unit_depth"][0, 0]
    torch.testing.assert_close(unit, (expected / max_depth_m).clamp(max=1))
    with pytest.raises(DataError, match="depths reach 80 m") if share == "100%" else nullcontext():
        data.train_dataloader()


def test_a_set_that_is_all_test_does_not_train(tmp_path: Path) -> None:
    data = DepthDataModule(
        RoomsSource(scenes=2, frames_per_scene=2, size=(16, 16)), size=16, split="test", cache=tmp_path
    )
    assert len(data.split.test) == 4
    with pytest.raises(DataError, match=r"data\.split=test"):
        data.train_dataloader()
