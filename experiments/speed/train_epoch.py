"""What does an epoch cost in addition to forward, backward and step?

Trains the same network in turns: in a bare PyTorch loop over batches that lie in memory, and as hudepth-train does,
with everything that an epoch has (store, augmentation, averaged weights, logging, history, finite-loss check,
checkpoint). Validation and pictures are left out of both. Prints the images per second of each, the ratio of each pair,
its median; then the rates of the loader and of augmentation alone.

    python experiments/speed/train_epoch.py [--experiment strong] [--size 224] [--batches 24] [--pairs 5] [overrides]
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from lightning.pytorch import Callback, LightningModule, Trainer
from omegaconf import OmegaConf

from hudepth.base.devices import without_known_warnings
from hudepth.base.instantiate import instantiate
from hudepth.base.machine import keep_freed_memory
from hudepth.base.types import Batch
from hudepth.base.verbs import conf_folder
from hudepth.data.build import build_data
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.preprocess import preprocess
from hudepth.training.fit import build_module
from hudepth.training.module import DepthModule
from hudepth.training.options import MEMORY_FORMATS
from hudepth.training.trainer import build_callbacks, build_run_trainer


def read_config(experiment: str, *, size: int, overrides: list[str]) -> dict[str, Any]:
    """Return the configuration of a training of one epoch on rooms, without validation and pictures."""
    fixed = [
        f"+experiment={experiment}", f"data.size=[{size},{size}]", "data.native=false", "data.split=random",
        "data.progressive=null", "model.weights=none", "logger=none", "callbacks.panels=0", "trainer.max_epochs=1",
        "trainer.limit_val_batches=0", "trainer.accelerator=cpu",
    ]  # fmt: skip
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        config: Any = OmegaConf.to_container(compose("train", [*fixed, *overrides]), resolve=True)
    return dict(config)


def new_module(config: dict[str, Any], data: DepthDataModule, net: torch.nn.Module) -> DepthModule:
    return build_module(config, copy.deepcopy(net), data, trust=[])


def bare_epoch(
    config: dict[str, Any],
    data: DepthDataModule,
    net: torch.nn.Module,
    batches: list[Batch],
    *,
    each_step: Callable[[], None] | None = None,
) -> float:
    """Train one epoch by hand on batches in memory; return its seconds."""
    module = new_module(config, data, net)
    optimizer = module._make_optimizer(module.net.named_parameters())
    precision, clip = str(config["trainer"]["precision"]), config["trainer"]["gradient_clip_val"]
    module.train()
    start = time.perf_counter()
    for batch in batches:
        if each_step:
            each_step()
        optimizer.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=precision.startswith("bf16")):
            pred = module.net(batch["image"])
            total = module.loss(pred, batch["unit_depth"], batch["image"], batch["valid"]).total
        total.backward()
        if clip:
            torch.nn.utils.clip_grad_norm_(module.net.parameters(), clip)
        optimizer.step()
    return time.perf_counter() - start


class Stopwatch(Callback):
    """Times what lies between the start of the first batch and the end of fit, checkpoint and history included."""

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.start = time.perf_counter()

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.seconds = time.perf_counter() - self.start


def real_epoch(config: dict[str, Any], data: DepthDataModule, net: torch.nn.Module) -> float:
    """Train one epoch as hudepth-train does, without validation; return its seconds."""
    watch = Stopwatch()
    fit_epoch(config, data, net, watch)
    return watch.seconds


def fit_epoch(config: dict[str, Any], data: DepthDataModule, net: torch.nn.Module, watch: Callback) -> None:
    with tempfile.TemporaryDirectory() as folder, without_known_warnings(), quiet():
        callbacks = build_callbacks({**config, "monitor": "train/loss/total"}, Path(folder), data)
        trainer = build_run_trainer(config, Path(folder), [watch, *callbacks], alone=True)
        trainer.fit(new_module(config, data, net), datamodule=data)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    with contextlib.redirect_stdout(None):
        yield


def rates(data: DepthDataModule) -> tuple[float, float]:
    """Return how many images a second the loader reads, and augmentation with normalisation takes."""
    loader = data.train_dataloader()
    start = time.perf_counter()
    raw = [batch for _ in range(3) for batch in loader]
    read = time.perf_counter() - start
    generator, images = torch.Generator(), 3 * len(data.split.train)

    def augment(image: torch.Tensor, depth: torch.Tensor, *, size: tuple[int, int]) -> Any:
        assert data.augment is not None
        return data.augment(image, depth, size=size, aspect=4 / 3, generator=generator)

    start = time.perf_counter()
    for batch in raw:
        preprocess(batch, max_depth_m=data.max_depth_m, augment=augment if data.augment else None)
    return images / read, images / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiment", default="strong", help="whose recipe")
    parser.add_argument("--size", type=int, default=224, help="side of the images [pixels]")
    parser.add_argument("--batches", type=int, default=24, help="batches of 8 in an epoch")
    parser.add_argument("--pairs", type=int, default=5, help="how often to repeat the comparison")
    parser.add_argument("overrides", nargs="*", help="of the configuration, for example trainer.precision=bf16-mixed")
    options = parser.parse_args()

    scenes = f"data.source.scenes={-(-options.batches * 8 * 5 // 14)}"
    config = read_config(options.experiment, size=options.size, overrides=[scenes, *options.overrides])
    keep_freed_memory()
    data = build_data(config["data"], trust=[], augment=config["augment"])
    data.prepare_data()
    net = instantiate(config["model"])
    net.to(memory_format=MEMORY_FORMATS[config["memory_format"]])
    batches = [preprocess(raw, max_depth_m=data.max_depth_m) for raw in data.train_dataloader()]
    images = len(data.split.train)
    bare_epoch(config, data, net, batches[:4])  # warm-up
    ratios = []
    for pair in range(options.pairs):
        runs = {
            "bare": lambda: bare_epoch(config, data, net, batches),
            "real": lambda: real_epoch(config, data, net),
        }
        order = list(runs) if pair % 2 == 0 else list(runs)[::-1]  # a machine that warms up favours neither
        seconds = {name: runs[name]() for name in order}
        ratios.append(seconds["bare"] / seconds["real"])
        speeds = ", ".join(f"{name} {images / value:.2f} images/s" for name, value in seconds.items())
        print(f"pair {pair + 1}: {speeds}, ratio {ratios[-1]:.3f}", flush=True)
    print(f"real / bare, {options.experiment}, {images} images of {options.size} x {options.size}: "
          f"median {statistics.median(ratios):.3f}")  # fmt: skip
    loader, augmented = rates(data)
    print(f"loader {loader:.0f} images/s, augmentation and normalisation {augmented:.0f} images/s")
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads, overrides {' '.join(options.overrides)}")


if __name__ == "__main__":
    main()
