"""From files to a store: the right pixels, once, whole or not at all, and one line for whatever goes wrong."""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from hudepth.base.console import log
from hudepth.base.errors import ConfigError, DataError
from hudepth.data.prepare import UNIT_SAMPLES, prepare, store_path
from hudepth.data.sources.base import RawPair, Record
from hudepth.data.sources.folder import FolderSource
from hudepth.data.store import DepthStore

SIZE = (6, 8)
NATIVE = (12, 18)


def write_pair(root: Path, name: str, *, seed: int, scale: float = 1.0, size: tuple[int, int] = NATIVE) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(500, 9500, size) * scale
    depth[rng.random(size) < 0.1] = 0
    for folder, pixels in (("images", rng.integers(0, 256, (*size, 3), np.uint8)), ("depths", depth)):
        (root / folder).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / folder / f"{name}.png"), pixels if folder == "images" else pixels.astype(np.uint16))


def write_set(root: Path, n: int = 5, *, scale: float = 1.0) -> FolderSource:
    for i in range(n):
        write_pair(root, f"{i:02d}", seed=i, scale=scale)
    return FolderSource(root, encoding="uint16_mm")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "set"


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def lines() -> Iterator[list[str]]:
    """What is logged."""
    heard: list[str] = []

    class Ear(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            heard.append(record.getMessage())

    ear, level = Ear(), log.level
    log.addHandler(ear)
    log.setLevel(logging.INFO)
    yield heard
    log.removeHandler(ear)
    log.setLevel(level)


def refusal(source: FolderSource, cache: Path, **options: Any) -> str:
    """Return the one line with which preparing fails, having made sure that no store is left."""
    with pytest.raises(DataError) as caught:
        prepare(source, size=SIZE, cache=cache, **options)
    assert not list(cache.glob("*.h5")) if cache.is_dir() else True
    assert not list(cache.glob(".*.part")) if cache.is_dir() else True
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_store_holds_what_the_files_hold(root: Path, cache: Path) -> None:
    source = write_set(root)
    write_pair(root, "05", seed=5, size=(20, 9))
    store = prepare(source, size=SIZE, cache=cache)
    images, depths = store.read(range(6))
    for i, record in enumerate(source.records()):
        image = cv2.cvtColor(cv2.imread(str(root / record.image)), cv2.COLOR_BGR2RGB)
        depth = cv2.imread(str(root / record.depth), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(images[i], cv2.resize(image, SIZE[::-1], interpolation=cv2.INTER_AREA))
        np.testing.assert_array_equal(depths[i], cv2.resize(depth, SIZE[::-1], interpolation=cv2.INTER_NEAREST_EXACT))
        np.testing.assert_array_equal(store.read_native(i), depth.astype(np.float32) / np.float32(1000))
    assert [record.id for record in store.records] == [f"{i:02d}" for i in range(6)]


def test_info_states_what_was_measured(root: Path, cache: Path, lines: list[str]) -> None:
    source = write_set(root)
    store = prepare(source, size=SIZE, cache=cache)
    raw = np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((root / "depths").iterdir())])
    low, high = raw[raw > 0].min() / 1000, raw.max() / 1000
    middle = float(np.median([np.median(depth[depth > 0]) for depth in raw])) / 1000
    share = float((raw > 0).mean())
    assert store.info == {
        "source": "folder",
        "fingerprint": source.fingerprint(),
        "encoding": "uint16_mm",
        "pairs": 5,
        "depth_min_m": pytest.approx(low, abs=5.1e-4),
        "depth_median_m": pytest.approx(middle, abs=5.1e-4),
        "depth_max_m": pytest.approx(high, abs=5.1e-4),
        "depth_percentiles_m": store.info["depth_percentiles_m"],
        "no_reading": 0.0,
        "valid_fraction": pytest.approx(share, abs=5.1e-5),
        "native_sizes": [list(NATIVE)],
        "skipped": [],
    }
    kept = store.read(range(5))[1]
    assert store.info["depth_percentiles_m"][::50] == pytest.approx(
        [np.quantile(kept[kept > 0], q, method="inverted_cdf") / 1000 for q in (0, 0.5, 1)]
    )
    assert lines == [
        f"folder: 5 pairs, depth {low:.2f} to {high:.2f} m (median {middle:.2f} m, encoding uint16_mm), "
        f"{100 * store.info['valid_fraction']:.1f} % of pixels measured; store {store.path}"
    ]


def test_without_native_truth(root: Path, cache: Path) -> None:
    source = write_set(root, 2)
    bare = prepare(source, size=SIZE, cache=cache, native=False)
    assert not bare.has_native
    assert bare.path != prepare(source, size=SIZE, cache=cache).path


def everything_in(path: Path) -> dict[str, Any]:
    """Each data set's bytes, type and shape, and each attribute: all that is in a file but its times of writing."""
    found: dict[str, Any] = {}
    with h5py.File(path) as file:
        found.update(file.attrs)
        file.visititems(
            lambda name, item: (
                found.update({name: (item[()].tolist(), item.dtype, item.shape)})
                if isinstance(item, h5py.Dataset)
                else None
            )
        )
    return found


def test_one_worker_and_two_write_the_same(root: Path, cache: Path) -> None:
    source = write_set(root, 40)
    one, two = (everything_in(prepare(source, size=SIZE, cache=cache / str(n), workers=n).path) for n in (1, 2))
    assert len(one) == 4 + 4 + 5
    assert one == two


def test_a_second_call_neither_reads_nor_writes(root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_set(root)
    path = prepare(source, size=SIZE, cache=cache).path
    before = path.stat().st_mtime_ns, path.read_bytes()
    monkeypatch.setattr(FolderSource, "read", None)
    assert prepare(source, size=SIZE, cache=cache).path == path
    assert (path.stat().st_mtime_ns, path.read_bytes()) == before


def test_a_cache_that_can_only_be_read_serves_what_it_has(root: Path, cache: Path) -> None:
    source = write_set(root)
    path = prepare(source, size=SIZE, cache=cache).path
    lock = path.with_suffix(".lock")
    lock.unlink(missing_ok=True)
    lock.mkdir()  # no lock can be taken, as on a read-only disk
    assert len(prepare(source, size=SIZE, cache=cache)) == 5


def edit(root: Path) -> None:
    """Change one byte and keep size and times, as rsync -t may."""
    path = root / "depths/00.png"
    before, data = path.stat(), bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize(
    "change",
    [
        edit,
        lambda root: write_pair(root, "05", seed=5),
        lambda root: [path.unlink() for path in root.glob("*/04.png")],
        lambda root: (root / "images/00.png").write_bytes((root / "images/00.png").read_bytes() + b"\0"),
        lambda root: [path.rename(path.with_name("10.png")) for path in root.glob("*/04.png")],
    ],
    ids=["edited", "one more", "one less", "longer", "renamed"],
)
def test_changed_files_give_another_store(root: Path, cache: Path, change: Callable[[Path], Any]) -> None:
    source = write_set(root)
    before = store_path(source, size=SIZE, native=True, cache=cache)
    assert store_path(FolderSource(root, encoding="uint16_mm"), size=SIZE, native=True, cache=cache) == before
    change(root)
    assert store_path(source, size=SIZE, native=True, cache=cache) != before


def test_size_encoding_and_native_truth_give_another_store(root: Path, cache: Path) -> None:
    source = write_set(root)
    paths = {
        store_path(source, size=SIZE, native=True, cache=cache),
        store_path(source, size=SIZE[::-1], native=True, cache=cache),
        store_path(source, size=SIZE, native=False, cache=cache),
        store_path(FolderSource(root, encoding="paper_literal"), size=SIZE, native=True, cache=cache),
    }
    assert len(paths) == 4
    assert {path.parent for path in paths} == {cache}
    assert sorted(path.name[:11] for path in paths) == ["folder-6x8-", "folder-6x8-", "folder-6x8-", "folder-8x6-"]


# Failures


def test_unknown_on_error(root: Path, cache: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        prepare(write_set(root, 1), size=SIZE, cache=cache, on_error="ignore")
    assert str(caught.value).startswith("data.on_error: 'ignore' is not one of raise, skip")


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def no_depth(root: Path) -> str:
    cv2.imwrite(str(root / "depths/02.png"), np.zeros(NATIVE, np.uint16))
    return "'depths/02.png': the depth is zero everywhere, nothing is measured."


def truncated_png(root: Path) -> str:
    cut(root / "depths/02.png")
    return f"'{root}/depths/02.png': the PNG is truncated or damaged (no end of the image). Copy the file again."


def truncated_jpeg(root: Path) -> str:
    image = cv2.imread(str(root / "images/02.png"))
    (root / "images/02.png").unlink()
    cv2.imwrite(str(root / "images/02.jpg"), image)
    cut(root / "images/02.jpg")
    return f"'{root}/images/02.jpg': the JPEG is truncated or damaged (no end of the image). Copy the file again."


def unequal(root: Path) -> str:
    cv2.imwrite(str(root / "depths/02.png"), np.full((12, 17), 2000, np.uint16))
    found = f"'{root}/images/02.png' is 18 x 12 pixels but '{root}/depths/02.png' is 17 x 12. Both must have one size."
    return f"{found} If they show the same view, pass data.source.unequal_sizes=true."


def one_of_8_bits(root: Path) -> str:
    cv2.imwrite(str(root / "depths/02.png"), np.full(NATIVE, 200, np.uint8))
    return (
        "depths/02.png: 8-bit data declared as millimetres (largest value 200 = 0.2 m). Use data.encoding=uint8_10m "
        "for value/255*10 m, or data.encoding=paper_literal to read it so on purpose."
    )


SPOILS = [no_depth, truncated_png, truncated_jpeg, unequal, one_of_8_bits]


@pytest.mark.parametrize("spoil", SPOILS)
def test_a_bad_pair_is_named_and_leaves_no_store(root: Path, cache: Path, spoil: Callable[[Path], str]) -> None:
    source = write_set(root)
    line = spoil(root)
    advice = "Fix it, or pass data.on_error=skip to leave out such pairs."
    assert refusal(source, cache) == f"{line} {advice}"


@pytest.mark.parametrize("spoil", SPOILS)
def test_a_bad_pair_is_skipped_and_listed(
    root: Path, cache: Path, lines: list[str], spoil: Callable[[Path], str]
) -> None:
    source = write_set(root)
    line = spoil(root)
    store = prepare(source, size=SIZE, cache=cache, on_error="skip")
    assert [record.id for record in store.records] == ["00", "01", "03", "04"]
    assert (store.info["pairs"], store.info["skipped"]) == (4, [line])
    assert lines[1:] == ["folder: 1 pairs skipped:", f"  {line}"]
    depth = cv2.imread(str(root / "depths/03.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(store.read_native(2), depth.astype(np.float32) / np.float32(1000))
    with pytest.raises(DataError) as caught:
        prepare(source, size=SIZE, cache=cache, on_error="raise")
    assert str(caught.value) == (
        f"folder: 1 pairs could not be read, the first: {line} Fix them, or pass data.on_error=skip to leave them out."
    )
    write_pair(root, "02", seed=9)
    (root / "images/02.jpg").unlink(missing_ok=True)
    assert len(prepare(source, size=SIZE, cache=cache, on_error="raise")) == 5


def test_no_readable_pair(root: Path, cache: Path) -> None:
    source = write_set(root, 2)
    for path in (root / "depths").iterdir():
        cv2.imwrite(str(path), np.zeros(NATIVE, np.uint16))
    assert refusal(source, cache, on_error="skip") == (
        "folder: none of 2 pairs could be read; the first: "
        "'depths/00.png': the depth is zero everywhere, nothing is measured."
    )


class EmptySource(FolderSource):
    def records(self) -> list[Record]:
        return []

    def files(self) -> list[Path]:
        return []


def test_an_empty_set(root: Path, cache: Path) -> None:
    assert refusal(EmptySource(root, encoding="uint16_mm"), cache) == "folder: the set is empty. Check data.root."


class CountingSource(FolderSource):
    """Notes what is read."""

    def __init__(self, root: Path, **options: Any) -> None:
        super().__init__(root, **options)
        self.seen: list[str] = []

    def read(self, record: Record) -> RawPair:
        self.seen.append(record.id)
        return super().read(record)


@pytest.mark.parametrize("on_error", ["raise", "skip"])
def test_implausible_units_are_refused_before_the_rest_is_read(root: Path, cache: Path, on_error: str) -> None:
    write_set(root, 40, scale=0.01)  # centimetres declared as millimetres
    source = CountingSource(root, encoding="uint16_mm")
    message = refusal(source, cache, on_error=on_error)
    assert message.startswith("data.encoding=uint16_mm: 'folder' has a median depth of 0.0")
    assert "data.encoding=cm (median" in message
    assert message.endswith("data.source.indoor=false for outdoor pairs.")
    assert len(source.seen) == UNIT_SAMPLES
    assert int(source.seen[-1]) >= 30  # from all of the set
    source.indoor = False
    assert len(prepare(source, size=SIZE, cache=cache, workers=1)) == 40


def test_depth_that_is_kept_sparse_has_a_store_of_its_own(root: Path, cache: Path) -> None:
    source = write_set(root, 1)
    paths = {store_path(source, size=SIZE, native=True, cache=cache)}
    source.sparse = True
    paths.add(store_path(source, size=SIZE, native=True, cache=cache))
    source.farthest_m = 100
    paths.add(store_path(source, size=SIZE, native=True, cache=cache))
    assert len(paths) == 3


@pytest.mark.parametrize("on_error", ["raise", "skip"])
def test_a_wrong_encoding_is_refused_before_the_rest_is_read(root: Path, cache: Path, on_error: str) -> None:
    write_set(root, 40)
    source = CountingSource(root, encoding="uint8_10m")
    assert refusal(source, cache, on_error=on_error) == (
        "depths/00.png: uint16 data declared as uint8_10m. Use data.encoding=uint16_mm."
    )
    assert len(source.seen) == UNIT_SAMPLES


@pytest.mark.parametrize(("inner", "reason"), [("", "File exists"), ("deep/er", "Not a directory")])
def test_a_cache_that_cannot_be_made(root: Path, tmp_path: Path, inner: str, reason: str) -> None:
    (tmp_path / "cache").write_text("in the way")
    source = write_set(root, 1)
    cache = tmp_path / "cache" / inner
    path = store_path(source, size=SIZE, native=True, cache=cache)
    assert refusal(source, cache) == (
        f"paths.cache: cannot write '{path}' ({reason}). "
        "Free some space, or pass paths.cache=<a folder you can write to>."
    )


def test_a_disk_too_small_is_refused_at_once(root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_set(root, 20)
    source = CountingSource(root, encoding="uint16_mm")
    usage = shutil.disk_usage(root)._replace(free=5 * 20 * 256 * 512 - 1)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(DataError, match=r"\(it takes 13\.1 MB or more, 13\.1 MB are free\)\. Free some space"):
        prepare(source, size=(256, 512), cache=cache)
    assert len(source.seen) == UNIT_SAMPLES
    assert not list(cache.glob("*.h5"))


def test_a_limit_of_file_sizes_is_refused_at_once(root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    source = write_set(root)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1024, 1024))
    with pytest.raises(DataError, match=r"\. Raise the limit of file sizes \(ulimit -f\), or pass paths\.cache="):
        prepare(source, size=SIZE, cache=cache)
    assert not [path for path in cache.iterdir() if path.suffix != ".lock"]


@pytest.mark.parametrize("kind", [OSError, RuntimeError])
def test_a_full_disk_gives_one_line(
    root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, kind: type[Exception]
) -> None:
    source = write_set(root)
    path = store_path(source, size=SIZE, native=True, cache=cache)
    # As HDF5 words it, over several lines.
    text = f"Can't write data (file write failed: time = now\n, filename = 'x', errno = {errno.ENOSPC}, error message)"

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, text) if kind is OSError else RuntimeError(text)

    monkeypatch.setattr(h5py.Dataset, "__setitem__", full)
    assert refusal(source, cache) == (
        f"paths.cache: cannot write '{path}' (No space left on device). "
        "Free some space, or pass paths.cache=<a folder you can write to>."
    )
    monkeypatch.undo()
    assert len(prepare(source, size=SIZE, cache=cache)) == 5


# Several processes

SCRIPT = """
import os, resource, signal, sys, time
from pathlib import Path
from hudepth.data.prepare import prepare
from hudepth.data.sources.folder import FolderSource
from hudepth.base.errors import DataError

class SlowSource(FolderSource):
    def read(self, record):
        with (Path(self.root).parent / f"read_by_{os.getpid()}").open("a") as file:
            file.write(record.id + "\\n")
        time.sleep(PAUSE)
        return super().read(record)

PAUSE, LIMIT = float(sys.argv[3]), int(sys.argv[5])
if __name__ == "__main__":
    if LIMIT:
        resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, LIMIT))
    try:
        store = prepare(
            SlowSource(sys.argv[1], encoding="uint16_mm"), size=(6, 8), cache=sys.argv[2], workers=int(sys.argv[4])
        )
    except DataError as error:
        print(error)
        sys.exit(3)
    print(len(store))
"""


def start(tmp_path: Path, *, pause: float = 0.0, workers: int = 1, limit_bytes: int = 0) -> subprocess.Popen[str]:
    """Prepare in another process."""
    (tmp_path / "script.py").write_text(SCRIPT)
    arguments = [tmp_path / "set", tmp_path / "cache", pause, workers, limit_bytes]
    command = [sys.executable, str(tmp_path / "script.py"), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=tmp_path
    )


def wait_for(condition: Callable[[], bool], *, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def readers(tmp_path: Path) -> dict[int, list[str]]:
    """What each process has read."""
    return {int(path.name.removeprefix("read_by_")): path.read_text().split() for path in tmp_path.glob("read_by_*")}


@pytest.mark.slow
def test_two_processes_prepare_once(tmp_path: Path, root: Path, cache: Path) -> None:
    write_set(root, 20)
    both = [start(tmp_path, pause=0.03) for _ in range(2)]
    for process in both:
        out, err = process.communicate(timeout=120)
        assert (process.returncode, out, err) == (0, "20\n", "")
    assert [len(names) for names in readers(tmp_path).values()] == [UNIT_SAMPLES + 20]
    assert len(list(cache.glob("*.h5"))) == 1
    assert not list(cache.glob(".*.part"))


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_kill_leaves_nothing_that_passes_for_a_store(tmp_path: Path, root: Path, cache: Path) -> None:
    source = write_set(root, 40)
    path = store_path(source, size=SIZE, native=True, cache=cache)
    process = start(tmp_path, pause=0.02, workers=2)
    wait_for(lambda: len(readers(tmp_path)) == 3)  # the parent's samples, and both workers have begun
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not path.exists()
    parts = list(cache.glob(".*.part"))
    assert len(parts) == 1
    with pytest.raises(DataError):
        DepthStore(parts[0])
    wait_for(lambda: not any(alive(pid) for pid in readers(tmp_path)))  # no process waits for ever
    assert len(prepare(source, size=SIZE, cache=cache, workers=1)) == 40
    assert not list(cache.glob(".*.part"))


@pytest.mark.slow
@pytest.mark.parametrize("limit_bytes", [20_000, 60_000])
def test_a_file_that_cannot_grow_gives_one_line_and_no_crash(
    tmp_path: Path, root: Path, cache: Path, limit_bytes: int
) -> None:
    source = write_set(root, 20)
    path = store_path(source, size=SIZE, native=True, cache=cache)
    process = start(tmp_path, limit_bytes=limit_bytes)
    out, err = process.communicate(timeout=120)
    assert (process.returncode, out, err) == (
        3,
        f"paths.cache: cannot write '{path}' (File too large). "
        "Raise the limit of file sizes (ulimit -f), or pass paths.cache=<a folder you can write to>.\n",
        "",
    )
    assert {file.suffix for file in cache.iterdir()} <= {".lock", ".json"}  # the latter: hashes of older files


def test_no_reading_and_a_far_median_are_said(root: Path, cache: Path, lines: list[str]) -> None:
    source = write_set(root)
    for path in (root / "depths").iterdir():
        depth = np.full(NATIVE, 12_500, np.uint16)  # 2.5 m as TUM stores it
        depth[:3] = 65535
        cv2.imwrite(str(path), depth)
    store = prepare(source, size=SIZE, cache=cache)
    assert store.info["no_reading"] == 0.25
    assert store.info["depth_max_m"] == 12.5
    assert any("25.0 %" in line and "data.invalid" in line for line in lines)
    assert any("data.encoding=uint16_5000 (median 2.5 m)" in line for line in lines)
    lines.clear()
    said = FolderSource(root, encoding="linear", depth_scale_m=1 / 5000, invalid=[65535])
    assert prepare(said, size=SIZE, cache=cache).info["depth_max_m"] == 2.5
    assert len(lines) == 1


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("depth_max_m", "far"),
        ("skipped", [{}]),
        ("native_sizes", [[0, 0]]),
        ("native_sizes", "a"),
        ("fingerprint", None),
    ],
)
def test_a_store_whose_info_is_damaged_is_one_line(root: Path, cache: Path, key: str, value: Any) -> None:
    source = write_set(root)
    path = prepare(source, size=SIZE, cache=cache, workers=1).path
    with h5py.File(path, "r+") as file:
        file.attrs["info"] = json.dumps({**json.loads(file.attrs["info"]), key: value})
    with pytest.raises(DataError, match=rf"is damaged: its info's {key}.*Delete it and prepare again\."):
        prepare(source, size=SIZE, cache=cache, workers=1)


def test_a_pipe_in_place_of_a_store_is_not_waited_for(root: Path, cache: Path) -> None:
    source = write_set(root)
    path = store_path(source, size=SIZE, native=True, cache=cache)
    cache.mkdir(exist_ok=True)
    os.mkfifo(path)
    with pytest.raises(DataError, match="is no regular file"):
        prepare(source, size=SIZE, cache=cache, workers=1)
