"""Each public data set on a tiny tree in its own layout: right depth in the store, or one clear line."""

from __future__ import annotations

import os
import pickle
import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.prepare import prepare
from hudepth.data.sources.sets.indoor import ScannetSource, SunRgbdSource
from hudepth.data.sources.sets.kitti import KittiSource
from hudepth.data.sources.sets.layout import SetSource
from hudepth.data.sources.sets.scanner import DiodeSource, Eth3dSource
from hudepth.data.sources.sets.tum import TumSource, associate
from hudepth.data.splits import make_split
from tests.commands import Command
from tests.data.sources.sets.trees import TREES, surface


@pytest.fixture(params=list(TREES))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def build(name: str, root: Path, **options: Any) -> Any:
    return TREES[name].source(root, **options)  # type: ignore[call-arg]


def refusal(source: Any, cache: Path) -> str:
    with pytest.raises(DataError) as caught:
        prepare(source, size=(16, 32), cache=cache, workers=1)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_store_holds_the_depth_of_the_set(name: str, tmp_path: Path) -> None:
    tree = TREES[name]
    expected = tree.write(tmp_path / "set")
    source = pickle.loads(pickle.dumps(build(name, tmp_path / "set")))
    store = prepare(source, size=(16, 32), cache=tmp_path / "cache", workers=1)
    assert [record.id for record in store.records] == sorted(expected)
    assert store.per_m == tree.per_m
    for row, record in enumerate(store.records):
        depth, truth = store.read_native(row), expected[record.id]
        assert ((depth > 0) == (truth > 0)).all(), record.id
        np.testing.assert_allclose(depth, truth, atol=0.5 / tree.per_m + 1e-6, err_msg=record.id)
    letters = {"train": "r", "test": "e", "": "-"}
    assert "".join(letters[record.split] for record in store.records) == tree.splits
    assert all(file.is_file() for file in source.files())
    assert len(source.files()) == len(store) * {"diode": 3, "ibims": 4}.get(name, 2)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_truncated_file_is_one_line(name: str, share: float, tmp_path: Path) -> None:
    TREES[name].write(tmp_path / "set")
    file = sorted((tmp_path / "set").glob(TREES[name].depth))[0]
    os.truncate(file, int(share * file.stat().st_size))
    message = refusal(build(name, tmp_path / "set"), tmp_path / "cache")
    assert file.name in message
    assert "Copy the file again" in message or "numpy.save" in message or "Replace it" in message


def test_a_wrong_unit_is_one_line(name: str, tmp_path: Path) -> None:
    TREES[name].write(tmp_path / "set")
    scale = {"depth_scale_m": None} if name == "ibims" else {}
    message = refusal(build(name, tmp_path / "set", encoding=TREES[name].wrong, **scale), tmp_path / "cache")
    assert "data.encoding=" in message
    assert " median depth of " in message or "is beyond" in message


def test_a_missing_depth_is_one_line(name: str, tmp_path: Path) -> None:
    TREES[name].write(tmp_path / "set")
    file = sorted((tmp_path / "set").glob(TREES[name].depth))[0]
    if name == "kitti":  # many of its images have none; but depth without its image is a mistake
        file = sorted((tmp_path / "set").glob("**/data/0000000005.png"))[0]
    file.unlink()
    message = refusal(build(name, tmp_path / "set"), tmp_path / "cache")
    assert ("have no depth" in message) or ("have no image" in message) or f"no file '{file}'" in message


def test_an_empty_folder_is_one_line(name: str, tmp_path: Path) -> None:
    assert refusal(build(name, tmp_path), tmp_path / "cache").startswith("data.root: no ")
    assert refusal(build(name, tmp_path / "none"), tmp_path / "cache").startswith("data.root: '")


@pytest.mark.parametrize("name", [n for n, tree in TREES.items() if issubclass(tree.source, SetSource)], indirect=True)
def test_a_missing_list_is_one_line(name: str, tmp_path: Path) -> None:
    TREES[name].write(tmp_path / "set")
    message = refusal(build(name, tmp_path / "set", test_list="none.txt"), tmp_path / "cache")
    assert message.startswith("data.source.test_list: no file '")
    (tmp_path / "set" / "latin.txt").write_bytes(b"\xe9\xff")
    assert "is not a text file" in refusal(build(name, tmp_path / "set", test_list="latin.txt"), tmp_path / "cache")


def test_the_commands_know_them(name: str, command: Command, tmp_path: Path) -> None:
    TREES[name].write(tmp_path / "set")
    options = {"scannet": ["data.source.every=1"], "tum": ["data.source.every=1"]}.get(name, [])
    done = command("data", "prepare", f"data={name}", "data.root=set", "data.size=16", "paths.cache=cache", *options)
    assert done.code == 0, done.err
    assert done.out.startswith(f"{len(TREES[name].splits)} pairs in ")


# --- KITTI


@pytest.mark.parametrize(
    "line",
    [
        "2011_09_26/2011_09_26_drive_0002_sync 0000000069 l",
        "2011_09_26/2011_09_26_drive_0002_sync 69 l",
        "2011_09_26/2011_09_26_drive_0002_sync/image_02/data/0000000069.png "
        "2011_09_26_drive_0002_sync/proj_depth/groundtruth/image_02/0000000069.png 721.5377",
        "2011_09_26/2011_09_26_drive_0002_sync/image_02/data/0000000069.png None 721.5377",
        "2011_09_26/2011_09_26_drive_0002_sync/image_02/data/0000000069.jpg "
        "2011_09_26/2011_09_26_drive_0002_sync/image_03/data/0000000069.jpg",
    ],
)
def test_kitti_reads_the_lists_of_others(line: str, tmp_path: Path) -> None:
    expected = TREES["kitti"].write(tmp_path)
    (tmp_path / "eigen_test.txt").write_text(f"{line}\n")
    (tmp_path / "train.txt").write_text("2011_09_26/2011_09_26_drive_0001_sync 5 r\n")
    source = KittiSource(tmp_path, train_list="train.txt", test_list=str(tmp_path / "eigen_test.txt"))
    assert [(record.id, record.split) for record in source.records()] == [
        ("2011_09_26_drive_0001_sync/image_03/0000000005", "train"),
        ("2011_09_26_drive_0002_sync/image_02/0000000069", "test"),
    ]
    assert {record.id for record in source.records()} < expected.keys()


def test_kitti_leaves_out_and_counts_what_has_no_truth(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    TREES["kitti"].write(tmp_path)
    (tmp_path / "l.txt").write_text("# Eigen\n\n2011_09_26_drive_0002_sync 69 l\n2011_09_26_drive_0002_sync 0 l\n")
    source = KittiSource(tmp_path, test_list="l.txt")
    assert len(source.records()) == len(source.records()) == 1
    assert [record.message for record in caplog.records] == [
        f"1 of 2 entries of the lists have no image or no depth in '{tmp_path}': left out, "
        "the first is '2011_09_26_drive_0002_sync/image_02/0000000000'"
    ]
    (tmp_path / "l.txt").write_text("2011_09_26_drive_0009_sync 69 l\n")
    with pytest.raises(DataError, match="has no pair of those on the lists, the first is '2011_09_26_drive_0009_sync"):
        source.records()
    (tmp_path / "l.txt").write_text("kitchen\n")
    with pytest.raises(DataError, match=r"data\.source\.test_list: line 1 of 'l\.txt' names no pair of kitti"):
        source.records()
    (tmp_path / "l.txt").write_text("2011_09_26_drive_0002_sync 69 l\n")
    both = KittiSource(tmp_path, train_list="l.txt", test_list="l.txt")
    with pytest.raises(DataError, match="is in both lists"):
        both.records()


def test_kitti_keeps_80_m_and_its_points(tmp_path: Path) -> None:
    TREES["kitti"].write(tmp_path / "set")
    store = prepare(KittiSource(tmp_path / "set"), size=(16, 16), cache=tmp_path / "cache", workers=1)
    for row in range(len(store)):
        assert store.read_native(row)[3, 3] == 80.0
        stored = store.read([row])[1][0]
        # nearest resizing would keep a third of the pixels, that is of 5 columns in 80
        assert (stored > 0).mean() > 0.9
        assert stored.max() == 80 * 256


# --- the others


def test_sunrgbd_lists_and_scenes(tmp_path: Path) -> None:
    TREES["sunrgbd"].write(tmp_path)
    lines = ["/n/fs/sun3d/data/SUNRGBD/kv1/NYUdata/NYU0001", "SUNRGBD/kv2/kinect2data/000002_a/image/1.jpg"]
    (tmp_path / "test.txt").write_text("\n".join(lines))
    records = SunRgbdSource(tmp_path, test_list="test.txt").records()
    assert [(record.id, record.split) for record in records] == [
        ("kv1/NYUdata/NYU0001", "test"), ("kv2/kinect2data/000002_a", "test"),
    ]  # fmt: skip
    records = SunRgbdSource(tmp_path / "SUNRGBD", depth="depth").records()
    assert [record.scene for record in records] == ["", "", "sun3ddata/brown_1/brown_1"]
    assert [Path(record.depth).parent.name for record in records] == ["depth"] * 3
    with pytest.raises(ConfigError, match=r"data\.source\.depth: 'raw' is not one of depth, depth_bfx"):
        SunRgbdSource(tmp_path, depth="raw")


def test_sunrgbd_reads_its_toolboxs_split(tmp_path: Path) -> None:
    TREES["sunrgbd"].write(tmp_path)
    cells = {}
    for split, pairs in (("train", ["kv1/NYUdata/NYU0001", "kv2/kinect2data/000002_a"]), ("test", ["kv1/none"])):
        cells[f"all{split}"] = np.empty((1, len(pairs)), object)
        cells[f"all{split}"][0] = [f"/n/fs/sun3d/data/SUNRGBD/{pair}" for pair in pairs]
    savemat(tmp_path / "allsplit.mat", cells)
    source = SunRgbdSource(tmp_path, train_list="allsplit.mat", test_list="allsplit.mat")
    assert [(record.id, record.split) for record in source.records()] == [
        ("kv1/NYUdata/NYU0001", "train"), ("kv2/kinect2data/000002_a", "train"),
    ]  # fmt: skip
    savemat(tmp_path / "other.mat", {"alltest": np.arange(3.0)})
    (tmp_path / "text.mat").write_text("kv1/NYUdata/NYU0001")
    with pytest.raises(DataError, match=r"data\.source\.train_list: '.*other\.mat' is not the allsplit\.mat"):
        SunRgbdSource(tmp_path, train_list="other.mat").records()
    with pytest.raises(DataError, match=r"data\.source\.test_list: '.*text\.mat' is not the allsplit\.mat"):
        SunRgbdSource(tmp_path, test_list="text.mat").records()
    with pytest.raises(DataError, match="no file '"):
        SunRgbdSource(tmp_path, test_list="none.mat").records()


def test_diode_outdoors_reaches_far(tmp_path: Path) -> None:
    TREES["diode"].write(tmp_path / "set")
    store = prepare(DiodeSource(tmp_path / "set", part="outdoor"), size=(16, 16), cache=tmp_path / "cache", workers=1)
    assert store.per_m == 128
    np.testing.assert_allclose(store.read_native(0), surface(2, most=299.0), atol=1 / 256)


def test_a_mask_of_another_size_is_one_line(tmp_path: Path) -> None:
    TREES["ibims"].write(tmp_path / "set")
    cv2.imwrite(str(tmp_path / "set/mask_transp/office_02.png"), np.ones((3, 4), np.uint8))
    assert "a mask of (3, 4) for depth of (24, 32)" in refusal(build("ibims", tmp_path / "set"), tmp_path / "cache")
    (tmp_path / "set/mask_transp/office_02.png").unlink()
    assert "no file '" in refusal(build("ibims", tmp_path / "set"), tmp_path / "cache")


@pytest.mark.parametrize("bits", [1, 2, 4, 16])
def test_masks_have_any_bit_depth(bits: int, tmp_path: Path) -> None:
    expected = TREES["ibims"].write(tmp_path)
    for file in tmp_path.glob("mask_*/*.png"):
        mask = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) > 0
        spread = np.zeros((*mask.shape, bits), np.uint8)
        spread[..., -1] = mask  # the least value above 0
        file.write_bytes(png_of(np.packbits(spread.reshape(len(mask), -1), axis=1), mask.shape[1], bits))
    source = build("ibims", tmp_path)
    for record in source.records():
        np.testing.assert_array_equal(source.read(record).depth > 0, expected[record.id] > 0)


def png_of(rows: np.ndarray, width: int, bits: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, len(rows), bits, 0, 0, 0, 0))
    pixels = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows)))
    return b"\x89PNG\r\n\x1a\n" + header + pixels + chunk(b"IEND", b"")


def test_boolean_masks_are_masks(tmp_path: Path) -> None:
    expected = TREES["diode"].write(tmp_path)
    for file in tmp_path.glob("**/*_mask.npy"):
        np.save(file, np.load(file) > 0)
    source = DiodeSource(tmp_path)
    for record in source.records():
        np.testing.assert_allclose(source.read(record).depth, expected[record.id], rtol=1e-6)


def test_scannet_splits_by_lists_of_scenes(tmp_path: Path) -> None:
    TREES["scannet"].write(tmp_path)
    source = ScannetSource(tmp_path, train_list="scannetv2_train.txt", test_list="scannetv2_val.txt")
    assert [(record.id, record.frame, record.split) for record in source.records()] == [
        ("scene0000_00/0", 0, "train"), ("scene0000_00/10", 1, "train"), ("scene0011_01/2", 0, "test"),
    ]  # fmt: skip
    assert [record.id for record in ScannetSource(tmp_path, every=2).records()] == ["scene0000_00/0", "scene0011_01/2"]
    cv2.imwrite(str(tmp_path / "scene0000_00/color/0.jpg"), np.zeros((48, 48, 3), np.uint8))
    with pytest.raises(DataError, match="Both must have one aspect ratio"):
        source.read(source.records()[0])


def test_times_are_associated_nearest_first() -> None:
    """As the set's associate.py: all differences, smallest first, each time at most once."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        first, second = (sorted(rng.uniform(0, 1, rng.integers(1, 30)).tolist()) for _ in range(2))
        near = sorted(
            (abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) <= 0.05
        )
        keys, others, expected = set(range(len(first))), set(range(len(second))), []
        for _, i, j in near:
            if i in keys and j in others:
                keys.remove(i)
                others.remove(j)
                expected.append((i, j))
        assert associate(first, second, most_s=0.05) == sorted(expected)


def test_tum_lists(tmp_path: Path) -> None:
    TREES["tum"].write(tmp_path / "set")
    place = tmp_path / "set" / "rgbd_dataset_freiburg1_xyz"
    alone = TumSource(place).records()
    assert [record.scene for record in alone] == [place.name] * 2
    assert alone[0].image == "rgb/100.000000.png"
    with pytest.raises(DataError, match=r"no image is within 1e-05 s of a depth map"):
        TumSource(place, max_difference_s=1e-5).records()
    (place / "depth.txt").write_text("1.0 depth/1.png\nabc depth/2.png\n")
    with pytest.raises(DataError, match=r"depth\.txt' line 2: not a time and a file"):
        TumSource(place).records()
    (place / "depth.txt").write_text("1.0 ../../secret.png\n")
    with pytest.raises(DataError, match="is not inside the data folder"):
        TumSource(place).records()
    (place / "depth.txt").unlink()
    with pytest.raises(DataError, match=r"data\.root: no file '.*depth\.txt'"):
        TumSource(place).records()


def test_eth3d_depth_fits_its_image(tmp_path: Path) -> None:
    TREES["eth3d"].write(tmp_path)
    shutil.copy(tmp_path / "pipes/images/dslr_images/DSC_0634.JPG", tmp_path / "pipes/ground_truth_depth/dslr_images/")
    source = Eth3dSource(tmp_path)
    with pytest.raises(DataError, match=r"bytes, but 32 x 24 floats are 3,072\. Copy the file again"):
        source.read(source.records()[1])
    assert make_split(source.records(), kind="test").test == [0, 1]
