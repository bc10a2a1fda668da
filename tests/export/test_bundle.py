"""Bundles as written, and as changed by somebody else."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

import hudepth
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.export.bundle import halve, write_bundle, zip_folder
from hudepth.inference.model_info import ModelInfo
from hudepth.runs.checkpoint import load_checkpoint

IMAGE = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)


@pytest.fixture(scope="session")
def bundle(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    checkpoint = load_checkpoint(str(tiny))
    folder = tmp_path_factory.mktemp("bundle") / "tiny"
    info = ModelInfo.of_checkpoint(checkpoint, parameters=1)
    samples = [hudepth.load(tiny, threads=1).predict(IMAGE)]
    write_bundle(folder, checkpoint, info=info, onnx=None, card="# tiny\n", results={"eigen": {}}, samples=samples)
    return folder


def test_a_bundle_and_its_zip_predict_what_the_checkpoint_does(bundle: Path, tiny: Path, tmp_path: Path) -> None:
    zip_folder(bundle, tmp_path / "tiny.zip")
    expected = hudepth.load(tiny, threads=1).predict(IMAGE).metres
    for path in (bundle, tmp_path / "tiny.zip"):
        assert (hudepth.load(path, threads=1).predict(IMAGE).metres == expected).all()
    assert sorted(str(file.relative_to(bundle)) for file in bundle.rglob("*.*")) == [
        "README.md", "config.json", "metrics/eigen.json", "model.safetensors", "samples/0.jpg",
    ]  # fmt: skip


def test_half_the_size_keeps_norms_and_biases(tiny: Path) -> None:
    checkpoint = load_checkpoint(str(tiny))
    halved = halve(checkpoint).state
    assert {name: tensor.dtype for name, tensor in halved.items()} == {
        name: torch.float16 if tensor.ndim > 1 else tensor.dtype for name, tensor in checkpoint.state.items()
    }


def altered(bundle: Path, folder: Path, change: dict[str, bytes]) -> Path:
    """A zip of the bundle with some files changed or added."""
    path = folder / "altered.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in bundle.glob("*.*"):
            if file.name not in change:
                archive.write(file, file.name)
        for name, content in change.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"../evil.txt": b"x"}, r"is refused: it holds '\.\./evil\.txt', a path outside its folder"),
        ({"/etc/evil": b"x"}, r"a path outside its folder"),
        ({"a/../../b": b"x"}, r"a path outside its folder"),
        ({"C:\\evil": b"x"}, r"a path outside its folder"),
        ({"config.json": b"{}"}, r"is not a bundle of hudepth"),
        ({"config.json": b"[" * 100_000}, r"its config.json cannot be read"),
        ({"model.safetensors": bytes(200_000_000)}, r"is refused: its model.safetensors unpacks to 190 MiB"),
        ({"model.safetensors": b"\xff" * 64}, r"its model.safetensors is damaged or cut off"),
        ({"other/config.json": b"{}"}, r"it has 2 config.json"),
    ],
    ids=["up", "root", "within", "drive", "empty", "deep", "bomb", "damaged", "two"],
)  # fmt: skip
def test_an_untrusted_zip(change: dict[str, bytes], message: str, bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=message):
        hudepth.load(altered(bundle, tmp_path, change))
    assert [file.name for file in tmp_path.iterdir()] == ["altered.zip"]  # nothing was unpacked


def test_an_untrusted_configuration_runs_no_code(bundle: Path, tmp_path: Path) -> None:
    content = json.loads((bundle / "config.json").read_text())
    content["config"]["model"] = {"_target_": "subprocess.Popen", "args": ["touch", str(tmp_path / "ran")]}
    with pytest.raises(ConfigError, match="is not under a trusted module"):
        hudepth.load(altered(bundle, tmp_path, {"config.json": json.dumps(content).encode()}))
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("size", [65536, [8192, 8192], [0, 48], "wide", None, [32, 48, 3]])
def test_an_untrusted_configuration_asks_for_no_absurd_size(size: object, bundle: Path, tmp_path: Path) -> None:
    content = json.loads((bundle / "config.json").read_text())
    content["config"]["data"]["size"] = size
    with pytest.raises(CheckpointError, match=r"altered\.zip.*(data\.size|does not record)"):
        hudepth.load(altered(bundle, tmp_path, {"config.json": json.dumps(content).encode()}))
