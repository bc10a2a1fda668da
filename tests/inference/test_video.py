from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from hudepth.base.errors import DataError
from hudepth.inference.video import CODECS, Codec, FrameReader, VideoWriter
from tests.browser import chromium


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


@pytest.fixture(params=[codec for codec in CODECS if codec.fourcc != "avc1"], ids=lambda codec: codec.fourcc)
def codec(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Codec:
    """Each encoder that PyPI's OpenCV has, as if there were no other."""
    monkeypatch.setattr("hudepth.inference.video.CODECS", (request.param, CODECS[-1]))
    return request.param


def test_a_video_is_written_with_even_sides_and_kept_when_something_fails(tmp_path: Path, codec: Codec) -> None:
    path = tmp_path / "deep" / f"out{codec.ending}"

    def interrupted() -> None:
        with VideoWriter(path.with_suffix(""), rate=5) as writer:
            for value in (10, 200, 10):
                writer.write(np.full((33, 47, 3), value, np.uint8))
            assert not path.exists()  # whole or not at all
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    reader = FrameReader(path)
    frames = list(reader)
    assert [frame.shape for frame in frames] == [(32, 46, 3)] * 3
    assert [round(float(frame.mean()), -1) for frame in frames] == [10, 200, 10]
    assert reader.rate == 5
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def write_three(path: Path) -> Path:
    with VideoWriter(path, rate=5) as writer:
        for _ in range(3):
            writer.write(np.zeros((32, 48, 3), np.uint8))
    return writer.path


def test_the_first_encoder_that_works_is_taken_in_silence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    writer = VideoWriter(tmp_path / "out", rate=5)
    with writer:
        writer.write(np.zeros((32, 48, 3), np.uint8))
    assert writer.codec in CODECS[:2]  # one that browsers play
    assert writer.path.read_bytes()[:4] == (b"\x1aE\xdf\xa3" if writer.path.suffix == ".webm" else b"\0\0\0\x1c")
    absent = Codec("av01", ".mp4", "AV1")
    empty = Codec("mp4v", ".webm", "a file that cannot be read again")
    monkeypatch.setattr("hudepth.inference.video.CODECS", (absent, empty, CODECS[-1]))
    assert write_three(tmp_path / "last").name == "last.mp4"
    assert capfd.readouterr().err == ""


def test_what_c_code_says_later_is_heard(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_three(tmp_path / "out")
    os.write(2, b"heard")
    assert capfd.readouterr().err == "heard"


PLAY = """async name => {
    const video = Object.assign(document.createElement("video"), { muted: true, src: name });
    document.body.append(video);
    await new Promise((good, bad) => {
        video.onloadeddata = good;
        video.onerror = () => bad(video.error.message);
        setTimeout(() => bad("nothing loaded"), 20000);
    });
    const colours = [];
    for (const second of [0.1, 1.5, 2.9]) {
        const shown = new Promise(done => { video.requestVideoFrameCallback(done); setTimeout(done, 5000); });
        await new Promise(done => { video.onseeked = done; video.currentTime = second; });
        await shown;  // a slow machine draws the frame after it has found it
        const pen = Object.assign(document.createElement("canvas"), { width: 1, height: 1 }).getContext("2d");
        pen.drawImage(video, 0, 0, 1, 1);
        colours.push([...pen.getImageData(0, 0, 1, 1).data].slice(0, 3));
    }
    await video.play();
    await new Promise(done => { video.onended = done; });
    return [video.videoWidth, video.videoHeight, video.duration, colours];
}"""


@pytest.mark.slow
def test_a_browser_plays_it(tmp_path: Path) -> None:
    shades = ((250, 20, 20), (20, 250, 20), (20, 20, 250))
    writer = VideoWriter(tmp_path / "out", rate=10)
    with writer:
        for number in range(30):
            writer.write(np.full((64, 96, 3), shades[number // 10], np.uint8))
    (tmp_path / "page.html").write_text("<!doctype html><title>video</title>")
    with chromium("--allow-file-access-from-files") as browser:
        tab = browser.new_page()
        tab.goto((tmp_path / "page.html").as_uri())
        width, height, seconds, colours = tab.evaluate(PLAY, writer.path.name)
    assert (width, height) == (96, 64)
    assert seconds == pytest.approx(3, abs=0.15)
    assert np.abs(np.subtract(colours, shades)).max() < 40, colours


def test_a_full_disk_is_noticed_before_the_next_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 9, 0))
    with pytest.raises(OSError, match="No space left"):
        write_three(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of file sizes")
def test_a_video_that_was_cut_off_leaves_the_earlier_one(tmp_path: Path, codec: Codec) -> None:
    """OpenCV does not say that it could not write."""
    path = write_three(tmp_path / "out")
    earlier = path.read_bytes()
    code = "import resource, sys, pathlib; from tests.inference.test_video import write_three; "
    code += f"from hudepth.inference import video; video.CODECS = video.CODECS[{CODECS.index(codec)}:]; "
    code += "out = pathlib.Path(sys.argv[1]).with_suffix(''); video._works(video.CODECS[0], (48, 32)); "
    code += "resource.setrlimit(resource.RLIMIT_FSIZE, (400, 400)); write_three(out)"
    done = subprocess.run([sys.executable, "-c", code, str(path)], check=False, capture_output=True, text=True)
    assert "OSError" in done.stderr
    assert path.read_bytes() == earlier
    assert list(tmp_path.iterdir()) == [path]


def test_a_video_that_ends_in_an_error_does_not_replace_one(tmp_path: Path, codec: Codec) -> None:
    path = write_three(tmp_path / "out")
    earlier = path.read_bytes()

    def interrupted() -> None:
        with VideoWriter(tmp_path / "out", rate=5) as writer:
            writer.write(np.zeros((32, 48, 3), np.uint8))
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        interrupted()
    assert path.read_bytes() == earlier
    assert list(tmp_path.iterdir()) == [path]


def test_no_frame_no_file(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "out", rate=5):
        pass
    assert list(tmp_path.iterdir()) == []
