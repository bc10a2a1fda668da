"""Scale of each image and what remains of its error, against numpy."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from hudepth.metrics.scale import median, scale_errors
from hudepth.metrics.summary import ImageTable, summarise


@given(st.integers(0, 500), st.integers(1, 4), st.integers(1, 8), st.integers(1, 8))
def test_each_image_against_numpy(seed: int, images: int, height: int, width: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.5, 10, (images, 1, height, width))
    pred = truth * rng.lognormal(0, 0.5, truth.shape)
    valid = rng.random(truth.shape) < 0.7
    found = scale_errors(*(torch.from_numpy(each) for each in (pred, truth, valid))).numpy()
    for row, p, t, mask in zip(found, pred, truth, valid, strict=True):
        p, t = p[mask], t[mask]
        if not p.size:
            assert np.isnan(row).all()
            continue
        scale = np.median(t) / np.median(p)  # as Monodepth2's evaluate_depth.py has it
        np.testing.assert_allclose(row, [np.log(scale), np.mean(np.abs(scale * p - t) / t)], rtol=1e-9, atol=1e-12)


def test_a_scale_alone_leaves_no_error_within_the_image() -> None:
    truth = torch.rand(3, 1, 6, 7, dtype=torch.float64) + 0.5
    factor = torch.tensor([0.5, 1.0, 3.0], dtype=torch.float64)
    found = scale_errors(truth * factor[:, None, None, None], truth, torch.ones_like(truth, dtype=torch.bool))
    torch.testing.assert_close(found[:, 0], -factor.log())
    assert found[:, 1].max() < 1e-12


def test_without_a_scale_they_are_undefined() -> None:
    truth = torch.ones(3, 1, 2, 2)
    pred = torch.stack([truth[0] * 0, truth[1] * torch.nan, -truth[2]])
    assert scale_errors(pred, truth, truth > 0).isnan().all()


@given(st.lists(st.floats(-9, 9, width=32), min_size=1, max_size=9))
def test_median_is_numpys(values: list[float]) -> None:
    assert median(torch.tensor(values)).item() == np.median(np.float32(values))


def test_of_a_set() -> None:
    rng = np.random.default_rng(0)
    pixels = np.array([10, 0, 30, 7])
    rmse, log_scale = rng.uniform(0.2, 2, 4), rng.normal(0.1, 0.3, 4)
    log_scale[1] = rmse[1] = np.nan
    table = ImageTable(list("abcd"), ["s"] * 4, [""] * 4, pixels, {"rmse": rmse, "log_scale": log_scale})
    kept = [0, 2, 3]
    for averaging in ("image", "pooled"):
        found = summarise(table, averaging=averaging)
        assert "log_scale" not in found
        np.testing.assert_allclose(found["scale_sd"], np.std(log_scale[kept]), rtol=1e-9)
        pooled = np.sqrt(np.sum(pixels[kept] * rmse[kept] ** 2) / pixels.sum())
        np.testing.assert_allclose(found["rmse_pooled"], pooled, rtol=1e-12)
        np.testing.assert_allclose(found["rmse"], pooled if averaging == "pooled" else rmse[kept].mean(), rtol=1e-12)
