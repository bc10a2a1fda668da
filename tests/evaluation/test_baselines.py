from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch.nn import functional

from hudepth.base.normalise import normalise_image
from hudepth.data.store import DepthStore
from hudepth.evaluation.baselines import ConstantDepth, NearestFrame, descriptor, trivial_baselines


def test_constant_depth_answers_every_image_alike() -> None:
    unit_depth = torch.rand(1, 1, 4, 6)
    baseline = ConstantDepth(unit_depth)
    for count in (1, 3):
        answer = baseline(torch.randn(count, 3, 4, 6))
        assert answer.shape == (count, 1, 4, 6)
        assert all(torch.equal(one[None], unit_depth) for one in answer)
    assert list(baseline.parameters()) == []
    assert baseline.to(torch.float64)(torch.zeros(1, 3, 4, 6)).dtype == torch.float64  # it moves as networks do


class FakeStore(DepthStore):
    """Truth that is made up, in the form in which a depth store gives it."""

    def __init__(self, stored_depth: np.ndarray) -> None:
        self.per_m = 1000
        self.stored_depth, self.size = stored_depth, stored_depth.shape[1:]  # no file is opened
        self.images = np.random.default_rng(0).integers(0, 256, (*stored_depth.shape, 3)).astype(np.uint8)

    def read(self, indices: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        return self.images[list(indices)], self.stored_depth[list(indices)]


@pytest.mark.parametrize("pairs", [1, 63, 64, 65, 200])
def test_trivial_baselines(pairs: int) -> None:
    rng = np.random.default_rng(pairs)
    stored_depth = rng.integers(500, 15_000, (pairs + 7, 5, 4)).astype(np.uint16)
    stored_depth[rng.random(stored_depth.shape) < 0.3] = 0
    stored_depth[:, 2, 1] = 0  # measured in no training image
    train = rng.permutation(pairs + 7)[:pairs].tolist()
    stored_depth[[i for i in range(pairs + 7) if i not in train]] = 1  # what must not be looked at
    store = FakeStore(stored_depth)
    made = trivial_baselines(store, train, max_depth_m=8.0)
    assert list(made) == ["nearest_frame", "mean_depth_map", "mean_depth"]

    metres = np.where(stored_depth[train] == 0, np.nan, np.minimum(stored_depth[train] / 1000, 8.0))
    mean = np.nanmean(metres)
    counted = (~np.isnan(metres)).sum(axis=0)
    mean_map = np.where(counted > 0, np.nansum(metres, axis=0) / np.maximum(counted, 1), mean)
    images = normalise_image(torch.from_numpy(store.images).permute(0, 3, 1, 2) / 255)
    answers = {name: (8 * net(images[:1]))[0, 0].numpy() for name, net in made.items()}
    np.testing.assert_allclose(answers["mean_depth"], np.full((5, 4), mean), rtol=1e-6)
    np.testing.assert_allclose(answers["mean_depth_map"], mean_map, rtol=1e-6)

    alike = made["nearest_frame"](images)  # a training image is most like itself
    for position, index in enumerate(train):
        expected = np.where(stored_depth[index] == 0, mean_map, np.minimum(stored_depth[index] / 1000, 8.0))
        np.testing.assert_allclose(8 * alike[index, 0].numpy(), expected, rtol=1e-6)
        assert made["nearest_frame"].nearest(images[index : index + 1]) == [train[position]]


def test_the_nearest_frame_against_numpy() -> None:
    rng = np.random.default_rng(0)
    store = FakeStore(rng.integers(500, 9000, (40, 23, 31)).astype(np.uint16))
    train, test = list(range(5, 40)), list(range(5))
    made = trivial_baselines(store, train, max_depth_m=10.0)
    nearest = made["nearest_frame"]
    assert isinstance(nearest, NearestFrame)
    normal = normalise_image(torch.from_numpy(store.images).permute(0, 3, 1, 2) / 255)
    thumbnails = functional.adaptive_avg_pool2d(normal, (10, 10)).flatten(1).double().numpy()
    distance = np.square(thumbnails[test][:, None] - thumbnails[train][None]).sum(-1)
    assert nearest.nearest(normal[test]) == [train[i] for i in distance.argmin(axis=1)]


def test_a_descriptor_does_not_depend_on_the_size() -> None:
    image = torch.rand(2, 3, 10, 10)
    large = image.repeat_interleave(4, dim=2).repeat_interleave(4, dim=3)
    torch.testing.assert_close(descriptor(image), descriptor(large))
    assert descriptor(image).shape == (2, 300)
