"""What all forms of NYU Depth V2 share: its terms, the official test set, and how scenes are named."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import ClassVar

COUNT = 1449
"""Pairs of the labelled set."""


class Nyu:
    """Provenance of NYU Depth V2 (Silberman, Hoiem, Kohli and Fergus, ECCV 2012); a mixin of its sources."""

    homepage: ClassVar[str] = "https://cs.nyu.edu/~fergus/datasets/nyu_depth_v2.html"
    terms: ClassVar[str] = (
        "NYU Depth V2 (Silberman, Hoiem, Kohli, Fergus: Indoor Segmentation and Support Inference from RGBD Images, "
        "ECCV 2012); its authors publish it for research and state no licence for other uses."
    )


@cache
def official_test() -> frozenset[int]:
    """Return the 654 positions, from 0, of the official test images among the 1,449 labelled ones."""
    lines = Path(__file__).with_name("nyu_test.txt").read_text(encoding="ascii").splitlines()
    numbers = [int(number) for line in lines if not line.startswith("#") for number in line.split()]
    return frozenset(number - 1 for number in numbers)


def category_of(scene: str) -> str:
    """Return the kind of an NYU scene: its name without its number, ``kitchen`` for ``kitchen_0004``."""
    return re.sub(r"_\d{4}[a-z]?$", "", scene.rsplit("/", 1)[-1])
