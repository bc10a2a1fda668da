"""Models that need no training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hudepth.inference.model import DepthModel
from hudepth.inference.model_info import ModelInfo
from tests.networks import write_tiny_checkpoint


class GreyBackend:
    """Depth [m] is the mean of red, green and blue over 100, which can be checked by hand."""

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


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint of a tiny network with random weights."""
    return write_tiny_checkpoint(tmp_path_factory.mktemp("tiny") / "tiny.ckpt")
