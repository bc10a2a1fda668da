"""What does a sweep cost in addition to its jobs, and what does running two at a time gain?

Runs the same eight small trainings on rooms twice in turns, each time with fresh folders: one after the other in one
process (the basic launcher), and side by side (joblib, as many processes as there are cores).

Cost of a job: from the start of the first job to the end of the last, less the time in which a job was at work (from
the first line of its train.log to its last status). Then a report is made of them, without and with pictures of
predictions, for which torch is imported and networks are loaded: that costs the same for few jobs as for many.

    python experiments/speed/sweep_cost.py [--pairs 2] [--epochs 60]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path

JOBS = 8


def command(epochs: int) -> list[str]:
    return [
        "hudepth-train", "-m", "model=tiny", "data.size=[32,48]", "data.source.scenes=12",
        "data.source.frames_per_scene=4", "data.source.size=[48,64]", "data.batch_size=4", "callbacks.panels=0",
        "logger=none", "baselines=false", "protocol=paper", "trainer.accelerator=cpu", f"trainer.max_epochs={epochs}",
        "loss=l1,l2", "seed=1,2,3,4",
    ]  # fmt: skip


def timed(words: list[str], cwd: Path) -> float:
    words = [str(Path(sys.executable).parent / words[0]), *words[1:]]
    environment = {**os.environ, "HUDEPTH_CACHE": str(cwd / "cache")}
    start = time.perf_counter()
    subprocess.run(words, cwd=cwd, env=environment, check=True, capture_output=True)
    return time.perf_counter() - start


def spans(folder: Path) -> list[tuple[float, float]]:
    """When each job began and ended [s]."""
    found = []
    for status in folder.glob("*/status.json"):
        first = (status.parent / "train.log").read_text().splitlines()[0]
        stamp = re.match(r"\S+ \S+", first)
        assert stamp
        began = datetime.strptime(stamp[0], "%Y-%m-%d %H:%M:%S,%f").timestamp()
        assert json.loads(status.read_text())["state"] == "finished"
        found.append((began, status.stat().st_mtime))
    return sorted(found)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--pairs", type=int, default=2)
    parser.add_argument("--epochs", type=int, default=60)
    options = parser.parse_args()
    ratios, costs, reports = [], [], []
    with tempfile.TemporaryDirectory() as temporary:
        cwd = Path(temporary)
        timed([*command(1), "sweep_dir=warm"], cwd)  # renders the rooms, fills the page cache
        for pair in range(options.pairs):
            one = timed([*command(options.epochs), f"sweep_dir=one{pair}"], cwd)
            two = timed([*command(options.epochs), f"sweep_dir=two{pair}", "hydra/launcher=joblib"], cwd)
            at_work = spans(cwd / f"one{pair}")
            between = (at_work[-1][1] - at_work[0][0] - sum(end - start for start, end in at_work)) / (JOBS - 1)
            words = ["hudepth-report", "sweep", f"dir=one{pair}", "protocol=paper"]
            report, pictures = timed([*words, "panels=0"], cwd), timed(words, cwd)
            ratios.append(one / two)
            costs.append(between)
            reports.append(report)
            print(
                f"pair {pair + 1}: one after the other {one:.1f} s, side by side {two:.1f} s, ratio {one / two:.2f}; "
                f"between two jobs {between:.2f} s; report {report:.1f} s, with predictions drawn {pictures:.1f} s",
                flush=True,
            )
    print(f"{JOBS} jobs of {options.epochs} epochs on {len(os.sched_getaffinity(0))} cores")
    print(f"side by side: {statistics.median(ratios):.2f} times as fast")
    print(f"launching: {statistics.median(costs):.2f} s a job")
    print(f"collecting, without drawing predictions again: {statistics.median(reports) / JOBS:.2f} s per job")


if __name__ == "__main__":
    main()
