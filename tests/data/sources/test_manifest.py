"""Sets with a list, and the real labelled NYU set."""

from __future__ import annotations

import csv
import pickle
from collections import Counter
from pathlib import Path
from unicodedata import normalize

import cv2
import numpy as np
import pytest

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.encoding import to_metres
from hudepth.data.sources.base import Record
from hudepth.data.sources.manifest import ManifestSource, NyuLabeledSource
from hudepth.data.sources.plausible import check_range

RGB = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 9999, (6, 8), dtype=np.uint16)


def write_list(folder: Path, *lines: str, end: str = "\n", bom: bool = False) -> Path:
    path = folder / "index.csv"
    path.write_bytes(("\ufeff" if bom else "").encode() + end.join([*lines, ""]).encode())
    return path


def refusal(source: ManifestSource) -> str:
    with pytest.raises(DataError) as caught:
        source.records()
    return str(caught.value)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("bom", [False, True])
def test_all_columns(tmp_path: Path, end: str, bom: bool) -> None:
    write_list(
        tmp_path,
        "id,image,depth,scene,frame,split,category,depth_scale_m,depth_offset",
        "k/7,a.jpg,a.png,kitchen_0001,7,train,kitchen,0.02,0.5",
        "",
        "o/1,b.jpg,b.npy,office,,,,,",
        end=end,
        bom=bom,
    )
    assert ManifestSource(tmp_path).records() == [
        Record(
            id="k/7",
            scene="kitchen_0001",
            frame=7,
            split="train",
            category="kitchen",
            image="a.jpg",
            depth="a.png",
            depth_scale_m=0.02,
            depth_offset=0.5,
        ),
        Record(id="o/1", scene="office", frame=0, image="b.jpg", depth="b.npy"),
    ]


def test_two_columns_suffice_and_frames_count_within_a_scene(tmp_path: Path) -> None:
    write_list(tmp_path, "depth,image", "d/a.png,i/a.jpg", "d/b.png,i/b.jpg")
    assert ManifestSource(tmp_path).records() == [
        Record(id="i/a", scene="", frame=0, image="i/a.jpg", depth="d/a.png"),
        Record(id="i/b", scene="", frame=1, image="i/b.jpg", depth="d/b.png"),
    ]
    write_list(tmp_path, "image,depth,scene", "1.png,1.npy,a", "2.png,2.npy,b", "3.png,3.npy,a")
    assert [(r.scene, r.frame) for r in ManifestSource(tmp_path).records()] == [
        ("a", 0),
        ("b", 0),
        ("a", 1),
    ]


def test_index_gives_the_id(tmp_path: Path) -> None:
    write_list(tmp_path, "index,image,depth", "12,a.jpg,a.png")
    assert ManifestSource(tmp_path).records()[0].id == "12"
    assert NyuLabeledSource(tmp_path).records()[0].id == "00012"


def test_the_root_can_be_the_list(tmp_path: Path) -> None:
    path = write_list(tmp_path, "image,depth", "a.jpg,a.png")
    renamed = path.rename(tmp_path / "my list.csv")
    assert ManifestSource(renamed).records() == ManifestSource(tmp_path, manifest="my list.csv").records()


@pytest.mark.parametrize("extension", [".png", ".npy", ".tif"])
def test_reads_a_pair(tmp_path: Path, extension: str) -> None:
    (tmp_path / "s").mkdir()
    cv2.imwrite(str(tmp_path / "s/a.png"), RGB[..., ::-1])
    depth = tmp_path / f"s/d{extension}"
    np.save(depth, DEPTH) if extension == ".npy" else cv2.imwrite(str(depth), DEPTH)
    index = write_list(tmp_path, "image,depth", f"s/a.png,s/d{extension}")
    source = pickle.loads(pickle.dumps(ManifestSource(tmp_path)))
    pair = source.read(source.records()[0])
    np.testing.assert_array_equal(pair.image, RGB)
    np.testing.assert_array_equal(pair.depth, DEPTH)
    assert pair.depth.dtype == np.uint16
    assert source.files() == [index, tmp_path / "s/a.png", depth]


def test_fingerprint_follows_list_and_files(tmp_path: Path) -> None:
    write_list(tmp_path, "image,depth", "a.jpg,a.png")
    source = ManifestSource(tmp_path)
    seen = {source.fingerprint()}
    (tmp_path / "a.jpg").write_bytes(b"1")
    seen.add(source.fingerprint())
    write_list(tmp_path, "image,depth,split", "a.jpg,a.png,test")
    seen.add(source.fingerprint())
    assert len(seen) == 3
    assert source.fingerprint() in seen


def test_missing_file_and_unequal_sizes(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), RGB)
    cv2.imwrite(str(tmp_path / "a.png"), DEPTH[:4])
    write_list(tmp_path, "image,depth", "a.jpg,a.png", "b.jpg,b.png")
    source = ManifestSource(tmp_path)
    unequal, missing = source.records()
    with pytest.raises(DataError) as caught:
        source.read(unequal)
    assert str(caught.value) == (
        f"'{tmp_path / 'a.jpg'}' is 8 x 6 pixels but '{tmp_path / 'a.png'}' is 8 x 4. Both must have one size."
    )
    with pytest.raises(DataError) as caught:
        source.read(missing)
    assert str(caught.value) == (f"no file '{tmp_path / 'b.jpg'}'. Copy it there, or take it off the list.")


def test_read_stays_inside(tmp_path: Path) -> None:
    write_list(tmp_path, "image,depth", "a.jpg,a.png")
    record = Record(id="x", scene="", frame=0, image="../a.jpg", depth="a.png")
    with pytest.raises(DataError, match=r"path '\.\./a\.jpg' is not inside the data folder"):
        ManifestSource(tmp_path).read(record)


LINES = [
    (
        ("image,scene", "a,b"),
        "'{index}': no column depth, found image, scene. Name the columns in its first line.",
    ),
    (
        ("a.jpg;a.png",),
        "'{index}': no column image and depth, found a.jpg, a.png. Name the columns in its first line.",
    ),
    ((), "'{index}': no column image and depth, found nothing. Name the columns in its first line."),
    (("image,depth",), "'{index}': lists no pairs. Add a line for each pair."),
    (("image,depth", "a,b", "c"), "'{index}' line 3: 1 cells for 2 columns. Complete the line."),
    (("image,depth", "a,b,c"), "'{index}' line 2: 3 cells for 2 columns. Complete the line."),
    (
        ("image,depth,split", "a,b,dev"),
        "'{index}' line 2: unknown split 'dev'. Write train, val, test, or nothing.",
    ),
    (
        ("id,image,depth", "1,a,b", "2,a,b", "1,c,d"),
        "'{index}' line 4: id '1' is taken by line 2. Make ids unique.",
    ),
    (
        ("image,depth", "/etc/a.jpg,b"),
        "'{index}' line 2: path '/etc/a.jpg' is not inside the data folder. Use paths relative to '{root}'.",
    ),
    (
        ("image,depth", "a.jpg,../b.png"),
        "'{index}' line 2: path '../b.png' is not inside the data folder. Use paths relative to '{root}'.",
    ),
    (
        ("image,depth", "a.jpg,"),
        "'{index}' line 2: the cell of depth is empty. Complete the line, or remove it.",
    ),
    (
        ("image,depth,frame", "a,b,-1"),
        "'{index}' line 2: frame is '-1'. Write a whole number, or leave the cell empty.",
    ),
    (
        ("image,depth,depth_scale_m", "a,b,1cm"),
        "'{index}' line 2: depth_scale_m is '1cm'. Write a finite number, or leave the cell empty.",
    ),
    (
        ("image,depth,depth_offset", "a,b,inf"),
        "'{index}' line 2: depth_offset is 'inf'. Write a finite number, or leave the cell empty.",
    ),
    (
        ("image,depth,depth_scale_m", "a,b,0"),
        "'{index}' line 2: depth_scale_m is 0. Write a positive number of metres.",
    ),
]


@pytest.mark.parametrize(("lines", "message"), LINES)
def test_refuses(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    index = write_list(tmp_path, *lines)
    assert refusal(ManifestSource(tmp_path)) == message.format(index=index, root=tmp_path)


def test_refuses_a_list_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "index.csv"
    path.write_bytes(b"image,depth\n\xff,b\n")
    assert refusal(ManifestSource(tmp_path)).startswith(f"'{path}': not a CSV file in UTF-8 (")


def test_roots_that_lack_the_list(tmp_path: Path) -> None:
    do = "Pass data.root=<folder with index.csv>, or run with data=rooms."
    assert refusal(ManifestSource(None)) == f"data.root is not set. {do}"
    gone = tmp_path / "gone"
    assert refusal(ManifestSource(gone)) == f"data.root: '{gone}' does not exist. {do}"
    assert refusal(ManifestSource(tmp_path)) == f"data.root: no file 'index.csv' in '{tmp_path}'. {do}"


def test_unknown_encoding(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data\.encoding: .*Did you mean 'linear'"):
        ManifestSource(tmp_path, encoding="linar").records()


def test_labelled_nyu_is_complete(nyu_root: Path) -> None:
    source = NyuLabeledSource(nyu_root)
    records = source.records()
    assert [record.id for record in records] == [f"{index:05d}" for index in range(1449)]
    assert len({record.scene for record in records}) == 464
    assert Counter(record.split for record in records) == {"train": 795, "test": 654}
    assert len(source.files()) == 1 + 2 * 1449


def test_labelled_nyu_in_metres(nyu_root: Path) -> None:
    source = NyuLabeledSource(nyu_root)
    with (nyu_root / "index.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    depths = []
    for index in (0, 700, 1448):
        record, row = source.records()[index], rows[index]
        pair = source.read(record)
        assert pair.image.shape == (480, 640, 3)
        stored = cv2.imread(str(nyu_root / row["depth"]), cv2.IMREAD_UNCHANGED)
        assert stored is not None
        depth = to_metres(pair.depth, source.encoding, scale_m=record.depth_scale_m, offset=record.depth_offset)
        expected = (stored.astype(np.float64) + float(row["depth_offset"])) * float(row["depth_scale_m"])
        np.testing.assert_array_equal(depth, expected.astype(np.float32))
        depths.append(depth)
    found = check_range(depths, indoor=source.indoor, encoding="linear", name=source.name)
    assert 0.0 < found.min_m < found.median_m < found.max_m < 10.5
    assert found.valid_fraction == 1.0


@pytest.mark.parametrize(
    "lines",
    [
        ("image,depth", "a/1.jpg,a/1.png", ",", ",", "", "   "),
        ("image,depth,,", "a/1.jpg,a/1.png,,"),
        ("image,depth", "a/1.jpg,a/1.png,,"),
        ("image;depth", "a/1.jpg;a/1.png"),
        ("image\tdepth", "a/1.jpg\ta/1.png"),
        ("image,depth", "a\\1.jpg,a\\1.png"),
    ],
    ids=["blank", "columns", "commas", "semicolons", "tabs", "backslashes"],
)
def test_lists_as_spreadsheets_write_them(tmp_path: Path, lines: tuple[str, ...]) -> None:
    write_list(tmp_path, *lines, bom=True)
    assert [(r.image, r.depth) for r in ManifestSource(tmp_path).records()] == [("a/1.jpg", "a/1.png")]


def test_own_validation_pairs(tmp_path: Path) -> None:
    write_list(tmp_path, "image,depth,split", "a,b,train", "c,d,val", "e,f,test")
    assert [record.split for record in ManifestSource(tmp_path).records()] == ["train", "val", "test"]


@pytest.mark.parametrize("name", ["../other.csv", "/etc/passwd"])
def test_a_list_outside_the_folder_is_not_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "other.csv").write_text("secret\n")
    with pytest.raises(DataError, match=r"data\.source\.manifest") as caught:
        ManifestSource(tmp_path / "set", manifest=name).records()
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(("listed", "stored"), [("NFC", "NFD"), ("NFD", "NFC"), ("NFC", "NFC"), ("NFD", "NFD")])
def test_accents_are_one_letter_or_two(tmp_path: Path, listed: str, stored: str) -> None:
    name = "Küche é"
    assert cv2.imwrite(str(tmp_path / f"{normalize(stored, name)}.jpg"), RGB)
    assert cv2.imwrite(str(tmp_path / f"{normalize(stored, name)}.png"), DEPTH)
    write_list(tmp_path, "image,depth", f"{normalize(listed, name)}.jpg,{normalize(listed, name)}.png")
    source = ManifestSource(tmp_path, encoding="uint16_mm")
    (record,) = source.records()
    assert record.id == normalize(listed, name)
    np.testing.assert_array_equal(source.read(record).depth, DEPTH)
    assert all(file.is_file() for file in source.files())
