"""One export of everything, looked at from all sides; and what strangers may do to its files."""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import hudepth
from hudepth.base.errors import CheckpointError, ConfigError, HudepthError
from hudepth.export.card import model_card
from hudepth.export.images import export_images
from hudepth.export.parity import check, compare
from hudepth.inference.backends import info_of
from hudepth.runs.checkpoint import load_checkpoint
from tests.commands import Command, script

IMAGE = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
EXACT = ("model.onnx", "model.pt2", "model.xml", "tiny")


@pytest.fixture(scope="session")
def exported(trained: Path, tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """All formats of the tiny run, by the installed script from another directory."""
    folder = tmp_path_factory.mktemp("exported")
    run = folder / "runs" / "tiny" / trained.name  # int8 is tested, which the run notes
    shutil.copytree(trained, run)
    formats = "format=[onnx,torch_export,openvino,int8,bundle]"
    arguments = (f"checkpoint={run}", formats, "compared=4", "calibration=8", "output=out")
    done = subprocess.run(**script("export", *arguments, cwd=folder, cache=cache), check=False)
    assert done.returncode == 0, done.stdout
    (folder / "out" / "log.txt").write_text(done.stdout)
    return folder / "out"


def test_every_format_is_compared_on_real_images_before_it_is_kept(exported: Path) -> None:
    record = json.loads((exported / "export.json").read_text())
    assert record["images"] == "test images of rooms"
    for name in ("onnx", "torch_export", "openvino", "bundle"):
        assert record[name]["compared"]["images"] == 2  # all test images there are
        assert record[name]["compared"]["worst_mm"] < 0.1
    assert record["int8"]["calibrated_on"] == 8
    assert {file.name for file in exported.iterdir()} == {
        "model.onnx", "model.pt2", "model.xml", "model.bin", "model_int8.xml", "model_int8.bin", "tiny", "export.json",
        "log.txt",
    }  # fmt: skip
    log = (exported / "log.txt").read_text()
    assert "model.onnx: at most" in log
    assert "torchvision" not in log


def test_int8_says_what_it_costs(exported: Path) -> None:
    record = json.loads((exported / "export.json").read_text())["int8"]["accuracy"]["eigen"]
    assert set(record) == {"abs_rel", "rmse", "delta1"}
    for row in record.values():
        assert row["change"] == pytest.approx(row["int8"] - row["float32"])
    log = (exported / "log.txt").read_text()
    assert "int8: eigen protocol, 2 test images of rooms" in log
    assert f"{record['delta1']['int8']:.4f}" in log


def test_a_run_notes_that_int8_was_tested(exported: Path, trained: Path) -> None:
    (run,) = (exported.parent / "runs" / "tiny").iterdir()
    before = json.loads((trained / "scored.json").read_text())
    after = json.loads((run / "scored.json").read_text())
    assert after[:-1] == before
    assert {key: value for key, value in after[-1].items() if key != "time"} == {
        **{key: value for key, value in before[0].items() if key != "time"}, "protocols": ["eigen"],
    }  # fmt: skip


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


def test_onnx_states_names_units_and_origin(exported: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(exported / "model.onnx"))
    (entry,), (exit_,) = session.get_inputs(), session.get_outputs()
    assert (entry.name, entry.type, entry.shape[1:]) == ("image", "tensor(uint8)", [32, 48, 3])
    assert (exit_.name, exit_.type) == ("depth_m", "tensor(float)")
    stated = session.get_modelmeta().custom_metadata_map
    assert stated["input"] == "image: uint8 [batch, 32, 48, 3], RGB, the whole image resized to this size"
    assert stated["output"].endswith("distance along the optical axis in metres")
    assert json.loads(stated["trained_on"])["source"] == "rooms"


@pytest.fixture(scope="session")
def raw(trained: Path, tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """Graphs without processing, and a zipped bundle."""
    folder = tmp_path_factory.mktemp("raw")
    arguments = ("format=[onnx,torch_export,bundle]", "processing=false", "zip=true", "name=mine", "compared=2")
    done = subprocess.run(**script("export", f"checkpoint={trained}", *arguments, cwd=folder, cache=cache), check=False)
    assert done.returncode == 0, done.stdout
    return folder / "export"


def test_without_processing(raw: Path, trained: Path) -> None:
    for name in ("model.onnx", "model.pt2"):
        model = hudepth.load(raw / name, trust=["pt2"])
        assert not model.info.processing
        assert np.abs(model.predict(IMAGE).metres - hudepth.load(trained).predict(IMAGE).metres).max() < 1e-4
    session = pytest.importorskip("onnxruntime").InferenceSession(str(raw / "model.onnx"))
    assert session.get_inputs()[0].shape[1:] == [3, 32, 48]


def test_an_export_that_differs_is_refused(exported: Path, trained: Path) -> None:
    images = np.stack([IMAGE[:32, :48], IMAGE[5:37, 5:53]])
    reference = hudepth.load(trained).backend
    parity = compare(hudepth.load(exported / "model_int8.xml").backend, reference, images, batch_size=1)
    expected = [hudepth.load(path).backend(images) for path in (exported / "model_int8.xml", trained)]
    assert parity.worst_mm == pytest.approx(1000 * np.abs(expected[0] - expected[1]).max(), rel=1e-3)
    assert parity.images == 2
    with pytest.raises(CheckpointError, match=r"model.x: .* mm from the checkpoint at the worst pixel, allowed"):
        check(parity, what="model.x", tolerance_mm=0.01)
    check(parity, what="model.x", tolerance_mm=1e6)


def test_a_prediction_that_is_no_number_is_no_match(trained: Path) -> None:
    class Broken:
        info, name = hudepth.load(trained).info, "torch"

        def __call__(self, rgb: np.ndarray) -> np.ndarray:
            return np.full(rgb.shape[:3], np.nan, np.float32)

    parity = compare(Broken(), hudepth.load(trained).backend, IMAGE[None, :32, :48])
    with pytest.raises(CheckpointError, match="inf mm from the checkpoint"):
        check(parity, what="x", tolerance_mm=1e9)


def test_a_program_is_not_run_unless_it_is_trusted(exported: Path) -> None:
    with pytest.raises(CheckpointError, match=r"is a program that could run any code .* pass trust=\[pt2\]"):
        hudepth.load(exported / "model.pt2")


def test_an_onnx_file_of_another_model(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Identity", ["x"], ["y"])], "g", [value],
                                   [onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])])  # fmt: skip
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)])
    model.ir_version = 9
    onnx.save(model, str(tmp_path / "other.onnx"))
    for backend in ("onnxruntime", "openvino"):
        with pytest.raises(CheckpointError, match=r"other.onnx' was not exported by hudepth: it does not say its size"):
            hudepth.load(tmp_path / "other.onnx", backend=backend)


@pytest.mark.parametrize("content", [b"", b"text", b"\x08\x09" * 50], ids=["empty", "text", "binary"])
@pytest.mark.parametrize("name", ["x.onnx", "x.xml", "x.pt2", "x.zip", "x.safetensors"])
def test_damaged_files(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CheckpointError) as caught:
        hudepth.load(tmp_path / name, trust=["pt2"])
    assert "\n" not in str(caught.value)


def test_choices_that_do_not_fit(exported: Path, trained: Path) -> None:
    for spec, options, message in (
        ("model.xml", {"backend": "onnxruntime"}, r"does not read 'model.xml'. Pass backend=openvino"),
        ("model.onnx", {"backend": "onxruntime"}, r"Did you mean 'onnxruntime'\?"),
        ("model.onnx", {"size": (64, 64)}, "has the size it was exported with"),
        ("model.onnx", {"backend": "onnxruntime", "precision": "bfloat16"}, "only OpenVINO computes in it"),
        ("nowhere.onnx", {}, "no file"),
    ):
        with pytest.raises(ConfigError, match=message):
            hudepth.load(exported / spec, **options)
    with pytest.raises(ConfigError, match=r"backend=openvino: needs an exported file. Run hudepth-export"):
        hudepth.load(trained, backend="openvino")
    with pytest.raises(ConfigError, match=r"device: no 'tpu' here\. Pass device="):
        hudepth.load(trained, device="tpu")


def test_a_bundle_is_a_checkpoint(exported: Path, trained: Path, command: Command) -> None:
    """What reads checkpoints reads bundles: here the test of the very split, with the very result."""
    done = command("test", f"checkpoint={exported / 'tiny'}", "protocol=eigen", "output=again")
    assert done.code == 0, done.err
    again = json.loads(Path("again/eigen/metrics.json").read_text())
    before = json.loads((trained / "test" / "eigen" / "metrics.json").read_text())
    assert again["metrics"] == before["metrics"]
    assert again["split"] == before["split"]


def test_a_bundle_tells_what_a_stranger_must_know(exported: Path, trained: Path) -> None:
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


def test_a_zip_reads_as_its_folder(raw: Path, trained: Path, tmp_path: Path) -> None:
    path = raw / "mine.zip"
    model = hudepth.load(path)
    assert (model.predict(IMAGE).metres == hudepth.load(trained).predict(IMAGE).metres).all()
    squeezed = tmp_path / "squeezed.zip"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(squeezed, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name.removeprefix("mine/"), old.read(name))
    assert hudepth.load(squeezed).info == model.info  # zipped again by somebody else, without the folder


def altered(exported: Path, folder: Path, change: dict[str, bytes]) -> Path:
    """A zip of the bundle with some files changed or added."""
    path = folder / "altered.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in (exported / "tiny").glob("*.*"):
            if file.name not in change:
                archive.write(file, file.name)
        for name, content in change.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"../evil.txt": b"x"}, r"is refused: it holds '\.\./evil\.txt', which leads out of its folder"),
        ({"/etc/evil": b"x"}, r"which leads out of its folder"),
        ({"a/../../b": b"x"}, r"which leads out of its folder"),
        ({"C:\\evil": b"x"}, r"which leads out of its folder"),
        ({"config.json": b"{}"}, r"is no bundle of hudepth's"),
        ({"config.json": b"[" * 100_000}, r"its config.json cannot be read"),
        ({"model.safetensors": bytes(200_000_000)}, r"is refused: its model.safetensors unpacks to 190 MiB"),
        ({"model.safetensors": b"\xff" * 64}, r"its model.safetensors is damaged or cut off"),
        ({"other/config.json": b"{}"}, r"it has 2 config.json"),
    ],
    ids=["up", "root", "within", "drive", "empty", "deep", "bomb", "damaged", "two"],
)  # fmt: skip
def test_a_strangers_zip(change: dict[str, bytes], message: str, exported: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=message):
        hudepth.load(altered(exported, tmp_path, change))
    assert [file.name for file in tmp_path.iterdir()] == ["altered.zip"]  # nothing was unpacked


def test_a_strangers_configuration_runs_no_code(exported: Path, tmp_path: Path) -> None:
    content = json.loads((exported / "tiny" / "config.json").read_text())
    content["config"]["model"] = {"_target_": "subprocess.Popen", "args": ["touch", str(tmp_path / "ran")]}
    with pytest.raises(ConfigError, match="is not under a trusted module"):
        hudepth.load(altered(exported, tmp_path, {"config.json": json.dumps(content).encode()}))
    assert not (tmp_path / "ran").exists()


def test_a_folder_is_not_overwritten(command: Command, trained: Path) -> None:
    Path("export/tiny").mkdir(parents=True)
    done = command("export", f"checkpoint={trained}", "format=bundle", "compared=2")
    assert done.code == 1
    assert "'export/tiny' exists. Remove it, or pass another name= or output=." in done.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("format=onx",), "hudepth-export: format: no 'onx'. Did you mean 'onnx'? Pass some of onnx, torch_export,"),
        (("tolerance_mm=0",), "hudepth-export: tolerance_mm: 0 is no positive number of millimetres."),
        (("compared=0",), "hudepth-export: compared: 0 is no whole number of at least 1."),
        (("images=nowhere",), "hudepth-export: input: no file, folder or match 'nowhere'."),
        (("format=int8", "calibration=3"), "hudepth-export: calibration: 3 images are too few. Pass at least 8"),
        (("format=bundle", "name=../x"), "hudepth-export: name: '../x' is no name for a folder."),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(arguments: tuple[str, ...], message: str, command: Command, trained: Path) -> None:
    done = command("export", f"checkpoint={trained}", *arguments)
    assert done.code == 1
    assert message in done.err.splitlines()[-1]


def test_an_output_that_cannot_be_written(command: Command, trained: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    done = command("export", f"checkpoint={trained}", "output=taken")
    assert "hudepth-export: output: cannot write to 'taken' (File exists). Pass output=<a folder>." in done.err


def test_where_the_data_is_gone_rooms_stand_in(
    trained: Path, cache: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = load_checkpoint(str(trained))
    source = {"_target_": "hudepth.data.sources.folder.FolderSource"}
    gone = replace(checkpoint, config={**checkpoint.config, "data": {**checkpoint.config["data"], "source": source}})
    config = {"paths": {"cache": str(cache)}, "data": {}, "trust": [], "images": None, "compared": 3, "calibration": 9}
    monkeypatch.setattr(logging.getLogger("hudepth"), "propagate", True)
    images = export_images(gone, config, size=(32, 48))
    assert (images.origin, images.datamodule) == ("built-in rooms", None)
    assert (images.compared.shape, images.calibration.shape) == ((3, 32, 48, 3), (9, 32, 48, 3))
    assert "images of built-in rooms stand in" in caplog.text
    with pytest.raises(HudepthError):  # what was typed is wanted
        export_images(gone, {**config, "data": {"root": "nowhere"}}, size=(32, 48))


def test_images_of_ones_own(trained: Path, tmp_path: Path) -> None:
    for number in range(5):
        Image.fromarray(IMAGE // (number + 1)).save(tmp_path / f"{number}.png")
    config = {"images": str(tmp_path), "compared": 2, "calibration": 5}
    images = export_images(load_checkpoint(str(trained)), config, size=(32, 48))
    assert len(images.compared) == 2
    assert len(images.calibration) == 5
    assert images.origin == f"images of '{tmp_path.name}'"


def test_a_card_of_an_untested_model_says_so(trained: Path) -> None:
    checkpoint = load_checkpoint(str(trained))
    card = model_card(
        checkpoint, info_of(checkpoint, parameters=1), name="x", results={}, parity="the same", samples=""
    )
    assert "None are on record. `hudepth-test` makes some" in card


def test_a_card_names_what_came_before_and_each_loss_of_a_mixture(trained: Path) -> None:
    checkpoint = load_checkpoint(str(trained))
    checkpoint = replace(
        checkpoint,
        data={**checkpoint.data, "before": [{"source": "rooms", "pairs": 8000}]},
        config={
            **checkpoint.config,
            "loss": {
                "_target_": "hudepth.losses.mixture.Mixture",
                "losses": {name: {"_target_": f"hudepth.losses.{name}"} for name in ("SILog", "BADCL", "BerHu")},
                "weights": {"SILog": 1.0, "BADCL": 0.3, "BerHu": 0},
            },
        },
    )
    card = model_card(
        checkpoint, info_of(checkpoint, parameters=1), name="x", results={}, parity="", samples="", half=True
    )
    assert "| trained before on | rooms, 8000 pairs |" in card
    assert "| loss | 1 SILog + 0.3 BADCL |" in card
    assert "- onnx" not in card


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
    assert "holds kernels and matrices as 16-bit floats" in card
    assert "model.onnx" not in card
    theirs, ours = (hudepth.load(str(folder)).predict(IMAGE).metres for folder in (whole, small))
    assert 0 < np.abs(ours - theirs).max() < 0.05  # metres
    assert hudepth.load(str(small)).backend.name.startswith("torch")


def test_a_model_that_does_not_come_along_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hudepth.runs.bundles.find_spec", lambda _: None)
    with pytest.raises(CheckpointError) as caught:
        hudepth.load("nyu")
    assert str(caught.value) == (
        "checkpoint: the weights of 'nyu' are not part of this installation. Install hudepth anew, or pass a run or a "
        "file."
    )
