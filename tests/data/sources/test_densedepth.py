"""DenseDepth's archive in every form it is kept in."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.encoding import to_metres
from hudepth.data.sources import densedepth
from hudepth.data.sources.base import Record
from hudepth.data.sources.densedepth import DenseDepthSource

_RNG = np.random.default_rng(0)
RGB = _RNG.integers(0, 256, (6, 8, 3), dtype=np.uint8)
DEPTH_8 = _RNG.integers(1, 256, (6, 8), dtype=np.uint8)
DEPTH_16 = _RNG.integers(1, 9999, (6, 8), dtype=np.uint16)
FRAMES = [("kitchen_0004", 1), ("kitchen_0004", 12), ("living_room_0038", 37)]
TRAIN = [
    Record(
        id=f"{scene}/{number}",
        scene=scene,
        frame=number,
        split="train",
        category=scene[:-5],
        image=f"data/nyu2_train/{scene}_out/{number}.jpg",
        depth=f"data/nyu2_train/{scene}_out/{number}.png",
    )
    for scene, number in FRAMES
]
TEST = [
    Record(
        id="test/00000",
        scene="",
        frame=0,
        split="test",
        image="data/nyu2_test/00000_colors.png",
        depth="data/nyu2_test/00000_depth.png",
    )
]


def members(end: str) -> dict[str, bytes]:
    """Return every file of a small copy of the archive by name."""
    lists = {
        f"data/nyu2_{split}.csv": "".join(f"{r.image},{r.depth}{end}" for r in records).encode()
        for split, records in (("train", TRAIN), ("test", TEST))
    }
    image = {split: cv2.imencode(kind, RGB[..., ::-1])[1] for split, kind in (("train", ".jpg"), ("test", ".png"))}
    depth = {"train": cv2.imencode(".png", DEPTH_8)[1], "test": cv2.imencode(".png", DEPTH_16)[1]}
    files = {}
    for record in [*TRAIN, *TEST]:
        files[record.image] = image[record.split].tobytes()
        files[record.depth] = depth[record.split].tobytes()
    return lists | files


def write(folder: Path, form: str, *, end: str = "\n") -> Path:
    """Write the copy in one form and return the root for it."""
    if form.startswith("zip"):
        with zipfile.ZipFile(folder / "nyu_data.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in members(end).items():
                archive.writestr(name, data)
        return folder if form == "zip in folder" else folder / "nyu_data.zip"
    inner = folder / ("renamed" if form == "inner folder" else "data")
    for name, data in members(end).items():
        if form != "lists alone" or name.endswith(".csv"):
            path = inner / name.removeprefix("data/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    return inner if form == "inner folder" else folder


FORMS = ["zip", "zip in folder", "folder", "inner folder"]


def refusal(source: DenseDepthSource) -> str:
    with pytest.raises(DataError) as caught:
        source.records()
    return str(caught.value)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("form", [*FORMS, "lists alone"])
def test_records(tmp_path: Path, form: str, end: str) -> None:
    root = write(tmp_path, form, end=end)
    assert DenseDepthSource(root).records() == TRAIN
    assert DenseDepthSource(root, subset="test").records() == TEST
    assert DenseDepthSource(root, subset="all").records() == TRAIN + TEST


@pytest.mark.parametrize("form", FORMS)
def test_auto_reads_both_encodings(tmp_path: Path, form: str) -> None:
    source = DenseDepthSource(write(tmp_path, form), subset="all")
    *train, test = source.records()
    source = pickle.loads(pickle.dumps(source))
    pair = source.read(train[1])
    np.testing.assert_array_equal(pair.depth, DEPTH_8)
    np.testing.assert_allclose(
        to_metres(pair.depth, source.encoding, auto_uint8=source.auto_uint8), DEPTH_8 / 25.5, rtol=1e-6
    )
    pair = source.read(test)
    np.testing.assert_array_equal(pair.image, RGB)
    np.testing.assert_array_equal(pair.depth, DEPTH_16)
    np.testing.assert_allclose(
        to_metres(pair.depth, source.encoding, auto_uint8=source.auto_uint8), DEPTH_16 / 1000, rtol=1e-6
    )


def test_files(tmp_path: Path) -> None:
    root = write(tmp_path, "zip")
    assert DenseDepthSource(root).files() == [root]
    write(tmp_path / "unpacked", "folder")
    found = DenseDepthSource(tmp_path / "unpacked", subset="all").files()
    assert len(found) == 2 + 2 * 4
    assert all(path.is_file() for path in found)


TRAIN_ROW = "data/nyu2_train/a_0001_out/1.jpg,data/nyu2_train/a_0001_out/1.png"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("", "'{path}': lists no pairs. Copy the file again."),
        (
            TRAIN_ROW.replace("data/nyu2_train/a_0001_out", "..") + "\n",
            "'{path}' line 1: '../1.jpg,../1.png' is not a pair of DenseDepth's train set. Copy the list again.",
        ),
        (
            f"{TRAIN_ROW}\ndata/nyu2_train/a_out/1.jpg\n",
            "'{path}' line 2: 'data/nyu2_train/a_out/1.jpg' is not a pair of DenseDepth's train set. "
            "Copy the list again.",
        ),
        (
            TRAIN_ROW.replace("1.png", "2.png"),
            "'{path}' line 1: 'data/nyu2_train/a_0001_out/1.jpg' and 'data/nyu2_train/a_0001_out/2.png' "
            "are of different frames. Copy the list again.",
        ),
        (
            f"{TRAIN_ROW}\n\n{TRAIN_ROW}\n",
            "'{path}' line 3: 'a_0001/1' is already on line 1. Remove one.",
        ),
    ],
)
def test_refuses_a_malformed_list(tmp_path: Path, rows: str, message: str) -> None:
    path = tmp_path / "nyu2_train.csv"
    path.write_text(rows)
    assert refusal(DenseDepthSource(tmp_path)) == message.format(path=path)


@pytest.mark.parametrize("name", ["../secret.png", "data/nyu2_train/../../x.png", "/etc/passwd", "nyu2_train.csv"])
def test_read_stays_inside(tmp_path: Path, name: str) -> None:
    source = DenseDepthSource(write(tmp_path, "folder"))
    with pytest.raises(DataError, match="not the name of a DenseDepth frame"):
        source.read(Record(id="x", scene="", frame=0, image=name, depth=TRAIN[0].depth))


def test_unknown_subset(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data\.source\.subset: .*Did you mean 'test'"):
        DenseDepthSource(tmp_path, subset="tests")


def test_roots_that_lack_the_set(tmp_path: Path) -> None:
    do = "Pass data.root=<path of nyu_data.zip or of its unpacked folder>, or run with data=rooms."
    assert refusal(DenseDepthSource(None)) == f"data.root is not set. {do}"
    assert refusal(DenseDepthSource(tmp_path)) == (
        f"data.root: neither 'nyu2_train.csv' nor 'nyu_data.zip' in '{tmp_path}'. {do}"
    )
    path = tmp_path / "data.zip"
    path.write_bytes(b"PK\x03\x04 truncated")
    assert refusal(DenseDepthSource(path)) == f"'{path}': not a zip file, or truncated. Copy the file again."


def test_missing_frame(tmp_path: Path) -> None:
    source = DenseDepthSource(write(tmp_path, "lists alone"))
    image = tmp_path / TRAIN[0].image
    with pytest.raises(DataError) as caught:
        source.read(source.records()[0])
    assert str(caught.value) == f"no file '{image}'. Copy it there, or take it off the list."


def repack(root: Path, name: str, data: bytes, method: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile(root, "w", method) as archive:
        for member, content in members("\n").items():
            archive.writestr(member, data if member == name else content)


def read_refusal(root: Path) -> str:
    source = DenseDepthSource(root)
    with pytest.raises(DataError) as caught:
        source.read(TRAIN[0])
    return str(caught.value)


def test_missing_member(tmp_path: Path) -> None:
    root = tmp_path / "nyu_data.zip"
    with zipfile.ZipFile(root, "w") as archive:
        archive.writestr("data/nyu2_train.csv", "")
    assert read_refusal(root) == f"no file '{TRAIN[0].image}' in '{root}'. Copy the zip file again."


def test_member_is_not_unpacked_beyond_the_cap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "nyu_data.zip"
    repack(root, TRAIN[0].image, bytes(1 << 20))
    monkeypatch.setattr(densedepth, "MAX_MEMBER_BYTES", (1 << 20) - 1)
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("unpacked"))
    assert read_refusal(root) == (f"'{TRAIN[0].image}' in '{root}': larger than 0 MiB. It cannot be one image or list.")


def test_member_that_understates_its_size(tmp_path: Path) -> None:
    root = tmp_path / "nyu_data.zip"
    repack(root, TRAIN[0].image, bytes(1 << 20))
    data = root.read_bytes().replace((1 << 20).to_bytes(4, "little"), (1000).to_bytes(4, "little"))
    root.write_bytes(data)
    assert read_refusal(root) == (
        f"'{TRAIN[0].image}' in '{root}': cannot be unpacked, the zip file is damaged. Copy the zip file again."
    )


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_methods_whose_output_cannot_be_bounded(tmp_path: Path, method: int) -> None:
    root = tmp_path / "nyu_data.zip"
    repack(root, "", b"", method)
    assert read_refusal(root) == (
        f"'{TRAIN[0].image}' in '{root}': cannot be unpacked, the zip file is damaged. Copy the zip file again."
    )


def test_truncated_frame_in_the_zip(tmp_path: Path) -> None:
    root = tmp_path / "nyu_data.zip"
    repack(root, TRAIN[0].image, members("\n")[TRAIN[0].image][:-9])
    assert read_refusal(root).startswith(f"'{TRAIN[0].image}' in '{root}': the JPEG is truncated")


def test_unequal_sizes(tmp_path: Path) -> None:
    root = tmp_path / "nyu_data.zip"
    repack(root, TRAIN[0].depth, cv2.imencode(".png", DEPTH_8[:4])[1].tobytes())
    assert read_refusal(root) == (
        f"'{TRAIN[0].image}' in '{root}' is 8 x 6 pixels but '{TRAIN[0].depth}' in '{root}' is 8 x 4. "
        "Both must have one size."
    )
