"""Gather what changes of a training were worth, from the studies that measured them, into the table of README.md.

python -m experiments.what_paid.table
"""

from __future__ import annotations

import json
from pathlib import Path

from hudepth.base.files import write_between

HERE = Path(__file__).parent
STUDIES = HERE.parent
PAGES = (
    # study, marker of its table, row, what was changed, where it was measured
    ("rooms_curve", "results", "wide_8k", "8,192 rooms before real images, `lite`", "validation"),
    ("rooms_curve", "results", "wide_32k", "32,768 rooms", "validation"),
    ("rooms_curve", "results", "homes_32k", "32,768 rooms with clutter and a worse camera", "validation"),
    ("lite_options", "short", "heads", "heads for normals and edges, `lite`, a short training", "validation"),
    ("lite_options", "short", "image_scale", "a loss of the scale of images, the same", "validation"),
    ("lite_options", "short", "scale_head", "a scale head, the same", "validation"),
    ("lite_options", "short", "wider_view", "zooming from 0.8 instead of 1, the same", "validation"),
    ("lite_options", "short", "no_zoom", "no zooming, the same", "validation"),
    ("lite_options", "short", "fields_of_view", "rooms seen by cameras of 45 to 75 degrees, the same", "validation"),
    ("lite_options", "short", "base_seed2", "only another seed, the same", "validation"),
    ("lite_options", "late", "image_scale", "a loss of the scale of images in a late cycle, `lite`", "validation"),
    ("edge_loss", "results", "edges", "a loss of depth edges in a late cycle, the paper's network", "validation"),
    ("lite_official", "validation", "third", "a narrower decoder and a third cycle, `lite`", "validation"),
)
COMPARED = (
    ("lite_official/compare", "that, and 90 more images in a fourth cycle, `lite`", "test"),
    ("strong_official/compare", "a fourth cycle, with a loss of depth edges, the paper's network", "test"),
    ("lite_official/compare_edges", "a fifth cycle, with a loss of depth edges, `lite`", "test"),
    ("equal_budget/compare", "`experiment=strong` instead of the paper's recipe, on as many images", "test"),
)
METRICS = ("abs_rel", "delta1", "edge_f1_0.25")


def cells(study: str, marker: str, row: str) -> list[str]:
    """Return the changes of METRICS from a row of a study's table; empty where it has none."""
    table = (STUDIES / study / "README.md").read_text(encoding="utf-8").split(f"<!-- {marker} -->\n")[1]
    head, *rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if "|" in line]
    (line,) = [line for line in rows if line[0] == row]
    changes = dict(zip(head, line, strict=True))
    return [changes.get(f"change of {name}", "") for name in METRICS]


def differences(folder: str) -> list[str]:
    """Return the changes of METRICS between two runs that hudepth-report compared."""
    document = json.loads((STUDIES / folder / "compare.json").read_text(encoding="utf-8"))
    rows = [document["metrics"][name] for name in METRICS]
    return [f"{row['difference']:+.3f} ({row['low']:+.3f} to {row['high']:+.3f})" for row in rows]


def table() -> str:
    """Return the table in Markdown."""
    lines = ["| change | on | abs_rel | delta1 | edges, F1 at 0.25 |", "|---|---|---|---|---|"]
    for study, marker, row, change, where in PAGES:
        lines.append(f"| {change} | [{where}](../{study}) | {' | '.join(cells(study, marker, row))} |")
    for folder, change, where in COMPARED:
        lines.append(f"| {change} | [{where}](../{folder.split('/')[0]}) | {' | '.join(differences(folder))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    write_between(HERE / "README.md", "table", table())
