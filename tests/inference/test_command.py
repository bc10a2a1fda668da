"""hudepth-predict, from the command line to the files."""

from __future__ import annotations

import errno
import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import hudepth
from hudepth.inference import video
from hudepth.inference.model import DepthModel
from hudepth.viz.colour import MIN_LEGEND
from tests.commands import Command, script

RANDOM = np.random.default_rng(0)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    Image.fromarray(RANDOM.integers(0, 256, (48, 64, 3), dtype=np.uint8)).save(folder / "a.png")
    Image.fromarray(RANDOM.integers(0, 256, (90, 50), dtype=np.uint8)).save(folder / "grey tall.jpg")
    Image.fromarray(RANDOM.integers(0, 256, (20, 80, 4), dtype=np.uint8)).save(folder / "wide.webp")
    return folder


def film(path: Path, count: int, *, codec: str = "MJPG") -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 12, (64, 48))
    for number in range(count):
        writer.write(np.full((48, 64, 3), 9 * number % 256, np.uint8))
    writer.release()


@pytest.mark.slow
def test_a_folder_by_the_installed_script(trained: Path, photos: Path, tmp_path: Path, cache: Path) -> None:
    arguments = (f"checkpoint={trained}", "input=photos", "formats=[png16,npy,colour,side,ply]")
    done = subprocess.run(**script("predict", *arguments, cwd=tmp_path, cache=cache), check=False)
    assert done.returncode == 0, done.stdout
    assert "model: TinyUNet of" in done.stdout
    assert "3 predicted in" in done.stdout
    out = tmp_path / "predictions"
    model = hudepth.load(trained)
    for name in ("a.png", "grey tall.jpg", "wide.webp"):
        stem = Path(name).stem
        metres = np.load(out / f"{stem}_depth.npy")
        assert metres.dtype == np.float32
        assert np.abs(metres - model.predict(photos / name).metres).max() < 1e-5
        millimetres = cv2.imread(str(out / f"{stem}_depth.png"), cv2.IMREAD_UNCHANGED)
        assert np.abs(millimetres / 1000 - metres).max() <= 0.0005 + 1e-6
        with Image.open(photos / name) as image, Image.open(out / f"{stem}_depth.jpg") as coloured:
            assert metres.shape == (image.height, image.width)
            assert coloured.height == image.height
            assert (coloured.width > image.width) is (image.height >= MIN_LEGEND)
        assert (out / f"{stem}_depth.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
        assert (out / f"{stem}_side.jpg").exists()
    stated = json.loads((out / "predictions.json").read_text())
    assert stated["units"] == {"png16": "mm", "npy": "m", "uncertainty": "m", "ply": "m", "glb": "m"}
    assert stated["network_size"] == [32, 48]
    assert stated["model"]["source"] == "rooms"
    assert (stated["predicted"], stated["failed"], stated["fit"]) == (3, {}, "stretch")


def test_what_is_bad_is_listed_and_the_rest_is_done(tiny: Path, photos: Path, command: Command) -> None:
    whole = (photos / "a.png").read_bytes()
    (photos / "empty.png").write_bytes(b"")
    (photos / "cut.png").write_bytes(whole[: len(whole) // 2])
    (photos / "text.jpg").write_text("no image")
    film(photos / "cut.avi", 40)
    film_bytes = (photos / "cut.avi").read_bytes()
    (photos / "cut.avi").write_bytes(film_bytes[: len(film_bytes) // 2])
    done = command("predict", f"checkpoint={tiny}", "input=photos", "formats=[npy]", "output=out")
    assert done.code == 1
    for line in ("empty.png': the file is empty", "cut.png': ", "text.jpg': "):
        assert line in done.err
    assert "cut.avi': ends after" in done.err
    last = done.err.splitlines()[-1]
    assert last == "hudepth-predict: 4 failed, in whole or in part, see above; the rest is in 'out'."
    assert sorted(file.name for file in Path("out").glob("*.npy")) == [
        "a_depth.npy",
        "grey tall_depth.npy",
        "wide_depth.npy",
    ]
    assert len(list(Path("out/cut_avi").glob("*.npy"))) > 5  # cut.png would have been "cut", too
    assert set(json.loads(Path("out/predictions.json").read_text())["failed"]) == {
        f"photos/{name}" for name in ("empty.png", "cut.png", "text.jpg", "cut.avi")
    }


def test_a_video_without_frames_is_no_success(tiny: Path, command: Command) -> None:
    film(Path("none.avi"), 0)
    done = command("predict", f"checkpoint={tiny}", "input=none.avi", "output=out")
    assert done.code == 1
    assert "'none.avi': " in done.err
    assert done.err.splitlines()[-1] == "hudepth-predict: 1 failed, in whole or in part, see above."


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("input=",), "input is not set. Pass input=<image | folder | video | camera>."),
        (("input=photos", "size=100"), "size: images of 100 x 100 (height x width), but both sides must be "),
        (("input=photos", "checkpoint=photos/a.png"), "'photos/a.png' is no checkpoint. Pass a run directory, "),
        (("input=photos", "checkpoint=no.onnx", "device=cuda"), "device=cuda: exported files run on the CPU."),
    ],
)
def test_mistakes_name_what_was_passed(arguments: tuple[str, ...], line: str, photos: Path, command: Command) -> None:
    Path("no.onnx").write_bytes(b"")
    done = command("predict", "checkpoint=nyu", "output=out", *arguments)
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith(f"hudepth-predict: {line}")


def test_what_cannot_be_written_is_named_and_the_rest_is_done(tiny: Path, photos: Path, command: Command) -> None:
    Image.fromarray(np.zeros((1, 60_000, 3), np.uint8)).save(photos / "line.png")
    for name in ("walk.avi", "run.avi"):
        film(photos / name, 5)
    ending = next(codec.ending for codec in video.CODECS if video._works(codec, (64, 48)))
    Path(f"out/walk_depth{ending}").mkdir(parents=True)
    Path("out/wide_side.jpg").mkdir()
    done = command("predict", f"checkpoint={tiny}", "input=photos", "formats=[npy,side,colour]", "output=out")
    assert done.code == 1
    assert set(json.loads(Path("out/predictions.json").read_text())["failed"]) == {
        f"photos/{name}" for name in ("line.png", "wide.webp", "walk.avi")
    }
    assert "line.png': no side: a JPEG of" in done.err
    assert "walk.avi': its results cannot be written" in done.err
    assert Path("out/line_depth.npy").exists()
    assert Path(f"out/run_depth{ending}").exists()
    assert "Traceback" not in done.err


def test_a_camera_in_millimetres_is_refused(tiny: Path, photos: Path, command: Command) -> None:
    camera = "camera=[4.2,4.2,2,3]"
    done = command("predict", f"checkpoint={tiny}", "input=photos/a.png", "formats=[ply]", camera, "output=out")
    assert done.code == 1
    assert re.search("camera: .* 64 x 48.* pixels", done.err)
    assert not list(Path("out").glob("*.ply"))


def test_a_second_run_does_not_read_the_first_ones_results(tiny: Path, photos: Path, command: Command) -> None:
    for output in ("predictions", "predictions", "other"):
        done = command("predict", f"checkpoint={tiny}", "input=.", "recursive=true", f"output={output}")
        assert done.code == 0, done.err
        assert "3 predicted in" in done.err
    assert "results of hudepth-predict" in done.err


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes on Linux only")
def test_names_that_are_not_utf8(tiny: Path, photos: Path, command: Command) -> None:
    name = os.fsdecode(b"caf\xe9")
    (photos / "a.png").rename(photos / f"{name}.png")
    film(photos / "b.avi", 5)
    (photos / "b.avi").rename(photos / f"{name}.avi")
    done = command("predict", f"checkpoint={tiny}", "input=photos", "output=out")
    assert done.code == 1
    assert r"caf\udce9.avi': videos need names in UTF-8" in done.err
    assert (Path("out") / f"{name}_png_depth.npy").exists()
    assert json.loads(Path("out/predictions.json").read_text())["predicted"] == 3


def test_a_video_becomes_a_video(tiny: Path, tmp_path: Path, command: Command) -> None:
    film(tmp_path / "walk.mp4", 20, codec="mp4v")
    formats = "formats=[colour,side,png16]"
    done = command("predict", f"checkpoint={tiny}", "input=walk.mp4", formats, "smoothing=0.5", "output=out")
    assert done.code == 0, done.err
    for name, wider in (("walk_depth", 1), ("walk_side", 2)):
        (path,) = (tmp_path / "out").glob(f"{name}.*")
        assert re.search(rf"{path.name}: (H\.264|VP8), which browsers and phones play", done.err)
        reader = video.FrameReader(path)
        frames = list(reader)
        assert len(frames) == 20
        assert reader.rate == pytest.approx(12)
        assert frames[0].shape[0] == 48
        assert frames[0].shape[1] > 64 * wider
    assert len(list((tmp_path / "out" / "walk").glob("*_depth.png"))) == 20


def test_a_camera_writes_frames(tiny: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """No camera is needed: a film stands in for it."""
    film(tmp_path / "film.avi", 30)
    opened = cv2.VideoCapture
    monkeypatch.setattr(
        cv2, "VideoCapture", lambda source: opened(str(tmp_path / "film.avi") if source == 0 else source)
    )
    done = command("predict", f"checkpoint={tiny}", "input=0", "frames=5", "output=out")
    assert done.code == 0, done.err
    assert sorted(file.name for file in (tmp_path / "out" / "camera0").iterdir()) == sorted(
        f"{frame:06d}_depth.{kind}" for frame in range(5) for kind in ("png", "jpg")
    )


def test_letterbox_and_size_and_scale(tiny: Path, photos: Path, command: Command) -> None:
    done = command(
        "predict", f"checkpoint={tiny}", "input=photos/wide.webp", "fit=letterbox", "size=64",
        "formats=[npy,colour]", "scale_m=[1,4]", "output=out",
    )  # fmt: skip
    assert done.code == 0, done.err
    expected = hudepth.load(tiny, fit="letterbox", size=64).predict(photos / "wide.webp").metres
    np.testing.assert_allclose(np.load("out/wide_depth.npy"), expected, atol=1e-5)
    stated = json.loads(Path("out/predictions.json").read_text())
    assert (stated["fit"], stated["network_size"], stated["scale_m"]) == ("letterbox", [64, 64], [1, 4])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("input=nowhere",), "input: .*'nowhere'.* video"),
        (("formats=[png]",), "formats: .* 'png16'"),
        (("formats=[]",), r"formats: \[\] .* png16, npy"),
        (("formats=[npy,uncertainty]",), "formats: uncertainty needs .* flip=true"),
        (("max_uncertainty=0.1",), "max_uncertainty needs .* flip=true"),
        (("smoothing=1",), "smoothing: 1 .* below 1"),
        (("scale_m=[4,1]",), r"scale_m: \[4,1\] .* rising"),
        (("camera=[1,2,3]",), r"camera: \[1,2,3\] .*fx,fy,cx,cy"),
        (("size=[30,48]",), "size: .*30 x 48.* multiples of 16"),
        (("size=[224]",), r"size: \[224\] .*height,width"),
        (("fit=crop",), "fit: 'crop' .* stretch, letterbox"),
        (("frames=0",), "frames: 0 .* at least 1"),
        (("threads=0",), "threads: 0 .* at least 1"),
        (("output=photos",), "output: 'photos' is the folder of the input"),
        (("output=taken",), "output: .*'taken'.*File exists"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(
    arguments: tuple[str, ...], words: str, tiny: Path, photos: Path, command: Command
) -> None:
    Path("taken").write_text("")
    done = command("predict", f"checkpoint={tiny}", "input=photos", *arguments)
    assert done.code == 1
    assert re.match(f"hudepth-predict: {words}", done.err.splitlines()[-1])


@pytest.mark.parametrize(
    ("code", "fix"), [(errno.ENOSPC, "Free some space"), (errno.EFBIG, "Raise the limit of file sizes (ulimit -f)")]
)
def test_a_disk_that_fills_up(
    code: int, fix: str, tiny: Path, photos: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("hudepth.inference.command.write_depth", full)
    done = command("predict", f"checkpoint={tiny}", "input=photos", "output=out")
    assert done.code == 1
    line = f"hudepth-predict: output: cannot write to 'out' ({os.strerror(code)}); 0 were predicted. {fix}, or pass"
    assert line in done.err


@pytest.mark.parametrize("kind", ["images", "video"])
def test_a_gpu_gets_batches_from_many_threads(
    kind: str, grey: DepthModel, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    grey.backend.device = torch.device("cuda")  # type: ignore[attr-defined]
    decoding, prepare, together = set(), grey.prepare, threading.Barrier(5, timeout=20)

    def watched(picture: Any) -> Any:
        if (thread := threading.get_ident()) not in decoding:
            decoding.add(thread)
            if kind == "images":
                together.wait()  # passes only if five decode at once
        return prepare(picture)

    monkeypatch.setattr(grey, "prepare", watched)
    monkeypatch.setattr("hudepth.inference.command.load_model", lambda _: grey)
    monkeypatch.setattr("hudepth.inference.command.usable_cores", lambda: 5)
    if kind == "images":
        for number in range(40):
            cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((32, 48, 3), number, np.uint8))
        given = tmp_path
    else:
        given = tmp_path / "a.avi"
        film(given, 40)
    done = command("predict", f"input={given}", "formats=[npy]", "output=out")
    assert done.code == 0, done.err
    assert grey.backend.batches == [16, 16, 8]  # type: ignore[attr-defined]
    assert len(decoding) == (5 if kind == "images" else 1)
    files = sorted((tmp_path / "out").rglob("*.npy"), key=lambda path: int(re.findall(r"\d+", path.stem)[0]))
    values = [float(np.load(path).mean()) for path in files]
    shades = np.arange(40) if kind == "images" else 9 * np.arange(40) % 256
    np.testing.assert_allclose(values, shades / 100, atol=0.02)


def test_a_gpu_that_fills_up(tiny: Path, photos: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has")

    monkeypatch.setattr("hudepth.inference.backends.DepthPipeline.forward", full)
    done = command("predict", f"checkpoint={tiny}", f"input={photos}")
    assert done.code == 1
    line = done.err.splitlines()[-1]
    assert line.startswith(
        "hudepth-predict: the GPU has too little memory (2.00 GiB more needed). Pass a smaller batch_"
    )


def test_what_predict_sees_is_what_test_sees(tiny: Path) -> None:
    """The very pixels of a prepared pair give the very prediction of the network on the stored image."""
    import torch

    from hudepth.base.normalise import normalise_image
    from hudepth.data.pairs import prepare_pair
    from hudepth.data.sources.rooms import RoomsSource
    from hudepth.runs.checkpoint import load_checkpoint

    source = RoomsSource(scenes=1, frames_per_scene=1, size=(48, 64))
    record = source.records()[0]
    pair, image = prepare_pair(source, record, (32, 48), native=False), source.read(record).image
    net = load_checkpoint(str(tiny)).build_net(trust=[])
    with torch.inference_mode():
        stored = normalise_image(torch.from_numpy(pair.image).permute(2, 0, 1)[None] / 255)
        expected = net(stored)[0, 0].numpy() * 10
    resized = cv2.resize(expected, (64, 48), interpolation=cv2.INTER_LINEAR)
    assert np.abs(hudepth.load(tiny).predict(image).metres - resized).max() < 1e-4
