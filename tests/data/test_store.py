"""The depth store: what goes in comes out, and what is no store is refused."""

from __future__ import annotations

import json
import multiprocessing
import pickle
import tempfile
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hudepth.base.errors import DataError
from hudepth.data import store as store_module
from hudepth.data.sources.base import Record
from hudepth.data.store import DepthStore, StoreWriter, to_mm, to_stored

SIZE = (3, 5)


def png(stored_depth: np.ndarray) -> np.ndarray:
    return cv2.imencode(".png", stored_depth)[1].ravel()


def write_store(
    path: Path,
    images: np.ndarray,
    depths_mm: np.ndarray,
    natives_mm: list[np.ndarray] | None = None,
    records: list[Record] | None = None,
) -> DepthStore:
    writer = StoreWriter(path, size=images.shape[1:3], native=natives_mm is not None)
    for i in range(len(images)):
        record = records[i] if records else Record(id=f"{i:02d}", scene="kitchen", frame=i)
        writer.append(record, images[i], depths_mm[i], None if natives_mm is None else png(natives_mm[i]))
    writer.close({"source": "test"})
    return DepthStore(path)


@pytest.fixture
def filled(tmp_path: Path) -> tuple[DepthStore, np.ndarray, np.ndarray, list[np.ndarray]]:
    """Seven pairs whose native truths all differ in size."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (7, *SIZE, 3), np.uint8)
    depths = rng.integers(0, 65536, (7, *SIZE), np.uint16)
    natives = [rng.integers(0, 65536, (4 + i, 9 - i), np.uint16) for i in range(7)]
    return write_store(tmp_path / "a.h5", images, depths, natives), images, depths, natives


def test_a_store_of_another_scale(tmp_path: Path) -> None:
    depth_m = np.array([[0, 0.001, 80.25], [255.99609375, 1, 65.6]], np.float32)
    stored = to_stored(depth_m, 256)
    writer = StoreWriter(tmp_path / "a.h5", size=(2, 3), native=True, per_m=256)
    writer.append(Record("a", "", 0), np.zeros((2, 3, 3), np.uint8), stored, png(stored))
    writer.close({})
    store = DepthStore(tmp_path / "a.h5")
    assert store.per_m == 256
    np.testing.assert_allclose(store.read_native(0), depth_m, atol=1 / 256)
    np.testing.assert_array_equal(store.read([0])[1][0], stored)


@st.composite
def contents(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    n, height, width = draw(st.integers(1, 4)), draw(st.integers(1, 6)), draw(st.integers(1, 6))
    sizes = st.tuples(st.integers(1, 6), st.integers(1, 6))
    return (
        draw(arrays(np.uint8, (n, height, width, 3))),
        draw(arrays(np.uint16, (n, height, width))),
        [draw(arrays(np.uint16, draw(sizes))) for _ in range(n)],
    )


@given(content=contents())
@settings(max_examples=20)
def test_pixels_come_back_exactly(content: tuple[np.ndarray, np.ndarray, list[np.ndarray]]) -> None:
    images, depths, natives = content
    with tempfile.TemporaryDirectory() as folder:
        store = write_store(Path(folder) / "a.h5", images, depths, natives)
        image, depth = store.read(range(len(images)))
        np.testing.assert_array_equal(image, images)
        np.testing.assert_array_equal(depth, depths)
        for i, native in enumerate(natives):
            found = store.read_native(i)
            assert found.dtype == np.float32
            np.testing.assert_array_equal(found, (native.astype(np.float64) / 1000).astype(np.float32))


def test_records_and_info_come_back(tmp_path: Path) -> None:
    records = [
        Record(id="küche_0004/17", scene="küche_0004", frame=17, split="train", category="küche"),
        Record(id="b", scene="", frame=0),
    ]
    images, depths = np.zeros((2, *SIZE, 3), np.uint8), np.ones((2, *SIZE), np.uint16)
    store = write_store(tmp_path / "a.h5", images, depths, records=records)
    assert store.records == records
    assert (len(store), store.size, store.info, store.has_native) == (2, SIZE, {"source": "test"}, False)


def test_it_grows_beyond_the_first_allocation(tmp_path: Path) -> None:
    depths = np.arange(130, dtype=np.uint16)[:, None, None] + np.ones((1, 1, 1), np.uint16)
    store = write_store(tmp_path / "a.h5", np.zeros((130, 1, 1, 3), np.uint8), depths)
    assert len(store) == 130
    np.testing.assert_array_equal(store.read(range(130))[1], depths)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["image"].shape == (130, 1, 1, 3)


@given(indices=st.lists(st.integers(0, 6), max_size=12))
def test_any_order_and_repetition(indices: list[int]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        rng = np.random.default_rng(1)
        images, depths = rng.integers(0, 256, (7, *SIZE, 3), np.uint8), rng.integers(0, 65536, (7, *SIZE), np.uint16)
        image, depth = write_store(Path(folder) / "a.h5", images, depths).read(indices)
    np.testing.assert_array_equal(image, images[indices] if indices else np.empty((0, *SIZE, 3)))
    np.testing.assert_array_equal(depth, depths[indices] if indices else np.empty((0, *SIZE)))


def test_millimetres_survive_metres_exactly() -> None:
    mm = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    np.testing.assert_array_equal(to_mm(mm.astype(np.float32) / np.float32(1000)), mm)


@given(depth=st.floats(0, 100, width=32))
def test_to_mm_rounds_to_the_nearest_millimetre(depth: float) -> None:
    found = int(to_mm(np.full((1, 1), depth, np.float32))[0, 0])
    exact = Fraction(depth) * 1000
    if depth == 0:
        assert found == 0
    elif exact >= 65535:
        assert found == 65535
    elif exact < 1:
        assert found == 1
    else:  # the product is rounded once to float32, which moves ties by less than 1/256 mm
        assert abs(found - exact) <= Fraction(1, 2) + Fraction(1, 256)


@pytest.mark.parametrize("depth", [1e-45, 1e-6, 4.9e-4])
def test_a_measured_depth_never_becomes_unmeasured(depth: float) -> None:
    np.testing.assert_array_equal(to_mm(np.array([[depth, 0]], np.float32)), np.array([[1, 0]], np.uint16))


@pytest.mark.parametrize("depth", [65.535, 65.536, 70.0, 1e6, 3e38])
def test_beyond_65_metres_is_capped(depth: float) -> None:
    assert to_mm(np.array([[depth]], np.float32))[0, 0] == 65535


def test_a_pickled_store_leaves_its_handle_behind(filled: tuple[Any, ...]) -> None:
    store, images, _, _ = filled
    fresh = pickle.dumps(store)
    store.read([0])  # opens the handle, which h5py refuses to pickle
    assert len(pickle.dumps(store)) == len(fresh)
    again = pickle.loads(pickle.dumps(store))
    np.testing.assert_array_equal(again.read([3])[0][0], images[3])
    assert again.records == store.records


def _read_in_fork(store: DepthStore, queue: Any) -> None:
    queue.put([store.read([i])[1].sum(dtype=np.int64) for i in range(len(store))])


def test_a_fork_reads_beside_its_parent(filled: tuple[Any, ...]) -> None:
    store, _, depths, _ = filled
    store.read([0])
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    children = [context.Process(target=_read_in_fork, args=(store, queue)) for _ in range(2)]
    for child in children:
        child.start()
    expected = [int(depth.sum(dtype=np.int64)) for depth in depths]
    assert [queue.get(timeout=30) for _ in children] == [expected, expected]
    for child in children:
        child.join()
    np.testing.assert_array_equal(store.read(range(7))[1], depths)


def test_without_native_truth(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    store = write_store(path, np.zeros((1, *SIZE, 3), np.uint8), np.ones((1, *SIZE), np.uint16))
    with pytest.raises(DataError) as caught:
        store.read_native(0)
    assert str(caught.value) == (f"'{path}' has no native ground truth. Pass data.native=true, or protocol=paper.")


@pytest.mark.parametrize("native", [True, False])
def test_a_pair_brings_native_truth_as_its_store_does(tmp_path: Path, native: bool) -> None:
    writer = StoreWriter(tmp_path / "a.h5", size=SIZE, native=native)
    depth = np.ones(SIZE, np.uint16)
    with pytest.raises(ValueError, match="'x': either all pairs of a store have native ground truth or none"):
        writer.append(Record("x", "", 0), np.zeros((*SIZE, 3), np.uint8), depth, None if native else png(depth))
    writer.abort()


def test_damaged_native_truth_names_the_pair(filled: tuple[Any, ...]) -> None:
    store = filled[0]
    with h5py.File(store.path, "r+") as file:
        start = int(file["native/end"][1])
        file["native/png"][start : start + 8] = 0
    with pytest.raises(DataError) as caught:
        store.read_native(2)
    assert str(caught.value) == f"'{store.path}': the ground truth of '02' is damaged. Delete it and prepare again."
    store.read_native(3)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.h5' cannot be read as a depth store .*No such file.* prepare again\.$"):
        DepthStore(tmp_path / "none.h5")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_file(filled: tuple[Any, ...], share: float) -> None:
    path = filled[0].path
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DataError) as caught:
        DepthStore(path)
    message = str(caught.value)
    assert message.startswith(f"'{path}' cannot be read as a depth store (")
    assert message.endswith("). Delete it and prepare again.")
    assert "\n" not in message


def test_a_file_of_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(b"PK\x03\x04 this is a zip" * 100)
    with pytest.raises(DataError, match=r"a\.h5' cannot be read as a depth store \(.*signature not found.*\)"):
        DepthStore(path)


def test_a_foreign_hdf5_file(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["image"] = np.zeros((1, *SIZE, 3))
    with pytest.raises(DataError) as caught:
        DepthStore(path)
    assert str(caught.value) == f"'{path}' is not a depth store of version 2. Delete it and prepare again."


def test_another_version(filled: tuple[Any, ...]) -> None:
    path = filled[0].path
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 1
    with pytest.raises(DataError) as caught:
        DepthStore(path)
    assert str(caught.value) == f"'{path}' is not a depth store of version 2. Delete it and prepare again."


def test_an_unfinished_file(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    writer = StoreWriter(path, size=SIZE, native=False)
    writer.append(Record("a", "", 0), np.zeros((*SIZE, 3), np.uint8), np.ones(SIZE, np.uint16), None)
    writer.abort()
    writer.abort()  # twice does no harm
    with pytest.raises(DataError, match=r"Delete it and prepare again\.$"):
        DepthStore(path)


def _drop_frames(file: h5py.File) -> None:
    del file["records/frame"]
    file["records/frame"] = np.zeros(3, np.int64)


def _replace(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[h5py.File], None]:
    def damage(file: h5py.File) -> None:
        values = file[name][()]
        del file[name]
        file[name] = change(values)

    return damage


def _text(*values: str) -> Callable[[np.ndarray], np.ndarray]:
    return lambda _: np.array(values, dtype=h5py.string_dtype())


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (_replace("image", lambda values: values[:-1]), "'depth' is uint16"),
        (_replace("depth", lambda values: values[:-3]), "'depth' is uint16 of shape"),
        (_replace("depth", lambda values: values[:, :2]), "'depth' is uint16 of shape"),
        (_replace("depth", lambda values: values.astype("f4")), "'depth' is float32"),
        (_replace("image", lambda values: values.astype("f4")), "'image' is float32"),
        (_replace("image", lambda _: np.zeros((7, 3, 5000, 3), np.uint8)), "size: .* at most 2048 pixels"),
        (_replace("native/end", lambda values: values[::-1]), "ends of its native truths"),
        (_replace("native/end", lambda values: values + 10**12), "ends of its native truths"),
        (_replace("native/end", lambda values: values[:2]), "'native/end' is int64"),
        (_replace("native/png", lambda values: values.astype("u2")), "'native/png' is uint16"),
        (_replace("records/id", _text(*"aabcdef")), "ids repeat"),
        (_replace("records/frame", lambda values: values + 0.5), "'records/frame' is float64"),
        (lambda file: file.attrs.__setitem__("per_metre", 7), "per_metre is 7"),
        (lambda file: file.attrs.__setitem__("info", "[" * 20_000), "recursion"),
        (lambda file: file.attrs.__setitem__("info", "[1]"), "cannot convert"),
        (lambda file: (file.pop("image"), file.__setitem__("image", h5py.ExternalLink("b.h5", "image"))), "no array"),
    ],
)
def test_parts_that_disagree(filled: tuple[Any, ...], damage: Any, what: str) -> None:
    path = filled[0].path
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(DataError, match=rf"cannot be read as a depth store \(.*{what}.*Delete it and prepare again\."):
        DepthStore(path)


@pytest.mark.parametrize("kind", [{"chunks": None}, {"chunks": (2, *SIZE)}, {"compression": "gzip"}, {"dtype": ">u2"}])
def test_rows_that_are_stored_in_another_way(filled: tuple[Any, ...], kind: dict[str, Any]) -> None:
    """The bytes of a foreign file must not be taken for values."""
    path = filled[0].path
    with h5py.File(path, "r+") as file:
        values = file["depth"][()]
        del file["depth"]
        file.create_dataset("depth", data=values, **{"chunks": (1, *SIZE), **kind})
    store = DepthStore(path)
    for use in (lambda: store.read([0]), lambda: store.read_ahead(0, 3)):
        with pytest.raises(DataError, match=r"is damaged \('/depth' is not stored row by row\)\. Delete it"):
            use()


def test_native_truth_that_is_too_large_to_score(filled: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_module, "MAX_NATIVE_PIXELS", filled[0].read_native(2).size - 1)
    with pytest.raises(DataError, match=r"ground truth of '02' has over \d+ pixels\. Shrink it"):
        filled[0].read_native(2)


@pytest.mark.parametrize("content", [b"x" * 40, png(np.ones((2, 2, 3), np.uint8)), png(np.ones((2, 2), np.uint8))])
def test_native_truth_that_is_no_16_bit_png(filled: tuple[Any, ...], content: np.ndarray) -> None:
    store = filled[0]
    bytes_ = np.frombuffer(bytes(content), np.uint8)
    with h5py.File(store.path, "r+") as file:
        del file["native/png"], file["native/end"]
        file["native/png"] = np.tile(bytes_, 7)
        file["native/end"] = len(bytes_) * np.arange(1, 8)
    with pytest.raises(DataError, match="ground truth of '00' is damaged"):
        DepthStore(store.path).read_native(0)


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.attrs.__delitem__("info"),
        lambda file: file.attrs.__setitem__("info", "{not json"),
        lambda file: file.attrs.__setitem__("info", 7),
        lambda file: file.__delitem__("records/scene"),
        lambda file: file.__delitem__("image"),
        _drop_frames,
    ],
    ids=["no info", "info is no JSON", "info is a number", "no scenes", "no images", "too few frames"],
)
def test_a_store_with_a_part_missing(filled: tuple[Any, ...], damage: Any) -> None:
    path = filled[0].path
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(DataError) as caught:
        DepthStore(path)
    assert str(caught.value).startswith(f"'{path}' cannot be read as a depth store (")


def test_layout_is_as_documented(filled: tuple[Any, ...]) -> None:
    with h5py.File(filled[0].path) as file:
        assert {key: (file[key].dtype, file[key].shape) for key in ("image", "depth", "native/end")} == {
            "image": (np.uint8, (7, *SIZE, 3)),
            "depth": (np.uint16, (7, *SIZE)),
            "native/end": (np.int64, (7,)),
        }
        assert len(file["native/png"]) == file["native/end"][-1]
        assert sorted(file["records"]) == ["category", "frame", "id", "scene", "split"]
        assert json.loads(file.attrs["info"]) == {"source": "test"}


def test_a_store_on_a_disk_without_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise BlockingIOError(11, "Unable to synchronously open file (unable to lock file, errno = 11)")

    monkeypatch.setattr(h5py, "File", refuse)
    with pytest.raises(DataError, match="HDF5_USE_FILE_LOCKING=FALSE"):
        DepthStore(tmp_path / "a.h5")
