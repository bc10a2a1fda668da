"""What is left of the speed of prediction when other programs keep every core busy?

Predicts with the bundled model in processes of their own, in turns on the idle machine and beside one busy loop for
each core, for several ways of waiting: OpenMP's threads spin while they wait for each other unless told otherwise.
Prints images per second and the share that is left. Half of each core is what a fair share would leave. The commands
of hudepth set GOMP_SPINCOUNT=10000.

    python experiments/speed/busy_machine.py [--seconds 8] [--rounds 3]
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

VARIANTS: dict[str, tuple[dict[str, str], list[str]]] = {
    "by default": ({}, []),
    "GOMP_SPINCOUNT=10000": ({"GOMP_SPINCOUNT": "10000"}, []),
    "GOMP_SPINCOUNT=1000": ({"GOMP_SPINCOUNT": "1000"}, []),
    "OMP_WAIT_POLICY=passive": ({"OMP_WAIT_POLICY": "passive"}, []),
    "one thread": ({}, ["1"]),
}
CHILD = """
import sys, time
import numpy as np
import hudepth
model = hudepth.load("nyu", **({"threads": int(sys.argv[2])} if len(sys.argv) > 2 else {}))
image = np.random.default_rng(0).integers(0, 256, (224, 224, 3), np.uint8)
for _ in range(3):
    model.predict(image)
start, count = time.perf_counter(), 0
while time.perf_counter() - start < float(sys.argv[1]):
    model.predict(image)
    count += 1
print(count / (time.perf_counter() - start))
"""


@contextmanager
def busy(loops: int) -> Iterator[None]:
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(loops)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def rate(variant: str, seconds: float) -> float:
    environment, arguments = VARIANTS[variant]
    command = [sys.executable, "-c", CHILD, str(seconds), *arguments]
    done = subprocess.run(command, env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8, help="length of a measurement")
    parser.add_argument("--rounds", type=int, default=3, help="how often to repeat the comparison")
    options = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    rates: dict[tuple[str, bool], list[float]] = {}
    for _ in range(options.rounds):
        for variant in VARIANTS:
            rates.setdefault((variant, False), []).append(rate(variant, options.seconds))
            with busy(cores):
                rates.setdefault((variant, True), []).append(rate(variant, options.seconds))
    print("| waiting | alone [images/s] | busy [images/s] | busy over alone by default |\n|---|---|---|---|")
    alone = statistics.median(rates["by default", False])
    for variant in VARIANTS:
        free, loaded = (statistics.median(rates[variant, kind]) for kind in (False, True))
        print(f"| {variant} | {free:.1f} | {loaded:.1f} | {loaded / alone:.2f} |")
    print(f"{cores} cores and as many busy loops, {options.rounds} rounds of {options.seconds:g} s")


if __name__ == "__main__":
    main()
