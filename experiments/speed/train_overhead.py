"""What does Lightning cost, and does the loader keep up?

Trains the same network on the same batches twice, in turns: in a bare PyTorch loop, and through Lightning with
everything hudepth-train adds to an epoch (logging, history, finite-loss check, checkpoint). Prints the ratio of each
pair and its median; then the loader's rate over that of training.

    python experiments/speed/train_overhead.py [--size 224] [--batches 24] [--pairs 3]
"""

from __future__ import annotations

import argparse
import copy
import statistics
import tempfile
import time
from functools import partial
from pathlib import Path

import torch
from lightning.pytorch import Callback, Trainer
from torch.utils.data import DataLoader

from hudepth.callbacks import EpochLine, History, checkpoint_callbacks
from hudepth.checkpoint import AtomicCheckpointIO
from hudepth.data.datamodule import DepthDataModule, preprocess
from hudepth.data.sources.rooms import RoomsSource
from hudepth.losses import BADCL
from hudepth.models import HybridUNet
from hudepth.module import DepthModule
from hudepth.types import RawBatch

OPTIMIZER = partial(torch.optim.AdamW, lr=1e-4)


def bare_epoch(net: torch.nn.Module, loader: DataLoader[RawBatch]) -> float:
    """Train one epoch by hand; return its seconds."""
    loss, optimizer = BADCL(), OPTIMIZER(net.parameters())
    net.train()
    start = time.perf_counter()
    for raw in loader:
        batch = preprocess(raw, max_depth_m=10.0)
        optimizer.zero_grad()
        loss(net(batch["image"]), batch["unit_depth"], batch["image"], batch["valid"]).total.backward()
        optimizer.step()
    return time.perf_counter() - start


class Stopwatch(Callback):
    """Times what lies between the start of the first batch and the end of fit, checkpoint and history included."""

    def on_train_epoch_start(self, trainer: Trainer, pl_module: DepthModule) -> None:
        self.start = time.perf_counter()

    def on_fit_end(self, trainer: Trainer, pl_module: DepthModule) -> None:
        self.seconds = time.perf_counter() - self.start


def lightning_epoch(net: torch.nn.Module, data: DepthDataModule) -> float:
    """Train one epoch as hudepth-train does, without validation; return its seconds."""
    module = DepthModule(net, BADCL(), max_depth_m=10.0, optimizer=OPTIMIZER)
    watch = Stopwatch()
    with tempfile.TemporaryDirectory() as folder:
        _, last = checkpoint_callbacks(Path(folder), monitor="val/abs_rel", mode="min")
        callbacks = [watch, History(Path(folder) / "metrics.csv"), EpochLine("val/abs_rel"), last]
        Trainer(
            accelerator="cpu", max_epochs=1, limit_val_batches=0, logger=False, callbacks=callbacks,
            plugins=[AtomicCheckpointIO()], enable_progress_bar=False, enable_model_summary=False,
            use_distributed_sampler=False,
        ).fit(module, datamodule=data)  # fmt: skip
    return watch.seconds


def loader_rate(data: DepthDataModule) -> float:
    """Read and normalise the training set three times; return images per second."""
    loader = data.train_dataloader()
    start = time.perf_counter()
    for _ in range(3):
        for raw in loader:
            preprocess(raw, max_depth_m=10.0)
    return 3 * len(data.split.train) / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=224, help="side of the images [pixels]")
    parser.add_argument("--batches", type=int, default=24, help="batches of 8 in an epoch")
    parser.add_argument("--pairs", type=int, default=3, help="how often to repeat the comparison")
    options = parser.parse_args()

    # 70 % of the frames train; two frames a scene
    source = RoomsSource(scenes=-(-options.batches * 8 * 10 // 14), frames_per_scene=2)
    data = DepthDataModule(source, size=(options.size, options.size), split="random", native=False)
    data.prepare_data()
    net = HybridUNet()
    images = len(data.split.train)
    bare_epoch(copy.deepcopy(net), data.train_dataloader())  # warm-up
    ratios, rates = [], []
    for pair in range(options.pairs):
        runs = {
            "bare": lambda: bare_epoch(copy.deepcopy(net), data.train_dataloader()),
            "lightning": lambda: lightning_epoch(copy.deepcopy(net), data),
        }
        order = list(runs) if pair % 2 == 0 else list(runs)[::-1]  # a machine that warms up favours neither
        seconds = {name: runs[name]() for name in order}
        ratios.append(seconds["lightning"] / seconds["bare"])
        rates.append(images / seconds["bare"])
        spans = ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items())
        print(f"pair {pair + 1}: {spans}, ratio {ratios[-1]:.3f}")
    median = statistics.median(ratios)
    print(f"lightning / bare, {images} images of {options.size} x {options.size}: median {median:.3f}")
    loader = loader_rate(data)
    training = statistics.median(rates)
    print(f"loader {loader:.0f} images/s, training {training:.1f} images/s, ratio {loader / training:.0f}")
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads")


if __name__ == "__main__":
    main()
