from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import hudepth
from hudepth.base.errors import CheckpointError, ConfigError, DataError
from hudepth.base.normalise import NormaliseBytes
from hudepth.inference.backends import TorchBackend
from hudepth.inference.model import DepthModel
from hudepth.inference.model_info import ModelInfo
from hudepth.runs.checkpoint import load_checkpoint
from tests.devices import with_graphs


class Columns:
    """Predicts the brightness of a pixel plus a tenth of its column: what mirroring changes."""

    name = "columns"

    def __init__(self, info: ModelInfo) -> None:
        self.info = info

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        return (rgb.mean(-1) + 0.1 * np.arange(rgb.shape[2])).astype(np.float32)


@pytest.mark.parametrize("count", [1, 3])
def test_flipping_averages_with_the_mirrored_image_mirrored_back(grey: DepthModel, count: int) -> None:
    backend = Columns(grey.info)
    images = list(np.random.default_rng(0).integers(0, 255, (count, *grey.info.size, 3), np.uint8))
    plain = DepthModel(backend).predict_many(images, batch_size=2)
    flipped = DepthModel(backend, flip=True).predict_many(images, batch_size=2)
    width = grey.info.size[1]
    for image, before, after in zip(images, plain, flipped, strict=True):
        np.testing.assert_allclose(before.metres, image.mean(-1) + 0.1 * np.arange(width), rtol=1e-5)
        np.testing.assert_allclose(after.metres, image.mean(-1) + 0.1 * (width - 1) / 2, rtol=1e-5)
        difference = 0.1 * np.abs(2 * np.arange(width) - (width - 1))  # of both predictions
        assert before.uncertainty_m is None
        assert after.uncertainty_m is not None
        np.testing.assert_allclose(after.uncertainty_m, np.tile(difference / 2, (len(image), 1)), atol=1e-4)


def test_the_bundled_pretrained_model_sees_depth() -> None:
    model = hudepth.load("nyu")
    assert model.info.size == (160, 160)
    floor = np.zeros((240, 320, 3), np.uint8)
    floor[:] = np.linspace(60, 200, 240).astype(np.uint8)[:, None, None]
    metres = model.predict(floor).metres
    assert metres.shape == (240, 320)
    assert 0.3 < metres.min() < metres.max() < 10


def test_a_missing_bundled_model_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("hudepth.runs.bundles.shipped", lambda *_: tmp_path)
    with pytest.raises(CheckpointError, match=r"checkpoint: .*'nyu'"):
        hudepth.load("nyu")


def test_tensors_are_pictures_and_lists_are_cameras(grey: DepthModel) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    depth = grey.predict(rgb)
    for tensor in (torch.from_numpy(rgb), torch.from_numpy(rgb).permute(2, 0, 1)):
        np.testing.assert_array_equal(grey.predict(tensor).metres, depth.metres)
    given = depth.point_cloud((60.0, 61.0, 32.0, 24.0)).points_m
    matrix = np.array([[60, 0, 32], [0, 61, 24], [0, 0, 1]])
    for camera in ([60.0, 61.0, 32.0, 24.0], np.array([60, 61, 32, 24]), matrix):
        np.testing.assert_array_equal(depth.point_cloud(camera).points_m, given)
    with pytest.raises(TypeError, match=r"camera: .*list"):
        depth.point_cloud([60.0, 61.0])
    with pytest.raises(ConfigError, match=r"camera: .*64 x 48"):
        depth.point_cloud([4.2, 4.2, 2.0, 3.0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.bool])
def test_a_tensor_that_holds_no_bytes_is_refused_with_what_is_taken(grey: DepthModel, dtype: torch.dtype) -> None:
    with pytest.raises(TypeError, match=r"image: a tensor of \w+\. Pass uint8 or uint16"):
        grey.predict(torch.ones(3, 48, 64).to(dtype))


@pytest.mark.parametrize("shape", [(1, 3, 48, 64), (5, 48, 64), (48,)])
def test_a_tensor_of_another_shape_is_refused_with_what_is_taken(grey: DepthModel, shape: tuple[int, ...]) -> None:
    with pytest.raises(DataError, match=r"shape .*Pass RGB as uint8"):
        grey.predict(torch.zeros(shape, dtype=torch.uint8))


def test_a_float_array_is_not_read_as_bytes(grey: DepthModel) -> None:
    with pytest.raises(DataError, match="float64"):
        grey.predict(np.full((48, 64, 3), 0.5))


def test_pillow_images_of_any_mode_are_read_as_their_files_are(grey: DepthModel) -> None:
    sixteen = Image.fromarray(np.full((48, 64), 30_000, np.uint16))
    assert grey.predict(sixteen).image[0, 0].tolist() == [117, 117, 117]  # 30000 / 257
    clear = Image.new("LA", (64, 48), (10, 0))
    assert grey.predict(clear).image[0, 0].tolist() == [255, 255, 255]
    with pytest.raises(DataError, match="floating-point"):
        grey.predict(Image.fromarray(np.full((48, 64), 0.5, np.float32)))


@pytest.mark.parametrize("trust", ["pt2", ("pt2",), {"pt2"}, iter(["pt2"])])
def test_what_is_trusted_is_one_name_or_several(trust: Iterable[str], tmp_path: Path) -> None:
    (tmp_path / "x.pt2").write_bytes(b"no program")
    with pytest.raises(CheckpointError, match=r"trust=\[pt2\]"):
        hudepth.load(tmp_path / "x.pt2")
    with pytest.raises(CheckpointError, match="cannot be read"):
        hudepth.load(tmp_path / "x.pt2", trust=trust)


@pytest.mark.parametrize(("precision", "most_m"), [("float32", 0.0), ("float16", 0.05), ("bfloat16", 0.4)])
def test_on_a_gpu_the_network_is_replayed(tiny: Path, precision: str, most_m: float) -> None:
    pictures = list(np.random.default_rng(0).integers(0, 256, (7, 48, 64, 3), np.uint8))
    usual = hudepth.load(tiny, device="cpu").predict_many(pictures, batch_size=2)
    calls: list[None] = []
    with with_graphs():
        model = on_stand_in(tiny, precision)
        model.backend.pipeline.register_forward_pre_hook(lambda *_: calls.append(None))  # type: ignore[attr-defined]
        for _ in range(4):
            predicted = model.predict_many(pictures, batch_size=2)
    assert len(calls) == 4 + 4  # of the 16: three as usual and one recorded, for two shapes
    for one, other in zip(usual, predicted, strict=True):
        assert np.abs(one.metres - other.metres).max() <= most_m
        assert other.metres.dtype == np.float32


def on_stand_in(path: Path, precision: str) -> DepthModel:
    checkpoint = load_checkpoint(str(path), runs="runs")
    backend = TorchBackend.of_checkpoint(checkpoint, device=torch.device("cpu"), trust=[], precision=precision)  # type: ignore[arg-type]
    return DepthModel(backend)


def test_numbers_that_float16_cannot_hold_name_the_fix(tiny: Path) -> None:
    with with_graphs():
        model = on_stand_in(tiny, "float16")
        with torch.no_grad():
            model.backend.pipeline.net.net.encode.weight.fill_(60_000)  # type: ignore[attr-defined]
            model.backend.pipeline.net.net.encode.weight[1::2] *= -1  # type: ignore[attr-defined]
        with pytest.raises(CheckpointError, match=r"float16\. Pass precision=bfloat16"):
            model.predict(np.full((32, 48, 3), 255, np.uint8))


@pytest.mark.parametrize(
    ("precision", "fix"),
    [("float16", r"Pass precision=float32\."), ("bfloat16", r"precision=float32, or run hudepth-export checkpoint=")],
)
def test_half_precision_needs_a_gpu(tiny: Path, precision: str, fix: str) -> None:
    with pytest.raises(ConfigError, match=f"^precision={precision}: needs an NVIDIA GPU. .*{fix}"):
        hudepth.load(tiny, device="cpu", precision=precision)
    with pytest.raises(ConfigError, match=r"^precision: 'half' is not"):
        hudepth.load(tiny, device="cpu", precision="half")


def test_the_network_is_a_torch_module_and_a_list_gives_a_list(tiny: Path) -> None:
    model = hudepth.load(tiny, threads=1)
    image = np.random.default_rng(0).integers(256, size=(*model.info.size, 3), dtype=np.uint8)
    normalised = NormaliseBytes()(torch.from_numpy(image)[None])
    with torch.inference_mode():
        unit_depth = model.network(normalised)
    one, two = model.predict([image, image[::-1]])
    np.testing.assert_allclose(unit_depth[0, 0] * model.info.max_depth_m, one.metres, atol=1e-5)
    assert one == model.predict(image) != two
