"""Read frames of videos and cameras, and write videos, with only a few frames in memory at a time."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import struct
import tempfile
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from hudepth.base.errors import DataError
from hudepth.base.images import check_pixels

# FFmpeg may open local files only, whatever a playlist names, and stays quiet; OpenCV reads these when it opens a file.
os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

DEFAULT_RATE = 25.0  # frames per second where a source does not state its rate


class Codec(NamedTuple):
    """A way to encode videos."""

    fourcc: str
    ending: str
    words: str


CODECS = (
    Codec("avc1", ".mp4", "H.264, which browsers and phones play"),
    Codec("VP80", ".webm", "VP8, which browsers and phones play"),
    Codec("mp4v", ".mp4", "MPEG-4 part 2, which browsers do not play: OpenCV has no H.264 or VP8 here"),
)
"""By preference. PyPI's OpenCV for Linux encodes H.264 on some boards only. Its VP9 takes four times as long as its VP8
and gives the same quality. Every build has the last one."""


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
        """Once all frames are read: return a line if there are none, or fewer than the file states."""
        if not self.read:
            return "holds no frame that can be decoded"
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
    """A video that appears when the block ends, with all frames written so far.

    It does so even after an error, but then it does not replace an earlier one. OpenCV says nothing of a full disk:
    OSError is raised here instead, and the video does not appear.
    """

    def __init__(self, path: Path, *, rate: float) -> None:
        """Prepare ``path``, which has no ending: that of the first of :data:`CODECS` that works here is added."""
        self.path, self._rate = path, rate
        self.codec: Codec | None = None  # once there is a frame
        self._writer: cv2.VideoWriter | None = None

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
            self._open(size=(even.shape[1], even.shape[0]))
        assert self._writer is not None
        self._writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))

    def _open(self, size: tuple[int, int]) -> None:
        self.codec = next((codec for codec in CODECS[:-1] if _works(codec, size)), CODECS[-1])
        ending = self.codec.ending  # by which OpenCV chooses the container
        self._part = self.path.with_name(f".{self.path.name}.{os.getpid()}.part{ending}")
        self.path = self.path.with_name(self.path.name + ending)
        self._writer = _open(self._part, self.codec, self._rate, size)
        if not self._writer.isOpened():
            raise DataError(f"'{self.path}': cannot write a video of {size[0]} x {size[1]} there.")

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


def _open(path: Path, codec: Codec, rate: float, size: tuple[int, int]) -> cv2.VideoWriter:
    with _no_output():
        return cv2.VideoWriter(_utf8(path), cv2.VideoWriter.fourcc(*codec.fourcc), rate, size)


@contextlib.contextmanager
def _no_output() -> Iterator[None]:
    """Discard what C code prints: OpenCV does not know that WebM holds VP8, says so, and writes it."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a process without standard error
            kept = os.dup(2)
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, 2)
            with Path(os.devnull).open("wb") as nothing:
                os.dup2(nothing.fileno(), 2)
        yield


@lru_cache(maxsize=64)
def _works(codec: Codec, size: tuple[int, int]) -> bool:
    """Return whether frames of this size (width, height) can be encoded and read again: that it opens says little."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trial" + codec.ending)
        writer = _open(path, codec, DEFAULT_RATE, size)
        for _ in range(3 if writer.isOpened() else 0):
            writer.write(np.zeros((size[1], size[0], 3), np.uint8))
        writer.release()
        if not _is_whole(path):
            return False
        capture = cv2.VideoCapture(_utf8(path))
        same = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)) == size[0] and capture.read()[0]
        capture.release()  # before its file is removed
        return bool(same)


def _is_whole(path: Path) -> bool:
    """Return whether a file written to the end is there: its index or length is written last."""
    return path.exists() and (_is_whole_webm if path.suffix == ".webm" else _is_whole_mp4)(path)


def _is_whole_webm(path: Path) -> bool:
    """Return whether the Segment, the second and last element of a WebM file (RFC 8794), ends where the file does."""
    with path.open("rb") as file:
        head = file.read(64)
    at = head.find(b"\x18\x53\x80\x67\x01") + 4  # its name, and that its length takes 8 bytes
    return at > 3 and at + 8 + int.from_bytes(head[at + 1 : at + 8], "big") == path.stat().st_size


def _is_whole_mp4(path: Path) -> bool:
    """Return whether an MP4 file has its index, which is written last, and ends where its last box does."""
    end, at, kinds = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while 0 <= at < end:
            file.seek(at)
            length, kind, long = struct.unpack(">I4sQ", file.read(16).ljust(16, b"\0"))
            kinds.add(kind)
            at += max(8, long if length == 1 else length)
    return at == end and b"moov" in kinds
