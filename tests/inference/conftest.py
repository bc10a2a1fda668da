"""A model that needs no training: what it says of an image can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from hudepth.inference.info import ModelInfo
from hudepth.inference.model import DepthModel


class GreyBackend:
    """Depth [m] is the mean of red, green and blue over 100."""

    name = "torch"

    def __init__(self) -> None:
        self.info = ModelInfo("Grey", (32, 48), 10.0, 0, 1)
        self.batches: list[int] = []

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        self.batches.append(len(rgb))
        return (rgb.astype(np.float32).mean(axis=3) / 100).astype(np.float32)


@pytest.fixture
def grey() -> DepthModel:
    return DepthModel(GreyBackend())
