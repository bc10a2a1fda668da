from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from torch import Tensor, nn

from hudepth.data.datamodule import DepthDataModule
from hudepth.data.sources.rooms import RoomsSource
from hudepth.errors import ConfigError
from hudepth.evaluation import ConstantDepth, Evaluation, trivial_baselines
from hudepth.metrics.protocol import SUM_COLUMNS, Protocol
from hudepth.models import TinyUNet

PAPER = Protocol(name="paper", ssim_window=3)
NATIVE = Protocol(
    name="native", resolution="native", crop=[4, 44, 4, 60], crop_size=[48, 64], clamp=True, max_depth_m=8
)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def make_data(cache: Path, *, batch_size: int = 2) -> DepthDataModule:
    source = RoomsSource(scenes=8, frames_per_scene=3, size=(48, 64), holes=True)
    return DepthDataModule(
        source, size=(32, 48), split="official", batch_size=batch_size, cache=cache, prepare_workers=1
    )  # fmt: skip


def evaluate(data: DepthDataModule, predictors: dict[str, nn.Module], *protocols: Protocol) -> Evaluation:
    evaluation = Evaluation(predictors, protocols, max_depth_m=data.max_depth_m)
    Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_model_summary=False,
        enable_progress_bar=False, use_distributed_sampler=False,
    ).test(evaluation, datamodule=data, verbose=False)  # fmt: skip
    return evaluation


@pytest.fixture
def net() -> TinyUNet:
    torch.manual_seed(0)
    return TinyUNet(channels=4).eval()


def test_the_batch_size_changes_nothing(cache: Path, net: TinyUNet) -> None:
    reference = evaluate(make_data(cache, batch_size=1), {"model": net}, PAPER, NATIVE)
    for batch_size in (2, 4, 50):
        other = evaluate(make_data(cache, batch_size=batch_size), {"model": net}, PAPER, NATIVE)
        assert other.indices == reference.indices
        for protocol in (PAPER, NATIVE):
            ours, theirs = (each.sums["model", protocol.name] for each in (other, reference))
            torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6, equal_nan=True)


def test_one_row_for_each_test_image(cache: Path, net: TinyUNet) -> None:
    data = make_data(cache)
    evaluation = evaluate(data, {"model": net, "other": TinyUNet(channels=2)}, PAPER, NATIVE)
    assert evaluation.indices == sorted(data.split.test)
    assert len(data.split.test) == 6
    for name in ("model", "other"):
        for protocol in (PAPER, NATIVE):
            assert evaluation.sums[name, protocol.name].shape == (6, len(SUM_COLUMNS))
    assert not torch.equal(evaluation.sums["model", "paper"], evaluation.sums["other", "paper"])


def test_rows_against_numpy(cache: Path, net: TinyUNet) -> None:
    data = make_data(cache)
    evaluation = evaluate(data, {"model": net}, PAPER)
    image, depth_mm = data.store.read(data.split.test)
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    with torch.inference_mode():
        normal = torch.from_numpy(((image / 255 - mean) / std).transpose(0, 3, 1, 2)).float()
        pred_m = 10 * net(normal)[:, 0].double().numpy()
    truth_m = np.minimum(depth_mm / 1000, 10)
    assert (truth_m == 0).any()
    rows = PAPER.per_image(evaluation.sums["model", "paper"])
    for row, (p, t) in enumerate(zip(pred_m, truth_m, strict=True)):
        p, t = p[t > 0], t[t > 0]
        assert rows["abs_rel"][row].item() == pytest.approx(np.mean(np.abs(p - t) / t), rel=1e-6)
        assert rows["rmse"][row].item() == pytest.approx(np.sqrt(np.mean((p - t) ** 2)), rel=1e-6)
        assert rows["delta1"][row].item() == pytest.approx(np.mean(np.maximum(p / t, t / p) < 1.25), abs=1e-9)


def test_rows_are_in_the_order_of_the_store(cache: Path, net: TinyUNet) -> None:
    """Whatever the order of the split, and so of the batches, or of the processes they went to."""
    data, shuffled = make_data(cache), make_data(cache, batch_size=4)
    shuffled.split = dataclasses.replace(data.split, test=[data.split.test[i] for i in (3, 0, 5, 1, 4, 2)])
    ours, theirs = (evaluate(each, {"model": net}, PAPER) for each in (shuffled, data))
    assert ours.indices == theirs.indices == sorted(data.split.test)
    rows = (each.sums["model", "paper"] for each in (ours, theirs))
    torch.testing.assert_close(*rows, rtol=1e-6, atol=1e-6, equal_nan=True)


def test_constant_depth_answers_every_image_alike() -> None:
    unit_depth = torch.rand(1, 1, 4, 6)
    baseline = ConstantDepth(unit_depth)
    for count in (1, 3):
        answer = baseline(torch.randn(count, 3, 4, 6))
        assert answer.shape == (count, 1, 4, 6)
        assert all(torch.equal(one[None], unit_depth) for one in answer)
    assert list(baseline.parameters()) == []
    assert baseline.to(torch.float64)(torch.zeros(1, 3, 4, 6)).dtype == torch.float64  # it moves as networks do


class FakeStore:
    """Truth that is made up, in the form in which a depth store gives it."""

    def __init__(self, depth_mm: np.ndarray) -> None:
        self.depth_mm, self.size = depth_mm, depth_mm.shape[1:]

    def read(self, indices: list[int]) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((len(indices), *self.size, 3), np.uint8), self.depth_mm[list(indices)]


@pytest.mark.parametrize("pairs", [1, 63, 64, 65, 200])
def test_trivial_baselines(pairs: int) -> None:
    rng = np.random.default_rng(pairs)
    depth_mm = rng.integers(500, 15_000, (pairs + 7, 5, 4)).astype(np.uint16)
    depth_mm[rng.random(depth_mm.shape) < 0.3] = 0
    depth_mm[:, 2, 1] = 0  # measured in no training image
    train = rng.permutation(pairs + 7)[:pairs].tolist()
    depth_mm[[i for i in range(pairs + 7) if i not in train]] = 1  # what must not be looked at
    bare = trivial_baselines
    while hasattr(bare, "__wrapped__"):  # the checker of the tests would insist on a real store
        bare = bare.__wrapped__
    made = bare(FakeStore(depth_mm), train, max_depth_m=8.0)  # type: ignore[arg-type]
    assert list(made) == ["mean_depth_map", "mean_depth"]

    metres = np.where(depth_mm[train] == 0, np.nan, np.minimum(depth_mm[train] / 1000, 8.0))
    mean = np.nanmean(metres)
    counted = (~np.isnan(metres)).sum(axis=0)
    mean_map = np.where(counted > 0, np.nansum(metres, axis=0) / np.maximum(counted, 1), mean)
    answers = {name: (8 * net(torch.zeros(1, 3, 5, 4)))[0, 0].numpy() for name, net in made.items()}
    np.testing.assert_allclose(answers["mean_depth"], np.full((5, 4), mean), rtol=1e-6)
    np.testing.assert_allclose(answers["mean_depth_map"], mean_map, rtol=1e-6)


def test_baselines_stand_beside_the_model(cache: Path, net: TinyUNet) -> None:
    data = make_data(cache)
    baselines = trivial_baselines(data.store, data.split.train, max_depth_m=data.max_depth_m)
    evaluation = evaluate(data, {"model": net, **baselines}, PAPER)
    rmse = {name: PAPER.summary(evaluation.sums[name, "paper"])["rmse"] for name in ("model", *baselines)}
    assert rmse["mean_depth"] < rmse["model"]  # which has learnt nothing
    truth_mm = data.store.read(data.split.test)[1]
    constant = 10 * baselines["mean_depth"].unit_depth[0, 0, 0, 0].item()  # type: ignore[union-attr, index]
    expected = np.mean([np.sqrt(np.mean((constant - np.minimum(t[t > 0] / 1000, 10)) ** 2)) for t in truth_mm])
    assert rmse["mean_depth"] == pytest.approx(expected, rel=1e-6)


class Half(nn.Module):
    """Predicts in half precision, as a network under bf16 does."""

    def forward(self, image: Tensor) -> Tensor:
        return torch.full((len(image), 1, *image.shape[-2:]), 0.3).to(torch.bfloat16)


def test_half_precision_predictions_are_scored_in_full(cache: Path) -> None:
    evaluation = evaluate(make_data(cache), {"coarse": Half()}, PAPER)
    exact = evaluate(make_data(cache), {"exact": ConstantDepth(Half()(torch.zeros(1, 3, 32, 48)).float())}, PAPER)
    assert torch.equal(evaluation.sums["coarse", "paper"].nan_to_num(), exact.sums["exact", "paper"].nan_to_num())


def test_two_protocols_of_one_name(net: TinyUNet) -> None:
    with pytest.raises(ConfigError) as caught:
        Evaluation({"model": net}, [PAPER, NATIVE, PAPER], max_depth_m=10.0)
    assert str(caught.value) == "protocol: two have one name among paper, native, paper. Give each its own name."
