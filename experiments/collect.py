"""Bring a finished run into a study's folder: what it says, not its weights.

Copies configuration, environment, split, history and test results, draws the curves (figure 5 of the paper) from the
history, and writes the table of results between the markers of the Markdown files named.

    python experiments/collect.py runs/badcl/2025-08-11_12-00-00 experiments/badcl_official README.md
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

from hudepth.files import write_between
from hudepth.viz.curves import read_history, save_curves

KEPT = ("config.yaml", "overrides.txt", "environment.json", "split.json", "status.json", "metrics.csv")
SHOWN = ("abs_rel", "rmse", "log10", "delta1", "delta2", "delta3")


def table(metrics: dict[str, dict[str, float]]) -> str:
    """Return the predictors' metrics as a Markdown table."""
    lines = [f"| | {' | '.join(SHOWN)} |", f"|---|{'---|' * len(SHOWN)}"]
    rows = metrics.items()
    lines += [f"| {who.replace('_', ' ')} | {' | '.join(f'{row[k]:.3f}' for k in SHOWN)} |" for who, row in rows]
    return "\n".join(lines)


def main(run: Path, study: Path, *documents: Path) -> None:
    """Copy, draw and write."""
    study.mkdir(parents=True, exist_ok=True)
    for name in KEPT:
        shutil.copy(run / name, study / name)
    for folder in (run / "test").iterdir():
        target = study / "test" / folder.name
        target.mkdir(parents=True, exist_ok=True)
        for name in ("metrics.json", "per_image.csv"):
            shutil.copy(folder / name, target / name)
    shutil.copy(run / "test" / "eigen" / "panels.png", study / "panels.png")
    history = read_history(run / "metrics.csv")
    save_curves(study / "curves.png", history, title=f"{run.parent.name}: total loss and raw terms, unit depth")

    metrics = json.loads((study / "test" / "eigen" / "metrics.json").read_text())["metrics"]
    for document in (study / "README.md", *documents):
        write_between(document, "results", table(metrics))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
