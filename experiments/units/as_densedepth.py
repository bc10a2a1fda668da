"""Write the labelled set in DenseDepth's layout: JPEG images and 8-bit depth, value / 255 * 10 m.

The paper's 50,688 frames come in this form, so ``data=densedepth`` reads the result the same way, correctly or as
millimetres.

    python experiments/units/as_densedepth.py <nyu_labeled> <folder to write>
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np

from hudepth.base.console import track
from hudepth.data.encoding import to_metres
from hudepth.data.sources.manifest import NyuLabeledSource


def main(root: Path, target: Path) -> None:
    """Convert all pairs and write the list that names them."""
    source = NyuLabeledSource(root, encoding="linear")
    lines = []
    records = source.records()
    for record in track(records, total=len(records), what="converting"):
        pair = source.read(record)
        depth_m = to_metres(pair.depth, "linear", scale_m=record.depth_scale_m, offset=record.depth_offset)
        value = np.clip(np.rint(depth_m / 10 * 255), 1, 255).astype(np.uint8)  # 0 would mean unmeasured
        stem = f"data/nyu2_train/{record.scene}_out/{record.frame}"
        (target / stem).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(root / record.image, target / f"{stem}.jpg")
        cv2.imwrite(str(target / f"{stem}.png"), value)
        lines.append(f"{stem}.jpg,{stem}.png\n")
    (target / "data" / "nyu2_train.csv").write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
