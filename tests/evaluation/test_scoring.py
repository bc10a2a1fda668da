from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from numpy.typing import NDArray
from skimage.metrics import structural_similarity
from torch import Tensor
from torch.nn import functional

from hudepth.base.errors import ConfigError
from hudepth.base.types import Batch
from hudepth.base.verbs import conf_folder
from hudepth.data.sources.base import Record
from hudepth.evaluation.grids import SUM_COLUMNS
from hudepth.evaluation.scoring import BatchScores, BatchTruth, image_table
from hudepth.metrics import catalogue
from hudepth.metrics.depth import METRIC_NAMES
from hudepth.metrics.protocol import Protocol
from hudepth.metrics.summary import ImageTable, summarise
from tests.devices import without_float64

F64 = NDArray[np.float64]
EIGEN: dict[str, Any] = {
    "name": "eigen",
    "resolution": "native",
    "crop": [45, 471, 41, 601],
    "min_depth_m": 1e-3,
    "max_depth_m": 10.0,
    "clamp": True,
}


def make_batch(count: int = 3, *, seed: int = 0, native: tuple[int, int] = (480, 640)) -> tuple[Tensor, Batch]:
    """Return predictions at 24 x 32 [m], some beyond every cap, and a batch with holes and truth beyond 10 m."""
    rng = torch.Generator().manual_seed(seed)
    coarse = 0.3 + 11 * torch.rand(count, 1, 6, 8, generator=rng)
    truth = functional.interpolate(coarse, size=native, mode="bilinear", align_corners=False)
    truth[:, :, 100:130, 200:260] = 0  # unmeasured
    truth[:, :, ::37, ::41] = 0
    small = functional.interpolate(truth, size=(24, 32), mode="nearest")
    pred_m = small * (1 + 0.4 * torch.randn(small.shape, generator=rng)) - 0.2
    batch = Batch(
        image=torch.zeros(count, 3, 24, 32),
        unit_depth=(small / 10).clamp(max=1),
        valid=small > 0,
        index=torch.arange(count),
        native_depth=list(truth),
    )
    assert pred_m.min() < 0
    assert pred_m.max() > 10
    assert truth.max() > 10
    return pred_m, batch


def oracle(p: F64, t: F64, *, silog_lambda: float = 1.0, silog_factor: float = 100.0) -> dict[str, float]:
    """Metrics of the pixels given, as the field writes them down."""
    positive = np.maximum(p, 1e-3)
    log = np.log(positive) - np.log(t)
    # in single precision, as the field's scripts have it: in double a pixel in a million lies on the other side
    single_p, single_t = positive.astype(np.float32), t.astype(np.float32)
    worse = np.maximum(single_p / single_t, single_t / single_p)
    return {
        "abs_rel": np.mean(np.abs(p - t) / t),
        "sq_rel": np.mean((p - t) ** 2 / t),
        "mse": np.mean((p - t) ** 2),
        "rmse": np.sqrt(np.mean((p - t) ** 2)),
        "rmse_log": np.sqrt(np.mean(log**2)),
        "log10": np.mean(np.abs(np.log10(positive) - np.log10(t))),
        "silog": silog_factor * np.sqrt(np.mean(log**2) - silog_lambda * np.mean(log) ** 2),
        "mae": np.mean(np.abs(p - t)),
        "delta1": np.mean(worse < 1.25),
        "delta2": np.mean(worse < 1.25**2),
        "delta3": np.mean(worse < 1.25**3),
    }


def score(protocol: Protocol, pred_m: Tensor, batch: Batch) -> Tensor:
    return BatchScores(pred_m, BatchTruth(batch, max_depth_m=10.0)).sums(protocol)


def table(protocol: Protocol, sums: Tensor) -> ImageTable:
    return image_table(protocol, sums, [Record(id=str(i), scene="", frame=i) for i in range(len(sums))])


def each_image(protocol: Protocol, sums: Tensor) -> dict[str, NDArray[np.float64]]:
    return table(protocol, sums).values


def summarised(protocol: Protocol, sums: Tensor) -> dict[str, float]:
    return summarise(
        table(protocol, sums), averaging=protocol.averaging,
        silog_lambda=protocol.silog_lambda, silog_factor=protocol.silog_factor,
    )  # fmt: skip


def eigen_pixels(pred_m: Tensor, batch: Batch) -> list[tuple[F64, F64]]:
    """Prediction and truth of the pixels that count, image by image, by the text of the usual NYU benchmark."""
    pixels = []
    for pred, native in zip(pred_m, batch["native_depth"], strict=True):
        full = functional.interpolate(pred[None], size=(480, 640), mode="bilinear", align_corners=False)[0, 0]
        p = np.clip(full.double().numpy(), 1e-3, 10)
        t = native[0].double().numpy()
        counts = np.zeros((480, 640), dtype=bool)
        counts[45:471, 41:601] = True
        counts &= (t > 1e-3) & (t < 10)
        pixels.append((p[counts], t[counts]))
    return pixels


def test_eigen_protocol() -> None:
    pred_m, batch = make_batch(4)
    protocol = Protocol(**EIGEN)
    sums = score(protocol, pred_m, batch)
    pixels = eigen_pixels(pred_m, batch)
    each = [oracle(p, t) for p, t in pixels]
    assert sums[:, 0].tolist() == [len(p) for p, _ in pixels]
    per_image, summary = each_image(protocol, sums), summarised(protocol, sums)
    for name in METRIC_NAMES:
        assert per_image[name].tolist() == pytest.approx([one[name] for one in each], rel=1e-6), name
        assert summary[name] == pytest.approx(np.mean([one[name] for one in each]), rel=1e-6), name


def test_eigen_protocol_is_what_the_configuration_says() -> None:
    files = [conf_folder() / name for name in ("base/protocol.yaml", "protocol/eigen.yaml")]
    base, own = (yaml.safe_load(file.read_text(encoding="utf-8")) for file in files)
    options = {**base, **own}
    assert options.pop("defaults") == ["/base/protocol@_here_", "_self_"]
    assert options.pop("_target_") == "hudepth.metrics.protocol.Protocol"
    pred_m, batch = make_batch()
    ours, theirs = Protocol(**EIGEN), Protocol(**options)
    assert theirs.stamp() == ours.stamp()
    expected = score(ours, pred_m, batch)
    assert torch.equal(score(theirs, pred_m, batch), expected)


def test_pooled_averaging() -> None:
    pred_m, batch = make_batch()
    options = {**EIGEN, "averaging": "pooled", "silog_lambda": 0.5, "silog_factor": 1.0}
    summary = summarised(Protocol(**options), score(Protocol(**options), pred_m, batch))
    p, t = (np.concatenate(side) for side in zip(*eigen_pixels(pred_m, batch), strict=True))
    expected = oracle(p, t, silog_lambda=0.5, silog_factor=1.0)
    for name in METRIC_NAMES:
        assert summary[name] == pytest.approx(expected[name], rel=1e-5), name
    per_image = summarised(Protocol(**EIGEN), score(Protocol(**EIGEN), pred_m, batch))
    assert summary["abs_rel"] != pytest.approx(per_image["abs_rel"], rel=1e-4)


def test_network_resolution() -> None:
    pred_m, batch = make_batch()
    protocol = Protocol(name="paper")
    summary = summarised(protocol, score(protocol, pred_m, batch))
    each = []
    for pred, unit, valid in zip(pred_m, batch["unit_depth"], batch["valid"], strict=True):
        each.append(oracle(pred[valid].double().numpy(), 10 * unit[valid].double().numpy()))
    for name in METRIC_NAMES:
        assert summary[name] == pytest.approx(np.mean([one[name] for one in each]), rel=1e-5), name


def test_ssim_of_an_image_without_holes() -> None:
    pred_m, batch = make_batch(1, native=(480, 640))
    batch["valid"] = torch.ones_like(batch["valid"])
    truth = batch["unit_depth"] = (batch["unit_depth"] + 0.1).clamp(max=1)
    sums = score(Protocol(name="x", ssim_data_range_m=7.0), pred_m, batch)
    images = (pred_m[0, 0].double().numpy(), 10 * truth[0, 0].double().numpy())
    expected = structural_similarity(
        *images, data_range=7.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert SUM_COLUMNS[-1] == "ssim"
    assert sums[0, -1].item() == pytest.approx(expected, abs=1e-6)
    for other in (Protocol(name="x"), Protocol(name="x", ssim_data_range_m=7.0, ssim_window=7)):
        assert score(other, pred_m, batch)[0, -1].item() != pytest.approx(expected, abs=1e-3)


def test_only_what_lies_in_the_crop_counts() -> None:
    pred_m, batch = make_batch()
    protocol = Protocol(name="x", crop=[10, 20, 8, 30], crop_size=[24, 32], ssim_window=3)
    before = score(protocol, pred_m, batch)
    inside = torch.zeros_like(pred_m, dtype=torch.bool)
    inside[..., 10:20, 8:30] = True
    for outside in (77.0, math.inf, math.nan):
        after = score(protocol, torch.where(inside, pred_m, outside), batch)
        torch.testing.assert_close(before[:, :-1], after[:, :-1], rtol=1e-6, atol=1e-4)
    assert before[:, 0].tolist() == (batch["valid"] & inside).sum(dim=(1, 2, 3)).tolist()


def exact_batch(*depths_m: float) -> tuple[Tensor, Batch]:
    truth = torch.tensor(depths_m).reshape(1, 1, 1, -1).repeat(1, 1, 11, 11)
    batch = Batch(
        image=torch.zeros(1, 3, *truth.shape[-2:]),
        unit_depth=truth / 10,
        valid=truth > 0,
        index=torch.tensor([0]),
        native_depth=[truth[0]],
    )
    return torch.full_like(truth, 2.0), batch


def test_the_range_that_counts_excludes_both_ends() -> None:
    pred_m, batch = exact_batch(0.0, 1e-3, 1.5e-3, 5.0, 9.999, 10.0, 12.0)
    options = {**EIGEN, "crop": None}
    assert score(Protocol(**options), pred_m, batch)[0, 0] == 3 * 121
    options["max_depth_m"] = None
    assert score(Protocol(**options), pred_m, batch)[0, 0] == 5 * 121
    options["min_depth_m"] = 0.0
    assert score(Protocol(**options), pred_m, batch)[0, 0] == 6 * 121


@pytest.mark.parametrize(("clamp", "mae"), [(True, 5.0), (False, 22.0)])
def test_clamping_is_an_option(clamp: bool, mae: float) -> None:
    _, batch = exact_batch(5.0)
    protocol = Protocol(**{**EIGEN, "crop": None, "clamp": clamp})
    sums = score(protocol, torch.full((1, 1, 11, 11), 27.0), batch)
    assert summarised(protocol, sums)["mae"] == pytest.approx(mae)


def test_a_perfect_prediction() -> None:
    _, batch = make_batch()
    protocol = Protocol(name="paper")
    summary = summarised(protocol, score(protocol, batch["unit_depth"] * 10, batch))
    for name in ("abs_rel", "sq_rel", "mse", "rmse", "rmse_log", "log10", "silog", "mae"):
        assert summary[name] == 0
    assert [summary[name] for name in ("delta1", "delta2", "delta3", "ssim")] == pytest.approx([1, 1, 1, 1])


# --- images of which nothing counts -----------------------------------------------------------------------------


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_images_without_a_valid_pixel_are_skipped(averaging: str) -> None:
    pred_m, batch = make_batch(3)
    protocol = Protocol(name="x", averaging=averaging)
    kept = score(protocol, pred_m[[0, 2]], _only(batch, [0, 2]))
    batch["valid"][1] = False
    sums = score(protocol, pred_m, batch)
    assert sums[1, 0] == 0
    assert summarised(protocol, sums) == summarised(protocol, kept)
    assert all(np.isnan(values[1]) for values in each_image(protocol, sums).values())


def _only(batch: Batch, rows: list[int]) -> Batch:
    return Batch(
        image=batch["image"][rows],
        unit_depth=batch["unit_depth"][rows],
        valid=batch["valid"][rows].clone(),
        index=batch["index"][rows],
    )


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_a_prediction_that_is_nan_is_not_skipped(averaging: str) -> None:
    """A network that answers one image in ten with NaN must not be scored on the other nine."""
    pred_m, batch = make_batch(3)
    pred_m[1, :, 5, 5] = math.nan
    assert batch["valid"][1, 0, 5, 5]
    for clamp in (False, True):
        protocol = Protocol(name="x", averaging=averaging, max_depth_m=20.0, clamp=clamp)
        summary = summarised(protocol, score(protocol, pred_m, batch))
        assert all(math.isnan(summary[name]) for name in ("abs_rel", "rmse", "silog", "log10", "mae"))


def test_an_image_without_a_whole_window_has_no_ssim_but_counts() -> None:
    pred_m, batch = make_batch(2)
    batch["valid"][0, :, ::5] = False
    protocol = Protocol(name="x", ssim_window=7)
    sums = score(protocol, pred_m, batch)
    assert sums[0, -1].isnan()
    assert not sums[1, -1].isnan()
    assert summarised(protocol, sums)["ssim"] == sums[1, -1].item()
    assert math.isfinite(summarised(protocol, sums)["abs_rel"])


def test_a_store_without_native_truth() -> None:
    pred_m, batch = make_batch()
    with pytest.raises(ConfigError) as caught:
        score(Protocol(**EIGEN), pred_m, _only(batch, [0, 1, 2]))
    assert str(caught.value) == (
        "protocol=eigen scores at native resolution, which this store was prepared without. "
        "Pass data.native=true, or protocol=paper."
    )


def test_truths_of_different_sizes() -> None:
    pred_m, batch = make_batch(2)
    other = make_batch(1, seed=3, native=(360, 500))[1]["native_depth"][0]
    batch["native_depth"] = [batch["native_depth"][0], other]
    sums = score(Protocol(**EIGEN), pred_m, batch)
    counted = (other[0, 34:353, 32:470] > 1e-3) & (other[0, 34:353, 32:470] < 10)
    assert sums[1, 0].item() == counted.sum().item()


MEASURED: dict[str, Any] = {"valid": "measured", "min_depth_m": 0.5, "max_depth_m": 5.0}
LEAST_SQUARES: dict[str, Any] = {**MEASURED, "alignment": "least_squares"}


@pytest.mark.parametrize(
    "several",
    [
        [
            {"alignment": "median", "crop": [0, 20, 0, 20]},
            {"alignment": "median", "crop": [0, 20, 0, 20], "crop_size": None},
        ],
        [
            {**MEASURED, "clamp": True},
            {**LEAST_SQUARES, "clamp": True},
            LEAST_SQUARES,
        ],
        [LEAST_SQUARES, {**LEAST_SQUARES, "valid": "closed"}, {**LEAST_SQUARES, "alignment": "affine_inverse"}],
    ],
)
def test_protocols_in_one_pass_say_what_each_says_alone(several: list[dict[str, Any]]) -> None:
    pred_m, batch = make_batch(1)
    pred_m = pred_m.clamp(0.5, 5.0)  # so that clamping changes nothing, unless after alignment
    protocols = [Protocol(name=f"p{i}", **options) for i, options in enumerate(several)]
    together = BatchScores(pred_m, BatchTruth(batch, max_depth_m=10.0))
    alone = [score(protocol, pred_m, batch) for protocol in protocols]
    assert not torch.equal(alone[-2], alone[-1])
    for protocol, expected in zip(protocols, alone, strict=True):
        torch.testing.assert_close(together.sums(protocol), expected, rtol=0, atol=0, equal_nan=True)


def test_an_image_of_which_the_crop_leaves_nothing_is_left_out() -> None:
    pred_m, batch = make_batch(1)
    protocol = Protocol(name="x", crop=[0, 1, 0, 640])
    scores = BatchScores(pred_m, BatchTruth(batch, max_depth_m=10.0))
    assert scores.sums(protocol)[0, 0] == 0
    assert scores.boundary(protocol).isnan().all()
    assert scores.strata(protocol).sum() == 0


def test_a_registered_metric_becomes_a_column(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalogue, "_CATALOGUE", {**catalogue._CATALOGUE})
    monkeypatch.setattr(catalogue, "_FUNCTIONS", {})
    catalogue.register(
        catalogue.MetricInfo("bias", "this test", unit="m", shown="narrow"),
        lambda pred, target, valid: torch.where(valid, pred - target, 0.0).sum((1, 2, 3)) / valid.sum((1, 2, 3)),
    )
    truth = torch.full((2, 1, 32, 32), 0.2)
    batch = Batch(image=torch.zeros(2, 3, 32, 32), unit_depth=truth, valid=truth > 0, index=torch.arange(2))
    batch["valid"][1] = False
    protocol = Protocol(name="x")
    scores = BatchScores(truth * 10 + 0.5, BatchTruth(batch, max_depth_m=10.0))
    records = [Record(id=str(i), scene="", frame=i) for i in range(2)]
    values = image_table(protocol, scores.sums(protocol), records).values["bias"]
    assert values[0] == pytest.approx(0.5)
    assert np.isnan(values[1])
    assert "bias" in catalogue.metric_names("narrow")


@pytest.mark.parametrize("alignment", ["none", "median", "least_squares"])
def test_a_device_without_float64(alignment: str) -> None:
    pred_m, batch = make_batch()
    protocol = Protocol(**EIGEN, alignment=alignment)

    def everything() -> list[Tensor]:
        scores = BatchScores(pred_m, BatchTruth(batch, max_depth_m=10.0))
        return [scores.sums(protocol), scores.boundary(protocol), scores.strata(protocol)]

    expected = everything()
    with without_float64():
        results = everything()
    for result, right in zip(results, expected, strict=True):
        torch.testing.assert_close(result.double(), right, rtol=1e-4, atol=1e-4, equal_nan=True)
