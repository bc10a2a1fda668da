"""NYU Depth V2 as a plain PyTorch data set, in both its forms."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from torch.utils.data import DataLoader

from hudepth.base.errors import ConfigError, DataError
from hudepth.data import NYUDepth
from hudepth.data.sources import nyu
from tests.data.sources.test_nyu_mat import DEPTHS, IMAGES, write_mat


@pytest.fixture
def labelled(tmp_path: Path) -> Path:
    """Ten scenes of two pairs, the last one for test; depth is (value + 1) * 0.05 m."""
    rows = ["index,image,depth,scene,split,depth_scale_m,depth_offset"]
    for i in range(20):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((12, 16, 3), 10 * i, np.uint8))
        depth = np.full((12, 16), 6 * i, np.uint8)
        depth[0] = 255
        cv2.imwrite(str(tmp_path / f"d{i}.png"), depth)
        rows.append(f"{i},{i}.png,d{i}.png,room_{i // 2:04d},{'test' if i >= 18 else 'train'},0.05,1")
    (tmp_path / "index.csv").write_text("\n".join(rows))
    return tmp_path


def test_samples_of_the_labelled_set(labelled: Path) -> None:
    subsets = {split: NYUDepth(labelled, split) for split in ("train", "val", "test")}
    ids = [{record.id for record in subset.records} for subset in subsets.values()]
    assert sorted(set.union(*ids)) == [f"{i:05d}" for i in range(20)]
    assert ids[2] == {"00018", "00019"}
    scenes = [{record.scene for record in subset.records} for subset in subsets.values()]
    assert not scenes[0] & scenes[1]
    sample = subsets["test"][0]
    assert sample["image"].shape == (3, 12, 16)
    assert sample["depth"].shape == sample["valid"].shape == (1, 12, 16)
    torch.testing.assert_close(sample["image"][:, 3, 3], torch.full((3,), 180 / 255))
    assert not sample["valid"][0, 0].any()  # 12.8 m is beyond max_depth_m
    assert sample["valid"][0, 1:].all()
    assert sample["depth"][0, 5, 5].item() == pytest.approx(5.45)
    assert (sample["id"], sample["scene"]) == ("00018", "room_0009")


def test_size_and_batches(labelled: Path) -> None:
    batch = next(iter(DataLoader(NYUDepth(labelled, "test", size=8, max_depth_m=20.0), batch_size=2)))
    assert batch["image"].shape == (2, 3, 8, 8)
    assert batch["depth"].shape == (2, 1, 8, 8)
    assert batch["valid"].all()
    assert batch["scene"] == ["room_0009", "room_0009"]


def test_the_official_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nyu, "COUNT", 3)
    monkeypatch.setattr(nyu, "official_test", lambda: frozenset({1}))
    path = write_mat(tmp_path, scenes=("kitchen_0004", "study_room_0005b", "office_0001"))
    for root in (path, tmp_path):
        sample = NYUDepth(root, "test")[0]
        torch.testing.assert_close(sample["depth"][0], torch.from_numpy(DEPTHS[1]))
        torch.testing.assert_close(sample["image"], torch.from_numpy(IMAGES[1]).permute(2, 0, 1) / 255)


def test_plot(labelled: Path) -> None:
    dataset = NYUDepth(labelled, "test")
    sample = dataset[0]
    figure = dataset.plot(sample)
    assert isinstance(figure, Figure)
    assert [axis.get_title() for axis in figure.axes] == ["Image", "Depth [m]"]
    figure = dataset.plot({**sample, "prediction": sample["depth"]}, title="mine")
    assert len(figure.axes) == 3
    assert figure.get_suptitle() == "mine"


def test_bad_options(labelled: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"split: 'tests'.*Did you mean 'test'"):
        NYUDepth(labelled, "tests")
    with pytest.raises(ConfigError, match="size"):
        NYUDepth(labelled, size=(1, 2, 3))
    with pytest.raises(ConfigError, match="max_depth_m"):
        NYUDepth(labelled, max_depth_m=0.0)
    with pytest.raises(DataError, match="does not exist"):
        NYUDepth(tmp_path / "gone")


def test_real_frames(nyu_root: Path) -> None:
    test = NYUDepth(nyu_root, "test", size=(224, 224))
    assert len(test) == 654
    sample = test[0]
    assert sample["valid"].float().mean() > 0.9
    assert 0.5 < sample["depth"][sample["valid"]].median() < 8
    assert sum(len(NYUDepth(nyu_root, split)) for split in ("train", "val")) == 795
