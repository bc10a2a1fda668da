"""Images per second on this device, and whether table 3 agrees with itself."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn

from experiments.ledger.tables import SIDE_PX, TABLE_3, SpeedRow


@dataclass(frozen=True)
class Speed:
    """Inference at one batch size."""

    batch: int
    ms_per_image: float
    """Median over the repeats."""
    repeats: int

    @property
    def images_per_s(self) -> float:
        """The same as a rate."""
        return 1000 / self.ms_per_image


def measure_speed(
    network: nn.Module, *, batch: int, seconds: float, device: torch.device, side_px: int = SIDE_PX
) -> Speed:
    """Time forward passes on random images: one to warm up, then as many as fit, at least one.

    Args:
        network: in eval mode on ``device``.
        batch: images per pass.
        seconds: to spend on the timed passes.
        device: synchronised before each reading of the clock.
        side_px: of the images.
    """
    image = torch.rand(batch, 3, side_px, side_px, device=device)
    times_s: list[float] = []
    with torch.inference_mode():
        _timed(network, image)
        while not times_s or sum(times_s) < seconds:
            times_s.append(_timed(network, image))
    return Speed(batch, 1000 * statistics.median(times_s) / batch, len(times_s))


def _timed(network: nn.Module, image: torch.Tensor) -> float:
    _wait(image.device)
    start = time.perf_counter()
    network(image)
    _wait(image.device)
    return time.perf_counter() - start


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def inconsistencies(rows: Sequence[SpeedRow] = TABLE_3) -> list[str]:
    """Return where a table of speeds disagrees with itself beyond what its printed digits round away.

    images/s = batch x batches/s and ms/image = 1000 / images/s, with rates printed to 0.01 and times to 0.001 ms.
    """
    found = []
    for row in rows:
        images, margin = row.batch * row.batches_per_s, 0.005 * row.batch + 0.005
        if abs(images - row.images_per_s) > margin + 1e-9:
            found.append(f"batch {row.batch}: {row.batches_per_s} batches/s are {images:.2f} images/s")
        slowest, fastest = 1000 / (row.images_per_s - 0.005), 1000 / (row.images_per_s + 0.005)
        if not fastest - 0.0005 - 1e-9 <= row.ms_per_image <= slowest + 0.0005 + 1e-9:
            found.append(f"batch {row.batch}: {row.images_per_s} images/s are {1000 / row.images_per_s:.3f} ms/image")
    return found
