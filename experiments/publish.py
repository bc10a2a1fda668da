"""Bring a sweep into a study's folder: reports, configuration, and the tables of its README.md.

    python -m experiments.publish <sweep_dir> <study> [--reports a,b] [--runs c,d] [--hide <text>]

Each report becomes a folder of the study, and the table between its markers in the page. One run is kept of each
variant among --runs. Texts named by --hide, paths for example, are cut from all files.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from experiments.studies import copy_run, hide, shrink
from hudepth.base.files import write_between

SHOWN = ("abs_rel", "rmse", "ssim", "delta1", "edge_f1_0.25")
PLACES = {"abs_rel": 4, "rmse": 3, "ssim": 4, "delta1": 3, "edge_f1_0.25": 3}
MARKS = {"better": " ▲", "worse": " ▼"}
REPORT = "document.json"


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sweep", type=Path, help="folder of the sweep")
    parser.add_argument("study", type=Path, help="folder under experiments/")
    parser.add_argument("--reports", help="sweeps in one folder, a report each; else one of all")
    parser.add_argument("--runs", help="variants of which one run is kept")
    parser.add_argument("--hide", action="append", default=[], help="text to cut from the files")
    options = parser.parse_args()
    sweep = options.sweep.resolve()
    reports = options.reports.split(",") if options.reports else ["report"]
    for name in reports:
        words = ["hudepth-report", "sweep", f"dir={sweep}", f"output={options.study / name}", "panels=2"]
        words += [f"name={name}"] if options.reports else []
        subprocess.run([str(Path(sys.executable).parent / words[0]), *words[1:]], check=True)
    shutil.copy(sweep / "sweep.yaml", options.study / "sweep.yaml")
    for name in options.runs.split(",") if options.runs else []:
        run = next(run for run in sorted(sweep.glob(f"{name}_s*1*")) if (run / "test").is_dir())
        copy_run(run, options.study / f"{name}_seed_1")
    shrink(options.study)
    hide(options.study, [f"{sweep}/", str(sweep), *options.hide])
    for name in reports:
        document = json.loads((options.study / name / REPORT).read_text(encoding="utf-8"))
        write_between(options.study / "README.md", name, table(document))


if __name__ == "__main__":
    main()
