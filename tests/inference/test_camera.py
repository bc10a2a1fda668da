"""What the camera of a picture does to its depth, its points and its files."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hudepth
from hudepth.base.camera import NYU_FOCAL, Intrinsics
from hudepth.base.errors import ConfigError
from hudepth.data.rooms.raycast import BOX, ROOM_FACES, Solids, View, trace
from hudepth.export.graphs import describe
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.model import DepthModel
from hudepth.inference.model_info import ModelInfo
from tests.commands import Command


class Grey:
    """Depth [m] is the mean of red, green and blue over 100."""

    name = "torch"

    def __init__(self, **info: object) -> None:
        self.info = ModelInfo("Grey", (32, 48), 10.0, 0, 1, **info)  # type: ignore[arg-type]

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        return (rgb.astype(np.float32).mean(axis=3) / 100).astype(np.float32)


def photograph(film_mm: int | None, *, turn: int = 1, size: tuple[int, int] = (64, 48)) -> bytes:
    """A JPEG of (width, height) as stored."""
    exif, file = Image.Exif(), io.BytesIO()
    exif[0x0112] = turn
    if film_mm is not None:
        exif.get_ifd(0x8769)[0xA405] = film_mm
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8)).save(
        file, "JPEG", exif=exif
    )
    return file.getvalue()


def factor_of(focal: float, height: int, width: int) -> float:
    """The powers are those of hudepth.inference.image_fit."""
    return float((focal / width / (518.857901 / 640)) ** 0.15 * (focal / height / (519.469611 / 480)) ** 0.6)


NYU = Grey(trained_on={"source": "rooms"})


def test_depth_follows_the_focal_length_that_exif_states() -> None:
    data = photograph(26)
    plain, scaled = DepthModel(NYU, camera="training").predict(data), DepthModel(NYU).predict(data)
    focal = 26 * math.hypot(48, 64) / math.hypot(36, 24)
    factor = factor_of(focal, 48, 64)
    np.testing.assert_allclose(scaled.metres, plain.metres * factor, rtol=1e-5)
    assert scaled.camera_factor == pytest.approx(factor)
    assert scaled.max_depth_m == pytest.approx(10 * factor)
    assert scaled.camera == Intrinsics.centred(focal, focal, 48, 64, origin="from EXIF, 26 mm on 35 mm film")
    assert (plain.camera_factor, plain.max_depth_m) == (1.0, 10.0)


@pytest.mark.parametrize("camera", ["auto", "training"])
def test_without_a_camera_nothing_is_scaled_to_the_last_digit(camera: str) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    expected = DepthModel(Grey()).predict(rgb).metres  # of an unknown training camera: never scaled
    for picture in (rgb, Image.fromarray(rgb)):
        depth = DepthModel(NYU, camera=camera).predict(picture)
        np.testing.assert_array_equal(depth.metres, expected)
        assert depth.camera == Intrinsics.of_nyu(48, 64)
        assert depth.camera_factor == 1


def test_exif_of_no_use_is_said() -> None:
    depth = DepthModel(NYU).predict(photograph(0))
    assert depth.camera is not None
    assert not depth.camera.known
    assert depth.whose_camera.startswith("NYU Depth V2's, assumed, since its EXIF states no possible focal length")
    assert "since" not in DepthModel(NYU, camera="training").predict(photograph(0)).whose_camera


def test_a_call_may_state_another_camera_and_one_that_cannot_be_is_refused() -> None:
    model = DepthModel(NYU, camera="f=60")
    data = photograph(26)
    assert model.predict(data).camera_factor == pytest.approx(factor_of(60, 48, 64))
    assert model.predict(data, camera="f=120").camera_factor == pytest.approx(factor_of(120, 48, 64))
    with pytest.raises(ConfigError, match=r"^camera: .*64 x 48"):
        model.predict(data, camera=(4.2, 4.2, 2.0, 3.0))


def test_a_training_camera_of_its_own() -> None:
    own = Grey(trained_on={"source": "folder"}, focal=(1.0, 1.25), aspect=1.25)
    depth = DepthModel(own, camera="f=60").predict(np.zeros((48, 60, 3), np.uint8))
    assert depth.camera_factor == pytest.approx(1)
    assumed = DepthModel(own).predict(np.zeros((60, 48, 3), np.uint8)).camera
    assert assumed == Intrinsics.centred(60, 60, 60, 48, known=False, origin="the training camera, assumed")
    same = DepthModel(own).predict(np.zeros((48, 60, 3), np.uint8)).camera
    assert same is not None
    assert same.numbers == pytest.approx((60, 60, 29.5, 23.5))
    read = ModelInfo.from_json(own.info.to_json(), where="x")
    assert read.training_focal == (1.0, 1.25)


def test_an_exported_file_states_the_factor_for_other_programs() -> None:
    words = describe(NYU.info)["camera"]
    formula = words.partition("multiply depth by ")[2].replace("^", "**")
    found = eval(formula, {"fx": 60, "fy": 61, "width": 64, "height": 48})
    given = DepthModel(NYU, camera=(60.0, 61.0, 32.0, 24.0)).predict(np.zeros((48, 64, 3), np.uint8))
    assert found == pytest.approx(given.camera_factor, rel=1e-3)
    assert "camera" not in describe(Grey(trained_on={"source": "folder"}).info)


def test_a_description_without_a_camera_is_still_read() -> None:
    content = json.loads(NYU.info.to_json())
    del content["focal"]
    assert ModelInfo.from_json(json.dumps(content), where="x").training_focal == NYU_FOCAL
    assert Grey(trained_on={"source": "folder"}).info.training_focal is None


def test_points_of_a_portrait_of_a_cube_have_its_proportions() -> None:
    """The depth is the ray-caster's: only the camera can be wrong. Sides are those of the face that is seen."""
    height, width, focal = 800, 547, 700.0
    xs = ((np.arange(width) - (width - 1) / 2) / focal).astype(np.float32)
    ys = ((np.arange(height) - (height - 1) / 2) / focal).astype(np.float32)
    view = View(np.array([2.0, 1.25, 0.5]), np.diag([1.0, -1.0, 1.0]), xs, ys)
    cube = Solids(np.array([BOX], np.int8), np.array([[2.0, 1.25, 3.5]]), np.full((1, 3), 0.5), np.zeros(1))
    depth_m, surface = trace(view, np.array([4.0, 2.5, 6.0]), cube)
    depth = DepthMap(depth_m, np.zeros((height, width, 3), np.uint8), 10.0)
    seen = (surface == ROOM_FACES).ravel() & (np.abs(depth_m.ravel() - 2.5) < 1e-3)
    for camera in (f"f={focal:g}", f"fov={math.degrees(2 * math.atan(width / 2 / focal))}"):
        sides = np.ptp(depth.point_cloud(camera, edges=True).points_m[seen], axis=0)
        assert sides[0] / sides[1] == pytest.approx(1, abs=0.02)
        assert sides[:2] == pytest.approx([1, 1], abs=0.02)
    assumed = np.ptp(depth.point_cloud(edges=True).points_m[seen], axis=0)
    assert assumed[0] / assumed[1] == pytest.approx(1, abs=0.02)  # square pixels, whoever took it


def test_the_files_and_the_log_say_which_camera(tiny: Path, tmp_path: Path, command: Command) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "phone.jpg").write_bytes(photograph(26, turn=6))
    (tmp_path / "photos" / "plain.jpg").write_bytes(photograph(None))
    done = command("predict", f"checkpoint={tiny}", "input=photos", "formats=[png16,npy,ply]", "output=out")
    assert done.code == 0, done.err
    stated = json.loads(Path("out/predictions.json").read_text())["cameras"]
    phone, plain = stated["photos/phone.jpg"], stated["photos/plain.jpg"]
    focal = 26 * math.hypot(48, 64) / math.hypot(36, 24)
    factor = factor_of(focal, 64, 48)  # upright, it is 64 pixels high
    assert phone["intrinsics"] == pytest.approx([focal, focal, 23.5, 31.5])
    assert phone["depth_factor"] == pytest.approx(factor)
    assert (phone["known"], plain["known"], plain["depth_factor"]) == (True, False, 1.0)
    expected = hudepth.load(tiny, camera="training").predict("photos/phone.jpg").metres * factor
    np.testing.assert_allclose(np.load("out/phone_depth.npy"), expected, rtol=1e-4)
    words = f"from EXIF, 26 mm on 35 mm film; depth x {factor:.3f} for it"
    with Image.open("out/phone_depth.png") as png:
        assert png.text["camera"].endswith(words)  # type: ignore[attr-defined]
        assert np.abs(np.asarray(png) / 1000 - expected).max() < 0.0006
    assert words.encode() in Path("out/phone_depth.ply").read_bytes()[:400]
    assert f"camera: from EXIF, 26 mm on 35 mm film; depth x {factor:.3g} (1 of 2)" in done.err
    assert "camera: NYU Depth V2's, assumed; depth x 1 (1 of 2)" in done.err


def test_a_field_of_view_is_typed_as_it_is_said(tiny: Path, tmp_path: Path, command: Command) -> None:
    (tmp_path / "a.jpg").write_bytes(photograph(26))
    for option, written in (("camera=fov=62", "fov=62"), ("camera=f35:26", "f35:26"), ("camera=[50,50,32,24]", None)):
        done = command("predict", f"checkpoint={tiny}", "input=a.jpg", option, "formats=[npy]", "output=out")
        assert done.code == 0, done.err
        assert "camera: as given" in done.err
        settings = json.loads(Path("out/predictions.json").read_text())["settings"]
        assert settings["camera"] == (written or [50, 50, 32, 24])


def test_uncertain_points_are_left_out(tiny: Path, tmp_path: Path, command: Command) -> None:
    (tmp_path / "a.jpg").write_bytes(photograph(26, size=(48, 32)))  # of the size of the network
    options = ("formats=[npy,uncertainty,ply]", "flip=true", "edges=true", "output=out")
    assert command("predict", f"checkpoint={tiny}", "input=a.jpg", *options, "max_uncertainty=0.1").code == 0
    depth, unsure = np.load("out/a_depth.npy"), np.load("out/a_uncertainty.npy")
    both = [
        hudepth.load(tiny).predict(np.ascontiguousarray(image)) for image in (depth_image(), depth_image()[:, ::-1])
    ]
    scaled = [each.metres * hudepth.load(tiny).predict("a.jpg").camera_factor for each in both]
    np.testing.assert_allclose(unsure, np.abs(scaled[0] - scaled[1][:, ::-1]) / 2, atol=2e-3)
    sure = int((unsure <= np.float32(0.1) * depth).sum())
    assert 0 < sure < depth.size
    assert f"element vertex {sure}\n".encode() in Path("out/a_depth.ply").read_bytes()


def depth_image() -> np.ndarray:
    with Image.open("a.jpg") as image:
        return np.asarray(image.convert("RGB"))
