"""What makes a training step of the hybrid UNet faster, and where does its time go?

Trains steps on a batch in memory (BADCL, AdamW), each variant in turns with the first: the plain network in float32,
channels-last, merged arithmetic, bfloat16, kept memory, a frozen stem, smaller images, recomputed activations. Prints
milliseconds and, for each variant, the median of the paired ratios of images per second. Each runs in a process of its
own, since kept memory cannot be given back. With --profile: the operations that take the most time, before and after.

    python experiments/speed/train_step.py [--batch 8] [--rounds 5] [--steps 3] [--profile]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from typing import Any

REFERENCE = "plain float32"
VARIANTS: dict[str, dict[str, Any]] = {
    REFERENCE: {},
    "channels-last": {"channels_last": True},
    "merged": {"arithmetic": "merged"},
    "kept memory": {"keep": True},
    "merged, kept memory": {"arithmetic": "merged", "keep": True},
    "bfloat16": {"bf16": True},
    "bfloat16, channels-last": {"bf16": True, "channels_last": True},
    "bfloat16, channels-last, merged": {"bf16": True, "channels_last": True, "arithmetic": "merged"},
    "bfloat16, channels-last, merged, kept memory": {
        "bf16": True, "channels_last": True, "arithmetic": "merged", "keep": True,
    },
    "the same, fused AdamW": {
        "bf16": True, "channels_last": True, "arithmetic": "merged", "keep": True, "fused": True,
    },
    "the same, stem and layer1 frozen": {
        "bf16": True, "channels_last": True, "arithmetic": "merged", "keep": True, "freeze": True,
    },
    "the same, encoder frozen": {
        "bf16": True, "channels_last": True, "arithmetic": "merged", "keep": True, "freeze": "all",
    },
    "the same at 160 x 160": {
        "bf16": True, "channels_last": True, "arithmetic": "merged", "keep": True, "size": 160,
    },
    "the same at 112 x 112": {
        "bf16": True, "channels_last": True, "arithmetic": "merged", "keep": True, "size": 112,
    },
    "the same, activations recomputed": {
        "bf16": True, "channels_last": True, "arithmetic": "merged", "keep": True, "recompute": True,
    },
}  # fmt: skip


def serve(batch: int) -> None:
    """Serve one variant: read options, then run as many steps as each line asks for, and print their seconds."""
    import torch

    from hudepth.base.machine import keep_freed_memory
    from hudepth.losses import BADCL
    from hudepth.models import HybridUNet

    options = json.loads(sys.stdin.readline())
    if options.get("keep"):
        keep_freed_memory()
    torch.manual_seed(0)
    net = HybridUNet(arithmetic=options.get("arithmetic", "plain"), recompute=bool(options.get("recompute")))
    if options.get("channels_last"):
        net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if options.get("freeze"):
        net.encoder.freeze(4 if options["freeze"] == "all" else 2)
    size = options.get("size", 224)
    image, truth = torch.randn(batch, 3, size, size), torch.rand(batch, 1, size, size)
    valid, loss = truth > 0, BADCL()
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-4, fused=options.get("fused"))

    def step() -> None:
        optimizer.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=bool(options.get("bf16"))):
            total = loss(net(image), truth, image, valid).total
        total.backward()
        optimizer.step()

    step()
    step()
    for line in sys.stdin:
        if line.startswith("profile"):
            with torch.profiler.profile() as profile:
                step()
            table = profile.key_averages().table(sort_by="self_cpu_time_total", row_limit=14, max_name_column_width=48)
            lines = [row[:96].rstrip() for row in table.splitlines() if not row.startswith("-")]
            print(json.dumps("\n".join(lines)), flush=True)
            continue
        start = time.perf_counter()
        for _ in range(int(line)):
            step()
        print(time.perf_counter() - start, flush=True)


class Worker:
    """A process that is one variant."""

    def __init__(self, name: str, batch: int) -> None:
        command = [sys.executable, __file__, "--serve", "--batch", str(batch)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.ask(json.dumps(VARIANTS[name]), answer=False)

    def ask(self, line: str, *, answer: bool = True) -> str:
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()
        return self.process.stdout.readline() if answer else ""

    def close(self) -> None:
        self.process.communicate()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=8, help="images in a step")
    parser.add_argument("--rounds", type=int, default=5, help="pairs of each variant with the reference")
    parser.add_argument("--steps", type=int, default=3, help="steps in a measurement")
    parser.add_argument("--profile", action="store_true", help="print where the time goes, before and after")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.batch)
        return
    reference = Worker(REFERENCE, options.batch)
    print("| step | ms | images/s over plain float32 |\n|---|---|---|")
    for name in VARIANTS:
        worker = Worker(name, options.batch) if name != REFERENCE else reference
        times, ratios = [], []
        for number in range(options.rounds):
            pair = [reference, worker] if number % 2 == 0 else [worker, reference]
            seconds = {id(each): float(each.ask(str(options.steps))) for each in dict.fromkeys(pair)}
            times.append(seconds[id(worker)] / options.steps)
            ratios.append(seconds[id(reference)] / seconds[id(worker)])
        print(f"| {name} | {1000 * statistics.median(times):.0f} | {statistics.median(ratios):.2f} |", flush=True)
        if options.profile and name in (REFERENCE, "bfloat16, channels-last, merged, kept memory"):
            print(f"\n{json.loads(worker.ask('profile'))}\n")
        if worker is not reference:
            worker.close()
    reference.close()


if __name__ == "__main__":
    main()
