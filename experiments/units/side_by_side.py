"""The same recipe on the same 8-bit depth, read correctly and as millimetres, next to the paper's figures.

    python experiments/units/side_by_side.py <run, uint8_10m> <run, paper_literal>

writes the table between the markers of README.md in this folder. The loss is that of the last epoch; the metrics are
those of the best checkpoint on its own test images, at network resolution, in metres as read.
"""

from __future__ import annotations

import sys
from pathlib import Path

from experiments.ledger import tables
from hudepth.base.files import write_between
from hudepth.runs.history import read_history
from hudepth.runs.results import Result, find_result

METRICS = ("ssim", "abs_rel", "rmse", "log10", "delta1", "delta2", "delta3")


def row(name: str, run: Path) -> tuple[str, list[float], Result]:
    """Return what a run reached, and its test result."""
    last = read_history(run / "metrics.csv")[-1]
    result = find_result(run, "paper")
    return name, [last["train/loss/total"], last["val/loss/total"], *(result.metrics[m] for m in METRICS)], result


def main(right: Path, literal: Path) -> None:
    """Write the table."""
    rows = [row("value / 255 * 10 m", right), row("value / 1000 m, as the paper's text", literal)]
    first, second = (result for *_, result in rows)
    if first.split["sha256"] != second.split["sha256"] or first.stamp != second.stamp:
        raise SystemExit("the two runs differ in split or protocol")
    lines = [f"| depth read as | loss, training | loss, validation | {' | '.join(METRICS)} |", f"|{'---|' * 10}"]
    for name, values, result in rows:
        lines.append(
            f"| {name} | {' | '.join([f'{values[0]:.4f}', f'{values[1]:.4f}', *(f'{v:.3f}' for v in values[2:])])} |"
        )
        mean = result.document["metrics"]["mean_depth"]
        lines.append(f"| the same, mean depth for every pixel | | | {' | '.join(f'{mean[m]:.3f}' for m in METRICS)} |")
    paper = tables.PROPOSED
    said = [tables.SSIM, paper.abs_rel, paper.rmse, paper.log10, *paper.deltas]
    lines.append(f"| the paper | {tables.LOSS_TRAIN} | {tables.LOSS_VAL} | {' | '.join(f'{v:.3f}' for v in said)} |")
    write_between(Path(__file__).parent / "README.md", "results", "\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
