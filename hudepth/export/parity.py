"""Compare an exported file with its checkpoint on real images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from hudepth.base.errors import CheckpointError
from hudepth.inference.backends import Backend


@dataclass(frozen=True)
class Parity:
    """Difference between an exported file and its checkpoint."""

    images: int
    worst_mm: float
    mean_mm: float

    def __str__(self) -> str:
        worst, mean = (f"{mm:.0f}" if mm >= 100 else f"{mm:.2g}" for mm in (self.worst_mm, self.mean_mm))
        return f"at most {worst} mm from the checkpoint at any pixel of {self.images} images, {mean} mm on average"


def compare(
    exported: Backend, reference: Backend, images: UInt8[np.ndarray, "n h w 3"], *, batch_size: int = 5
) -> Parity:
    """Predict the same RGB images twice, several at a time, which also tests the batch axis."""
    worst, total = 0.0, 0.0
    for at in range(0, len(images), batch_size):
        batch = np.ascontiguousarray(images[at : at + batch_size])
        difference = np.abs(exported(batch) - reference(batch)).astype(np.float64) * 1000
        worst = max(worst, float(difference.max())) if np.isfinite(difference).all() else float("inf")
        total += float(difference.mean(axis=(1, 2)).sum())
    return Parity(len(images), worst, total / len(images))


def check(parity: Parity, *, what: str, tolerance_mm: float) -> None:
    """Raise CheckpointError if the difference exceeds the tolerance."""
    if not parity.worst_mm <= tolerance_mm:
        found = f"{parity.worst_mm:.3g} mm from the checkpoint at the worst pixel, the limit is {tolerance_mm:g}"
        fix = f"The file was not kept; pass tolerance_mm={parity.worst_mm * 1.1:.2g} to accept it."
        raise CheckpointError(f"{what}: {found}. {fix}")
