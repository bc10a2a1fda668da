"""What does the host pay for a training step in addition to forward, backward and optimiser?

On a GPU the host launches the kernels of a step one by one, so what it does besides them slows training down. This can
be measured without a GPU: one thread, images of 32 x 32, one at a time. Trains epochs in turns, as hudepth-train does
and in a bare loop over batches in memory, and prints the median processor time of a step in each [ms] and that of the
differences. Validation, pictures and checkpoints are left out.

    python experiments/speed/step_overhead.py [--experiments badcl strong] [--steps 150] [--pairs 5]
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from experiments.speed.train_epoch import bare_epoch, fit_epoch, read_config
from hudepth.base.instantiate import instantiate
from hudepth.data.build import build_data
from hudepth.data.preprocess import preprocess

SMALL = ["data.batch_size=1", "data.source.frames_per_scene=10", "data.source.size=[48,64]"]


class StepClock(Callback):
    """Processor time between the starts of training batches [s]."""

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.times: list[float] = []

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        self.times.append(time.process_time())


def measure(experiment: str, *, steps: int, pairs: int) -> float:
    """Print a row of the table; return the median difference [ms]."""
    torch.set_num_threads(1)
    overrides = [*SMALL, f"data.source.scenes={-(-steps // 7)}"]
    config: dict[str, Any] = read_config(experiment, size=32, overrides=overrides)
    data = build_data(config["data"], trust=[], augment=config["augment"])
    data.prepare_data()
    net = instantiate(config["model"])
    batches = [preprocess(raw, max_depth_m=data.max_depth_m) for raw in data.train_dataloader()]
    bare, real = [], []
    for number in range(pairs + 1):
        clock, times = StepClock(), []
        bare_epoch(config, data, net, batches, each_step=lambda times=times: times.append(time.process_time()))
        fit_epoch(config, data, net, clock)
        if number:  # the first pair warms up
            bare.append(1000 * statistics.median(np.diff(times)))
            real.append(1000 * statistics.median(np.diff(clock.times)))
    extra = [r - b for r, b in zip(real, bare, strict=True)]
    print(
        f"| {experiment} | {statistics.median(bare):.1f} | {statistics.median(real):.1f} "
        f"| {statistics.median(extra):.1f} ({min(extra):.1f} to {max(extra):.1f}) |", flush=True,
    )  # fmt: skip
    return statistics.median(extra)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", nargs="+", default=["badcl", "strong"], help="whose recipes")
    parser.add_argument("--steps", type=int, default=150, help="steps in an epoch, about")
    parser.add_argument("--pairs", type=int, default=5, help="how often to repeat the comparison")
    options = parser.parse_args()
    print("| recipe | bare step [ms] | step [ms] | difference [ms] |\n|---|---|---|---|", flush=True)
    for experiment in options.experiments:
        measure(experiment, steps=options.steps, pairs=options.pairs)
    print(f"torch {torch.__version__}, one thread, {options.steps} steps, {options.pairs} pairs")


if __name__ == "__main__":
    main()
