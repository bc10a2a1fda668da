"""What do metrics and further protocols cost in addition to the network itself?

Three questions, each answered by ratios of times taken in turns in one process:

1. One pass over a test set under all six protocols, against one protocol that needs the same forward passes
   (``eigen_flip``), with the trivial baselines and without, depth edges and strata aside.
2. All metrics of one protocol on a 480 x 640 ground truth, SSIM and resizing included, vs the network's forward pass
   at 224 x 224.
3. The boundary metrics, against the same.

    python experiments/speed/test_cost.py [--images 24] [--pairs 5]
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
import yaml
from lightning.pytorch import Trainer
from torch import nn

from hudepth.base.verbs import conf_folder
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.dataset import StoreDataset
from hudepth.data.preprocess import preprocess
from hudepth.data.sources.rooms import RoomsSource
from hudepth.evaluation.baselines import trivial_baselines
from hudepth.evaluation.routine import Evaluation
from hudepth.evaluation.scoring import BatchScores, BatchTruth
from hudepth.metrics.protocol import Protocol
from hudepth.models import HybridUNet

NAMES = ("paper", "eigen", "eigen_flip", "densedepth", "guided", "raw_holes")


def protocol(name: str) -> Protocol:
    """Read a protocol of the configuration, without its further measures."""
    text = (conf_folder() / "protocol" / f"{name}.yaml").read_text()
    options = {k: v for k, v in yaml.safe_load(text).items() if k not in ("_target_", "boundary", "strata")}
    return Protocol(**options)


def test_seconds(data: DepthDataModule, predictors: dict[str, nn.Module], names: tuple[str, ...]) -> float:
    """Run one test as hudepth-test does; return its seconds."""
    evaluation = Evaluation(predictors, [protocol(name) for name in names], max_depth_m=data.max_depth_m)
    trainer = Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_model_summary=False,
        enable_progress_bar=False, use_distributed_sampler=False,
    )  # fmt: skip
    start = time.perf_counter()
    trainer.test(evaluation, datamodule=data, verbose=False)
    return time.perf_counter() - start


def ratios(numerator: Callable[[], float], denominator: Callable[[], float], pairs: int) -> tuple[float, float, float]:
    """Take both in turns; return the median ratio and both median times."""
    times: list[tuple[float, float]] = []
    for pair in range(pairs + 1):  # the first pair warms up
        order = (numerator, denominator) if pair % 2 else (denominator, numerator)
        first, second = (f() for f in order)
        times.append((first, second) if pair % 2 else (second, first))
    above, below = zip(*times[1:], strict=True)
    return statistics.median(a / b for a, b in times[1:]), statistics.median(above), statistics.median(below)


def timed(work: Callable[[], object], repeats: int) -> Callable[[], float]:
    """Return a function that does the work some times and returns the seconds of one."""

    def run() -> float:
        start = time.perf_counter()
        for _ in range(repeats):
            work()
        return (time.perf_counter() - start) / repeats

    return run


@torch.inference_mode()
def metric_costs(data: DepthDataModule, net: nn.Module, pairs: int) -> None:
    """Print what scoring one image costs in addition to predicting it."""
    dataset = StoreDataset(data.store, data.split.test[:1], native=True)
    batch = preprocess(dataset[0], max_depth_m=data.max_depth_m)
    assert batch["native_depth"][0].shape[-2:] == (480, 640)
    pred_m = net(batch["image"]) * data.max_depth_m
    eigen = protocol("eigen")

    def scores() -> BatchScores:
        return BatchScores(pred_m, BatchTruth(batch, max_depth_m=data.max_depth_m))

    forward = timed(lambda: net(batch["image"]), 8)
    for what, work in (
        ("all metrics of the eigen protocol", lambda: scores().sums(eigen)),
        ("boundary metrics", lambda: scores().boundary(eigen)),
    ):
        ratio, above, below = ratios(timed(work, 8), forward, pairs)
        print(f"{what}, 480 x 640 / forward at 224 x 224: {ratio:.3f} ({1000 * above:.1f} ms / {1000 * below:.1f} ms)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=24, help="test images")
    parser.add_argument("--pairs", type=int, default=5, help="how often to repeat each comparison")
    options = parser.parse_args()

    source = RoomsSource(scenes=options.images * 5, frames_per_scene=1, size=(480, 640))  # the last fifth tests
    data = DepthDataModule(source, split="official")
    data.prepare_data()
    net = HybridUNet().eval()
    baselines = trivial_baselines(data.store, data.split.train, max_depth_m=data.max_depth_m)
    for what, predictors in (("network alone", {"model": net}), ("with three baselines", {"model": net, **baselines})):
        ratio, six, one = ratios(
            lambda p=predictors: test_seconds(data, p, NAMES),
            lambda p=predictors: test_seconds(data, p, ("eigen_flip",)),
            options.pairs,
        )
        print(f"six protocols / eigen_flip, {what}: {ratio:.3f} ({six:.2f} s / {one:.2f} s)")
    metric_costs(data, net, options.pairs)
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads, {len(data.split.test)} test images")


if __name__ == "__main__":
    main()
