from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from hudepth.base.errors import DataError
from hudepth.inference.video import FrameReader, VideoWriter


def write_video(path: Path, count: int, *, codec: str = "MJPG", size: tuple[int, int] = (48, 64)) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10, (size[1], size[0]))
    for number in range(count):
        writer.write(np.full((*size, 3), (0, 0, 10 * number), np.uint8))  # OpenCV's order: blue, green, red
    writer.release()


def test_frames_come_in_order_as_rgb(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", 12)
    reader = FrameReader(tmp_path / "a.avi")
    frames = list(reader)
    assert (reader.rate, reader.expected, reader.read) == (10, 12, 12)
    assert reader.shortfall() is None
    assert [round(frame[..., 0].mean() / 10) for frame in frames] == list(range(12))
    assert frames[-1][..., 2].max() < 20
    reader.close()


def test_a_video_that_ends_early_is_reported(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", 40)
    data = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    reader = FrameReader(tmp_path / "cut.avi")
    read = len(list(reader))
    assert 5 < read < 35
    line = reader.shortfall()
    assert line is not None
    assert line.startswith(f"ends after {read} of 40 frames")


@pytest.mark.parametrize("content", [b"", b"text", b"#EXTM3U\n#EXTINF:1,\nfile:///x\n"], ids=["0", "text", "list"])
def test_what_is_not_a_video(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.mp4").write_bytes(content)
    with pytest.raises(DataError, match=r"x.mp4': cannot be opened"):
        FrameReader(tmp_path / "x.mp4")


def test_a_camera_that_is_not_there() -> None:
    with pytest.raises(DataError, match="camera 97: cannot be opened"):
        FrameReader(97)


def test_a_video_is_written_with_even_sides_and_kept_when_something_fails(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "out.mp4"

    def interrupted() -> None:
        with VideoWriter(path, rate=5) as writer:
            for value in (10, 200, 10):
                writer.write(np.full((33, 47, 3), value, np.uint8))
            assert not path.exists()  # whole or not at all
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    reader = FrameReader(path)
    frames = list(reader)
    assert [frame.shape for frame in frames] == [(32, 46, 3)] * 3
    assert reader.rate == 5
    assert [file.name for file in path.parent.iterdir()] == ["out.mp4"]


def write_three(path: Path) -> None:
    with VideoWriter(path, rate=5) as writer:
        for _ in range(3):
            writer.write(np.zeros((32, 48, 3), np.uint8))


def test_a_full_disk_is_noticed_before_the_next_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 9, 0))
    with pytest.raises(OSError, match="No space left"):
        write_three(tmp_path / "out.mp4")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of file sizes")
def test_a_video_that_was_cut_off_leaves_the_earlier_one(tmp_path: Path) -> None:
    """OpenCV does not say that it could not write."""
    path = tmp_path / "out.mp4"
    write_three(path)
    earlier = path.read_bytes()
    code = "import resource, sys, pathlib; from tests.inference.test_video import write_three; "
    code += "resource.setrlimit(resource.RLIMIT_FSIZE, (512, 512)); write_three(pathlib.Path(sys.argv[1]))"
    done = subprocess.run([sys.executable, "-c", code, str(path)], check=False, capture_output=True, text=True)
    assert "OSError" in done.stderr
    assert path.read_bytes() == earlier
    assert list(tmp_path.iterdir()) == [path]


def test_a_video_that_ends_in_an_error_does_not_replace_one(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    write_three(path)
    earlier = path.read_bytes()

    def interrupted() -> None:
        with VideoWriter(path, rate=5) as writer:
            writer.write(np.zeros((32, 48, 3), np.uint8))
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        interrupted()
    assert path.read_bytes() == earlier
    assert list(tmp_path.iterdir()) == [path]


def test_no_frame_no_file(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out.mp4", rate=5):
        pass
    assert list(tmp_path.iterdir()) == []
