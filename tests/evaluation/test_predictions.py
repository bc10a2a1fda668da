"""Predictions in files: scored as a checkpoint's are, and as the field's scripts score them."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import hudepth
from hudepth.base.errors import DataError
from hudepth.data.sources.base import Record
from hudepth.data.sources.rooms import RoomsSource
from hudepth.evaluation.predictions import _find
from hudepth.runs.results import find_result
from tests.commands import TINY, Command, Result

F64 = NDArray[np.float64]
COUNT, SIZE = 3, (480, 640)
ROOMS = [argument for argument in TINY if argument.startswith("data")]


def metrics(folder: Path) -> dict[str, float]:
    found: dict[str, float] = json.loads((folder / "metrics.json").read_text())["metrics"]["model"]
    return found


# --- our own predictions


@pytest.fixture(scope="module")
def own(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trained run's predictions of all rooms at their own size, as npy [m], PNG [mm] and inverse depths."""
    folder, model = tmp_path_factory.mktemp("own"), hudepth.load(trained)
    source = RoomsSource(scenes=6, frames_per_scene=2, size=(48, 64))
    for record in source.records():
        depth = model.predict(source.read(record).image).metres
        for kind in ("npy", "png", "inverse", "mm"):
            (folder / kind / record.id).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / "npy" / f"{record.id}.npy", depth)
        np.save(folder / "mm" / f"{record.id}.npy", 1000 * depth)
        np.save(folder / "inverse" / f"{record.id}.npy", 3 / depth - 7)
        cv2.imwrite(str(folder / "png" / f"{record.id}_depth.png"), np.rint(depth * 1000).astype(np.uint16))
    return folder


@pytest.mark.parametrize(("kind", "rel"), [("npy", 1e-6), ("png", 1e-4)])
def test_our_own_predictions_give_the_figures_of_their_checkpoint(
    kind: str, rel: float, command: Command, own: Path, trained: Path, tmp_path: Path
) -> None:
    done = command("test", f"predictions={own / kind}", "data=rooms", *ROOMS, "protocol=eigen", "panels=2")
    assert done.code == 0, done.err
    folder = tmp_path / f"test_{kind}" / "eigen"
    found, expected = metrics(folder), metrics(trained / "test" / "eigen")
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        # thresholds of gradients in steps of 1 mm; of deltas, a pixel is 1.6e-4 of these small images
        steps = {"delt": 1e-3, "edge": 0.05, "dbe_": 0.05, "si_b": 0.05}.get(name[:4], 1e-4)
        assert found[name] == pytest.approx(value, rel=rel, abs=steps if kind == "png" else 1e-6), name
    assert {path.name for path in folder.iterdir()} == {path.name for path in (trained / "test" / "eigen").iterdir()}
    assert "mean depth map" in done.out
    document = json.loads((folder / "metrics.json").read_text())
    assert document["predictions"] == {
        "folder": str((own / kind).resolve()), "kind": "metric", "per_m": None, "files": 2,
    }  # fmt: skip
    assert "are of no pair" not in done.err  # the others are of training pairs
    compared = command("report", "compare", f"a={trained}", f"b=test_{kind}", "repeats=100", "output=c")
    assert compared.code == 0, compared.err
    rows = json.loads((tmp_path / "c" / "compare.json").read_text())["metrics"]
    assert rows["abs_rel"]["difference"] == pytest.approx(0, abs=1e-4)


def test_inverse_depth_up_to_scale_and_shift(command: Command, own: Path, trained: Path, tmp_path: Path) -> None:
    shared = ("data=rooms", *ROOMS, "protocol=eigen", "panels=1", "baselines=false")
    done = command("test", f"predictions={own / 'inverse'}", "kind=affine_disparity", *shared)
    assert done.code == 0, done.err
    assert "aligned to its ground truth (affine_inverse)" in done.out
    done = command(
        "test", f"checkpoint={trained}", "protocol=eigen", "protocol.eigen.alignment=affine_inverse", "output=o"
    )
    assert done.code == 0, done.err
    found, expected = (find_result(tmp_path / name, "eigen") for name in ("test_inverse", "o"))
    assert found.stamp == expected.stamp
    for name in ("abs_rel", "rmse", "silog", "delta1", "ssim"):
        assert found.metrics[name] == pytest.approx(expected.metrics[name], rel=1e-4), name


def test_the_networks_own_size_is_scored_as_the_network(
    command: Command, own: Path, trained: Path, tmp_path: Path
) -> None:
    """At 32 x 48, of another shape than the 48 x 64 images, predictions show the whole image."""
    from hudepth.data.preprocess import preprocess
    from hudepth.evaluation.test_data import open_data
    from hudepth.runs.checkpoint import load_checkpoint

    checkpoint = load_checkpoint(str(trained))
    data, _ = open_data(checkpoint, {}, trust=[])
    data.prepare_data()
    net = checkpoint.build_net(trust=[]).eval()
    for batch in data.test_dataloader():
        unit = net(preprocess(batch, max_depth_m=data.max_depth_m)["image"]).detach().numpy()
        for row, depth in zip(batch["index"].tolist(), unit * data.max_depth_m, strict=True):
            file = tmp_path / "small" / f"{data.store.records[row].id}.npy"
            file.parent.mkdir(parents=True, exist_ok=True)
            np.save(file, depth)  # [1, h, w]
    done = command("test", "predictions=small", "data=rooms", *ROOMS, "panels=0", "baselines=false")
    assert done.code == 0, done.err
    for protocol in ("paper", "eigen"):
        found, expected = metrics(tmp_path / "test_small" / protocol), metrics(trained / "test" / protocol)
        for name in ("abs_rel", "rmse", "silog", "ssim", "scale_sd", "rmse_pooled", "abs_rel_aligned"):
            assert found[name] == pytest.approx(expected[name], rel=1e-5), name


# --- anybody's predictions, against the field's formulas


def truths_and_predictions() -> tuple[list[F64], list[F64]]:
    rng = np.random.default_rng(0)
    truths, predictions = [], []
    for i in range(COUNT):
        surface = 1.5 + 0.7 * i + np.add.outer(np.linspace(0, 4, SIZE[0]), np.linspace(0, 6, SIZE[1]))
        surface[rng.random(SIZE) < 0.1] = 0  # holes
        truths.append(np.rint(surface * 1000) / 1000)
        smooth = cv2.resize(rng.lognormal(0.02 * i, 0.2, (12, 16)), SIZE[::-1], interpolation=cv2.INTER_CUBIC)
        predictions.append(np.rint((surface + (surface == 0)) * np.abs(smooth) * 1000) / 1000)
    return truths, predictions


TRUTHS, PREDICTIONS = truths_and_predictions()


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pairs")
    lines = ["image,depth,scene"]
    for i, truth in enumerate(TRUTHS):
        cv2.imwrite(str(root / f"rgb_{i}.jpg"), np.full((*SIZE, 3), 40 * i, np.uint8))
        cv2.imwrite(str(root / f"truth_{i}.png"), np.rint(truth * 1000).astype(np.uint16))
        lines.append(f"rgb_{i}.jpg,truth_{i}.png,scene_{i}")
    (root / "index.csv").write_text("\n".join(lines))
    return root


@pytest.fixture
def score(command: Command, pairs: Path, tmp_path: Path) -> Callable[..., Result]:
    """Return a function that scores the folder ``p`` of the working directory under the eigen protocol."""
    data = ("data=manifest", f"data.root={pairs}", "data.encoding=uint16_mm", "data.split=test", "data.size=[32,48]")

    def run(*arguments: str) -> Result:
        return command("test", "predictions=p", *data, "protocol=eigen", "panels=0", *arguments)

    return run


def write(folder: Path, predictions: list[F64]) -> None:
    folder.mkdir(exist_ok=True)
    for i, depth in enumerate(predictions):
        np.save(folder / f"rgb_{i}.npy", depth.astype(np.float32))


def eigen_pixels(truth: F64) -> NDArray[np.bool_]:
    """Pixels that BTS counts with garg_crop=False, eigen_crop=True: measured within (1e-3, 10) m in the crop."""
    valid = np.logical_and(truth > 1e-3, truth < 10)
    mask = np.zeros(valid.shape)
    mask[45:471, 41:601] = 1
    return np.logical_and(valid, mask)


def bts(gt: F64, pred: F64) -> dict[str, float]:
    """compute_errors of BTS (Lee et al. 2019), its formulas and its order."""
    thresh = np.maximum(gt / pred, pred / gt)
    err = np.log(pred) - np.log(gt)
    return {
        "delta1": (thresh < 1.25).mean(),
        "delta2": (thresh < 1.25**2).mean(),
        "delta3": (thresh < 1.25**3).mean(),
        "rmse": np.sqrt(((gt - pred) ** 2).mean()),
        "rmse_log": np.sqrt((err**2).mean()),
        "abs_rel": np.mean(np.abs(gt - pred) / gt),
        "sq_rel": np.mean(((gt - pred) ** 2) / gt),
        "silog": np.sqrt(np.mean(err**2) - np.mean(err) ** 2) * 100,
        "log10": np.mean(np.abs(np.log10(pred) - np.log10(gt))),
    }


def oracle(predictions: list[F64]) -> dict[str, float]:
    """Metrics of a set as BTS reports them: predictions clipped to the caps, means over images."""
    each = []
    for truth, pred in zip(TRUTHS, predictions, strict=True):
        mask = eigen_pixels(truth)
        each.append(bts(truth[mask], np.clip(pred, 1e-3, 10)[mask]))
    return {name: float(np.mean([one[name] for one in each])) for name in each[0]}


def agrees(folder: Path, expected: dict[str, float], *, rel: float = 1e-6) -> None:
    found = metrics(folder)
    for name, value in expected.items():
        # in single precision a pixel in a million lies on the other side of a delta's threshold
        assert found[name] == pytest.approx(value, rel=rel, abs=2e-5 if name.startswith("delta") else 0), name


def test_metric_depth_as_bts_scores_it(score: Callable[..., Result], tmp_path: Path) -> None:
    write(tmp_path / "p", PREDICTIONS)
    done = score()
    assert done.code == 0, done.err
    agrees(tmp_path / "test_p" / "eigen", oracle(PREDICTIONS))
    found = metrics(tmp_path / "test_p" / "eigen")
    squares = [((p.clip(1e-3, 10) - t) ** 2)[eigen_pixels(t)] for t, p in zip(TRUTHS, PREDICTIONS, strict=True)]
    assert found["rmse_pooled"] == pytest.approx(np.sqrt(np.concatenate(squares).mean()), rel=1e-6)
    scales = [
        np.median(t[m]) / np.median(p[m])
        for t, p, m in zip(TRUTHS, PREDICTIONS, map(eigen_pixels, TRUTHS), strict=True)
    ]
    assert found["scale_sd"] == pytest.approx(np.std(np.log(scales)), rel=1e-5)


def test_png_of_any_scale(score: Callable[..., Result], tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    for i, depth in enumerate(PREDICTIONS):
        cv2.imwrite(str(tmp_path / "p" / f"rgb_{i}.png"), np.rint(depth.clip(0, 13) * 5000).astype(np.uint16))
    done = score("per_m=5000")
    assert done.code == 0, done.err
    agrees(tmp_path / "test_p" / "eigen", oracle(PREDICTIONS), rel=1e-4)


@pytest.mark.parametrize("kind", ["affine_depth", "affine_disparity"])
def test_affine_invariant_predictions_are_fitted_by_least_squares(
    kind: str, score: Callable[..., Result], tmp_path: Path
) -> None:
    stated, fitted = [], []
    for i, (truth, pred) in enumerate(zip(TRUTHS, PREDICTIONS, strict=True)):
        given = (pred if kind == "affine_depth" else 1 / pred) * (2 + i) - 3.0
        stated.append(given)
        mask = eigen_pixels(truth)
        target = truth[mask] if kind == "affine_depth" else 1 / truth[mask]
        scale, shift = np.linalg.lstsq(np.stack([given[mask], np.ones(mask.sum())], axis=1), target, rcond=None)[0]
        line = scale * given + shift
        fitted.append(line if kind == "affine_depth" else 1 / np.maximum(line, 1e-3))
    write(tmp_path / "p", stated)
    done = score(f"kind={kind}")
    assert done.code == 0, done.err
    agrees(tmp_path / "test_p" / "eigen", oracle(fitted), rel=1e-5)


def test_predictions_of_another_size_are_resized(score: Callable[..., Result], tmp_path: Path) -> None:
    small = [cv2.resize(depth, (320, 240), interpolation=cv2.INTER_AREA) for depth in PREDICTIONS]
    write(tmp_path / "p", small)
    done = score()
    assert done.code == 0, done.err
    resized = [cv2.resize(depth.astype(np.float32), SIZE[::-1]).astype(np.float64) for depth in small]
    agrees(tmp_path / "test_p" / "eigen", oracle(resized), rel=1e-5)


# --- mistakes


def change(i: int, to: Callable[[F64], Any]) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / f"rgb_{i}.npy", to(PREDICTIONS[i].astype(np.float32)))


def holes(depth: F64) -> F64:
    depth[5, 7:9] = np.nan
    return depth


def eight_bits(folder: Path) -> None:
    (folder / "rgb_1.npy").unlink()
    cv2.imwrite(str(folder / "rgb_1.png"), np.full(SIZE, 7, np.uint8))


@pytest.mark.parametrize(
    ("spoil", "arguments", "message"),
    [
        (lambda p: (p / "rgb_2.npy").unlink(), (), "1 of 3 test pairs have no file in 'p', the first is 'rgb_2'"),
        (lambda p: shutil.rmtree(p), (), "predictions: no folder 'p'. Pass predictions=<folder"),
        (change(1, lambda d: d.T), (), "'p/rgb_1.npy' is 640 x 480, but its image is 480 x 640 (height x width)."),
        (change(1, lambda d: d[45:471, 41:601]), (), "is 426 x 560, but its image is 480 x 640"),
        (change(1, lambda d: cv2.resize(d, (4, 4))), (), "is 4 x 4, but its image is 480 x 640"),
        (change(1, lambda d: cv2.resize(d, (81, 62))), (), "is 62 x 81, but its image is 480 x 640"),
        (change(1, lambda d: cv2.resize(d, (76, 57))), (), "is 57 x 76, less than an eighth of its image, 480 x 640"),
        (change(1, lambda d: np.stack([d] * 3, -1)), (), "array of shape (480, 640, 3). Save one number per pixel"),
        (change(0, holes), (), "'p/rgb_0.npy' is NaN or infinite at 2 of 307200 pixels."),
        (change(0, lambda d: 1 / np.where(d == d.max(), 0, d)), (), "is NaN or infinite at 1 of 307200 pixels."),
        (eight_bits, (), "'p/rgb_1.png' holds 8-bit values, too coarse for depth."),
        (lambda p: os.truncate(p / "rgb_0.npy", 999), (), "not a complete .npy array"),
        (lambda p: None, ("kind=inverse",), "kind: 'inverse' is not one of metric, affine_depth, affine_disparity."),
        (lambda p: None, ("per_m=0",), "per_m: 0 is not a number above 0"),
        (lambda p: None, ("kind=affine_depth", "per_m=2"), "per_m: kind=affine_depth has no unit. Leave per_m out"),
        (lambda p: None, ("protocol=eigen_flip",), "protocol=eigen_flip adds the prediction for the mirrored image"),
        (lambda p: None, ("kind=affine_disparity", "protocol.eigen.alignment=median"), "alignment=median does not fit"),
        (lambda p: None, ("checkpoint=last",), "checkpoint, predictions: both are set. Pass one of them."),
    ],
)  # fmt: skip
def test_mistakes(
    spoil: Callable[[Path], object],
    arguments: tuple[str, ...],
    message: str,
    score: Callable[..., Result],
    tmp_path: Path,
) -> None:
    write(tmp_path / "p", PREDICTIONS)
    with np.errstate(divide="ignore"):
        spoil(tmp_path / "p")
    done = score(*arguments)
    assert done.code == 1
    assert message in done.err.splitlines()[-1]
    assert "Traceback" not in done.err


@pytest.mark.parametrize(
    ("factor", "fix"), [(1000, "Pass per_m=1000, or kind="), (100, "Pass per_m=100, or kind="), (1 / 37, "Pass kind=")]
)
def test_a_wrong_unit_is_refused(factor: float, fix: str, score: Callable[..., Result], tmp_path: Path) -> None:
    write(tmp_path / "p", [factor * depth for depth in PREDICTIONS])
    done = score()
    assert done.code == 1
    assert "predictions: kind=metric: they have a median of " in done.err.splitlines()[-1]
    assert fix in done.err.splitlines()[-1]


def test_likely_mistakes_are_warned_of(score: Callable[..., Result], tmp_path: Path) -> None:
    write(tmp_path / "p", [4 / depth for depth in PREDICTIONS])
    (tmp_path / "p" / "other.npy").write_bytes(b"")
    done = score("kind=affine_depth")
    assert done.code == 0
    assert "look like inverse depth (correlation with the truth -0." in done.err
    assert "1 of 4 files in 'p' are of no pair of the data, the first is 'other.npy'; left out" in done.err
    write(tmp_path / "p", PREDICTIONS)
    assert "look like depth (correlation with the truth 0." in score("kind=affine_disparity").err
    write(tmp_path / "p", [np.where(np.indices(SIZE)[1] < 64, 0, depth) for depth in PREDICTIONS])
    assert "kind=metric: 10 % of them are 0 m or less, which counts as an error" in score().err
    for i, depth in enumerate(PREDICTIONS):
        (tmp_path / "p" / f"rgb_{i}.npy").unlink()
        cv2.imwrite(str(tmp_path / "p" / f"rgb_{i}_depth.png"), np.rint(depth * 256).astype(np.uint16))
    assert "Pass per_m=256, or kind=" in score().err


def test_names_that_several_pairs_have_need_their_folders(tmp_path: Path) -> None:
    records = [Record(id=f"{i}", scene=s, frame=0, image=f"{s}/rgb_0.jpg") for i, s in enumerate(("bath", "hall"))]
    (tmp_path / "rgb_0.npy").touch()
    with pytest.raises(DataError, match=r"2 of 2 test pairs .* no '0\.npy' or 'bath/rgb_0\.npy', nor \.png"):
        _find(tmp_path, records, records)
    for name in ("bath_rgb_0.png", "bath_rgb_0_depth.NPY", "1.pfm", "1_depth.npy"):
        (tmp_path / name).touch()
    # the id comes first, then the image; without _depth before with it; npy before pfm before png
    assert [path.name for path in _find(tmp_path, records, records)] == ["bath_rgb_0.png", "1.pfm"]
    assert [path.name for path in _find(tmp_path, records[:1], records)] == ["bath_rgb_0.png"]


def test_predictions_need_to_know_their_data(command: Command, tmp_path: Path) -> None:
    write(tmp_path / "p", PREDICTIONS)
    done = command("test", "predictions=p")
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith(
        "hudepth-test: data is not set. Pass data=<the set the predictions are of>"
    )
