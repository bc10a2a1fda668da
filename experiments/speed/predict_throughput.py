"""Does writing keep up with predicting? Images decoded, predicted and written, against the network alone.

    python experiments/speed/predict_throughput.py [folder of images]

Blocks of the folder's images go through the default path twice, in turns: decoded, predicted and written as npy, 16-bit
PNG and colour picture, as hudepth-predict does; and as arrays in memory through the network alone. The ratio of the two
rates is the share of the network's speed that remains. Weights are random: they do not change the work.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import cv2
import torch

from hudepth.base.console import setup_logging
from hudepth.base.machine import usable_cores
from hudepth.inference.backends import TorchBackend
from hudepth.inference.depth_files import Style, write_depth
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.inputs import find_inputs
from hudepth.inference.model import DepthModel
from hudepth.inference.model_info import ModelInfo
from hudepth.inference.stream import Stream, Tally
from hudepth.models import HybridUNet
from hudepth.models.inference import inference_form

BLOCK = 145
FORMATS = ["png16", "npy", "colour"]


def main() -> None:
    setup_logging()
    root = sys.argv[1] if len(sys.argv) > 1 else os.environ.get("HUDEPTH_NYU_ROOT", "../shared/data/nyu_labeled")
    items = find_inputs(f"{root}/*.jpg", recursive=False).images
    cv2.setNumThreads(1)  # as hudepth-predict does
    torch.set_num_threads(usable_cores())
    torch.manual_seed(0)
    info = ModelInfo("HybridUNet", (224, 224), 10.0, 4_653_313, 0)
    net = inference_form(HybridUNet().eval(), size=info.size)
    model = DepthModel(TorchBackend(net, info, device=torch.device("cpu")))
    for _ in range(5):
        model.predict(items[0].path)
    ratios, seconds = [], [0.0, 0.0]
    with tempfile.TemporaryDirectory() as folder:
        style = Style((0.0, 10.0))

        def write(key: Path, depth: DepthMap) -> None:
            write_depth(Path(folder) / key, depth, FORMATS, style)

        for at in range(0, len(items), BLOCK):
            block = items[at : at + BLOCK]
            start = time.perf_counter()
            stream: Stream[Path] = Stream(model, write, tally=Tally())
            for _ in stream.run((item.stem, item.path) for item in block):
                pass
            whole = time.perf_counter() - start
            prepared = [model.prepare(item.path) for item in block]
            start = time.perf_counter()
            for each in prepared:
                model.run([each])
            alone = time.perf_counter() - start
            ratios.append(alone / whole)
            seconds = [seconds[0] + whole, seconds[1] + alone]
            rates = f"{len(block) / whole:5.1f} a second written, {len(block) / alone:5.1f} alone"
            print(f"{at + len(block):5d} images: {rates}", flush=True)
    print(
        f"\n{len(items)} images of {Path(root).name}, {torch.get_num_threads()} threads; written: {', '.join(FORMATS)}"
    )
    rates = [len(items) / each for each in seconds]
    print(f"all of them: {rates[0]:.1f} a second, the network alone {rates[1]:.1f}: ratio {rates[0] / rates[1]:.3f}")
    spread = f"from {min(ratios):.3f} to {max(ratios):.3f}"
    print(f"median of {len(ratios)} paired ratios {statistics.median(ratios):.3f} ({spread})")


if __name__ == "__main__":
    main()
