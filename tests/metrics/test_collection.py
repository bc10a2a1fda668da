from __future__ import annotations

import copy
import itertools
import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torchmetrics import Metric, MetricCollection
from torchmetrics.utilities import dim_zero_sum

from hudepth.base.errors import ConfigError
from hudepth.metrics import MAE, MSE, RMSE, AbsRel, Delta, Log10, RMSELog, SILog, SqRel, metric_info
from hudepth.metrics.collection import DepthMetrics, DepthSSIM, FunctionMetric
from hudepth.metrics.depth import METRIC_NAMES, depth_metrics, depth_metrics_from_sums, depth_sums
from hudepth.metrics.ssim import ssim
from tests.devices import without_float64

BUILD: dict[str, Callable[[], Metric]] = {
    "image": DepthMetrics,
    "pooled": lambda: DepthMetrics(averaging="pooled"),
    "ssim": lambda: DepthSSIM(data_range=10.0),
}


def make_images(seed: int = 0, *, count: int = 6, side: int = 16) -> tuple[Tensor, Tensor, Tensor]:
    """Return images of different coverage, among them one without a valid pixel."""
    generator = torch.Generator().manual_seed(seed)
    target = 0.5 + 9.5 * torch.rand(count, 1, side, side, generator=generator)
    pred = target * (0.3 * torch.randn(count, 1, side, side, generator=generator)).exp()
    valid = torch.ones(count, 1, side, side, dtype=torch.bool)
    for image in range(count):
        valid[image, :, : image % 4, :] = False
    valid[count // 2] = False
    return pred, torch.where(valid, target, 0.0), valid


def as_floats(result: Any) -> list[float]:
    return [value.item() for value in result.values()] if isinstance(result, dict) else [result.item()]


def measure(metric: Metric, batches: list[tuple[Tensor, Tensor, Tensor]]) -> list[float]:
    for batch in batches:
        metric.update(*batch)
    return as_floats(metric.compute())


def test_image_averaging_is_the_mean_over_measured_images() -> None:
    images = make_images()
    metric = DepthMetrics(silog_lambda=0.5, silog_factor=1.0)
    metric.update(*images)
    expected = depth_metrics(*images, silog_lambda=0.5, silog_factor=1.0)
    result = metric.compute()
    assert tuple(result) == METRIC_NAMES
    for name in METRIC_NAMES:
        assert result[name].item() == pytest.approx(expected[name].nanmean().item(), rel=1e-12)
    assert metric.images.item() == 5


def test_pooled_averaging_is_one_measurement_over_all_pixels() -> None:
    images = make_images()
    metric = DepthMetrics(averaging="pooled", silog_lambda=0.5)
    metric.update(*images)
    pooled = {name: total.sum() for name, total in depth_sums(*images).items()}
    expected = depth_metrics_from_sums(pooled, silog_lambda=0.5)
    assert as_floats(metric.compute()) == pytest.approx([value.item() for value in expected.values()], rel=1e-12)
    by_image = DepthMetrics(silog_lambda=0.5)
    by_image.update(*images)
    assert by_image.compute()["rmse"] != metric.compute()["rmse"]


def test_ssim_is_the_mean_over_measured_images() -> None:
    images = make_images()
    expected = ssim(*images, data_range=10.0).nanmean().item()
    assert measure(DepthSSIM(data_range=10.0), [images]) == pytest.approx([expected], rel=1e-6)


@pytest.mark.parametrize("kind", BUILD)
@given(seed=st.integers(0, 1000), cuts=st.sets(st.integers(1, 5)))
def test_any_partition_into_batches_gives_the_same(kind: str, seed: int, cuts: set[int]) -> None:
    images = make_images(seed)
    edges = [0, *sorted(cuts), 6]
    sizes = [end - start for start, end in itertools.pairwise(edges)]
    batches = list(zip(*(torch.split(tensor, sizes) for tensor in images), strict=True))
    assert measure(BUILD[kind](), batches) == pytest.approx(measure(BUILD[kind](), [images]), rel=1e-12)


@pytest.mark.parametrize("kind", BUILD)
def test_states_of_two_processes_add_up_to_one(kind: str) -> None:
    images = make_images()
    replicas = [BUILD[kind]() for _ in range(2)]
    for rank, replica in enumerate(replicas):
        replica.update(*(tensor[rank::2] for tensor in images))
    merged = BUILD[kind]()
    for name in merged._defaults:
        assert merged._reductions[name] is dim_zero_sum
        setattr(merged, name, getattr(replicas[0], name) + getattr(replicas[1], name))
    merged._update_count = 2
    assert as_floats(merged.compute()) == pytest.approx(measure(BUILD[kind](), [images]), rel=1e-12)


@pytest.mark.parametrize("kind", BUILD)
def test_nothing_measured_is_nan(kind: str) -> None:
    pred, target, valid = make_images()
    assert all(math.isnan(value) for value in measure(BUILD[kind](), [(pred, target, torch.zeros_like(valid))]))


@pytest.mark.parametrize("kind", BUILD)
def test_a_prediction_of_nan_is_not_skipped(kind: str) -> None:
    pred, target, valid = make_images()
    pred[0] = torch.nan
    assert any(math.isnan(value) for value in measure(BUILD[kind](), [(pred, target, valid)]))


@pytest.mark.parametrize("kind", BUILD)
def test_forward_returns_the_batch_and_reset_forgets(kind: str) -> None:
    images, others = make_images(0), make_images(1)
    metric = BUILD[kind]()
    metric.update(*others)
    assert as_floats(metric(*images)) == pytest.approx(measure(BUILD[kind](), [images]), rel=1e-12)
    assert as_floats(metric.compute()) == pytest.approx(measure(BUILD[kind](), [others, images]), rel=1e-12)
    metric.reset()
    assert measure(metric, [images]) == measure(BUILD[kind](), [images])


@pytest.mark.parametrize("kind", BUILD)
def test_copies_and_pickles_carry_their_options_and_states(kind: str) -> None:
    metric, images = BUILD[kind](), make_images()
    expected = measure(metric, [images])
    for other in (copy.deepcopy(metric), metric.clone(), pickle.loads(pickle.dumps(metric))):
        assert as_floats(other.compute()) == expected


@pytest.mark.parametrize("kind", BUILD)
def test_a_half_precision_module_still_accumulates_in_float64(kind: str) -> None:
    images = make_images()
    metric = torch.nn.ModuleList([BUILD[kind]()]).to(torch.bfloat16)[0]
    assert isinstance(metric, Metric)
    assert measure(metric, [images, images]) == pytest.approx(measure(BUILD[kind](), [images, images]), rel=1e-12)


def test_a_collection_names_every_metric_once_under_its_prefix() -> None:
    collection = MetricCollection({"depth": DepthMetrics(), "ssim": DepthSSIM(data_range=10.0)}, prefix="val/")
    collection.update(*make_images())
    result = collection.compute()
    assert set(result) == {f"val/{name}" for name in (*METRIC_NAMES, "ssim")}
    tested = collection.clone(prefix="test/")
    tested.reset()
    tested.update(*make_images(1))
    assert set(tested.compute()) == {f"test/{name}" for name in (*METRIC_NAMES, "ssim")}
    assert collection.compute()["val/rmse"] == result["val/rmse"] != tested.compute()["test/rmse"]


def test_a_collection_keeps_two_averagings_apart() -> None:
    images = make_images()
    collection = MetricCollection({"image": DepthMetrics(), "pooled": DepthMetrics(averaging="pooled")})
    for _ in range(2):
        collection.update(*images)
    result = collection.compute()
    for kind in ("image", "pooled"):
        assert [result[f"{kind}_{name}"].item() for name in METRIC_NAMES] == pytest.approx(
            measure(BUILD[kind](), [images]), rel=1e-12
        )


@pytest.mark.parametrize(
    ("build", "key"),
    [
        (lambda: DepthMetrics(averaging="images"), "metrics.averaging"),
        (lambda: DepthMetrics(silog_lambda=1.5), "metrics.silog_lambda"),
        (lambda: DepthSSIM(data_range=0.0), "metrics.data_range"),
        (lambda: Delta(4), "power"),
    ],
)
def test_bad_options_say_what_to_do(build: Callable[[], Metric], key: str) -> None:
    with pytest.raises(ConfigError, match=f"^{key}: "):
        build()


def test_single_metrics_share_their_states_in_a_collection() -> None:
    images = make_images()
    metrics = {m.name: m for m in (AbsRel(), SqRel(), MSE(), RMSE(), RMSELog(), Log10(), SILog(), MAE())}
    metrics |= {f"delta{power}": Delta(power) for power in (1, 2, 3)}
    collection = MetricCollection(metrics)  # type: ignore[arg-type]
    collection.update(*images)
    collection.update(*make_images(1))
    assert len(collection.compute_groups) == 1
    whole = DepthMetrics()
    whole.update(*images)
    whole.update(*make_images(1))
    assert collection.compute() == whole.compute()
    assert {name: metric.higher_is_better for name, metric in metrics.items()} == {
        name: metric_info(name).higher_is_better for name in METRIC_NAMES
    }


def test_registered_functions_are_validated_where_they_are_defined() -> None:
    pred, target, valid = make_images()

    def worst(pred_m: Tensor, target_m: Tensor, valid: Tensor) -> Tensor:
        return torch.where(valid, (pred_m - target_m).abs(), 0.0).amax(dim=(1, 2, 3))

    metric = FunctionMetric(worst)
    metric.update(pred, target, valid)
    measured = valid.flatten(1).any(dim=1)
    assert metric.compute().item() == pytest.approx(worst(pred, target, valid)[measured].double().mean().item())


def test_images_smaller_than_the_window_say_so() -> None:
    with pytest.raises(ConfigError, match=r"^ssim: a 8 x 8 image has no window of 11 x 11 pixels\."):
        DepthSSIM(data_range=10.0).update(*make_images(side=8))


def move_to_mps(x: Tensor) -> Tensor:
    if x.dtype == torch.float64:
        raise TypeError("Cannot convert a MPS Tensor to float64 dtype as the MPS framework doesn't support float64.")
    return x.clone()


@pytest.mark.parametrize("name", BUILD)
def test_a_device_without_float64(name: str) -> None:
    images = make_images()
    expected = measure(BUILD[name](), [images])
    metric = BUILD[name]()._apply(move_to_mps)
    with without_float64():
        for _ in range(2):  # the second time from the states that a reset leaves
            metric.reset()
            assert measure(metric, [images]) == pytest.approx(expected, rel=1e-5)
