"""NYU Depth V2 as a data set for any PyTorch code: named samples and a picture of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import cv2
import numpy as np
import torch
from torch.utils.data import Dataset

from hudepth.base.images import resize_image
from hudepth.base.options import Choice, Range, Size, convert
from hudepth.data.pairs import read_metres
from hudepth.data.sources.base import Source
from hudepth.data.sources.manifest import NyuLabeledSource
from hudepth.data.sources.nyu_mat import NyuMatSource
from hudepth.data.splits import SUBSETS, make_split
from hudepth.viz.colour import colour_depth

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class NYUDepth(Dataset[dict[str, Any]]):
    """The 1,449 labelled pairs of NYU Depth V2 with the official split: 654 test pairs, validation taken by scene.

    Each sample is a dictionary:

    =========== ============================ ==========================================================
    key         type, shape                  content
    =========== ============================ ==========================================================
    image       float32 [3, h, w]            RGB in [0, 1]
    depth       float32 [1, h, w]            depth along the optical axis [m], 0 where not valid
    valid       bool [1, h, w]               where depth is measured, positive and at most max_depth_m
    id, scene   str                          for example ``00012`` and ``kitchen_0004``
    =========== ============================ ==========================================================

    Pairs are decoded when they are asked for, and nothing is written to disk. Raises ConfigError if an option is out of
    range, DataError if the root is missing or neither form of the data set.

    Args:
        root: the folder with ``index.csv`` and the frames, or ``nyu_depth_v2_labeled.mat`` or its folder.
        split: ``train``, ``val`` or ``test``; train and val share the official training pairs 7 : 1.
        size: (height, width) to resize to, or one number for a square; as stored by default. Images are averaged over
            areas, depths take the nearest pixel.
        max_depth_m: depths beyond it are not valid [m].
        seed: of the choice of validation scenes.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "train",
        *,
        size: int | Sequence[int] | None = None,
        max_depth_m: float = 10.0,
        seed: int = 42,
    ) -> None:
        subset = convert("split", split, Annotated[str, Choice(SUBSETS)])
        self.size: tuple[int, int] | None = convert("size", size, Size | None)
        self.max_depth_m: float = convert("max_depth_m", max_depth_m, Annotated[float, Range(0, above=True)])
        path = Path(root).expanduser()
        is_mat = path.suffix == ".mat" or (path / "nyu_depth_v2_labeled.mat").exists()
        self.source: Source = NyuMatSource(path) if is_mat else NyuLabeledSource(path, encoding="linear")
        records = self.source.records()
        if subset == "test":
            self.records = [record for record in records if record.split == "test"]
        else:
            self.records = [records[index] for index in make_split(records, kind="official", seed=seed)[subset]]

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Decode one sample; DataError if its files are missing or damaged."""
        record = self.records[index]
        raw = self.source.read(record)
        image, depth = raw.image, read_metres(self.source, record, raw.depth)
        if self.size:
            image = resize_image(image, self.size)
            depth = np.asarray(cv2.resize(depth, self.size[::-1], interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
        valid = (depth > 0) & (depth <= self.max_depth_m)
        return {
            "image": torch.from_numpy(image.astype(np.float32) / 255).permute(2, 0, 1).contiguous(),
            "depth": torch.from_numpy(np.where(valid, depth, np.float32(0)))[None],
            "valid": torch.from_numpy(valid)[None],
            "id": record.id,
            "scene": record.scene,
        }

    def plot(self, sample: dict[str, Any], *, title: str | None = None) -> Figure:
        """Draw a sample: the image, its depth, and ``sample["prediction"]`` [1, h, w] in metres if there is one.

        The title is the scene by default.
        """
        from matplotlib.figure import Figure

        pictures = {"Image": sample["image"].permute(1, 2, 0).cpu().numpy()}
        for key in ("depth", "prediction"):
            if key in sample:
                depth = sample[key][0].detach().float().cpu().numpy()
                pictures[f"{key.capitalize()} [m]"] = colour_depth(depth, scale_m=(0.0, self.max_depth_m))
        figure = Figure(figsize=(4.2 * len(pictures), 3.6), layout="constrained")
        for axis, (name, picture) in zip(figure.subplots(1, len(pictures)), pictures.items(), strict=True):
            axis.imshow(picture)
            axis.set_title(name)
            axis.axis("off")
        figure.suptitle(sample["scene"] if title is None else title)
        return figure
