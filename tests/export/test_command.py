"""One export of every format, and what may be wrong with its files."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import hudepth
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.export.parity import check, compare
from hudepth.runs.checkpoint import load_checkpoint
from tests.commands import Command, script

IMAGE = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
EXACT = ("model.onnx", "model.pt2", "model.xml", "tiny")


@pytest.mark.slow
def test_onnx_predicts_what_the_checkpoint_does(command: Command, tiny: Path, tmp_path: Path) -> None:
    """The one export that every test run makes; all other formats are below."""
    Image.fromarray(IMAGE).save(tmp_path / "photo.png")
    done = command("export", f"checkpoint={tiny}", "images=.", "compared=1", "output=out")
    assert done.code == 0, done.err
    assert json.loads(Path("out/export.json").read_text())["onnx"]["compared"]["worst_mm"] < 0.1
    model, original = (hudepth.load(path, threads=1) for path in ("out/model.onnx", tiny))
    assert model.info == original.info
    assert np.abs(model.predict(IMAGE).metres - original.predict(IMAGE).metres).max() < 1e-4
    many = model.predict_many([IMAGE, IMAGE[::-1], IMAGE], batch_size=2)  # a batch size that was not exported
    assert np.abs(many[2].metres - original.predict(IMAGE).metres).max() < 1e-4


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("format=onx",), "format: 'onx' .* 'onnx'"),
        (("tolerance_mm=0",), "tolerance_mm: 0 .* above 0"),
        (("compared=0",), "compared: 0 .* at least 1"),
        (("images=nowhere",), "input: .*'nowhere'"),
        (("format=int8", "calibration=3"), "calibration: 3 images"),
        (("format=bundle", "name=../x"), r"name: '\.\./x'"),
    ],
)
def test_mistakes_are_one_line(arguments: tuple[str, ...], words: str, command: Command, tiny: Path) -> None:
    done = command("export", f"checkpoint={tiny}", "compared=1", *arguments)
    assert done.code == 1
    assert re.match(f"hudepth-export: {words}", done.err.splitlines()[-1])


def test_an_output_that_cannot_be_written(command: Command, tiny: Path) -> None:
    Path("taken").write_text("")
    done = command("export", f"checkpoint={tiny}", "output=taken", "compared=1", "calibration=1")
    assert re.search(r"hudepth-export: output: .*'taken'.*File exists", done.err)


def test_a_folder_is_not_overwritten(command: Command, tiny: Path) -> None:
    Path("export/tiny").mkdir(parents=True)
    done = command("export", f"checkpoint={tiny}", "format=bundle", "name=tiny", "compared=2", "calibration=1")
    assert done.code == 1
    assert "'export/tiny' exists" in done.err


@pytest.fixture(scope="session")
def exported(trained: Path, tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """All formats of the tiny run, by the installed script from another directory."""
    folder = tmp_path_factory.mktemp("exported")
    run = folder / "runs" / "tiny" / trained.name  # int8 is tested, which the run notes
    shutil.copytree(trained, run)
    formats = "format=[onnx,onnx_any_size,torch_export,openvino,int8,bundle]"
    arguments = (f"checkpoint={run}", formats, "compared=4", "calibration=8", "output=out")
    done = subprocess.run(**script("export", *arguments, cwd=folder, cache=cache), check=False)
    assert done.returncode == 0, done.stdout
    (folder / "out" / "log.txt").write_text(done.stdout)
    return folder / "out"


@pytest.mark.slow
def test_every_format_is_compared_on_real_images_before_it_is_kept(exported: Path) -> None:
    record = json.loads((exported / "export.json").read_text())
    assert record["images"] == "test images of rooms"
    for name in ("onnx", "onnx_any_size", "torch_export", "openvino", "bundle"):
        assert record[name]["compared"]["images"] == 2  # all test images there are
        assert record[name]["compared"]["worst_mm"] < 0.1
    assert record["int8"]["calibrated_on"] == 8
    assert {file.name for file in exported.iterdir()} == {
        "model.onnx", "model_any_size.onnx", "model.pt2", "model.xml", "model.bin", "model_int8.xml", "model_int8.bin",
        "tiny", "export.json", "log.txt",
    }  # fmt: skip
    log = (exported / "log.txt").read_text()
    assert "model.onnx: at most" in log
    assert "torchvision" not in log


@pytest.mark.slow
def test_int8_says_what_it_costs(exported: Path) -> None:
    record = json.loads((exported / "export.json").read_text())["int8"]["accuracy"]["eigen"]
    assert set(record) == {"abs_rel", "rmse", "delta1"}
    for row in record.values():
        assert row["change"] == pytest.approx(row["int8"] - row["float32"])
    log = (exported / "log.txt").read_text()
    assert "int8: eigen protocol, 2 test images of rooms" in log
    assert f"{record['delta1']['int8']:.4f}" in log
    assert f"{record['rmse']['int8']:.4f} m" in log
    assert f"{record['rmse']['change']:+.4f} m" in log


@pytest.mark.slow
def test_a_run_notes_that_int8_was_tested(exported: Path, trained: Path) -> None:
    (run,) = (exported.parent / "runs" / "tiny").iterdir()
    before = json.loads((trained / "scored.json").read_text())
    after = json.loads((run / "scored.json").read_text())
    assert after[:-1] == before
    assert {key: value for key, value in after[-1].items() if key != "time"} == {
        **{key: value for key, value in before[0].items() if key != "time"}, "protocols": ["eigen"],
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("backend", ["auto", "onnxruntime"])
def test_every_file_predicts_what_the_checkpoint_does(name: str, backend: str, exported: Path, trained: Path) -> None:
    if backend == "onnxruntime" and name != "model.onnx":
        pytest.skip("reads ONNX alone")
    model = hudepth.load(exported / name, backend=backend, trust=["pt2"])
    original = hudepth.load(trained)
    assert model.info == original.info
    assert np.abs(model.predict(IMAGE).metres - original.predict(IMAGE).metres).max() < 1e-4
    many = model.predict_many([IMAGE, IMAGE[::-1], IMAGE], batch_size=2)  # a batch size that was not exported
    assert np.abs(many[2].metres - original.predict(IMAGE).metres).max() < 1e-4


@pytest.mark.slow
def test_onnx_states_names_units_and_origin(exported: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(exported / "model.onnx"))
    (entry,), (exit_,) = session.get_inputs(), session.get_outputs()
    assert (entry.name, entry.type, entry.shape[1:]) == ("image", "tensor(uint8)", [32, 48, 3])
    assert (exit_.name, exit_.type) == ("depth_m", "tensor(float)")
    stated = session.get_modelmeta().custom_metadata_map
    assert "INTER_AREA" in stated["resize"]
    assert stated["input"] == "image: uint8 [batch, 32, 48, 3], RGB, the whole image resized to this size"
    assert stated["output"].endswith("distance along the optical axis in metres")
    assert json.loads(stated["trained_on"])["source"] == "rooms"


@pytest.mark.slow
@pytest.mark.parametrize("size", [(32, 48), (61, 97), (130, 90), (40, 31)])
def test_a_graph_for_any_size_predicts_what_hudepth_does(size: tuple[int, int], exported: Path, trained: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(exported / "model_any_size.onnx"))
    photos = np.random.default_rng(0).integers(256, size=(2, *size, 3), dtype=np.uint8)
    (depth,) = session.run(None, {"image": photos})
    model = hudepth.load(trained)
    assert depth.shape == photos.shape[:3]
    for found, photo in zip(depth, photos, strict=True):  # rounding to bytes can fall either way
        expected = model.predict(photo).metres
        assert np.abs(found - expected).mean() < 2e-3
        assert np.abs(found - expected).max() < 2e-2
    stated = session.get_modelmeta().custom_metadata_map
    assert stated["input"] == "image: uint8 [batch, height, width, 3], RGB, of any size"
    with pytest.raises(CheckpointError, match=r"has no description by hudepth: .*onnx_any_size"):
        hudepth.load(exported / "model_any_size.onnx")


@pytest.fixture(scope="session")
def raw(trained: Path, tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """Graphs without processing, and a zipped bundle."""
    folder = tmp_path_factory.mktemp("raw")
    arguments = ("format=[onnx,torch_export,bundle]", "processing=false", "zip=true", "name=mine", "compared=2")
    done = subprocess.run(**script("export", f"checkpoint={trained}", *arguments, cwd=folder, cache=cache), check=False)
    assert done.returncode == 0, done.stdout
    return folder / "export"


@pytest.mark.slow
def test_without_processing(raw: Path, trained: Path) -> None:
    for name in ("model.onnx", "model.pt2"):
        model = hudepth.load(raw / name, trust=["pt2"])
        assert not model.info.processing
        assert np.abs(model.predict(IMAGE).metres - hudepth.load(trained).predict(IMAGE).metres).max() < 1e-4
    session = pytest.importorskip("onnxruntime").InferenceSession(str(raw / "model.onnx"))
    assert session.get_inputs()[0].shape[1:] == [3, 32, 48]


@pytest.mark.slow
def test_an_export_that_differs_is_refused(exported: Path, trained: Path) -> None:
    images = np.stack([IMAGE[:32, :48], IMAGE[5:37, 5:53]])
    reference = hudepth.load(trained).backend
    parity = compare(hudepth.load(exported / "model_int8.xml").backend, reference, images, batch_size=1)
    expected = [hudepth.load(path).backend(images) for path in (exported / "model_int8.xml", trained)]
    assert parity.worst_mm == pytest.approx(1000 * np.abs(expected[0] - expected[1]).max(), rel=1e-3)
    assert parity.images == 2
    with pytest.raises(CheckpointError, match=r"model.x: .* mm"):
        check(parity, what="model.x", tolerance_mm=0.01)
    check(parity, what="model.x", tolerance_mm=1e6)


@pytest.mark.slow
def test_a_program_is_not_run_unless_it_is_trusted(exported: Path) -> None:
    with pytest.raises(CheckpointError, match=r"any code .* trust=\[pt2\]"):
        hudepth.load(exported / "model.pt2")


@pytest.mark.slow
def test_choices_that_do_not_fit(exported: Path, trained: Path) -> None:
    for spec, options, message in (
        ("model.xml", {"backend": "onnxruntime"}, "backend=onnxruntime: .* backend=openvino"),
        ("model.onnx", {"backend": "onxruntime"}, "backend: .* 'onnxruntime'"),
        ("model.onnx", {"size": (64, 64)}, "size: "),
        ("model.onnx", {"backend": "onnxruntime", "precision": "bfloat16"}, "precision=bfloat16: .*openvino"),
        ("model.onnx", {"backend": "openvino", "precision": "float16"}, "precision=float16: needs a checkpoint on"),
        ("nowhere.onnx", {}, "checkpoint: no file"),
    ):
        with pytest.raises(ConfigError, match=message):
            hudepth.load(exported / spec, **options)
    with pytest.raises(ConfigError, match=r"backend=openvino: .*hudepth-export"):
        hudepth.load(trained, backend="openvino")
    with pytest.raises(ConfigError, match=r"device: .*'tpu'"):
        hudepth.load(trained, device="tpu")


@pytest.mark.slow
def test_a_bundle_is_a_checkpoint(exported: Path, trained: Path, command: Command) -> None:
    """What reads checkpoints reads bundles: here the test of the very split, with the very result."""
    done = command("test", f"checkpoint={exported / 'tiny'}", "protocol=eigen", "output=again")
    assert done.code == 0, done.err
    again = json.loads(Path("again/eigen/metrics.json").read_text())
    before = json.loads((trained / "test" / "eigen" / "metrics.json").read_text())
    assert again["metrics"] == before["metrics"]
    assert again["split"] == before["split"]


@pytest.mark.slow
def test_a_bundle_contains_what_users_must_know(exported: Path, trained: Path) -> None:
    bundle = exported / "tiny"
    card = (bundle / "README.md").read_text()
    result = json.loads((trained / "test" / "eigen" / "metrics.json").read_text())
    assert card.startswith("---\nlibrary_name: hudepth\npipeline_tag: depth-estimation\nlicense: mit\n")
    assert result["split"]["sha256"] in card
    low, high = result["intervals"]["model"]["abs_rel"]
    if low is not None:
        assert f"{result['metrics']['model']['abs_rel']:.3f} [{low:.3f}, {high:.3f}]" in card
    for heading in ("## Use", "## Training", "## Results", "## Samples", "## Limits", "## Licence", "## How to cite"):
        assert heading in card
    for number in range(card.count("](samples/")):
        assert (bundle / "samples" / f"{number}.jpg").stat().st_size > 500
    assert json.loads((bundle / "metrics" / "eigen.json").read_text()) == result
    told = (bundle / "config.json").read_text()
    assert str(trained.parents[2]) not in told + card  # nothing of the machine it comes from
    assert (bundle / "model.onnx").stat().st_mode & 0o044 == (bundle / "model.safetensors").stat().st_mode & 0o044


@pytest.mark.slow
def test_a_zip_reads_as_its_folder(raw: Path, trained: Path, tmp_path: Path) -> None:
    path = raw / "mine.zip"
    model = hudepth.load(path)
    assert (model.predict(IMAGE).metres == hudepth.load(trained).predict(IMAGE).metres).all()
    squeezed = tmp_path / "squeezed.zip"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(squeezed, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name.removeprefix("mine/"), old.read(name))
    assert hudepth.load(squeezed).info == model.info  # zipped again by somebody else, without the folder


@pytest.mark.slow
def test_a_bundle_of_half_the_size(command: Command, trained: Path, tmp_path: Path) -> None:
    for name, half in (("whole", "false"), ("small", "true")):
        done = command("export", f"checkpoint={trained}", "format=bundle", f"name={name}", f"half={half}", "compared=4")
        assert done.code == 0, done.err
    whole, small = (tmp_path / "export" / name for name in ("whole", "small"))
    assert (whole / "model.onnx").is_file()
    assert not (small / "model.onnx").exists()
    tensors, kept = load_checkpoint(str(whole)).state, load_checkpoint(str(small)).state
    for name, tensor in tensors.items():
        assert kept[name].dtype == (torch.float16 if tensor.ndim > 1 else tensor.dtype), name
        assert torch.equal(kept[name].to(tensor.dtype), tensor.half().to(tensor.dtype) if tensor.ndim > 1 else tensor)
    card = (small / "README.md").read_text()
    assert "16-bit floats" in card
    assert "model.onnx" not in card
    theirs, ours = (hudepth.load(str(folder)).predict(IMAGE).metres for folder in (whole, small))
    assert 0 < np.abs(ours - theirs).max() < 0.05  # metres
    assert hudepth.load(str(small)).backend.name.startswith("torch")
