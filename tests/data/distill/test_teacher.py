"""A teacher's depths: which file belongs to which pair, what is read from it, and what is refused."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.data import prepare
from hudepth.data.dataset import StoreDataset
from hudepth.data.distill import teacher
from hudepth.data.distill.teacher import ENDINGS, TeacherDepths
from hudepth.data.sources.base import Record
from hudepth.data.store import DepthStore, StoreWriter

N, SIZE, NATIVE = 5, (4, 6), (8, 12)


@pytest.fixture
def store(tmp_path: Path) -> DepthStore:
    path = tmp_path / "cache" / "a.h5"
    path.parent.mkdir()
    writer = StoreWriter(path, size=SIZE, native=False)
    for i in range(N):
        writer.append(Record(f"p{i}", "", i), np.zeros((*SIZE, 3), np.uint8), np.ones(SIZE, np.uint16), None)
    writer.close({"native_sizes": [list(NATIVE)]})
    return DepthStore(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "teacher").mkdir()
    return tmp_path / "teacher"


def lay(folder: Path, depths: Iterable[NDArray[Any]], ending: str = ".npy") -> None:
    """Lay a depth beside each pair: a npy as it is, a png in millimetres."""
    for i, depth in enumerate(depths):
        path = folder / f"p{i}{ending}"
        if path.suffix == ".npy":
            np.save(path, depth)
        else:
            cv2.imwrite(str(path), np.rint(depth * 1000).astype(np.uint16))


def random_depths(size: tuple[int, int] = SIZE, seed: int = 0) -> NDArray[np.float32]:
    mm = np.random.default_rng(seed).integers(1, 65536, (N, *size))
    return (mm / 1000).astype(np.float32)


@pytest.mark.parametrize("ending", ENDINGS)
def test_depths_come_back_from_each_kind_of_file(store: DepthStore, folder: Path, ending: str) -> None:
    depths = random_depths()
    lay(folder, depths, ending)
    found = TeacherDepths(folder, store, range(N)).read(range(N))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, depths, rtol=1e-7)


def test_a_folder_may_hold_files_of_several_kinds_and_of_other_pairs(store: DepthStore, folder: Path) -> None:
    depths = random_depths()
    for i, ending in enumerate((*ENDINGS, ".npy")):
        lay(folder, depths, ending)
        for j in range(N):
            if j != i:
                (folder / f"p{j}{ending}").unlink()
        lay(folder, depths[:i], ".npy")
    np.save(folder / "other.npy", np.zeros((1, 1)))
    np.testing.assert_allclose(TeacherDepths(folder, store, range(N)).read(range(N)), depths, rtol=1e-7)


@given(rows=st.lists(st.integers(0, N - 1), unique=True, min_size=1), data=st.data())
def test_each_position_of_the_store_gets_its_own_depth(
    tmp_path_factory: pytest.TempPathFactory, rows: list[int], data: st.DataObject
) -> None:
    """Whatever order the training pairs have, and whatever order a batch has."""
    root = tmp_path_factory.mktemp("any")
    writer = StoreWriter(root / "a.h5", size=SIZE, native=False)
    for i in range(N):
        writer.append(Record(f"p{i}", "", i), np.zeros((*SIZE, 3), np.uint8), np.ones(SIZE, np.uint16), None)
    writer.close({})
    depths = random_depths()
    lay(root, depths)
    for i in set(range(N)) - set(rows):
        (root / f"p{i}.npy").unlink()  # only training pairs need a depth
    teacher_depths = TeacherDepths(root, DepthStore(root / "a.h5"), rows)
    batch = data.draw(st.lists(st.sampled_from(rows), max_size=6))
    np.testing.assert_array_equal(teacher_depths.read(batch), depths[np.array(batch, int)])


def test_what_is_no_depth_counts_as_not_predicted(store: DepthStore, folder: Path) -> None:
    depths = random_depths().astype(np.float64)
    depths[:, 0] = [np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300]  # the last is infinite once it is float32
    with np.errstate(over="ignore"):
        lay(folder, depths)
        found = TeacherDepths(folder, store, range(N)).read(range(N))
    assert not found[:, 0].any()
    np.testing.assert_array_equal(found[:, 1:], depths[:, 1:].astype(np.float32))


def test_native_depths_are_sampled_not_mixed(store: DepthStore, folder: Path) -> None:
    depths = random_depths(NATIVE)
    lay(folder, depths)
    found = TeacherDepths(folder, store, range(N)).read(range(N))
    blocks = depths.reshape(N, SIZE[0], 2, SIZE[1], 2).transpose(0, 1, 3, 2, 4).reshape(N, *SIZE, 4)
    assert (blocks == found[..., None]).any(axis=-1).all()


@pytest.mark.parametrize("dtype", ["<f8", ">f4", "<f2", "<i4", "<u2", "|u1"])
def test_any_numbers_will_do(store: DepthStore, folder: Path, dtype: str) -> None:
    depths = np.random.default_rng(0).integers(1, 200, (N, *SIZE)).astype(dtype)
    lay(folder, depths)
    np.testing.assert_array_equal(TeacherDepths(folder, store, range(N)).read(range(N)), depths.astype(np.float32))


def test_columns_first_are_read_as_they_are_meant(store: DepthStore, folder: Path) -> None:
    depths = random_depths()
    lay(folder, [np.asfortranarray(depth) for depth in depths])
    np.testing.assert_array_equal(TeacherDepths(folder, store, range(N)).read(range(N)), depths)


def test_files_are_read_once(store: DepthStore, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    depths = random_depths()
    lay(folder, depths)
    first = TeacherDepths(folder, store, [3, 1])
    read: list[Path] = []
    real = teacher.read_teacher

    def spy(file: Path) -> NDArray[np.float32]:
        read.append(file)
        return real(file)

    monkeypatch.setattr(teacher, "read_teacher", spy)
    again = TeacherDepths(folder, store, [1, 3])  # the same pairs
    assert again.path == first.path
    assert again.path.parent == store.path.parent
    assert read == []
    np.testing.assert_array_equal(again.read([3, 1]), depths[[3, 1]])
    more = TeacherDepths(folder, store, [1, 2, 3])
    assert more.path != first.path
    assert [file.name for file in read] == ["p1.npy", "p2.npy", "p3.npy"]


def test_files_that_changed_are_read_anew_whatever_their_times_say(store: DepthStore, folder: Path) -> None:
    lay(folder, random_depths())
    for file in folder.iterdir():
        os.utime(file, (10**9, 10**9))
    before = TeacherDepths(folder, store, range(N)).read([2])
    after = random_depths(seed=1)
    np.save(folder / "p2.npy", after[2])
    os.utime(folder / "p2.npy", (10**9, 10**9))
    found = TeacherDepths(folder, store, range(N)).read([2])
    assert not np.array_equal(found, before)
    np.testing.assert_array_equal(found[0], after[2])


def test_a_cache_that_can_only_be_read_is_enough(
    store: DepthStore, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lay(folder, random_depths())
    TeacherDepths(folder, store, range(N))

    def locked(*_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(prepare, "FileLock", locked)
    np.testing.assert_array_equal(TeacherDepths(folder, store, range(N)).read([4])[0], random_depths()[4])


def test_it_goes_to_workers_without_its_handle(store: DepthStore, folder: Path) -> None:
    lay(folder, random_depths())
    depths = TeacherDepths(folder, store, range(N))
    depths.read([0])  # opens the handle, which h5py refuses to pickle
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(depths)).read([1])[0], random_depths()[1])


def test_a_batch_brings_the_teachers_depths_of_its_pairs(store: DepthStore, folder: Path) -> None:
    lay(folder, random_depths())
    dataset = StoreDataset(store, [4, 0, 2], teacher=TeacherDepths(folder, store, [4, 0, 2]))
    batch = dataset.__getitems__([1, 0])
    assert batch["index"].tolist() == [0, 4]
    np.testing.assert_array_equal(batch["teacher_m"], random_depths()[[0, 4]])


# --- what is refused --------------------------------------------------------------------------------------------


def test_no_folder(store: DepthStore, tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught:
        TeacherDepths(tmp_path / "none", store, [0])
    assert str(caught.value) == (
        f"distill.teacher: no folder '{tmp_path / 'none'}'. Pass distill.teacher=<folder of npy or png files>."
    )


def test_missing_depths(store: DepthStore, folder: Path) -> None:
    lay(folder, random_depths()[:2])
    with pytest.raises(DataError) as caught:
        TeacherDepths(folder, store, [3, 0, 2])
    assert str(caught.value) == (
        f"distill.teacher: 2 of 3 training pairs have no depth in '{folder}', the first is 'p2': no p2.npy or .png. "
        "Predict them with hudepth-predict, or copy them there."
    )


@pytest.mark.parametrize("shape", [(5, 6), (6, 4), (16, 24), (1, 1)])
def test_another_size(store: DepthStore, folder: Path, shape: tuple[int, int]) -> None:
    lay(folder, random_depths())
    np.save(folder / "p1.npy", np.ones(shape))
    with pytest.raises(DataError) as caught:
        TeacherDepths(folder, store, range(N))
    assert str(caught.value) == (
        f"distill.teacher: '{folder / 'p1.npy'}' is {shape[0]} x {shape[1]}, but the images are 8 x 12 or 4 x 6 "
        "(height x width). Resize it to its image."
    )
    assert not list(store.path.parent.glob("*teacher-*.h5*"))  # nothing half-done stays


def npy(header: str, body: bytes = b"") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def npy_of(shape: str, descr: str = "'<f4'", body: bytes = b"") -> bytes:
    return npy(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}", body)


def saved(array: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def archive() -> bytes:
    file = io.BytesIO()
    np.savez(file, depth=np.ones(SIZE))
    return file.getvalue()


def encoded(ending: str, image: NDArray[Any]) -> bytes:
    return cv2.imencode(ending, image)[1].tobytes()


def png_of(width: int, height: int) -> bytes:
    """A 16-bit png that claims a size and holds next to nothing."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    size = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    parts = (chunk(b"IHDR", size), chunk(b"IDAT", zlib.compress(b"\0" * 9)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


GREY = np.full(SIZE, 1000, np.uint16)
DAMAGED: dict[str, tuple[str, Callable[[], bytes]]] = {
    "empty": ("npy", bytes),
    "text": ("npy", lambda: b"hello"),
    "truncated": ("npy", lambda: saved(random_depths()[0])[:-4]),
    "only magic": ("npy", lambda: b"\x93NUMPY"),
    "another version": ("npy", lambda: b"\x93NUMPY\x09\x00" + saved(GREY)[8:]),
    "header of no dict": ("npy", lambda: npy("3")),
    "header without keys": ("npy", lambda: npy("{}")),
    "unknown numbers": ("npy", lambda: npy_of("(4, 6)", "'zz'")),
    "claims 40 GB": ("npy", lambda: npy_of("(100000, 100000)")),
    "claims a negative size": ("npy", lambda: npy_of("(-1, 4)", body=bytes(64))),
    "pickled": ("npy", lambda: pickle.dumps(np.ones(SIZE))),
    "objects": ("npy", lambda: saved(np.full(SIZE, None))),
    "3-D": ("npy", lambda: saved(np.ones((2, *SIZE)))),
    "1-D": ("npy", lambda: saved(np.ones(24))),
    "a number": ("npy", lambda: saved(np.ones(()))),
    "complex": ("npy", lambda: saved(np.ones(SIZE, complex))),
    "true and false": ("npy", lambda: saved(np.ones(SIZE, bool))),
    "letters": ("npy", lambda: saved(np.full(SIZE, "1.0"))),
    "structs": ("npy", lambda: saved(np.zeros(SIZE, [("depth", "f4")]))),
    "no file at all": ("png", bytes),
    "8-bit": ("png", lambda: encoded(".png", GREY.astype(np.uint8))),
    "colour": ("png", lambda: encoded(".png", np.stack([GREY, GREY, GREY + 1], axis=2))),
    "jpeg": ("png", lambda: encoded(".jpg", GREY.astype(np.uint8))),
    "cut": ("png", lambda: encoded(".png", random_mm())[:60]),
    "an archive of arrays": ("npy", archive),
    "a damaged archive": ("npy", lambda: b"PK\x03\x04" + bytes(64)),
    "a header that does not end": ("npy", lambda: npy("(" * 9000)),
    "a side beyond 64 bits": ("npy", lambda: npy_of(f"({10**30}, 2)")),
    "a size of truth values": ("npy", lambda: npy_of("(True, True)", body=bytes(4))),
    "claims 80 GB": ("png", lambda: png_of(200_000, 200_000)),
}


def random_mm() -> NDArray[np.uint16]:
    return np.random.default_rng(0).integers(0, 65536, NATIVE, np.uint16)


@pytest.mark.parametrize(("suffix", "content"), [pytest.param(*case, id=name) for name, case in DAMAGED.items()])
def test_what_is_no_depth_map(store: DepthStore, folder: Path, suffix: str, content: Callable[[], bytes]) -> None:
    lay(folder, random_depths())
    (folder / "p1.npy").unlink()
    file = folder / f"p1.{suffix}"
    file.write_bytes(content())
    with pytest.raises(DataError) as caught:
        TeacherDepths(folder, store, range(N))
    assert str(caught.value) == (
        f"distill.teacher: '{file}' is not a depth map: a .npy of numbers [height, width], or a 16-bit grey .png [mm]."
    )


def test_a_full_disk(store: DepthStore, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lay(folder, random_depths())

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(h5py.File, "create_dataset", full)
    with pytest.raises(DataError) as caught:
        TeacherDepths(folder, store, range(N))
    message = str(caught.value)
    assert message.startswith(f"paths.cache: cannot write '{store.path.parent}/teacher-")
    assert message.endswith(
        ".h5' (No space left on device). Free some space, or pass paths.cache=<a folder you can write to>."
    )
    assert not list(store.path.parent.glob("*teacher-*.h5*"))
