"""What the field of view does to the metres of the bundled model, on crops whose camera and depth are known.

    python experiments/field_of_view/crops.py <nyu_labeled> [--every N]

writes the tables between the markers of README.md in this folder: the powers by which focal lengths count, from crops
of training images; errors on crops of the 654 test images; and errors on rooms rendered with other cameras. ``--every``
takes each N-th image only.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

import hudepth
from hudepth.base.camera import NYU_FOCAL, Intrinsics
from hudepth.base.console import track
from hudepth.base.files import write_between
from hudepth.data.encoding import to_metres
from hudepth.data.sources.manifest import NyuLabeledSource
from hudepth.data.sources.rooms import RoomsSource
from hudepth.inference.model import DepthModel

Pixels = NDArray[np.uint8]
Depths = NDArray[np.float32]
FULL = (480, 640)
CROPS = {
    "four fifths of the field of view": (384, 512), "two thirds": (320, 426), "half": (240, 320),
    "portrait 3:4": (456, 342), "square": (456, 456), "wide 16:9": (342, 608),
}  # fmt: skip
"""(height, width) around the centre. All lie within the Eigen crop, rows 45 to 471 and columns 41 to 601, but for a
margin of 33 rows and columns at most, which is cut off where depth is scored."""
EIGEN = (slice(45, 471), slice(41, 601))
FITTED = [*CROPS.values(), (436, 582), (274, 366), (304, 608)]
CAMERAS = {
    "x 0.6": (0.6, 0.6), "x 0.8": (0.8, 0.8), "x 1": (1.0, 1.0), "x 1.25": (1.25, 1.25), "x 1.5": (1.5, 1.5),
    "x 2": (2.0, 2.0), "phone, portrait": (1.235, 0.694),
}  # fmt: skip
"""Focal lengths of rooms, horizontal and vertical, in those of NYU over the sides of the picture."""


def pairs(root: Path, split: str, every: int) -> Iterator[tuple[Pixels, Depths]]:
    """Yield images and depths [m] of the official split at 640 x 480."""
    source = NyuLabeledSource(root, encoding="linear")
    records = [record for record in source.records() if record.split == split][::every]
    for record in track(records, total=len(records), what=split):
        pair = source.read(record)
        depth = to_metres(pair.depth, "linear", scale_m=record.depth_scale_m, offset=record.depth_offset)
        yield np.ascontiguousarray(pair.image), np.asarray(depth, np.float32)


def box(size: tuple[int, int]) -> tuple[slice, slice]:
    """Return rows and columns of a crop around the centre."""
    top, left = (FULL[0] - size[0]) // 2, (FULL[1] - size[1]) // 2
    return slice(top, top + size[0]), slice(left, left + size[1])


def score(pred_m: Depths, truth_m: Depths) -> tuple[float, float]:
    """Return abs_rel and the mean log error, as the protocol eigen: 1 mm < truth < 10 m, prediction clamped to that."""
    counts = (truth_m > 1e-3) & (truth_m < 10)
    pred, truth = np.clip(pred_m, 1e-3, 10)[counts], truth_m[counts]
    return float(np.mean(np.abs(pred - truth) / truth)), float(np.mean(np.log(pred / truth)))


def ratios(size: tuple[int, int]) -> tuple[float, float]:
    """Return the focal lengths of a crop at the network's input over those of the whole picture."""
    return FULL[1] / size[1], FULL[0] / size[0]


def fit_powers(root: Path, model: DepthModel, every: int) -> NDArray[np.float64]:
    """Return the powers that undo what cropping training images does to depth, by least squares over kinds of crops."""
    shift: dict[tuple[int, int], list[float]] = defaultdict(list)
    for image, truth in pairs(root, "train", every):
        whole = model.predict(image).metres
        for size in FITTED:
            part = box(size)
            crop = model.predict(np.ascontiguousarray(image[part])).metres
            shift[size].append(score(whole[part], truth[part])[1] - score(crop, truth[part])[1])
    logs = np.log([ratios(size) for size in FITTED])
    return np.asarray(np.linalg.lstsq(logs, np.array([np.mean(shift[size]) for size in FITTED]), rcond=None)[0])


def matched(size: tuple[int, int]) -> tuple[int, int]:
    """Return the input size, in multiples of 16, at which a crop has the focal lengths of the training."""
    across, down = ratios(size)
    return max(64, round(160 / down / 16) * 16), max(64, round(160 / across / 16) * 16)


def nyu_table(root: Path, model: DepthModel, models: dict[tuple[int, int], DepthModel], every: int) -> list[str]:
    """Score crops of the test images, beside the same pixels of the whole images."""
    scores: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for image, truth in pairs(root, "test", every):
        whole = model.predict(image).metres
        scores["all of the image", "whole"].append(score(whole[EIGEN], truth[EIGEN]))
        for name, size in CROPS.items():
            part = box(size)
            inside = tuple(slice(max(e.start - p.start, 0), e.stop - p.start) for e, p in zip(EIGEN, part, strict=True))
            crop = np.ascontiguousarray(image[part])
            across, down = ratios(size)
            plain, other = model.predict(crop).metres, models[matched(size)].predict(crop).metres
            nyu = Intrinsics.of_nyu(*FULL)
            own = Intrinsics(nyu.fx, nyu.fy, nyu.cx - part[1].start, nyu.cy - part[0].start)
            rows, columns = matched(size)
            rest = np.sqrt(rows / 160 * down * columns / 160 * across)  # multiples of 16 match roughly
            ways = {
                "whole": whole[part], "none": plain, "ratio": plain * np.sqrt(across * down), "down": plain * down,
                "camera": model.predict(crop, camera=own).metres,
                "two": np.sqrt(plain * across**0.25 * down**0.75 * other * rest),
            }  # fmt: skip
            for way, depth in ways.items():
                scores[name, way].append(score(np.asarray(depth[inside], np.float32), truth[part][inside]))
    lines = [
        "| crop | whole image, same pixels | no camera | ratio | vertical ratio | `camera=` | two views |",
        f"|{'---|' * 7}",
        f"| all of the image | {_cell(scores['all of the image', 'whole'])} | | | | | |",
    ]
    ways_shown = ("whole", "none", "ratio", "down", "camera", "two")
    lines += [f"| {name} | {' | '.join(_cell(scores[name, way]) for way in ways_shown)} |" for name in CROPS]
    return lines


def rooms_table(model: DepthModel, count: int) -> list[str]:
    """Score rooms that were rendered with other focal lengths, which crops of NYU cannot be: wider ones."""
    lines = ["| focal length | no camera | ratio | `camera=` |", f"|{'---|' * 4}"]
    of_nyu = Intrinsics.of_nyu
    for name, (across, down) in CAMERAS.items():

        def other(height: int, width: int, across: float = across, down: float = down) -> Intrinsics:
            camera = of_nyu(height, width)
            return Intrinsics(camera.fx * across, camera.fy * down, camera.cx, camera.cy)

        scores: dict[str, list[tuple[float, float]]] = defaultdict(list)
        with patch.object(Intrinsics, "of_nyu", other):
            source = RoomsSource(scenes=count, frames_per_scene=1, size=(160, 160), seed=77)
            rooms = [source.read(record) for record in source.records()]
        for room in rooms:
            image, truth = np.ascontiguousarray(room.image), np.asarray(room.depth, np.float32)
            own = Intrinsics.centred(across * NYU_FOCAL[0] * 160, down * NYU_FOCAL[1] * 160, 160, 160)
            plain = model.predict(image).metres
            scores["none"].append(score(plain, truth))
            scores["ratio"].append(score(plain * np.float32(np.sqrt(across * down)), truth))
            scores["camera"].append(score(model.predict(image, camera=own).metres, truth))
        lines.append(f"| {name} | {' | '.join(_cell(scores[way]) for way in ('none', 'ratio', 'camera'))} |")
    return lines


def _cell(scores: list[tuple[float, float]]) -> str:
    abs_rel, bias = np.mean(scores, axis=0)
    return f"{abs_rel:.3f} ({bias:+.2f})"


def main() -> None:
    """Write the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("root", type=Path)
    parser.add_argument("--every", type=int, default=1)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    threads = torch.get_num_threads()
    model = hudepth.load("nyu", device="cpu", threads=threads)
    sizes = {matched(size) for size in CROPS.values()}
    models = {size: hudepth.load("nyu", device="cpu", size=size, threads=threads) for size in sizes}
    across, down = fit_powers(given.root, model, 4 * given.every)
    lines = [f"Powers of the ratios, fitted: {across:.3f} horizontal, {down:.3f} vertical.", ""]
    lines += [*nyu_table(given.root, model, models, given.every), "", *rooms_table(model, max(2, 100 // given.every))]
    write_between(Path(__file__).parent / "README.md", "results", "\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
