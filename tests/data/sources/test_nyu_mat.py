"""The official labelled file, imitated with h5py."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from hudepth.base.errors import ConfigError, DataError
from hudepth.data.sources import nyu
from hudepth.data.sources.base import Record
from hudepth.data.sources.nyu_mat import NyuMatSource

SCENES = ("kitchen_0004", "study_room_0005b", "kitchen_0004")
_RNG = np.random.default_rng(0)
IMAGES = _RNG.integers(0, 256, (3, 6, 8, 3), dtype=np.uint8)  # [N, H, W, 3]
DEPTHS = _RNG.uniform(0.7, 9.9, (3, 6, 8)).astype(np.float32)  # [N, H, W]
RAW_DEPTHS = DEPTHS * (DEPTHS > 3)
NAME = "nyu_depth_v2_labeled.mat"


def write_mat(folder: Path, scenes: tuple[str, ...] = SCENES) -> Path:
    """Write [N, 3, W, H] and [N, W, H] arrays and references to names, behind MATLAB's 512 bytes."""
    path = folder / NAME
    with h5py.File(path, "w", userblock_size=512) as file:
        file["images"] = IMAGES.transpose(0, 3, 2, 1)
        file["depths"] = DEPTHS.transpose(0, 2, 1)
        file["rawDepths"] = RAW_DEPTHS.transpose(0, 2, 1)
        names = []
        for index, scene in enumerate(scenes):
            file[f"#refs#/{index}"] = np.array([[ord(letter)] for letter in scene], np.uint16)
            names.append(file[f"#refs#/{index}"].ref)
        table = file.create_dataset("scenes", (1, 3), dtype=h5py.ref_dtype)
        table[0] = names
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(512))
    return path


def refusal(source: NyuMatSource) -> str:
    with pytest.raises(DataError) as caught:
        source.records()
    return str(caught.value)


def test_records(tmp_path: Path) -> None:
    path = write_mat(tmp_path)
    named = [
        ("kitchen_0004", 0, "kitchen"),
        ("study_room_0005b", 0, "study_room"),
        ("kitchen_0004", 1, "kitchen"),
    ]
    expected = [
        Record(
            id=f"0000{index}",
            scene=scene,
            frame=frame,
            category=category,
            image=f"images/0000{index}",
            depth=f"depths/0000{index}",
        )
        for index, (scene, frame, category) in enumerate(named)
    ]
    assert NyuMatSource(tmp_path).records() == expected
    assert NyuMatSource(path).records() == expected
    assert NyuMatSource(path).files() == [path]


def test_pairs_are_upright_and_survive_pickling(tmp_path: Path) -> None:
    write_mat(tmp_path)
    source = NyuMatSource(tmp_path)
    records = source.records()  # opens the file, whose handle cannot be pickled
    for record, image, depth in zip(records, IMAGES, DEPTHS, strict=True):
        pair = pickle.loads(pickle.dumps(source)).read(record)
        np.testing.assert_array_equal(pair.image, image)
        np.testing.assert_array_equal(pair.depth, depth)
        assert pair.image.flags.c_contiguous
        assert pair.depth.dtype == np.float32


def test_raw_depths(tmp_path: Path) -> None:
    write_mat(tmp_path)
    source = NyuMatSource(tmp_path, depth="rawDepths")
    np.testing.assert_array_equal(source.read(source.records()[1]).depth, RAW_DEPTHS[1])
    assert source.fingerprint() != NyuMatSource(tmp_path).fingerprint()


def test_unknown_depth(tmp_path: Path) -> None:
    write_mat(tmp_path)
    with pytest.raises(ConfigError, match=r"data\.source\.depth: .*Did you mean 'rawDepths'"):
        NyuMatSource(tmp_path, depth="rawdepths")


def test_the_official_split_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mat(tmp_path)
    monkeypatch.setattr(nyu, "COUNT", 3)
    assert [record.split for record in NyuMatSource(tmp_path).records()] == ["test", "test", "train"]


def test_roots_that_lack_the_file(tmp_path: Path) -> None:
    do = f"Pass data.root=<path of {NAME}>, or run with data=rooms."
    assert refusal(NyuMatSource(None)) == f"data.root is not set. {do}"
    assert refusal(NyuMatSource(tmp_path)) == f"data.root: no file '{NAME}' in '{tmp_path}'. {do}"


def test_truncated_file(tmp_path: Path) -> None:
    path = write_mat(tmp_path)
    path.write_bytes(path.read_bytes()[:2000])
    assert refusal(NyuMatSource(path)) == (f"'{path}': not an HDF5 file, or truncated. Copy the file again.")


def altered(folder: Path, name: str, change: Callable[[h5py.File], object]) -> Path:
    """Write the file with ``name`` replaced by what ``change`` makes of it."""
    path = write_mat(folder)
    with h5py.File(path, "r+") as file:
        del file[name]
        change(file)
    return path


def put(name: str, array: np.ndarray) -> Callable[[h5py.File], object]:
    return lambda file: file.create_dataset(name, data=array)


def nameless(file: h5py.File) -> None:
    file["#refs#/long"] = np.zeros(1000, np.uint16)
    file.create_dataset("scenes", data=[[file["#refs#/long"].ref] * 3], dtype=h5py.ref_dtype)


DO = f"Pass data.root=<path of {NAME}>."
LAYOUTS: list[tuple[str, Callable[[h5py.File], object], str]] = [
    (
        "images",
        put("images", np.zeros((3, 3, 8, 6), np.uint16)),
        f": 'images' is uint16 of shape (3, 3, 8, 6). {DO}",
    ),
    (
        "images",
        put("images", np.zeros((3, 1, 8, 6), np.uint8)),
        f": 'images' is uint8 of shape (3, 1, 8, 6). {DO}",
    ),
    (
        "depths",
        put("depths", np.zeros((8, 6), np.float32)),
        f": 'depths' is float32 of shape (8, 6). {DO}",
    ),
    ("images", put("images", np.zeros((2, 3, 8, 6), np.uint8)), f": no 2 scene names in 'scenes'. {DO}"),
    ("scenes", put("scenes", np.zeros((1, 3))), f": no 3 scene names in 'scenes'. {DO}"),
    ("depths", lambda file: file.create_group("depths"), f": no array 'depths'. {DO}"),
    ("scenes", nameless, ": a scene has no name. Copy the file again."),
    (
        "scenes",
        lambda file: file.create_dataset("scenes", (1, 3), dtype=h5py.ref_dtype),  # null references
        ": a scene has no name. Copy the file again.",
    ),
    (
        "depths",
        lambda file: file.create_dataset("depths", (3, 20_000, 6_000), "f4"),  # unwritten: takes no disk
        " depths: 20000 x 6000 pixels, allowed are 1 to 100 million. Resize the file.",
    ),
    (
        "depths",
        lambda file: file.create_dataset("depths", (400, 1000, 1000), "f4", chunks=(400, 1000, 1000)),
        ": 'depths' has chunks of (400, 1000, 1000) values. Repack the file.",
    ),
]


@pytest.mark.parametrize(("name", "change", "message"), LAYOUTS)
def test_layout_is_checked(tmp_path: Path, name: str, change: Callable[[h5py.File], object], message: str) -> None:
    path = altered(tmp_path, name, change)
    assert refusal(NyuMatSource(path)) == f"'{path}'{message}"


def elsewhere(file: h5py.File, form: str, folder: Path) -> None:
    """Make ``depths`` point at another file."""
    if form == "link":
        file["depths"] = h5py.ExternalLink("secret.h5", "depths")
    elif form == "raw":
        secret = [(str(folder / "secret.bin"), 0, DEPTHS.nbytes)]
        file.create_dataset("depths", (3, 8, 6), "f4", external=secret)
    else:
        layout = h5py.VirtualLayout(shape=(3, 8, 6), dtype="f4")
        layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "depths", shape=(3, 8, 6))
        file.create_virtual_dataset("depths", layout)


@pytest.mark.parametrize("form", ["link", "raw", "virtual"])
def test_other_files_are_not_followed(tmp_path: Path, form: str) -> None:
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["depths"] = DEPTHS.transpose(0, 2, 1)
    (tmp_path / "secret.bin").write_bytes(DEPTHS.tobytes())
    path = altered(tmp_path, "depths", lambda file: elsewhere(file, form, tmp_path))
    with h5py.File(path) as file:
        assert file["depths"].shape == (3, 8, 6)  # h5py itself follows it
    assert refusal(NyuMatSource(path)) == f"'{path}': no array 'depths'. {DO}"


def test_fewer_depth_maps_than_images(tmp_path: Path) -> None:
    source = NyuMatSource(altered(tmp_path, "depths", put("depths", DEPTHS[:2].transpose(0, 2, 1))))
    record = source.records()[2]
    with pytest.raises(DataError) as caught:
        source.read(record)
    assert str(caught.value) == f"'{tmp_path / NAME}' image 2: the file holds 3 images and 2 depth maps."


def test_damaged_values(tmp_path: Path) -> None:
    values = DEPTHS.transpose(0, 2, 1)
    path = altered(
        tmp_path,
        "depths",
        lambda file: file.create_dataset("depths", data=values, chunks=(1, 8, 6), fletcher32=True),
    )
    data = path.read_bytes()
    path.write_bytes(data.replace(values[1].tobytes(), bytes(values[1].nbytes)))
    source = NyuMatSource(path)
    record = source.records()[1]
    with pytest.raises(DataError) as caught:
        source.read(record)
    assert str(caught.value) == f"'{path}' image 1: cannot be read, the file is damaged. Copy the file again."


def test_unequal_sizes(tmp_path: Path) -> None:
    path = altered(tmp_path, "depths", put("depths", DEPTHS[:, :4].transpose(0, 2, 1)))
    source = NyuMatSource(path)
    record = source.records()[0]
    with pytest.raises(DataError) as caught:
        source.read(record)
    assert str(caught.value) == (f"'{path}' image 0 is 8 x 6 pixels but its depths is 8 x 4. Both must have one size.")
