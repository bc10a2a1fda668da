"""Bring a finished run into a study's folder: its results, not its weights.

    python -m experiments.collect <run> <study> [--pages README.md ...] [--hide <text> ...]

Copies configuration, environment, split, history, times and test results, draws the curves (figure 5 of the paper) from
the history, and writes the table of results between the markers of the study's README.md and of --pages.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

from experiments.studies import copy_run, hide, shrink
from hudepth.base.files import write_between
from hudepth.report.curves import draw_curves
from hudepth.runs.history import read_history
from hudepth.viz.panels import save_figure

SHOWN = ("abs_rel", "rmse", "log10", "delta1", "delta2", "delta3")


def table(metrics: dict[str, dict[str, float]]) -> str:
    """Return the predictors' metrics as a Markdown table."""
    lines = [f"| | {' | '.join(SHOWN)} |", f"|---|{'---|' * len(SHOWN)}"]
    rows = metrics.items()
    lines += [f"| {who.replace('_', ' ')} | {' | '.join(f'{row[k]:.3f}' for k in SHOWN)} |" for who, row in rows]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run directory")
    parser.add_argument("study", type=Path, help="folder under experiments/")
    parser.add_argument("--pages", type=Path, nargs="*", default=[], help="further pages that show the table")
    parser.add_argument("--hide", action="append", default=[], help="text to cut from the files")
    options = parser.parse_args()
    run, study = options.run, options.study
    copy_run(run, study, tables=["eigen"])
    hide(study, options.hide)
    shutil.copy(run / "test" / "eigen" / "panels.png", study / "panels.png")
    history = read_history(run / "metrics.csv")
    title = f"{run.parent.name}: total loss and raw terms, unit depth"
    save_figure(study / "curves.png", draw_curves(history, title=title))
    shrink(study)
    metrics = json.loads((study / "test" / "eigen" / "metrics.json").read_text())["metrics"]
    for page in (study / "README.md", *options.pages):
        write_between(page, "results", table(metrics))


if __name__ == "__main__":
    main()
