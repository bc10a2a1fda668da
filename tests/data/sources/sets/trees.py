"""Tiny trees of public data sets, each in the layout of its own archives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hudepth.data.sources.base import Source
from hudepth.data.sources.sets.indoor import IbimsSource, ScannetSource, SunRgbdSource
from hudepth.data.sources.sets.kitti import KittiSource
from hudepth.data.sources.sets.scanner import DiodeSource, Eth3dSource
from hudepth.data.sources.sets.tum import TumSource

SIZE = (24, 32)
Depth = NDArray[np.float64]


def surface(number: int, *, least: float = 1.5, most: float = 6.0, size: tuple[int, int] = SIZE) -> Depth:
    """Return depth [m] that differs from pair to pair, with holes."""
    height, width = size
    depth = np.geomspace(least, most, height * width).reshape(size) * (1 + 0.03 * number)
    depth[::5, 1::3] = 0
    return depth


def picture(path: Path, number: int, size: tuple[int, int] = SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # a JPEG's name may end in .JPG, which OpenCV knows too
    cv2.imwrite(str(path), np.full((*size, 3), 20 + 10 * number, np.uint8))


def png(path: Path, stored: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), stored)


def rounded(depth: Depth, per_m: float) -> NDArray[np.uint16]:
    return np.rint(depth * per_m).astype(np.uint16)


def kitti(root: Path) -> dict[str, Depth]:
    expected = {}
    for number, (part, drive, camera, frame) in enumerate(
        [("train", "0001", "image_02", 5), ("train", "0001", "image_03", 5), ("val", "0002", "image_02", 69)]
    ):
        name, size = f"2011_09_26_drive_{drive}_sync", (24, 80)
        depth = np.where(np.indices(size).sum(0) % 3 == 0, surface(number, least=5, most=70, size=size), 0)
        depth[3, 3] = 80.0
        raw = root / f"2011_09_26/{name}/{camera}/data"
        picture(raw / f"{frame:010d}.png", number, size)
        picture(raw / "0000000000.png", 9, size)  # the first frames have no annotated depth
        stored = rounded(depth, 256)
        png(root / f"{part}/{name}/proj_depth/groundtruth/{camera}/{frame:010d}.png", stored)
        expected[f"{name}/{camera}/{frame:010d}"] = stored / 256
    (root / "2011_09_26/calib_cam_to_cam.txt").write_text("calib_time: 09-Jan-2012")
    return expected


def sunrgbd(root: Path) -> dict[str, Depth]:
    expected = {}
    for number, pair in enumerate(
        ["kv1/NYUdata/NYU0001", "kv2/kinect2data/000002_a", "xtion/sun3ddata/brown_1/brown_1/0000103-00"]
    ):
        folder, depth = root / "SUNRGBD" / pair, surface(number)
        picture(folder / f"image/{number}.jpg", number)
        mm = rounded(depth, 1000)
        png(folder / "depth_bfx/x.png", (mm << 3 | mm >> 13).astype(np.uint16))
        png(folder / "depth/x.png", (mm << 3).astype(np.uint16))
        (folder / "intrinsics.txt").write_text("518.8 0 284.6")
        expected[pair] = mm / 1000
    return expected


def diode(root: Path) -> dict[str, Depth]:
    expected = {}
    for number, (part, where) in enumerate([("train", "indoors"), ("val", "indoors"), ("val", "outdoor")]):
        stem = f"{part}/{where}/scene_00019/scan_0018{number}/00019_0018{number}_{where}_000_010"
        depth = surface(number, most=6.0 if where == "indoors" else 299.0)
        picture(root / f"{stem}.png", number)
        filled = np.where(depth > 0, depth, 7.0)  # what the mask leaves out holds anything
        np.save(root / f"{stem}_depth.npy", filled[..., None].astype(np.float32))
        np.save(root / f"{stem}_depth_mask.npy", (depth > 0).astype(np.float64))
        expected[stem] = depth
    return {name: depth for name, depth in expected.items() if "indoors" in name}


def ibims(root: Path) -> dict[str, Depth]:
    expected = {}
    for number, name in enumerate(["corridor_01", "office_02"]):
        depth = surface(number)
        picture(root / f"rgb/{name}.png", number)
        stored = np.rint(depth * 65535 / 50).astype(np.uint16)
        png(root / f"depth/{name}.png", stored)
        invalid, transparent = np.ones(SIZE, np.uint8), np.full(SIZE, 255, np.uint8)
        invalid[2], transparent[:, 4] = 0, 0
        png(root / f"mask_invalid/{name}.png", invalid)
        png(root / f"mask_transp/{name}.png", transparent)
        depth = stored.astype(np.float64) * 50 / 65535
        depth[2], depth[:, 4] = 0, 0
        expected[name] = depth
    (root / "imagelist.txt").write_text("corridor_01\noffice_02\n")
    return expected


def scannet(root: Path) -> dict[str, Depth]:
    expected = {}
    for number, (scene, frame) in enumerate([("scene0000_00", 0), ("scene0000_00", 10), ("scene0011_01", 2)]):
        depth, size = surface(number, size=(48, 64)), (97, 130)  # 1.340, 1.333
        picture(root / f"{scene}/color/{frame}.jpg", number, size)
        png(root / f"{scene}/depth/{frame}.png", rounded(depth, 1000))
        (root / f"{scene}/pose").mkdir(exist_ok=True)
        (root / f"{scene}/pose/{frame}.txt").write_text("1 0 0 0")
        expected[f"{scene}/{frame}"] = rounded(depth, 1000) / 1000
    (root / "scannetv2_train.txt").write_text("scene0000_00\n")
    (root / "scannetv2_val.txt").write_text("scene0011_01\nscene0011_00\n")
    return expected


def tum(root: Path) -> dict[str, Depth]:
    place = root / "rgbd_dataset_freiburg1_xyz"
    images, depths = [100.00, 100.033, 100.066], [100.015, 100.040, 100.300]
    header = "# color images\n# file: 'rgbd_dataset_freiburg1_xyz.bag'\n# timestamp filename\n"
    for folder, times in (("rgb", images), ("depth", depths)):
        lines = [f"{time:.6f} {folder}/{time:.6f}.png\n" for time in times]
        (place / folder).mkdir(parents=True)
        (place / f"{folder}.txt").write_text(header + "".join(lines))
    for number, time in enumerate(images):
        picture(place / f"rgb/{time:.6f}.png", number)
    for number, time in enumerate(depths):
        png(place / f"depth/{time:.6f}.png", rounded(surface(number), 5000))
    # 100.033 is nearest to 100.040, then 100.000 to 100.015; 100.066 has no other
    scene = place.name
    return {f"{scene}/{images[i]:.6f}": rounded(surface(i), 5000) / 5000 for i in (0, 1)}


def eth3d(root: Path) -> dict[str, Depth]:
    expected = {}
    for number, (scene, name) in enumerate([("courtyard", "DSC_0286"), ("pipes", "DSC_0634")]):
        depth = surface(number, most=60)
        picture(root / f"{scene}/images/dslr_images/{name}.JPG", number)
        stored = np.where(depth > 0, depth, np.inf).astype("<f4")
        path = root / f"{scene}/ground_truth_depth/dslr_images/{name}.JPG"
        path.parent.mkdir(parents=True)
        path.write_bytes(stored.tobytes())
        expected[f"{scene}/{name}"] = depth
    return expected


@dataclass(frozen=True)
class Tree:
    """A set: what writes its tree and returns the depth [m] of each pair, and what reads it."""

    write: Callable[[Path], dict[str, Depth]]
    source: type[Source]
    per_m: int
    """Of the store."""
    splits: str
    """First letters of each pair's split; - for none."""
    depth: str
    """Pattern of its depth maps."""
    wrong: str
    """An encoding that is not the set's."""


TREES = {
    "kitti": Tree(kitti, KittiSource, 256, "rre", "**/groundtruth/**/*.png", "uint16_mm"),
    "sunrgbd": Tree(sunrgbd, SunRgbdSource, 1000, "---", "**/depth_bfx/*.png", "uint16_mm"),
    "diode": Tree(diode, DiodeSource, 1000, "re", "**/indoors/**/*_depth.npy", "mm"),
    "ibims": Tree(ibims, IbimsSource, 1000, "--", "depth/*.png", "uint16_10000"),
    "scannet": Tree(scannet, ScannetSource, 1000, "---", "**/depth/*.png", "uint16_5000"),
    "tum": Tree(tum, TumSource, 1000, "--", "**/depth/*.png", "uint16_mm"),
    "eth3d": Tree(eth3d, Eth3dSource, 256, "--", "**/ground_truth_depth/**/*.JPG", "mm"),
}
