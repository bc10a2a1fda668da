"""When does each run first reach the best validation abs_rel of the paper's recipe? From the runs' own histories.

    python -m experiments.time_to_accuracy.table [<run of badcl> <run of strong> [<text to cut>]]

Given two runs, it copies their histories here first.
"""

from __future__ import annotations

import sys
from pathlib import Path

from experiments.studies import copy_run, hide
from hudepth.base.files import write_between
from hudepth.runs.history import read_history
from hudepth.training.times import read_times

HERE = Path(__file__).parent
RUNS = ("badcl", "strong")
METRIC = "val/abs_rel"


def reached(run: Path, target: float) -> tuple[int, float, float] | None:
    """Return the first epoch at the final size with a metric of at most ``target``: number, metric, CPU time [s]."""
    times = {int(row["epoch"]): row for row in read_times(run / "times.csv")}
    final = times[max(times)]["height"]
    for row in read_history(run / "metrics.csv"):
        time = times[int(row["epoch"])]
        if time["height"] == final and row[METRIC] <= target:
            return int(row["epoch"]), row[METRIC], float(time["cpu_s"])
    return None


def table() -> str:
    """Return the comparison as Markdown."""
    target = min(row[METRIC] for row in read_history(HERE / RUNS[0] / "metrics.csv"))
    lines = ["| run | epoch | validation abs_rel | CPU time | share |", "|---|---|---|---|---|"]
    whole = 0.0
    for name in RUNS:
        found = reached(HERE / name, target)
        if found is None:
            lines.append(f"| {name} | never | | | |")
            continue
        epoch, value, cpu = found
        whole = whole or cpu
        lines.append(f"| {name} | {epoch} | {value:.4f} | {cpu / 60:.1f} min | {cpu / whole:.2f} |")
    return "\n".join(lines)


def main(*words: str) -> None:
    for name, run in zip(RUNS, words[:2], strict=False):
        copy_run(Path(run), HERE / name)
    hide(HERE, list(words[2:]))
    write_between(HERE / "README.md", "table", table())


if __name__ == "__main__":
    main(*sys.argv[1:])
