"""The kitti_eigen protocol on sparse truth, end to end, against numpy as Eigen's successors write it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hudepth.base.errors import ConfigError
from hudepth.metrics.protocol import Protocol
from tests.commands import Command

SIZES = [(375, 1242), (370, 1224), (374, 1238), (376, 1241)]
"""KITTI's cameras differ in size."""


def garg(height: int, width: int) -> np.ndarray:
    """Garg's crop as Monodepth2's evaluate_depth.py computes it."""
    shares = [0.40810811 * height, 0.99189189 * height, 0.03594771 * width, 0.96405229 * width]
    top, bottom, left, right = np.array(shares).astype(np.int32)
    inside = np.zeros((height, width), bool)
    inside[top:bottom, left:right] = True
    return inside


def test_crop_is_gargs() -> None:
    protocol = Protocol(name="x", crop_shares=[0.40810811, 0.99189189, 0.03594771, 0.96405229])
    for size in [*SIZES, (352, 1216), (192, 640), (7, 9)]:
        window = protocol.window(*size)
        assert window is not None
        inside = np.zeros(size, bool)
        inside[window] = True
        np.testing.assert_array_equal(inside, garg(*size))
    assert protocol.window(1, 1) is None
    assert protocol.stamp()["crop_shares"] == [0.40810811, 0.99189189, 0.03594771, 0.96405229]
    assert "crop_shares" not in Protocol(name="x").stamp()


@pytest.mark.parametrize("shares", [[0.5, 0.4, 0, 1], [0, 1, 0], [0, 1, 0, 1.5]])
def test_shares_are_checked(shares: list[float]) -> None:
    with pytest.raises(ConfigError, match=r"protocol\.x\.crop_shares: "):
        Protocol(name="x", crop_shares=shares)
    with pytest.raises(ConfigError, match="with crop=null"):
        Protocol(name="x", crop=[0, 1, 0, 1], crop_shares=[0, 1, 0, 1])


def compute_errors(gt: np.ndarray, pred: np.ndarray) -> dict[str, float]:
    """The seven numbers of Eigen et al. 2014, as everybody computes them on KITTI."""
    thresh = np.maximum(gt / pred, pred / gt)
    return {
        "abs_rel": np.mean(np.abs(gt - pred) / gt),
        "sq_rel": np.mean((gt - pred) ** 2 / gt),
        "rmse": np.sqrt(np.mean((gt - pred) ** 2)),
        "rmse_log": np.sqrt(np.mean((np.log(gt) - np.log(pred)) ** 2)),
        "delta1": np.mean(thresh < 1.25),
        "delta2": np.mean(thresh < 1.25**2),
        "delta3": np.mean(thresh < 1.25**3),
    }


def test_sparse_truth_is_scored_as_eigen_and_garg_do(command: Command, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    each: list[dict[str, float]] = []
    (tmp_path / "p").mkdir()
    for number, size in enumerate(SIZES):
        drive, frame = f"2011_09_26_drive_000{number}_sync", f"{number:010d}"
        smooth = np.geomspace(90, 4, size[0])[:, None] * np.ones(size)
        truth = np.rint(np.where(rng.random(size) < 0.05, smooth * rng.uniform(0.8, 1.2, size), 0) * 256) / 256
        pred = (smooth * rng.lognormal(0.1, 0.3, size)).astype(np.float32)
        raw = tmp_path / f"set/2011_09_26/{drive}/image_02/data/{frame}.png"
        depth = tmp_path / f"set/val/{drive}/proj_depth/groundtruth/image_02/{frame}.png"
        for path, pixels in ((raw, np.full((*size, 3), 90, np.uint8)), (depth, np.rint(truth * 256).astype(np.uint16))):
            path.parent.mkdir(parents=True)
            cv2.imwrite(str(path), pixels)
        np.save(tmp_path / "p" / f"{drive}_image_02_{frame}.npy", pred)
        mask = (truth > 1e-3) & (truth < 80) & garg(*size)
        each.append(compute_errors(truth[mask], np.clip(pred.astype(np.float64), 1e-3, 80)[mask]))
    done = command(
        "test", "predictions=p", "data=kitti", "data.root=set", "data.split=test", "data.size=[32,96]",
        "paths.cache=cache", "protocol=kitti_eigen", "panels=1",
    )  # fmt: skip
    assert done.code == 0, done.err
    document: dict[str, Any] = json.loads((tmp_path / "test_p/kitti_eigen/metrics.json").read_text())
    assert document["images"] == len(SIZES)
    for name in each[0]:
        expected = np.mean([one[name] for one in each])
        # in single precision a pixel may lie on the other side of a delta's threshold: one of some 14,000
        step = 2e-5 if name.startswith("delta") else 0
        assert document["metrics"]["model"][name] == pytest.approx(expected, rel=1e-6, abs=step), name
