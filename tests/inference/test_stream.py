from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hudepth.inference.depth_map import DepthMap
from hudepth.inference.model import DepthModel
from hudepth.inference.stream import LOT, Stream, Tally


def frame(value: int) -> np.ndarray:
    return np.full((6, 8, 3), value, np.uint8)


@pytest.mark.parametrize(("batch_size", "batches"), [(1, [1] * 10), (4, [4, 4, 2]), (100, [10])])
@pytest.mark.parametrize("overlap", [False, True])
def test_every_image_is_written_once_in_batches(
    grey: DepthModel, batch_size: int, batches: list[int], overlap: bool
) -> None:
    written: dict[int, float] = {}

    def write(key: int, depth: DepthMap) -> None:
        written[key] = float(depth.metres[0, 0])

    tally = Tally()
    stream: Stream[int] = Stream(grey, write, tally=tally, batch_size=batch_size, overlap=overlap)
    assert list(stream.run((value, frame(value)) for value in range(10))) == list(range(10))
    assert written == {value: pytest.approx(value / 100) for value in range(10)}
    assert tally.done == 10
    assert grey.backend.batches == batches  # type: ignore[attr-defined]


def test_what_cannot_be_read_is_left_out_and_noted(grey: DepthModel, tmp_path: Path) -> None:
    good, bad, moving = tmp_path / "good.png", tmp_path / "bad.jpg", tmp_path / "moving.gif"
    Image.fromarray(frame(50)).save(good)
    bad.write_bytes(b"\xff\xd8\xff")
    Image.fromarray(frame(1)).save(moving, save_all=True, append_images=[Image.fromarray(frame(2))])
    tally, written = Tally(), []
    stream: Stream[str] = Stream(grey, lambda key, _: written.append(key), tally=tally)
    seen = list(stream.run((str(path), path) for path in (good, bad, moving)))
    assert sorted(seen) == sorted([str(good), str(bad), str(moving)])
    assert sorted(written) == [str(good), str(moving)]
    assert list(tally.failed) == [str(bad)]
    assert "bad.jpg'" in tally.failed[str(bad)]
    assert tally.notes == {str(moving): "animated, 2 frames: the first is taken"}


def test_frames_are_smoothed_in_order(grey: DepthModel) -> None:
    written: list[float] = []
    stream: Stream[int] = Stream(
        grey, lambda _, d: written.append(float(d.metres[0, 0])), tally=Tally(), smoothing=0.5, workers=1
    )
    list(stream.run(enumerate([frame(100), frame(200), frame(200)])))
    assert written == pytest.approx([1.0, 1.5, 1.75])


@pytest.mark.parametrize("overlap", [False, True])
def test_a_slow_disk_holds_back_the_reading(grey: DepthModel, overlap: bool) -> None:
    """However long the video, no more than a few frames are in memory."""
    read, written, most = 0, 0, 0
    lock = threading.Lock()

    def frames() -> Iterator[tuple[int, np.ndarray]]:
        nonlocal read, most
        for number in range(60):
            with lock:
                read += 1
                most = max(most, read - written)
            yield number, frame(number)

    def write(_: int, __: DepthMap) -> None:
        nonlocal written
        time.sleep(0.002)
        with lock:
            written += 1

    stream: Stream[int] = Stream(grey, write, tally=Tally(), workers=1, overlap=overlap)
    list(stream.run(frames()))
    assert written == 60
    assert most <= 3 * LOT  # one lot being written, one in hand, one ahead


def test_a_full_disk_ends_it(grey: DepthModel) -> None:
    def write(number: int, _: DepthMap) -> None:
        if number >= 3:
            raise OSError(28, "No space left on device")

    tally = Tally()
    stream: Stream[int] = Stream(grey, write, tally=tally)
    with pytest.raises(OSError, match="No space left"):
        list(stream.run((number, frame(number)) for number in range(100)))
    assert tally.done == 3  # what was written, not what was predicted
