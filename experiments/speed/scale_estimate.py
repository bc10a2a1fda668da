"""Estimate what long trainings need on GPUs, from rates measured on two CPU cores; writes the table of docs/scale.md.

    python experiments/speed/scale_estimate.py

Nothing here has run on a GPU. Measured are the loader and augmentation (train_epoch.txt) and a training step
(train_step.txt); the work of a step is counted; how much of a GPU's peak such small layers reach is assumed.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE.parents[1] / "docs" / "scale.md"

FRAMES = {"50,688 (the paper)": 50_688, "407,024 (all raw frames)": 407_024}
EPOCHS = 30  # section 4 of the paper
PEAK_TFLOPS = 989  # NVIDIA H100 SXM, dense bfloat16, from its data sheet
SHARES = (0.03, 0.15)  # of the peak: what small convolutional networks reach, at worst and at best (assumed)
SCALING = 0.9  # of each of eight GPUs, relative to a single one (assumed)
PASSES = 3  # a backward pass costs two forward passes
STEP = "bfloat16, channels-last, merged, kept memory"
BATCH = 8
CORES = 2
MEGABYTES = 224 * 224 * (3 + 2) / 1e6  # of a pair in the store: RGB bytes and 16-bit depth


def gflop_per_image() -> float:
    """Count the forward pass of the merged arithmetic on one 224 x 224 image [GFLOP]."""
    import torch

    from hudepth.models import HybridUNet
    from hudepth.models.cost import counted_flops

    with torch.device("meta"):
        return counted_flops(HybridUNet(arithmetic="merged"), torch.empty(1, 3, 224, 224)) / 1e9


def measured() -> dict[str, float]:
    """Read images/s of one core that loads, of one that augments, and of two that train."""
    step = re.search(rf"^\| {re.escape(STEP)} \| (\d+) \|", (HERE / "train_step.txt").read_text(), re.MULTILINE)
    epoch = (HERE / "train_epoch.txt").read_text()
    rates = re.search(r"^loader (\d+) images/s, augmentation and normalisation (\d+) images/s$", epoch, re.MULTILINE)
    assert step
    assert rates
    return {"step": 1000 * BATCH / float(step[1]), "loader": float(rates[1]), "augmentation": float(rates[2])}


def estimate() -> str:
    """Return the measured rates and the table as Markdown."""
    rates, work = measured(), gflop_per_image() * PASSES
    slow, fast = (share * PEAK_TFLOPS * 1000 / work for share in SHARES)
    workers = math.ceil(fast / rates["loader"])
    lines = [
        f"Measured on {CORES} CPU cores (of two machines, see experiments/speed): the loader reads "
        f"{rates['loader']:,.0f} images/s, augmentation, which runs "
        f"where the network does, changes {rates['augmentation']:,.0f}, training steps take {rates['step']:.1f}. A "
        f"step is {work:.1f} GFLOP an image (three times the counted forward pass), so these cores compute "
        f"{rates['step'] * work:.0f} GFLOP/s. Assumed of an H100 with `trainer.precision=bf16-mixed "
        f"memory_format=channels_last`: {100 * SHARES[0]:.0f} to {100 * SHARES[1]:.0f} % of its {PEAK_TFLOPS} TFLOP/s, "
        f"which is {_round(slow)} to {_round(fast)} images/s, and that eight reach {100 * SCALING:.0f} % of eight "
        f"times that. `data.num_workers={workers}` for each GPU then keeps up with the faster of the two.",
        "",
        f"| estimate, {EPOCHS} epochs at 224 x 224 | store | 1 GPU | 8 GPUs | read by 8 GPUs |",
        "|---|---|---|---|---|",
    ]
    for name, frames in FRAMES.items():
        one = [frames * EPOCHS / rate / 3600 for rate in (fast, slow)]
        eight = [hours / 8 / SCALING for hours in one]
        flow = fast * 8 * SCALING * MEGABYTES / 1000
        lines.append(
            f"| {name} | {frames * MEGABYTES / 1000:.0f} GB | {_hours(one)} | {_hours(eight)} | up to {flow:.0f} GB/s |"
        )
    return "\n".join(lines)


def _round(value: float) -> str:
    """Two digits are more than an estimate has."""
    digits = max(0, math.floor(math.log10(value)) - 1)
    return f"{round(value, -digits):,.0f}"


def _hours(ends: list[float]) -> str:
    if ends[1] < 2:
        return f"{60 * ends[0]:.1f} to {60 * ends[1]:.1f} min"
    return f"{ends[0]:.1f} to {ends[1]:.1f} h"


if __name__ == "__main__":
    from hudepth.base.files import write_between

    write_between(PAGE, "estimate", estimate())
