"""How much of a GPU does hudepth use? One command, at most four minutes, prints and writes every figure.

Trains with hudepth-train on built-in rooms and reads times.csv; runs the same network in a bare loop over a batch in
memory, step by step and as a CUDA graph; predicts through hudepth.load; measures with hudepth-bench; measures what the
host pays for a step. Without a GPU it measures what a CPU can tell, at a smaller size, and names the rest.

    python -m experiments.speed.gpu [--output gpu] [--seconds 240]
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

import hudepth
from experiments.speed import step_overhead
from experiments.speed.train_epoch import read_config
from hudepth.base.instantiate import instantiate
from hudepth.base.machine import float32_products, hardware
from hudepth.base.tables import Table
from hudepth.cuda import graphs
from hudepth.models.cost import image_flops

PAPER_IMAGES, PAPER_EPOCHS, PAPER_VALIDATION = 35_481, 100, 5_068
"""The paper's training, and a tenth of its 50,688 pairs for validation."""
PAPER_RATES = {1: 249.84, 32: 1212.19}
"""Table 3: images/s by batch on its GPU."""


@dataclass(frozen=True)
class Row:
    """A figure, and the least or most it should be."""

    what: str
    value: float
    bar: str
    unit: str = ""


@dataclass
class Report:
    """Figures as they come, each printed at once; what cannot be measured is ``missing``."""

    deadline: float
    gpu: bool
    """Whether there is one; only then are there bars for its rates."""
    rows: list[Row] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def add(self, what: str, value: float, bar: str = "", unit: str = "") -> float:
        bar = bar if self.gpu or unit == "ms" else ""
        self.rows.append(Row(what, value, bar, unit))
        print(f"{what}: {value:.4g} {unit}".rstrip() + (f" (bar {bar})" if bar else ""), flush=True)
        return value

    def part(self, name: str, measure: Callable[[], None]) -> None:
        """Measure, and go on with the next part if this one fails or there is no time left."""
        try:
            if time.monotonic() > self.deadline:
                raise TimeoutError("no time left")
            measure()
        except Exception as error:  # one failing part should not cost the others
            lines = str(error).strip().splitlines() or [""]
            self.missing.append(f"{name}: {type(error).__name__} {lines[-1]}"[:200])
            print(f"missing: {self.missing[-1]}", flush=True)


@dataclass(frozen=True)
class Epochs:
    """Rates of a training after its first epoch."""

    images_per_s: float
    seconds: float
    """Of an epoch, the median."""


def command(name: str, *overrides: str, cwd: Path, seconds: float = 120) -> str:
    """Run a console script; raise RuntimeError with its last line if it fails."""
    script = Path(sys.executable).with_name(name)
    done = subprocess.run([script, *overrides], cwd=cwd, capture_output=True, text=True, timeout=seconds, check=False)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or [f"{name} failed"])[-1])
    return done.stderr


def train(folder: Path, experiment: str, *, size: int, batch: int, scenes: int, more: tuple[str, ...] = ()) -> Epochs:
    """Train as the README does, on rooms; what is not about speed is left out of ``more``."""
    epochs = 5
    with tempfile.TemporaryDirectory(dir=folder) as runs:
        printed = command(
            "hudepth-train", f"+experiment={experiment}", "data=rooms", f"data.source.scenes={scenes}",
            "data.source.frames_per_scene=8", f"data.size=[{size},{size}]", f"data.batch_size={batch}",
            "data.native=false", "data.progressive=null", "model.weights=none", f"trainer.max_epochs={epochs}",
            "test=false", f"paths.runs={runs}", f"data.cache={folder}", *more, cwd=folder,
        )  # fmt: skip
        for line in printed.splitlines():
            if "CUDA graph" in line:
                print(f"  {line.strip()}", flush=True)
        (file,) = Path(runs).rglob("times.csv")
        rows = [(int(row["images"]), float(row["wall_s"])) for row in csv.DictReader(file.open())]
    took = np.diff([seconds for _, seconds in rows])
    return Epochs((rows[-1][0] - rows[0][0]) / float(took.sum()), float(np.median(took)))


def bare_step(experiment: str, *, size: int, batch: int, device: torch.device, bf16: bool) -> Callable[[], None]:
    """Return a training step of an experiment's network, loss and fused AdamW on one batch in memory."""
    config = read_config(experiment, size=size, overrides=[])
    layout = torch.channels_last if bf16 else torch.contiguous_format
    net = instantiate(config["model"]).to(device, memory_format=layout)
    loss = instantiate(config["loss"])
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-4, fused=True, capturable=device.type == "cuda")
    image = torch.randn(batch, 3, size, size, device=device).contiguous(memory_format=layout)
    truth = torch.rand(batch, 1, size, size, device=device)
    valid = truth > 0

    def step() -> None:
        optimizer.zero_grad()
        with torch.autocast(device.type, torch.bfloat16, enabled=bf16, cache_enabled=False):
            pred = net(image)
        loss(pred.float(), truth, image, valid).total.backward()
        optimizer.step()

    return step


def recorded(function: Callable[[], Any]) -> Callable[[], None]:
    """Return a replay of a function."""
    for _ in range(graphs.WARM_UPS):
        with graphs.beside():
            function()
    return graphs.record(function).replay


def rate(function: Callable[[], Any], images: int, *, seconds: float = 2.0) -> float:
    """Return the images a second of a function that takes ``images`` at a time."""

    def wait() -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()

    for _ in range(3):
        function()
    wait()
    start, calls = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        for _ in range(5):
            function()
        wait()
        calls += 5
    return calls * images / (time.perf_counter() - start)


class Training:
    """Compares hudepth-train with bare loops."""

    QUIET = ("callbacks.panels=0", "trainer.limit_val_batches=0", "logger=none", "monitor=train/loss/total")
    SHARE: ClassVar = {8: 0.75, 64: 0.95}

    def __init__(self, report: Report, folder: Path, device: torch.device, *, size: int, scenes: int) -> None:
        self.report, self.device, self.size, self.scenes = report, device, size, scenes
        self.train = partial(train, folder, size=size, scenes=scenes)
        self.cuda = device.type == "cuda"
        self.real: dict[int, Epochs] = {}

    def measure(self) -> None:
        for batch in (8, 64) if self.cuda else (8,):
            self.report.part(f"badcl, batch {batch}", partial(self.badcl, batch))
        self.report.part("strong over badcl", self.strong)
        self.report.part("the paper's training", self.paper)
        if self.cuda:
            self.report.part("share of the bf16 peak", self.share)

    def badcl(self, batch: int) -> None:
        add = self.report.add
        self.real[batch] = self.train("badcl", batch=batch, more=self.QUIET)
        got = add(f"badcl, batch {batch}", self.real[batch].images_per_s, unit="images/s")
        with float32_products(tf32=self.cuda):
            step = bare_step("badcl", size=self.size, batch=batch, device=self.device, bf16=False)
            eager = add(f"bare eager loop, batch {batch}", rate(step, batch), unit="images/s")
            add(f"badcl over the bare eager loop, batch {batch}", got / eager, ">= 3" if batch == 8 else "")
            if self.cuda:
                graph = add(f"bare CUDA graph, batch {batch}", rate(recorded(step), batch), unit="images/s")
                add(f"badcl over the bare CUDA graph, batch {batch}", got / graph, f">= {self.SHARE[batch]}")

    def strong(self) -> None:
        found = self.train("strong", batch=8, more=(*self.QUIET, "trainer.precision=tf32"))
        self.report.add("strong over badcl, batch 8", found.images_per_s / self.real[8].images_per_s, ">= 0.85")

    def paper(self) -> None:
        whole = self.train("badcl", batch=8, more=())
        self.report.add("badcl, batch 8, with validation and pictures", whole.images_per_s, unit="images/s")
        validated = max(1, self.scenes * 8 // 10)
        evaluation = (whole.seconds - self.real[8].seconds) * max(1.0, PAPER_VALIDATION / validated)
        if self.cuda:
            minutes = PAPER_EPOCHS * (PAPER_IMAGES / self.real[8].images_per_s + evaluation) / 60
            self.report.add("the paper's training", minutes, "< 30", "minutes")

    def share(self) -> None:
        found = self.train("badcl", batch=128, more=(*self.QUIET, "trainer.precision=fast"))
        flops = 3 * network_flops(self.size)  # a backward pass takes two forward passes
        percent = 100 * found.images_per_s * flops / peak_flops(self.device)
        self.report.add("share of the bf16 peak in training, batch 128", percent, ">= 12", "%")


def network_flops(size: int) -> float:
    """Return the operations of a forward pass of the paper's network per image."""
    net = instantiate(read_config("badcl", size=size, overrides=[])["model"])
    return float(image_flops(net, (size, size)))


def peak_flops(device: torch.device) -> float:
    """Return the operations a second of a product of large bfloat16 matrices."""
    side = 8192
    a, b = (torch.randn(side, side, device=device, dtype=torch.bfloat16) for _ in range(2))
    return 2 * side**3 * rate(lambda: torch.mm(a, b), 1, seconds=0.5)


def measure_inference(report: Report, folder: Path, device: torch.device) -> None:
    """Compare hudepth.load with a bare CUDA graph, and hudepth-bench with table 3."""
    for batch in (1, 32):
        report.part(f"inference, batch {batch}", partial(measure_load, report, device, batch))
    report.part("hudepth-bench", partial(measure_bench, report, folder, device))


def measure_bench(report: Report, folder: Path, device: torch.device) -> None:
    backends = "[eager,default,cuda_graph,fp16,bf16]" if device.type == "cuda" else "[eager,default]"
    command(
        "hudepth-bench", "checkpoint=nyu", f"device={device.type}", f"backends={backends}", "batches=[1,32]",
        "repeats=2", "seconds=0.3", f"output={folder / 'bench'}", cwd=folder,
    )  # fmt: skip
    for row in json.loads((folder / "bench" / "bench.json").read_text())["rows"]:
        name = f"hudepth-bench, {row['contender']}, batch {row['batch']} (the paper: {PAPER_RATES[row['batch']]})"
        report.add(name, row["images_per_s"], unit="images/s")


def measure_load(report: Report, device: torch.device, batch: int) -> None:
    precision = "float16" if device.type == "cuda" else "float32"
    backend: Any = hudepth.load("nyu", device=device.type, precision=precision).backend
    rgb = np.random.default_rng(0).integers(256, size=(batch, *backend.info.size, 3), dtype=np.uint8)
    got = report.add(f"hudepth.load, batch {batch}, {precision}", rate(lambda: backend(rgb), batch), unit="images/s")
    if device.type == "cuda":
        pixels = torch.from_numpy(rgb).to(device)
        with torch.inference_mode():
            bare = rate(recorded(lambda: backend.pipeline(pixels)), batch)
        report.add(f"bare CUDA graph of the same network, batch {batch}", bare, unit="images/s")
        report.add(f"hudepth.load over the bare graph, batch {batch}", got / bare, ">= 0.9")


def measure_host(report: Report) -> None:
    """Measure what the host pays for a step, which needs no GPU."""

    def measure(experiment: str, bar: str) -> None:
        extra = step_overhead.measure(experiment, steps=100, pairs=3)
        report.add(f"host time of a step of {experiment} beyond the bare step", extra, bar, "ms")

    for experiment, bar in (("badcl", "<= 1.5"), ("strong", "<= 4")):
        report.part(f"host time of {experiment}", partial(measure, experiment, bar))


NEEDS_GPU = (
    "the bare CUDA graphs", "the paper's training", "share of the bf16 peak", "hudepth.load over the bare graph",
    "hudepth-bench in float16 and bfloat16",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("gpu"), help="folder for gpu.json and gpu.md")
    parser.add_argument("--seconds", type=float, default=240, help="start no further part after so long")
    parser.add_argument("--size", type=int, help="side of the images [pixels]; default: 224, on a CPU 64")
    parser.add_argument("--scenes", type=int, help="rooms of eight images to train on; default: 400, on a CPU 8")
    options = parser.parse_args()
    cuda = torch.cuda.is_available()
    device = torch.device("cuda" if cuda else "cpu")
    size, scenes = options.size or (224 if cuda else 64), options.scenes or (400 if cuda else 8)
    report = Report(time.monotonic() + options.seconds, cuda)
    options.output.mkdir(parents=True, exist_ok=True)
    machine = hardware() | ({"gpu": torch.cuda.get_device_name()} if cuda else {})
    print(
        f"{machine.get('gpu', 'no GPU')}, {machine['processor']}, torch {torch.__version__}, {size} x {size}",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as folder:
        Training(report, Path(folder), device, size=size, scenes=scenes).measure()
        measure_inference(report, Path(folder), device)
    measure_host(report)
    if not cuda:
        report.missing += [f"{what}: needs a GPU" for what in NEEDS_GPU]
    table = Table(("what", "measured", "unit", "bar"), left=1)
    for row in report.rows:
        table.add(row.what, f"{row.value:.4g}", row.unit, row.bar)
    table.show()
    for line in report.missing:
        print(f"missing: {line}")
    content = {"machine": machine, "size": size, "scenes": scenes, "rows": [asdict(row) for row in report.rows]}
    (options.output / "gpu.json").write_text(json.dumps({**content, "missing": report.missing}, indent=1) + "\n")
    (options.output / "gpu.md").write_text(
        table.to_markdown() + "\n" + "".join(f"- missing: {x}\n" for x in report.missing)
    )


if __name__ == "__main__":
    main()
