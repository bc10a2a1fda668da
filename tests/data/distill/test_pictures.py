"""Pictures without truth among the training pairs: what a student sees of them, and which are refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.dataset import PicturedDataset
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses.distillation import Distillation

SIZE, NATIVE = (32, 48), (40, 60)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def source() -> RoomsSource:
    return RoomsSource(scenes=5, frames_per_scene=2, size=(60, 90))


def picture(seed: int) -> np.ndarray[Any, Any]:
    """A smooth image that looks like no other."""
    coarse = np.random.default_rng(seed).integers(0, 256, (5, 6, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, NATIVE[::-1], interpolation=cv2.INTER_CUBIC))


@pytest.fixture
def folders(tmp_path: Path, source: RoomsSource) -> dict[str, Path]:
    """Three pictures, one in a subfolder, and a teacher's depth of them and of the training pairs."""
    pictures, teacher = tmp_path / "pictures", tmp_path / "teacher"
    for number, name in enumerate(["a", "b", "away/c"]):
        for folder in (pictures, teacher):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(pictures / f"{name}.png"), picture(number)[..., ::-1])
        np.save(teacher / f"{name}_depth.npy", np.full(NATIVE, 1.0 + number, np.float32))
    for record in source.records():
        (teacher / record.scene).mkdir(exist_ok=True)
        np.save(teacher / f"{record.id}.npy", np.full(source.size, 5.0, np.float32))
    return {"pictures": pictures, "teacher": teacher}


def make(source: RoomsSource, cache: Path, folders: dict[str, Path], **options: Any) -> DepthDataModule:
    return DepthDataModule(source, size=SIZE, split="official", cache=cache, native=False, **folders, **options)


def test_pictures_join_the_pairs_without_truth(source: RoomsSource, cache: Path, folders: dict[str, Path]) -> None:
    data = make(source, cache, folders, batch_size=100)
    data.prepare_data()
    (batch,) = data.train_dataloader()
    count = len(data.split.train)
    assert len(batch["image"]) == count + 3 == len(data.training_pairs)
    assert bool((batch["stored_depth"][:count].int() > 0).all())
    assert not batch["stored_depth"][count:].int().any()
    assert bool((batch["teacher_m"][:count] == 5).all())
    ids = [data.training_pairs.pair_id(index) for index in batch["index"].tolist()]
    assert sorted(ids[:count]) == sorted(data.store.records[row].id for row in data.split.train)
    seen = dict(zip(ids[count:], zip(batch["image"][count:], batch["teacher_m"][count:], strict=True), strict=True))
    assert sorted(seen) == ["a", "away/c", "b"]
    for number, name in enumerate(["a", "b", "away/c"]):
        image, depth = seen[name]
        small = cv2.resize(picture(number), SIZE[::-1], interpolation=cv2.INTER_AREA)
        np.testing.assert_allclose(image.numpy().astype(int), small, atol=1)
        assert bool((depth == 1 + number).all())
    for loader in (data.val_dataloader(), data.test_dataloader()):
        assert all(int(index) < len(data.store) for batch in loader for index in batch["index"])


def test_of_a_picture_only_the_teacher_is_learnt(source: RoomsSource, cache: Path, folders: dict[str, Path]) -> None:
    data = make(source, cache, folders)
    pairs = data.training_pairs
    assert isinstance(pairs, PicturedDataset)
    batch = data.on_after_batch_transfer(pairs.__getitems__([len(pairs) - 1, len(pairs) - 2]), 0)
    assert not batch["valid"].any()
    pred = torch.full_like(batch["unit_depth"], 0.2)
    expected = np.mean(np.abs(np.log(0.2 / np.array([0.2, 0.3]))))  # the order is that of names: a, away/c, b
    assert float(Distillation()(pred, batch["teacher"])) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("change", ["same", "jpeg", "brighter"])
@pytest.mark.parametrize("subset", ["val", "test"])
def test_pictures_of_held_out_images_are_refused(
    source: RoomsSource, cache: Path, folders: dict[str, Path], change: str, subset: str
) -> None:
    row = make(source, cache, folders).split[subset][1]
    record = source.records()[row]
    image = source.read(record).image[..., ::-1]
    file = folders["pictures"] / f"copy.{'jpg' if change == 'jpeg' else 'png'}"
    cv2.imwrite(str(file), cv2.convertScaleAbs(image, alpha=1.1) if change == "brighter" else image)
    np.save(folders["teacher"] / "copy.npy", np.ones(source.size, np.float32))
    with pytest.raises(
        DataError, match=rf"1 of 4 pictures show images that are held out.*'{file}', like '{record.id}'"
    ):
        make(source, cache, folders).prepare_data()


def test_a_training_image_may_be_among_the_pictures(source: RoomsSource, cache: Path, folders: dict[str, Path]) -> None:
    record = source.records()[make(source, cache, folders).split.train[0]]
    cv2.imwrite(str(folders["pictures"] / "again.png"), source.read(record).image[..., ::-1])
    np.save(folders["teacher"] / "again.npy", np.ones(source.size, np.float32))
    assert len(make(source, cache, folders).training_pairs) == 4 + len(make(source, cache, folders).split.train)


def test_what_cannot_be_used_is_named(source: RoomsSource, cache: Path, folders: dict[str, Path]) -> None:
    pictures, teacher = folders["pictures"], folders["teacher"]
    whole = (pictures / "b.png").read_bytes()
    cases = [
        (pictures / "b.png", whole[: len(whole) // 2], rf"^'?{pictures / 'b.png'}"),
        (teacher / "b_depth.npy", b"no depth", rf"^distill\.teacher: '{teacher / 'b_depth.npy'}' is not a depth map"),
    ]
    for path, data, message in cases:
        before = path.read_bytes()
        path.write_bytes(data)
        with pytest.raises(DataError, match=message) as error:
            make(source, cache, folders).prepare_data()
        assert "\n" not in str(error.value)
        path.write_bytes(before)
    np.save(teacher / "b_depth.npy", np.ones((30, 60), np.float32))
    with pytest.raises(DataError, match=r"b_depth\.npy' is 30 x 60, but its picture is 40 x 60"):
        make(source, cache, folders).prepare_data()
    (teacher / "b_depth.npy").unlink()
    with pytest.raises(DataError, match=r"1 of 3 pictures have no depth in .*, the first is 'b'"):
        make(source, cache, folders).prepare_data()


def test_an_empty_folder_and_none_at_all(source: RoomsSource, cache: Path, folders: dict[str, Path]) -> None:
    for name, message in (("empty", "no JPEG or PNG file in"), ("missing", "no folder")):
        folder = folders["pictures"].parent / name
        if name == "empty":
            folder.mkdir()
        with pytest.raises(DataError, match=rf"^distill\.pictures: {message}"):
            make(source, cache, {**folders, "pictures": folder}).prepare_data()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shuffle_block": 2}, "data.shuffle_block"), ({"on_device": True}, "data.on_device"),
        ({"stream": 4}, "data.stream: a teacher"), ({"teacher": None}, "distill.pictures: they have no depth"),
    ],
)  # fmt: skip
def test_options_that_pictures_exclude(
    source: RoomsSource, cache: Path, folders: dict[str, Path], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        make(source, cache, {**folders, **options})


def test_a_picture_may_not_share_the_depth_of_a_pair(
    source: RoomsSource, cache: Path, folders: dict[str, Path]
) -> None:
    data = make(source, cache, folders)
    record = source.records()[data.split.train[0]]
    file = folders["pictures"] / f"{record.id}.png"
    file.parent.mkdir()
    cv2.imwrite(str(file), picture(9))
    with pytest.raises(DataError, match=rf"^distill\.pictures: 1 pictures have the name .* the first is '{record.id}'"):
        data.prepare_data()


def test_pictures_are_named_and_left_out_as_hudepth_predict_does(
    source: RoomsSource, cache: Path, folders: dict[str, Path], caplog: pytest.LogCaptureFixture
) -> None:
    """Two that differ in the ending have two depths; hidden files, other kinds and the teacher's own are none."""
    caplog.set_level("INFO", logger="hudepth")
    root = folders["pictures"]
    cv2.imwrite(str(root / "a.jpg"), picture(7))
    (root / "._b.png").write_bytes(b"of a file system")
    (root / "notes.txt").write_text("none")
    inside = root / "taught"
    folders["teacher"].rename(inside)
    for name, value in (("a_png", 1.0), ("a_jpg", 8.0)):
        np.save(inside / f"{name}_depth.npy", np.full(NATIVE, value, np.float32))
    cv2.imwrite(str(inside / "a_jpg_colour.png"), picture(8))
    pairs = make(source, cache, {"pictures": root, "teacher": inside}).training_pairs
    assert isinstance(pairs, PicturedDataset)
    assert pairs.pictures.ids == ["a_jpg", "a_png", "away/c", "b"]
    assert pairs.pictures.read([0, 1])[1][:, 0, 0].tolist() == [8.0, 1.0]
    assert "left out, neither JPEG nor PNG: 1 (notes.txt)" in caplog.text


def test_a_batch_of_pictures_alone_is_like_any_other(
    source: RoomsSource, cache: Path, folders: dict[str, Path]
) -> None:
    pairs = make(source, cache, folders).training_pairs
    alone, mixed = pairs.__getitems__([len(pairs) - 1]), pairs.__getitems__([0, len(pairs) - 1])
    assert {name: value.dtype for name, value in alone.items() if isinstance(value, torch.Tensor)} == {
        name: value.dtype for name, value in mixed.items() if isinstance(value, torch.Tensor)
    }
    assert pairs.pair_id(alone["index"].tolist()[0]) == "b"
