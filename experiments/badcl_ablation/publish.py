"""Turn the runs of the ablation into what its page shows: reports, configuration, and the tables of README.md.

python experiments/badcl_ablation/publish.py <sweep_dir> [<path to shorten> ...]
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from hudepth.files import write_between, write_text

HERE = Path(__file__).parent
SWEEPS = ("loss_terms", "badcl_reading", "attention")
EVIDENCE = ("paper", "l1")
"""Variants of which one run is kept."""
SHOWN = ("abs_rel", "rmse", "ssim", "delta1", "edge_f1_0.25")
PLACES = {"abs_rel": 4, "rmse": 3, "ssim": 4, "delta1": 3, "edge_f1_0.25": 3}
MARKS = {"better": " ▲", "worse": " ▼"}


def table(document: dict[str, Any]) -> str:
    """Return means with half the interval over seeds, and below the difference from the reference with its verdict."""
    lines = [f"| | seeds | {' | '.join(SHOWN)} |", f"|---|---|{'---|' * len(SHOWN)}"]
    for row in document["rows"]:
        cells = [row["label"].replace("_", " "), str(len(row["runs"]))]
        lines.append(f"| {' | '.join([*cells, *(cell(row, name) for name in SHOWN)])} |")
    return "\n".join(lines)


def cell(row: dict[str, Any], name: str) -> str:
    metric, places = row["metrics"][name], PLACES[name]
    text = f"{metric['mean']:.{places}f}"
    if metric["seeds"] and metric["seeds"][0] is not None:
        text += f" ±{(metric['seeds'][1] - metric['seeds'][0]) / 2:.{places}f}"
    difference = row.get("differences", {}).get(name)
    if difference:
        text += f"<br>{difference['value']:+.{places}f}{MARKS.get(difference['verdict'], '')}"
    return f"**{text}**" if metric["best"] else text


def copy_run(run: Path, target: Path) -> None:
    """Copy what a run says, not its weights and pictures: whole, for the ledger of the paper's claims."""
    for pattern in ("*.yaml", "*.json", "metrics.csv", "test/*/metrics.json", "test/*/per_image.csv"):
        for file in run.glob(pattern):
            (target / file.relative_to(run)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, target / file.relative_to(run))


def main(sweep: Path, *shortened: str) -> None:
    for name in SWEEPS:
        words = ["hudepth-report", "sweep", f"dir={sweep}", f"name={name}", f"output={HERE / name}", "panels=2"]
        subprocess.run([str(Path(sys.executable).parent / words[0]), *words[1:]], check=True)
    shutil.copy(sweep / "sweep.yaml", HERE / "sweep.yaml")
    for name in EVIDENCE:
        run = next(run for run in sorted(sweep.glob(f"{name}_s*1*")) if (run / "test").is_dir())
        copy_run(run, HERE / f"{name}_seed_1")
    for file in HERE.rglob("*"):
        if file.suffix in (".json", ".yaml", ".html", ".csv", ".md", ".tex"):
            text = file.read_text(encoding="utf-8")
            for path in (f"{sweep}/", str(sweep), *shortened):
                text = text.replace(path, "")
            write_text(file, text)
    for name in SWEEPS:
        document = json.loads((HERE / name / "document.json").read_text(encoding="utf-8"))
        write_between(HERE / "README.md", name, table(document))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), *sys.argv[2:])
