from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.base.types import Batch
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.dataset import StoreDataset
from hudepth.data.preprocess import preprocess
from hudepth.data.sources.rooms import RoomsSource
from hudepth.evaluation.baselines import ConstantDepth, trivial_baselines
from hudepth.evaluation.grids import SUM_COLUMNS
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.scoring import image_table
from hudepth.metrics.boundary import BOUNDARY_NAMES, boundary_metrics
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.strata import STRATA
from hudepth.metrics.summary import ImageTable, summarise
from hudepth.metrics.uncertainty import uncertainty_metrics
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


def table(data: DepthDataModule, evaluation: Evaluation, name: str = "model") -> ImageTable:
    records = [data.store.records[index] for index in evaluation.indices]
    return image_table(PAPER, evaluation.sums[name, "paper"], records)


@pytest.fixture
def net() -> TinyUNet:
    torch.manual_seed(0)
    return TinyUNet(channels=4).eval()


@pytest.mark.slow
def test_the_batch_size_changes_nothing(cache: Path, net: TinyUNet) -> None:
    reference = evaluate(make_data(cache, batch_size=1), {"model": net}, PAPER, NATIVE)
    for batch_size in (2, 4, 50):
        other = evaluate(make_data(cache, batch_size=batch_size), {"model": net}, PAPER, NATIVE)
        assert other.indices == reference.indices
        for protocol in (PAPER, NATIVE):
            ours, theirs = (each.sums["model", protocol.name] for each in (other, reference))
            torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6, equal_nan=True)


@pytest.mark.slow
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
    image, stored_depth = data.store.read(data.split.test)
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    with torch.inference_mode():
        normal = torch.from_numpy(((image / 255 - mean) / std).transpose(0, 3, 1, 2)).float()
        pred_m = 10 * net(normal)[:, 0].double().numpy()
    truth_m = np.minimum(stored_depth / 1000, 10)
    assert (truth_m == 0).any()
    rows = table(data, evaluation).values
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


def test_baselines_stand_beside_the_model(cache: Path, net: TinyUNet) -> None:
    data = make_data(cache)
    baselines = trivial_baselines(data.store, data.split.train, max_depth_m=data.max_depth_m)
    evaluation = evaluate(data, {"model": net, **baselines}, PAPER)
    rmse = {name: summarise(table(data, evaluation, name), averaging="image")["rmse"] for name in ("model", *baselines)}
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
    assert str(caught.value).startswith("protocol: two have the same name among paper, native, paper.")


@pytest.mark.slow
def test_a_flip_averages_the_mirrored_prediction(cache: Path, net: TinyUNet) -> None:
    data = make_data(cache)
    flip = dataclasses.replace(PAPER, name="flip", flip=True)
    baselines = trivial_baselines(data.store, data.split.train, max_depth_m=data.max_depth_m)
    evaluation = evaluate(data, {"model": net, **baselines}, PAPER, flip)

    class Mirrored(nn.Module):
        def forward(self, image: Tensor) -> Tensor:
            mirrored: Tensor = (net(image) + net(image.flip(-1)).flip(-1)) / 2
            return mirrored

    expected = evaluate(data, {"model": Mirrored()}, PAPER)
    torch.testing.assert_close(
        evaluation.sums["model", "flip"], expected.sums["model", "paper"], rtol=1e-6, atol=1e-6, equal_nan=True
    )
    assert not torch.equal(evaluation.sums["model", "flip"][:, :-1], evaluation.sums["model", "paper"][:, :-1])
    for name in baselines:  # they have no left and right to average
        ours, plain = (evaluation.sums[name, protocol].nan_to_num() for protocol in ("flip", "paper"))
        assert torch.equal(ours, plain)


def test_protocols_scored_together_or_alone_are_the_same(cache: Path, net: TinyUNet) -> None:
    protocols = [
        PAPER,
        NATIVE,
        dataclasses.replace(NATIVE, name="flip", flip=True),
        dataclasses.replace(NATIVE, name="tight", min_depth_m=2.0, max_depth_m=4.0),
        dataclasses.replace(NATIVE, name="aligned", alignment="median"),
        dataclasses.replace(NATIVE, name="nearest", resize="nearest", crop=None, valid="measured"),
        dataclasses.replace(NATIVE, name="other", ssim_window=5, ssim_data_range_m=5.0, clamp=False),
    ]
    data = make_data(cache)
    together = evaluate(data, {"model": net}, *protocols)
    for protocol in protocols:
        alone = evaluate(data, {"model": net}, protocol)
        torch.testing.assert_close(
            together.sums["model", protocol.name], alone.sums["model", protocol.name],
            rtol=1e-9, atol=1e-9, equal_nan=True,
        )  # fmt: skip
    rows = [together.sums["model", protocol.name].nan_to_num() for protocol in protocols]
    assert all(not torch.equal(a, b) for i, a in enumerate(rows) for b in rows[:i])


def test_a_flip_also_measures_what_its_disagreement_tells(cache: Path, net: TinyUNet) -> None:
    data = make_data(cache)
    flip = dataclasses.replace(PAPER, name="flip", flip=True)
    evaluation = Evaluation({"model": net, "other": net}, [PAPER, flip], max_depth_m=10.0, detailed="model")
    Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_model_summary=False,
        enable_progress_bar=False, use_distributed_sampler=False,
    ).test(evaluation, datamodule=data, verbose=False)  # fmt: skip
    assert set(evaluation.uncertainty) == {"flip"}
    rows = []
    for batch in data.test_dataloader():
        ready = data.on_after_batch_transfer(batch, 0)
        with torch.no_grad():
            both = [10 * net(ready["image"]), 10 * net(ready["image"].flip(-1)).flip(-1)]
        rows.append(
            uncertainty_metrics(
                sum(both) / 2,
                10 * ready["unit_depth"],
                ready["valid"],
                (both[0] - both[1]).abs(),  # type: ignore[arg-type]
            )
        )
    torch.testing.assert_close(evaluation.uncertainty["flip"], torch.cat(rows), rtol=1e-3, atol=1e-4)
    table = image_table(
        flip, evaluation.sums["model", "flip"], [data.store.records[i] for i in evaluation.indices],
        uncertainty=evaluation.uncertainty["flip"],
    )  # fmt: skip
    assert {"flip_ause", "flip_rank_corr"} <= set(summarise(table, averaging="pooled"))


def test_edges_and_strata_are_measured_where_asked_for(cache: Path, net: TinyUNet) -> None:
    data = make_data(cache)
    detailed = dataclasses.replace(PAPER, name="detailed", boundary=True, strata=True)
    evaluation = Evaluation({"model": net, "other": net}, [PAPER, detailed], max_depth_m=10.0, detailed="model")
    Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_model_summary=False,
        enable_progress_bar=False, use_distributed_sampler=False,
    ).test(evaluation, datamodule=data, verbose=False)  # fmt: skip
    assert set(evaluation.boundary) == set(evaluation.strata) == {"detailed"}
    assert evaluation.boundary["detailed"].shape == (6, len(BOUNDARY_NAMES))
    assert evaluation.strata["detailed"].shape[:2] == (6, len(STRATA))
    (batch,) = make_batches(data)
    with torch.inference_mode():
        expected = boundary_metrics(10 * net(batch["image"]), 10 * batch["unit_depth"], batch["valid"])
    for column, name in zip(evaluation.boundary["detailed"].T, BOUNDARY_NAMES, strict=True):
        torch.testing.assert_close(column, expected[name], rtol=1e-4, atol=1e-4, equal_nan=True)


def make_batches(data: DepthDataModule) -> list[Batch]:
    dataset = StoreDataset(data.store, sorted(data.split.test))
    return [preprocess(dataset.__getitems__(range(len(dataset))), max_depth_m=10.0)]
