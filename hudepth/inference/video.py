"""Read frames of videos and cameras, and write videos, with only a few frames in memory at a time."""

from __future__ import annotations

import errno
import os
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from hudepth.base.errors import DataError
from hudepth.base.images import check_pixels

# FFmpeg may open local files only, whatever a playlist names, and stays quiet; OpenCV reads these when it opens a file.
os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

DEFAULT_RATE = 25.0  # frames per second where a source does not state its rate
CODEC = "mp4v"  # MPEG-4 part 2, which every build of OpenCV can write


class FrameReader:
    """Upright RGB frames of a video file or of a numbered camera; raises DataError if not readable or too large."""

    def __init__(self, source: Path | int) -> None:
        self.name = f"camera {source}" if isinstance(source, int) else f"'{source}'"
        self._capture = cv2.VideoCapture(source if isinstance(source, int) else _utf8(source))
        if not self._capture.isOpened():
            self._capture.release()
            fix = "It is not a video or is cut off before its index; convert it to .mp4."
            if isinstance(source, int):
                fix = "Pass the number of a connected camera."
            raise DataError(f"{self.name}: cannot be opened. {fix}")
        width, height = (int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        check_pixels(height, width, where=self.name)
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.rate = rate if 0 < rate < 1000 else DEFAULT_RATE  # frames per second
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)  # as the file states; a camera does not
        self.expected = int(count) if not isinstance(source, int) and 0 < count < 1e9 else None
        self.read = 0

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Yield the remaining frames."""
        while True:
            ok, bgr = self._capture.read()
            if not ok:
                return
            self.read += 1
            yield np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)

    def shortfall(self) -> str | None:
        """Once all frames are read: return a line if the file ended before the number it states."""
        if self.expected is None or self.read >= self.expected - 1:  # containers round and may be off by one
            return None
        return f"ends after {self.read} of {self.expected} frames, the file is cut off or damaged; those were kept"

    def close(self) -> None:
        """Release the file or the camera."""
        self._capture.release()


def _utf8(path: Path) -> str:
    """Return a path as OpenCV takes it; raises DataError if its name is not UTF-8."""
    try:
        return str(path).encode().decode()
    except UnicodeEncodeError:
        raise DataError(f"{str(path)!a}: videos need names in UTF-8. Rename it.") from None


class VideoWriter:
    """An ``.mp4`` that appears when the block ends, with all frames written so far.

    It does so even after an error, but then it does not replace an earlier one. OpenCV says nothing of a full disk:
    OSError is raised here instead, and the video does not appear.
    """

    def __init__(self, path: Path, *, rate: float) -> None:
        self.path, self._rate = path, rate
        self._writer: cv2.VideoWriter | None = None
        self._part = path.with_name(f".{path.stem}.{os.getpid()}.part.mp4")  # OpenCV chooses the format by the ending

    def __enter__(self) -> VideoWriter:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        return self

    def write(self, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
        """Add a frame; all must have the size of the first. Odd sides lose a pixel, since the codec needs even ones.

        Raises DataError if the video cannot be written, and OSError if the disk is full.
        """
        if not shutil.disk_usage(self.path.parent).free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        even = rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2]
        if self._writer is None:
            size = (even.shape[1], even.shape[0])
            self._writer = cv2.VideoWriter(_utf8(self._part), cv2.VideoWriter.fourcc(*CODEC), self._rate, size)
            if not self._writer.isOpened():
                raise DataError(f"'{self.path}': cannot write a video of {size[0]} x {size[1]} there.")
        self._writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._writer is None:
            return
        self._writer.release()
        try:
            if not _is_whole(self._part):
                raise OSError(errno.ENOSPC, "the disk is full, or a file may not be so large", str(self.path))
            if kind is None or not self.path.exists():
                self._part.replace(self.path)
        finally:
            self._part.unlink(missing_ok=True)


def _is_whole(path: Path) -> bool:
    """Return whether an MP4 file has its index, which is written last, and ends where its last box does."""
    if not path.exists():
        return False
    end, at, kinds = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while 0 <= at < end:
            file.seek(at)
            length, kind, long = struct.unpack(">I4sQ", file.read(16).ljust(16, b"\0"))
            kinds.add(kind)
            at += max(8, long if length == 1 else length)
    return at == end and b"moov" in kinds
