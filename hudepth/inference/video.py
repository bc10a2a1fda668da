"""Videos and cameras: frames in, frames out, never more than a few of them in memory."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import UInt8

from hudepth.base.errors import DataError
from hudepth.base.images import check_pixels

# FFmpeg may open files and nothing else, whatever a playlist says, and does not talk; OpenCV looks when it opens one.
os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

USUAL_RATE = 25.0
"""Frames a second of what does not tell."""
CODEC = "mp4v"
"""MPEG-4 part 2: what every build of OpenCV can write."""


class FrameReader:
    """Frames of a video file or a camera, upright RGB, one at a time.

    Args:
        source: a file, or the number of a camera.

    Raises:
        DataError: if it cannot be opened, or its frames are too large.
    """

    def __init__(self, source: Path | int) -> None:
        self.name = f"camera {source}" if isinstance(source, int) else f"'{source}'"
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # what it warns of is an error below
        self._capture = cv2.VideoCapture(source if isinstance(source, int) else str(source))
        if not self._capture.isOpened():
            self._capture.release()
            mend = (
                "Pass the number of one that is connected."
                if isinstance(source, int)
                else "It is no video, or cut off before its index; convert it to .mp4."
            )
            raise DataError(f"{self.name}: cannot be opened. {mend}")
        width, height = (int(self._capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        check_pixels(height, width, where=self.name)
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.rate = rate if 0 < rate < 1000 else USUAL_RATE
        """Frames a second."""
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.expected = int(count) if not isinstance(source, int) and 0 < count < 1e9 else None
        """How many frames the file says it has; None for a camera."""
        self.read = 0
        """How many have been read."""

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Yield the frames that are left."""
        while True:
            there, bgr = self._capture.read()
            if not there:
                return
            self.read += 1
            yield np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)

    def shortfall(self) -> str | None:
        """Return a line if the file ended before the number of frames it states, once all are read."""
        if self.expected is None or self.read >= self.expected - 1:  # containers round, and are one off at times
            return None
        return (
            f"ends after {self.read} of {self.expected} frames, the file is cut off or damaged; what there is was kept"
        )

    def close(self) -> None:
        """Let go of the file or the camera."""
        self._capture.release()


class VideoWriter:
    """A video file that appears whole, with what was written when the block is left, by an error or not.

    Args:
        path: an ``.mp4``; its folder is made.
        rate: frames a second.
    """

    def __init__(self, path: Path, *, rate: float) -> None:
        self.path, self._rate = path, rate
        self._writer: cv2.VideoWriter | None = None
        self._part = path.with_name(f".{path.stem}.{os.getpid()}.part.mp4")  # OpenCV goes by the ending

    def __enter__(self) -> VideoWriter:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        return self

    def write(self, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
        """Add a frame; all must have the first one's size. Odd sides lose a pixel, which the codec cannot keep.

        Raises:
            DataError: if no video can be written there.
        """
        even = rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2]
        if self._writer is None:
            size = (even.shape[1], even.shape[0])
            code = cv2.VideoWriter.fourcc(*CODEC)
            self._writer = cv2.VideoWriter(str(self._part), code, self._rate, size)
            if not self._writer.isOpened():
                raise DataError(f"'{self.path}': no video of {size[0]} x {size[1]} can be written there.")
        self._writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.release()
        if self._part.exists():
            self._part.replace(self.path)  # what was written so far is worth keeping
