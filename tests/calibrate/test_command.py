"""hudepth-data calibrate, and what a calibrated bundle does in other commands."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import hudepth
from hudepth.base.errors import CheckpointError
from hudepth.inference.backends import DepthPipeline
from tests.commands import Command
from tests.networks import write_tiny_checkpoint


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_checkpoint(tmp_path_factory.mktemp("tiny") / "tiny.ckpt", source="elsewhere")


@pytest.fixture
def mine(tiny: Path, tmp_path: Path) -> Path:
    """Pairs whose depth [mm] is 0.7 times what the network predicts."""
    model = hudepth.load(tiny)
    for name in ("images", "depths"):
        (tmp_path / "mine" / name).mkdir(parents=True)
    for number in range(8):
        rgb = np.random.default_rng(number).integers(0, 256, (48, 64, 3), np.uint8)
        Image.fromarray(rgb).save(tmp_path / "mine" / "images" / f"{number}.png")
        depth = np.rint(700 * model.predict(rgb).metres).astype(np.uint16)
        Image.fromarray(depth).save(tmp_path / "mine" / "depths" / f"{number}.png")
    return tmp_path / "mine"


DATA = ("data=folder", "data.root=mine", "data.encoding=uint16_mm", "data.source.indoor=false")


def test_a_scale_is_found_stored_and_applied(tiny: Path, mine: Path, command: Command) -> None:
    done = command("data", "calibrate", f"checkpoint={tiny}", *DATA, "camera=fov=60", "output=fitted")
    assert done.code == 0, done.err
    assert re.search(r"scale +0\.00\d +-0\.\d+ +\[-0\.\d+, -0\.\d+\] +yes", done.out)
    assert "calibrated on 8 pairs of folder: 0.700 depth; stored: pass checkpoint=fitted" in done.err
    before, after = hudepth.load(tiny, camera="training"), hudepth.load("fitted", camera="training")
    picture = mine / "images" / "3.png"
    np.testing.assert_allclose(after.predict(picture).metres, 0.7 * before.predict(picture).metres, rtol=2e-3)
    assert after.predict(picture).max_depth_m == pytest.approx(7, rel=1e-3)
    assert "calibrated on 8 pairs of folder" in str(after.info)
    focal = 1 / (2 * np.tan(np.radians(30)))
    assert after.info.training_focal == pytest.approx((focal, focal * 64 / 48))
    assert hudepth.load("fitted", camera="fov=60").predict(picture).camera_factor == pytest.approx(1)
    assert "0.700 depth" in Path("fitted/README.md").read_text()
    assert "model.onnx" not in Path("fitted/README.md").read_text()
    done = command("predict", "checkpoint=fitted", f"input={picture}", "formats=[npy]", "output=out")
    assert "calibrated on 8 pairs" in done.err
    stated = json.loads(Path("out/predictions.json").read_text())
    assert stated["calibration"]["scale"] == pytest.approx(0.7, rel=1e-3)
    np.testing.assert_array_equal(np.load("out/3_depth.npy"), after.predict(picture).metres)
    again = command("data", "calibrate", "checkpoint=fitted", *DATA, "output=again")
    assert "0.700 depth" in again.err  # of the network, not of the calibrated model
    assert command("data", "calibrate", f"checkpoint={tiny}", *DATA, "output=fitted").code == 1


def test_what_does_not_help_is_not_stored(tiny: Path, mine: Path, command: Command) -> None:
    model = hudepth.load(tiny)
    for number in range(8):
        depth = model.predict(mine / "images" / f"{number}.png").metres * (1000, 1100, 900)[number % 3]
        Image.fromarray(np.rint(depth).astype(np.uint16)).save(mine / "depths" / f"{number}.png")
    done = command("data", "calibrate", f"checkpoint={tiny}", *DATA, "output=fitted")
    assert done.code == 0, done.err
    assert "not stored: no calibration lowers the error" in done.err
    assert not Path("fitted").exists()


@pytest.mark.parametrize("encoding", ["uint16_10000", "uint16_5000"])
def test_a_wrong_unit_is_refused(encoding: str, tiny: Path, mine: Path, command: Command) -> None:
    for file in (mine / "depths").iterdir():  # 0.4 times what is predicted, in millimetres
        Image.fromarray((np.array(Image.open(file)) * (4 / 7)).astype(np.uint16)).save(file)
    wrong = [each for each in DATA if "encoding" not in each]
    done = command("data", "calibrate", f"checkpoint={tiny}", *wrong, f"data.encoding={encoding}", "output=fitted")
    assert done.code == 1
    factor = {"uint16_10000": 0.04, "uint16_5000": 0.08}[encoding]
    line = f"hudepth-data: data: measured depth is {factor:g} times what is predicted, so its unit is wrong."
    assert done.err.splitlines()[-1].startswith(line)
    assert not Path("fitted").exists()


def test_built_in_rooms_calibrate_no_model_of_other_data(tiny: Path, command: Command) -> None:
    done = command("data", "calibrate", f"checkpoint={tiny}")
    assert done.code == 1
    assert done.err.splitlines()[-1] == (
        "hudepth-data: data: built-in rooms are no camera's. Pass data=<yours>, or points=<file>."
    )


def test_either_points_or_data_are_given(tiny: Path, mine: Path, command: Command) -> None:
    done = command("data", "calibrate", f"checkpoint={tiny}", *DATA, "points=mine/points.csv")
    assert done.code == 1
    assert done.err.splitlines()[-1] == "hudepth-data: data, points: both are set. Pass one of them."


def test_what_the_fit_leaves_out_and_how_it_is_checked_is_said(tiny: Path, mine: Path, command: Command) -> None:
    for file in (mine / "depths").iterdir():
        depth = np.array(Image.open(file))
        depth[:12] = 30_000  # a quarter
        Image.fromarray(depth).save(file)
    done = command("data", "calibrate", f"checkpoint={tiny}", *DATA, "output=fitted")
    assert done.code == 0, done.err
    assert "25 % of the measured depth is beyond 10 m, the model's largest depth: left out" in done.err
    assert "8 pairs of folder, no scenes named" in done.out
    said = " ".join(done.out.split())
    assert "Each picture is corrected by a fit on other pictures. Pictures of one room make it look better" in said


def test_points_will_do(tiny: Path, mine: Path, command: Command) -> None:
    model, lines = hudepth.load(tiny), ["image,x,y,metres"]
    for number in range(6):
        metres = model.predict(mine / "images" / f"{number}.png").metres
        lines += [f"images/{number}.png,{x},{y},{1.5 * metres[y, x]:.5f}" for x, y in ((3, 40), (60, 5))]
    (mine / "points.csv").write_text("\n".join(lines))
    done = command("data", "calibrate", f"checkpoint={tiny}", "points=mine/points.csv", "output=fitted")
    assert done.code == 0, done.err
    assert "calibrated on 12 points of points: 1.500 depth" in done.err
    assert "camera: not stated" in done.err
    assert hudepth.load("fitted").info.training_focal is None


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("image,x,y\n", "points.csv': no column metres"),
        ("image,x,y,metres\n", "points.csv': lists no points"),
        ("image,x,y,metres\nimages/0.png,1,2,0\n", "points.csv' line 2: is not image,x,y,metres"),
        ("image,x,y,metres\nimages/0.png,1,nan,2\n", "points.csv' line 2: is not image,x,y,metres"),
        ("image,x,y,metres\nimages/0.png,1\n", "points.csv' line 2: is not image,x,y,metres"),
        ("image,x,y,metres\nimages/0.png,64,2,2\n", r"points.csv' line 2: \(64, 2\) is outside the picture, 64 x 48"),
        ("image,x,y,metres\n../a.png,6,2,2\n", "points.csv': path '../a.png' is not inside"),
        ("image,x,y,metres\nb.png,6,2,2\n", "no file 'mine/b.png'"),
        ("image,x,y,metres\nimages/0.png,6,2,2\n", "data: all depths are of one scene"),
    ],
)
def test_bad_points_are_one_line(lines: str, words: str, tiny: Path, mine: Path, command: Command) -> None:
    (mine / "points.csv").write_text(lines)
    done = command("data", "calibrate", f"checkpoint={tiny}", "points=mine/points.csv", "output=fitted")
    assert done.code == 1
    assert re.match(f"hudepth-data: .*{words}", done.err.splitlines()[-1]), done.err


def test_the_exported_graph_holds_the_calibration(tiny: Path, mine: Path, command: Command) -> None:
    import torch

    command("data", "calibrate", f"checkpoint={tiny}", *DATA, "output=fitted")
    model = hudepth.load("fitted", device="cpu")
    pipeline = model.backend.pipeline  # type: ignore[attr-defined]
    assert isinstance(pipeline, DepthPipeline)
    rgb = np.random.default_rng(0).integers(0, 256, (1, 32, 48, 3), np.uint8)
    program = torch.export.export(pipeline.eval(), (torch.from_numpy(rgb),)).module()
    plain = hudepth.load(tiny, device="cpu").backend(rgb)
    np.testing.assert_allclose(program(torch.from_numpy(rgb)).detach().numpy(), 0.7 * plain, rtol=2e-3)


@pytest.mark.parametrize("calibration", [{"scale": 0}, {"scale": 1e9}, {"scale": 1, "power": 99}, {"scale": "x"}, [1]])
def test_a_calibration_out_of_range_is_refused(calibration: object, tiny: Path, mine: Path, command: Command) -> None:
    command("data", "calibrate", f"checkpoint={tiny}", *DATA, "output=fitted")
    config = json.loads(Path("fitted/config.json").read_text())
    config["data"]["calibration"] = calibration
    Path("fitted/config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match="calibration"):
        hudepth.load("fitted")
