from __future__ import annotations

import base64
import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hudepth.base.camera import CameraLike, Intrinsics
from hudepth.base.errors import DataError
from hudepth.data.store import to_mm
from hudepth.demo.answers import Answer, Limits, answer, colour_table, reduce_depth
from hudepth.inference.model import DepthModel, load
from hudepth.viz.colour import auto_scale, colour_depth
from tests.networks import write_tiny_checkpoint

from .conftest import HOSTILE, encoded

LIMITS = Limits(upload_bytes=2**20, pixels=40_000_000)


def answered(folder: Path, model: DepthModel, data: bytes, name: str = "a.png", camera: CameraLike = "auto") -> Answer:
    (folder / name).write_bytes(data)
    return answer(folder / name, DepthModel(model.backend, camera=camera), LIMITS)


def depth_of(payload: dict[str, object]) -> np.ndarray:
    millimetres = np.frombuffer(base64.b64decode(str(payload["depth_mm"])), "<u2")
    return millimetres.reshape(int(str(payload["height"])), int(str(payload["width"])))


@pytest.mark.parametrize("name", HOSTILE)
def test_a_bad_file_is_answered_in_a_line(tmp_path: Path, model: DepthModel, name: str) -> None:
    data, expected = HOSTILE[name]
    with pytest.raises(DataError) as caught:
        answered(tmp_path, model, data, name)
    assert str(caught.value).startswith(expected)


def test_what_is_too_large_is_not_read(tmp_path: Path, model: DepthModel) -> None:
    with pytest.raises(DataError, match=r"'a.png': 1\.5 MB"):
        answered(tmp_path, model, bytes(3 * 2**19))


def test_a_picture_that_is_gone_is_said(tmp_path: Path, model: DepthModel) -> None:
    with pytest.raises(DataError, match=r"'b.png': .*No such file"):
        answer(tmp_path / "b.png", model, LIMITS)


def test_a_small_picture_goes_over_pixel_by_pixel(tmp_path: Path, model: DepthModel) -> None:
    result = answered(tmp_path, model, encoded(60, 80))
    assert result.shown is result.depth
    np.testing.assert_array_equal(depth_of(result.payload), to_mm(result.depth.metres))
    assert result.payload["max_depth_m"] == 10.0
    assert result.payload["scale_m"] == list(auto_scale(result.depth.metres))
    assert result.payload["facts"][0] == "a.png, 80 x 60"
    photo = base64.b64decode(str(result.payload["photo"]).removeprefix("data:image/jpeg;base64,"))
    assert cv2.imdecode(np.frombuffer(photo, np.uint8), cv2.IMREAD_COLOR).shape == (60, 80, 3)


def test_the_edges_are_those_of_the_files(tmp_path: Path, model: DepthModel) -> None:
    result = answered(tmp_path, model, encoded(60, 83))
    bits = np.unpackbits(np.frombuffer(base64.b64decode(str(result.payload["edges"])), np.uint8))[: 60 * 83]
    assert 0 < bits.sum() < bits.size
    kept = result.depth.point_cloud(edges=False).points_m
    np.testing.assert_array_equal(result.depth.point_cloud(edges=True).points_m[bits == 0], kept)


def test_of_a_large_picture_depths_are_picked_not_averaged(tmp_path: Path, model: DepthModel) -> None:
    result = answered(tmp_path, model, encoded(700, 960, "JPEG"))
    millimetres = depth_of(result.payload)
    assert millimetres.shape == (467, 640)
    assert np.isin(millimetres, to_mm(result.depth.metres)).all()
    assert millimetres[233, 320] == to_mm(result.depth.metres)[350, 480]
    assert len(str(result.payload["depth_mm"])) < 2**20


def test_one_row_is_a_picture_too(tmp_path: Path, model: DepthModel) -> None:
    assert reduce_depth(answered(tmp_path, model, encoded(1, 2000)).depth).metres.shape == (1, 640)


def test_a_camera_is_scaled_with_the_picture(tmp_path: Path, model: DepthModel) -> None:
    given = answered(tmp_path, model, encoded(960, 1280, "JPEG"), camera=(1000, 1100, 639.5, 479.5))
    assert given.shown.camera == Intrinsics(500, 550, 319.5, 239.5)
    assert given.payload["camera"] == [500, 550, 319.5, 239.5]
    nyu = answered(tmp_path, model, encoded(960, 1280, "JPEG")).shown.camera
    assert nyu == Intrinsics.of_nyu(480, 640)
    assert not nyu.known
    assert nyu.scale(1, 1) == nyu


def test_a_portrait_has_square_pixels_and_a_wrong_camera_is_said(tmp_path: Path, model: DepthModel) -> None:
    portrait = answered(tmp_path, model, encoded(800, 547, "JPEG"))
    fx, fy, _, _ = portrait.payload["camera"]
    assert fx == pytest.approx(fy, rel=2e-3)  # the shown picture has whole pixels
    assert "NYU Depth V2's camera assumed: set the field of view" in portrait.payload["facts"]
    wrong = answered(tmp_path, model, encoded(96, 128), camera=(1000, 1100, 639.5, 479.5))
    assert wrong.shown.camera == Intrinsics.of_nyu(96, 128)
    assert "The camera that was set cannot have taken a picture of this size" in wrong.payload["facts"]


def test_a_visitors_field_of_view_counts(tmp_path: Path) -> None:
    model = load(write_tiny_checkpoint(tmp_path / "rooms.ckpt"), device="cpu", threads=1)
    (tmp_path / "a.png").write_bytes(encoded(60, 80))
    results = [answer(tmp_path / "a.png", model, LIMITS, camera) for camera in (None, "fov=40", "f35=26")]
    factors = [result.depth.camera_factor for result in results]
    assert factors[0] == 1 < factors[1]
    assert [result.payload["max_depth_m"] for result in results] == pytest.approx([10, 10, 10])
    expected = model.predict(tmp_path / "a.png", camera="fov=40").metres
    np.testing.assert_array_equal(results[1].depth.metres, expected)
    assert f"Camera as given, 40 degrees across; depth x {factors[1]:.3f} for it" in results[1].payload["facts"]
    assert f"Camera as given, 26 mm on 35 mm film; depth x {factors[2]:.3f} for it" in results[2].payload["facts"]


def test_an_animation_says_that_one_frame_was_taken(tmp_path: Path, model: DepthModel) -> None:
    file, frames = io.BytesIO(), [Image.new("RGB", (40, 30), (shade, 0, 0)) for shade in (0, 99, 200)]
    frames[0].save(file, "GIF", save_all=True, append_images=frames[1:])
    result = answered(tmp_path, model, file.getvalue(), "a.gif")
    assert "Animated, 3 frames: the first is taken" in result.payload["facts"]


def test_the_table_has_the_colours_of_depth_pictures() -> None:
    depth = np.array([[0.02, 2.0, 5.0, 9.98]], np.float32)
    expected = colour_depth(depth, scale_m=(0.0, 10.0), legend=False)[0]
    np.testing.assert_array_equal(colour_table()[np.rint(depth[0] * 25.5).astype(int)], expected)
