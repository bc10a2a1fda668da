from __future__ import annotations

import dataclasses
import json
import math
from importlib import resources
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from skimage.metrics import structural_similarity
from torch import Tensor
from torch.nn import functional

from hudepth.errors import ConfigError
from hudepth.metrics.depth import METRIC_NAMES
from hudepth.metrics.protocol import SUM_COLUMNS, Protocol
from hudepth.types import Batch

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
    worse = np.maximum(positive / t, t / positive)
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
    pred_m, batch = make_batch()
    protocol = Protocol(**EIGEN)
    sums = protocol.score(pred_m, batch, max_depth_m=10.0)
    each = [oracle(p, t) for p, t in eigen_pixels(pred_m, batch)]
    assert sums[:, 0].tolist() == [len(p) for p, _ in eigen_pixels(pred_m, batch)]
    per_image, summary = protocol.per_image(sums), protocol.summary(sums)
    for name in METRIC_NAMES:
        assert per_image[name].tolist() == pytest.approx([one[name] for one in each], rel=1e-5), name
        assert summary[name] == pytest.approx(np.mean([one[name] for one in each]), rel=1e-5), name


def test_eigen_protocol_is_what_the_configuration_says() -> None:
    text = resources.files("hudepth.conf").joinpath("protocol/eigen.yaml").read_text(encoding="utf-8")
    options = yaml.safe_load(text)
    assert options.pop("_target_") == "hudepth.metrics.protocol.Protocol"
    pred_m, batch = make_batch()
    ours, theirs = Protocol(**EIGEN), Protocol(**options)
    assert theirs.stamp() == ours.stamp()
    expected = ours.score(pred_m, batch, max_depth_m=10.0)
    assert torch.equal(theirs.score(pred_m, batch, max_depth_m=10.0), expected)


def test_pooled_averaging() -> None:
    pred_m, batch = make_batch()
    options = {**EIGEN, "averaging": "pooled", "silog_lambda": 0.5, "silog_factor": 1.0}
    summary = Protocol(**options).summary(Protocol(**options).score(pred_m, batch, max_depth_m=10.0))
    p, t = (np.concatenate(side) for side in zip(*eigen_pixels(pred_m, batch), strict=True))
    expected = oracle(p, t, silog_lambda=0.5, silog_factor=1.0)
    for name in METRIC_NAMES:
        assert summary[name] == pytest.approx(expected[name], rel=1e-5), name
    per_image = Protocol(**EIGEN).summary(Protocol(**EIGEN).score(pred_m, batch, max_depth_m=10.0))
    assert summary["abs_rel"] != pytest.approx(per_image["abs_rel"], rel=1e-4)


def test_network_resolution() -> None:
    pred_m, batch = make_batch()
    protocol = Protocol(name="paper")
    summary = protocol.summary(protocol.score(pred_m, batch, max_depth_m=10.0))
    each = []
    for pred, unit, valid in zip(pred_m, batch["unit_depth"], batch["valid"], strict=True):
        each.append(oracle(pred[valid].double().numpy(), 10 * unit[valid].double().numpy()))
    for name in METRIC_NAMES:
        assert summary[name] == pytest.approx(np.mean([one[name] for one in each]), rel=1e-5), name


def test_ssim_of_an_image_without_holes() -> None:
    pred_m, batch = make_batch(1, native=(480, 640))
    batch["valid"] = torch.ones_like(batch["valid"])
    truth = batch["unit_depth"] = (batch["unit_depth"] + 0.1).clamp(max=1)
    score = Protocol(name="x", ssim_data_range_m=7.0).score(pred_m, batch, max_depth_m=10.0)
    images = (pred_m[0, 0].double().numpy(), 10 * truth[0, 0].double().numpy())
    expected = structural_similarity(
        *images, data_range=7.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert SUM_COLUMNS[-1] == "ssim"
    assert score[0, -1].item() == pytest.approx(expected, abs=1e-6)
    for other in (Protocol(name="x"), Protocol(name="x", ssim_data_range_m=7.0, ssim_window=7)):
        assert other.score(pred_m, batch, max_depth_m=10.0)[0, -1].item() != pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("size", "rows", "columns"),
    [
        ((480, 640), (45, 471), (41, 601)),
        ((240, 320), (22, 236), (20, 300)),
        ((224, 224), (21, 220), (14, 210)),
        ((960, 1280), (90, 942), (82, 1202)),
        ((24, 32), (2, 24), (2, 30)),
    ],
)
def test_crop_is_scaled(size: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]) -> None:
    protocol = Protocol(**EIGEN)
    assert protocol.window(*size) == (slice(*rows), slice(*columns))
    assert Protocol(name="x").window(*size) == (slice(None), slice(None))


@given(st.integers(16, 1000), st.integers(16, 1000))
def test_crop_stays_inside_and_covers_its_share(height: int, width: int) -> None:
    rows, columns = Protocol(**EIGEN).window(height, width)
    assert 0 <= rows.start < rows.stop <= height
    assert 0 <= columns.start < columns.stop <= width
    assert (rows.stop - rows.start) / height == pytest.approx(426 / 480, abs=1 / height)
    assert (columns.stop - columns.start) / width == pytest.approx(560 / 640, abs=1 / width)


def test_only_what_lies_in_the_crop_counts() -> None:
    pred_m, batch = make_batch()
    protocol = Protocol(name="x", crop=[10, 20, 8, 30], crop_size=[24, 32], ssim_window=3)
    before = protocol.score(pred_m, batch, max_depth_m=10.0)
    inside = torch.zeros_like(pred_m, dtype=torch.bool)
    inside[..., 10:20, 8:30] = True
    after = protocol.score(torch.where(inside, pred_m, 77.0), batch, max_depth_m=10.0)
    assert torch.equal(before[:, :-1], after[:, :-1])
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
    assert Protocol(**options).score(pred_m, batch, max_depth_m=10.0)[0, 0] == 3 * 121
    options["max_depth_m"] = None
    assert Protocol(**options).score(pred_m, batch, max_depth_m=10.0)[0, 0] == 5 * 121
    options["min_depth_m"] = 0.0
    assert Protocol(**options).score(pred_m, batch, max_depth_m=10.0)[0, 0] == 6 * 121


@pytest.mark.parametrize(("clamp", "mae"), [(True, 5.0), (False, 22.0)])
def test_clamping_is_an_option(clamp: bool, mae: float) -> None:
    _, batch = exact_batch(5.0)
    protocol = Protocol(**{**EIGEN, "crop": None, "clamp": clamp})
    score = protocol.score(torch.full((1, 1, 11, 11), 27.0), batch, max_depth_m=10.0)
    assert protocol.summary(score)["mae"] == pytest.approx(mae)


def test_a_perfect_prediction() -> None:
    _, batch = make_batch()
    protocol = Protocol(name="paper")
    summary = protocol.summary(protocol.score(batch["unit_depth"] * 10, batch, max_depth_m=10.0))
    for name in ("abs_rel", "sq_rel", "mse", "rmse", "rmse_log", "log10", "silog", "mae"):
        assert summary[name] == 0
    assert [summary[name] for name in ("delta1", "delta2", "delta3", "ssim")] == pytest.approx([1, 1, 1, 1])


# --- images of which nothing counts -----------------------------------------------------------------------------


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_images_without_a_valid_pixel_are_skipped(averaging: str) -> None:
    pred_m, batch = make_batch(3)
    protocol = Protocol(name="x", averaging=averaging)
    kept = protocol.score(pred_m[[0, 2]], _only(batch, [0, 2]), max_depth_m=10.0)
    batch["valid"][1] = False
    sums = protocol.score(pred_m, batch, max_depth_m=10.0)
    assert sums[1, 0] == 0
    assert protocol.summary(sums) == protocol.summary(kept)
    assert all(values[1].isnan() for values in protocol.per_image(sums).values())


def _only(batch: Batch, rows: list[int]) -> Batch:
    return Batch(
        image=batch["image"][rows],
        unit_depth=batch["unit_depth"][rows],
        valid=batch["valid"][rows].clone(),
        index=batch["index"][rows],
    )


def test_no_pixel_of_any_image() -> None:
    pred_m, batch = make_batch(3)
    batch["valid"][:] = False
    protocol = Protocol(name="mine")
    with pytest.raises(ConfigError) as caught:
        protocol.summary(protocol.score(pred_m, batch, max_depth_m=10.0))
    assert str(caught.value) == "protocol=mine: no pixel of 3 images counts; look at its crop and caps."


@pytest.mark.parametrize("averaging", ["image", "pooled"])
def test_a_prediction_that_is_nan_is_not_skipped(averaging: str) -> None:
    """A network that answers one image in ten with NaN must not be scored on the other nine."""
    pred_m, batch = make_batch(3)
    pred_m[1, :, 5, 5] = math.nan
    assert batch["valid"][1, 0, 5, 5]
    for clamp in (False, True):
        protocol = Protocol(name="x", averaging=averaging, max_depth_m=20.0, clamp=clamp)
        summary = protocol.summary(protocol.score(pred_m, batch, max_depth_m=10.0))
        assert all(math.isnan(summary[name]) for name in ("abs_rel", "rmse", "silog", "log10", "mae"))


def test_an_image_without_a_whole_window_has_no_ssim_but_counts() -> None:
    pred_m, batch = make_batch(2)
    batch["valid"][0, :, ::5] = False
    protocol = Protocol(name="x", ssim_window=7)
    sums = protocol.score(pred_m, batch, max_depth_m=10.0)
    assert sums[0, -1].isnan()
    assert not sums[1, -1].isnan()
    assert protocol.summary(sums)["ssim"] == sums[1, -1].item()
    assert math.isfinite(protocol.summary(sums)["abs_rel"])


def test_a_store_without_native_truth() -> None:
    pred_m, batch = make_batch()
    with pytest.raises(ConfigError) as caught:
        Protocol(**EIGEN).score(pred_m, _only(batch, [0, 1, 2]), max_depth_m=10.0)
    assert str(caught.value) == (
        "protocol=eigen scores at native resolution, which this store was prepared without. "
        "Pass data.native=true, or protocol=paper."
    )


def test_truths_of_different_sizes() -> None:
    pred_m, batch = make_batch(2)
    other = make_batch(1, seed=3, native=(360, 500))[1]["native_depth"][0]
    batch["native_depth"] = [batch["native_depth"][0], other]
    sums = Protocol(**EIGEN).score(pred_m, batch, max_depth_m=10.0)
    counted = (other[0, 34:353, 32:470] > 1e-3) & (other[0, 34:353, 32:470] < 10)
    assert sums[1, 0].item() == counted.sum().item()


# --- the stamp --------------------------------------------------------------------------------------------------

CHANGES: dict[str, list[Any]] = {
    "name": ["other"],
    "resolution": ["network"],
    "crop": [None, [45, 471, 41, 600], [44, 471, 41, 601]],
    "crop_size": [[481, 640], [480, 641]],
    "min_depth_m": [0.0, 1.0000001e-3, 2e-3],
    "max_depth_m": [None, 9.0, 10.0000001, 80.0],
    "clamp": [False],
    "averaging": ["pooled"],
    "silog_lambda": [0.5, 0.85],
    "silog_factor": [1.0, 10.0],
    "ssim_data_range_m": [9.0, 10.000001],
    "ssim_window": [7],
    "extra": [{"source": "BTS"}],
}


def test_every_field_has_a_change() -> None:
    assert set(CHANGES) == {field.name for field in dataclasses.fields(Protocol)}


@pytest.mark.parametrize(("field", "value"), [(field, value) for field, values in CHANGES.items() for value in values])
def test_whatever_changes_a_number_changes_the_stamp(field: str, value: object) -> None:
    assert Protocol(**{**EIGEN, field: value}).stamp() != Protocol(**EIGEN).stamp()


@given(
    st.builds(
        Protocol,
        name=st.text(min_size=1),
        resolution=st.sampled_from(["network", "native"]),
        crop=st.none() | st.just((45, 471, 41, 601)),
        min_depth_m=st.floats(0, 1),
        max_depth_m=st.none() | st.floats(1.5, 100),
        clamp=st.booleans(),
        averaging=st.sampled_from(["image", "pooled"]),
        silog_lambda=st.floats(0, 1),
    )
)
def test_a_stamp_is_json(protocol: Protocol) -> None:
    assert json.loads(json.dumps(protocol.stamp(), allow_nan=False)) == protocol.stamp()


def test_the_stamp_of_the_usual_benchmark() -> None:
    assert Protocol(**EIGEN, extra={"averaging": "lie", "source": "BTS"}).stamp() == {
        "name": "eigen",
        "resolution": "native",
        "resize": "bilinear, align_corners=False",
        "crop": [45, 471, 41, 601],
        "crop_size": [480, 640],
        "valid": "measured, 0.001 m < truth < 10 m",
        "clamp_m": [0.001, 10.0],
        "averaging": "image",
        "alignment": "none",
        "test_time_flip": False,
        "silog": {"lambda": 1.0, "factor": 100.0},
        "ssim": {
            "window": 11,
            "sigma": 1.5,
            "data_range_m": 10.0,
            "averaging": "image, windows of valid pixels only",
        },
        "units": {"mae": "m", "rmse": "m", "sq_rel": "m", "mse": "m^2", "others": "1"},
        "source": "BTS",
    }


# --- options out of range ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"resolution": "natve"},
            "protocol.x.resolution: no 'natve'. Did you mean 'native'? Pass one of network, native.",
        ),
        (
            {"averaging": "pool"},
            "protocol.x.averaging: no 'pool'. Did you mean 'pooled'? Pass one of image, pooled.",
        ),
        ({"crop": [1, 2, 3]}, "protocol.x.crop: [1, 2, 3] is not [top,bottom,left,right] within [480, 640]."),
        ({"crop": [9, 9, 0, 9]}, "protocol.x.crop: [9, 9, 0, 9] is not [top,bottom,left,right] within [480, 640]."),
        ({"crop": [-9, 9, 0, 9]}, "protocol.x.crop: [-9, 9, 0, 9] is not [top,bottom,left,right] within [480, 640]."),
        (
            {"crop": [0, 300, 0, 320], "crop_size": [240, 320]},
            "protocol.x.crop: [0, 300, 0, 320] is not [top,bottom,left,right] within [240, 320].",
        ),
        ({"crop_size": [480]}, "protocol.x.crop_size: [480] is not [height,width]."),
        ({"min_depth_m": -0.1}, "protocol.x.min_depth_m: -0.1 is negative."),
        ({"min_depth_m": 3.0, "max_depth_m": 2.0}, "protocol.x.max_depth_m: 2.0 is not above min_depth_m."),
        ({"silog_lambda": 1.5}, "protocol.x.silog_lambda: 1.5 is not in [0, 1]."),
        ({"ssim_window": 0}, "protocol.x: ssim_data_range_m and ssim_window must be positive."),
        ({"ssim_data_range_m": 0.0}, "protocol.x: ssim_data_range_m and ssim_window must be positive."),
    ],
)
def test_options_out_of_range(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Protocol(name="x", **options)
    assert str(caught.value) == message
