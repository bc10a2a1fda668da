"""Pairs without a list, in two folders and in one."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.prepare import prepare
from hudepth.data.sources.base import Record
from hudepth.data.sources.folder import FolderSource

RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).uniform(0.5, 9, (6, 8)).astype(np.float32)
MORE = ", or 'rgb_<name>' with 'depth_<name>'; data=manifest reads a list of other names."
BOTH = {"images": ".", "depths": ".", "encoding": "float_m"}


def write(root: Path, *names: str) -> None:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def refusal(source: FolderSource) -> str:
    with pytest.raises(DataError) as caught:
        source.records()
    return str(caught.value)


def test_two_folders(tmp_path: Path) -> None:
    write(tmp_path, "images/k/10.JPG", "images/k/9.png", "images/1.jpeg", "images/notes.txt")
    write(tmp_path, "depths/k/10.npy", "depths/k/9.TIF", "depths/1.png")
    assert FolderSource(tmp_path, encoding="float_m").records() == [
        Record(id="1", scene="", frame=0, image="images/1.jpeg", depth="depths/1.png"),
        Record(id="k/9", scene="k", frame=0, image="images/k/9.png", depth="depths/k/9.TIF"),
        Record(id="k/10", scene="k", frame=1, image="images/k/10.JPG", depth="depths/k/10.npy"),
    ]


@pytest.mark.parametrize(("image_suffix", "depth_suffix"), [("_rgb", "_depth"), ("", "_depth"), ("_rgb", "")])
def test_one_folder(tmp_path: Path, image_suffix: str, depth_suffix: str) -> None:
    for name in ("a", "b"):
        write(tmp_path, f"s/{name}{image_suffix}.png", f"s/{name}{depth_suffix}.png")
    source = FolderSource(tmp_path, image_suffix=image_suffix, depth_suffix=depth_suffix, **BOTH)  # type: ignore[arg-type]
    assert source.records() == [
        Record(
            id=f"s/{name}",
            scene="s",
            frame=frame,
            image=f"s/{name}{image_suffix}.png",
            depth=f"s/{name}{depth_suffix}.png",
        )
        for frame, name in enumerate("ab")
    ]


@pytest.mark.parametrize("extension", [".npy", ".tif"])
def test_reads_a_pair(tmp_path: Path, extension: str) -> None:
    image, depth = tmp_path / "rgb/a.png", tmp_path / f"z/a{extension}"
    write(tmp_path, "rgb/a.png", f"z/a{extension}")
    cv2.imwrite(str(image), RGB[..., ::-1])
    np.save(depth, DEPTH) if extension == ".npy" else cv2.imwrite(str(depth), DEPTH)
    source = pickle.loads(pickle.dumps(FolderSource(tmp_path, images="rgb", depths="z", encoding="float_m")))
    pair = source.read(source.records()[0])
    np.testing.assert_array_equal(pair.image, RGB)
    np.testing.assert_array_equal(pair.depth, DEPTH)
    assert source.files() == [image, depth]


def test_encoding_is_required(tmp_path: Path) -> None:
    write(tmp_path, "images/a.jpg", "depths/a.png")
    assert refusal(FolderSource(tmp_path)).startswith("data.encoding is not set")
    with pytest.raises(ConfigError, match="Did you mean 'float_m'"):
        FolderSource(tmp_path, encoding="float").records()


def test_unpaired(tmp_path: Path) -> None:
    write(tmp_path, "images/a.jpg", "images/b.jpg", "images/c.jpg", "depths/a.png")
    expects = f"Expected 'images/<name>.jpg' with 'depths/<name>.png' (or .npy, .tif){MORE}"
    skip = "Pass data.on_error=skip to leave them out."
    source = FolderSource(tmp_path, encoding="auto")
    assert refusal(source) == (
        f"data.root: 2 of 3 images in '{tmp_path}' have no depth, the first is 'images/b.jpg'. {expects} {skip}"
    )
    write(tmp_path, "depths/b.png", "depths/c.png", "depths/x/d.npy")
    assert refusal(source) == (
        f"data.root: 1 of 4 depth maps in '{tmp_path}' have no image, the first is 'depths/x/d.npy'. {expects} {skip}"
    )
    write(tmp_path, "depths/a.npy")
    assert refusal(source) == ("'depths/a.npy' and 'depths/a.png' are both the depth of 'a'. Keep one of them.")


def test_roots_without_pairs(tmp_path: Path) -> None:
    assert refusal(FolderSource(None, encoding="auto")) == (
        "data.root is not set. Pass data.root=<folder with images and depths>, or run with data=rooms."
    )
    source = FolderSource(tmp_path, encoding="auto")
    assert refusal(source) == (
        f"data.source.images: no folder 'images' in '{tmp_path}'. Pass data.source.images=<folder within data.root>."
    )
    (tmp_path / "images").mkdir()
    assert refusal(source) == (
        f"data.source.depths: no folder 'depths' in '{tmp_path}'. Pass data.source.depths=<folder within data.root>."
    )
    (tmp_path / "depths").mkdir()
    assert refusal(source) == (
        f"data.root: no pairs in '{tmp_path}'. "
        f"Expected 'images/<name>.jpg' with 'depths/<name>.png' (or .npy, .tif){MORE}"
    )


def test_one_folder_needs_suffixes(tmp_path: Path) -> None:
    write(tmp_path, "a.jpg", "a.png")
    message = refusal(FolderSource(tmp_path, images=".", depths="./", encoding="auto"))
    assert "data.source.image_suffix=_rgb" in message


@pytest.mark.parametrize(
    ("images", "depths"),
    [
        (["images/rgb_1.jpg", "images/k/rgb_2.png"], ["depths/depth_1.png", "depths/k/depth_2.npy"]),
        (["images/rgb1.jpg", "images/k/rgb2.png"], ["depths/depth1.png", "depths/k/depth2.npy"]),
        (["images/1_color.jpg", "images/k/2_color.png"], ["depths/1-depth.png", "depths/k/2-depth.npy"]),
        (["images/IMG_1.jpg", "images/k/IMG_2.png"], ["depths/1.png", "depths/k/2.npy"]),
        (["images/1.jpg", "images/k/2.png"], ["depths/sync_depth_1.png", "depths/k/sync_depth_2.npy"]),
    ],
)
def test_words_for_what_a_file_is_are_left_out(images: list[str], depths: list[str], tmp_path: Path) -> None:
    write(tmp_path, *images, *depths)
    records = FolderSource(tmp_path, encoding="float_m").records()
    assert [(record.id, record.scene) for record in records] == [("1", ""), ("k/2", "k")]
    assert [record.image for record in records] == images
    assert [record.depth for record in records] == depths


def test_words_in_one_folder(tmp_path: Path) -> None:
    write(tmp_path, "k/rgb_1.png", "k/depth_1.png", "k/rgb_2.png", "k/depth_2.png", "k/mask_1.png")
    records = FolderSource(tmp_path, images=".", depths=".", encoding="uint16_mm").records()
    assert [(record.id, record.image, record.depth) for record in records] == [
        (f"k/{i}", f"k/rgb_{i}.png", f"k/depth_{i}.png") for i in (1, 2)
    ]


def test_equal_names_keep_their_words(tmp_path: Path) -> None:
    write(tmp_path, "images/rgb_1.jpg", "depths/rgb_1.png")
    assert [record.id for record in FolderSource(tmp_path, encoding="auto").records()] == ["rgb_1"]
    write(tmp_path, "images/x.jpg")
    assert "1 of 2 images in" in refusal(FolderSource(tmp_path, encoding="auto"))


def test_other_names_need_a_list(tmp_path: Path) -> None:
    write(tmp_path, "images/left_1.jpg", "depths/laser_1.png")
    message = refusal(FolderSource(tmp_path, encoding="auto"))
    assert "1 of 1 images in" in message
    assert "data=manifest reads a list of other names." in message


def test_folders_stay_inside(tmp_path: Path) -> None:
    (tmp_path / "depths").mkdir()
    assert refusal(FolderSource(tmp_path, images="../x", encoding="auto")) == (
        f"data.source.images: path '../x' is not inside the data folder. Use paths relative to '{tmp_path}'."
    )


def test_unequal_sizes(tmp_path: Path) -> None:
    write(tmp_path, "images/a.png", "depths/a.npy")
    cv2.imwrite(str(tmp_path / "images/a.png"), RGB)
    np.save(tmp_path / "depths/a.npy", DEPTH.T)
    source = FolderSource(tmp_path, encoding="float_m")
    with pytest.raises(DataError) as caught:
        source.read(source.records()[0])
    assert str(caught.value) == (
        f"'{tmp_path / 'images/a.png'}' is 8 x 6 pixels but '{tmp_path / 'depths/a.npy'}' is 6 x 8. "
        "Both must have one size."
    )


def test_names_that_are_not_utf8_and_decomposed_accents(tmp_path: Path) -> None:
    files = [(b"images/caf\xe9.jpg", b"depths/caf\xe9.png"), ("images/é.jpg".encode(), "depths/e\u0301.png".encode())]
    for folder in ("images", "depths"):
        (tmp_path / folder).mkdir()
    for image, depth in files:
        cv2.imwrite(str(tmp_path / "i.jpg"), np.zeros((4, 6, 3), np.uint8))
        cv2.imwrite(str(tmp_path / "d.png"), np.full((4, 6), 2000, np.uint16))
        (tmp_path / "i.jpg").rename(os.fsdecode(os.fsencode(tmp_path) + b"/" + image))
        (tmp_path / "d.png").rename(os.fsdecode(os.fsencode(tmp_path) + b"/" + depth))
    source = FolderSource(tmp_path, encoding="uint16_mm")
    assert [record.id for record in source.records()] == ["caf\\xe9", "é"]
    store = prepare(source, size=(4, 6), cache=tmp_path / "cache")
    assert [record.id for record in store.records] == ["caf\\xe9", "é"]


def test_unpaired_files_are_listed_as_skipped(tmp_path: Path) -> None:
    for folder in ("images", "depths"):
        (tmp_path / folder).mkdir()
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"images/{i}.jpg"), np.zeros((4, 6, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "depths/1.png"), np.full((4, 6), 2000, np.uint16))
    (tmp_path / "images/._1.jpg").write_bytes(b"\0\5\x16\7")
    data = DepthDataModule(FolderSource(tmp_path, encoding="uint16_mm"), size=4, cache=tmp_path, on_error="skip")
    assert [record.id for record in data.store.records] == ["1"]
    assert data.store.info["skipped"] == ["'images/0.jpg': has no depth."]


def test_image_and_depth_of_two_sizes(tmp_path: Path) -> None:
    for folder in ("images", "depths"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "images/a.png"), RGB)
    np.save(tmp_path / "depths/a.npy", np.full((3, 4), 2, np.float32))
    refused = FolderSource(tmp_path, encoding="float_m")
    with pytest.raises(DataError, match=r"data\.source\.unequal_sizes=true"):
        refused.read(refused.records()[0])
    source = FolderSource(tmp_path, encoding="float_m", unequal_sizes=True)
    store = prepare(source, size=(6, 8), cache=tmp_path)
    assert store.read_native(0).shape == (3, 4)
    assert [array.shape for array in store.read([0])] == [(1, 6, 8, 3), (1, 6, 8)]
    np.save(tmp_path / "depths/a.npy", np.full((4, 4), 2, np.float32))
    with pytest.raises(DataError, match="aspect ratio"):
        source.read(source.records()[0])
