from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import hudepth
from hudepth.base.errors import CheckpointError
from hudepth.export.parity import check, compare


def test_a_prediction_that_is_nan_does_not_match(tiny: Path) -> None:
    class Broken:
        info, name = hudepth.load(tiny).info, "torch"

        def __call__(self, rgb: np.ndarray) -> np.ndarray:
            return np.full(rgb.shape[:3], np.nan, np.float32)

    parity = compare(Broken(), hudepth.load(tiny).backend, np.zeros((1, 32, 48, 3), np.uint8))
    with pytest.raises(CheckpointError, match="inf mm from the checkpoint"):
        check(parity, what="x", tolerance_mm=1e9)
