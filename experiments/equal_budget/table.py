"""Compare the two runs of this folder image by image, and write the table of README.md.

    python -m experiments.equal_budget.table [<run of the paper's recipe> <run of experiment/strong> [<text to cut>]]

Given two runs, it copies their results here first.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from experiments.studies import copy_run, hide, shrink
from hudepth.base.files import write_between

HERE = Path(__file__).parent
RUNS = ("badcl", "strong")
SHOWN = ("abs_rel", "rmse", "log10", "delta1", "delta2", "edge_f1_0.25", "edge_f1_0.5")


def table(document: dict[str, Any]) -> str:
    """Return both results, their difference with its interval by scene, and the difference as a share."""
    lines = ["| | badcl | strong | difference, 95 % interval by scene | share |", "|---|---|---|---|---|"]
    for name in SHOWN:
        row = document["metrics"][name]
        interval = f"{row['difference']:+.3f} [{row['low']:+.3f}, {row['high']:+.3f}]"
        share = f"{100 * row['difference'] / row['a']:+.1f} %"
        lines.append(f"| {name} | {row['a']:.3f} | {row['b']:.3f} | {interval} | {share} |")
    return "\n".join(lines)


def main(*words: str) -> None:
    for name, run in zip(RUNS, words[:2], strict=False):
        copy_run(Path(run), HERE / name, tables=["eigen"])
    command = ["hudepth-report", "compare", *(f"{key}={HERE / run}" for key, run in zip("ab", RUNS, strict=True))]
    subprocess.run(
        [str(Path(sys.executable).parent / command[0]), *command[1:], f"output={HERE / 'compare'}"], check=True
    )
    shrink(HERE)
    hide(HERE, [f"{HERE}/", *words[2:]])
    document = json.loads((HERE / "compare" / "compare.json").read_text(encoding="utf-8"))
    write_between(HERE / "README.md", "table", table(document))


if __name__ == "__main__":
    main(*sys.argv[1:])
