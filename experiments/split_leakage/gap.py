"""How much does a random split of frames flatter? Compares two runs of one recipe, on a random and a disjoint split.

Two answers, each with 95 % intervals by scene. Over both test subsets as they are: what a paper would print. And over
the images that both runs were tested on: there, the first network was trained on other frames of the very scenes, and
the second never saw them, with everything else equal.

    python experiments/split_leakage/gap.py <run, random split> <run, disjoint split> <name of the table>

writes the table between the markers of README.md in this folder, and <name>.json with the figures.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from hudepth.base.files import write_between, write_json
from hudepth.metrics.bootstrap import describe, intervals, paired_differences, unpaired_differences
from hudepth.metrics.summary import summarise
from hudepth.runs.comparison import common_images
from hudepth.runs.results import Result, find_result

METRICS = ("abs_rel", "rmse", "delta1", "ssim")
HERE = Path(__file__).parent


def compare(random: Result, disjoint: Result) -> list[dict[str, object]]:
    """Return a row for all test images and one for those both runs were tested on."""
    options = random.averaging
    shared = common_images(random, disjoint)
    cases = (
        ("all test images", (random.table, disjoint.table), unpaired_differences),
        ("the same images", shared, paired_differences),
    )
    rows = []
    for what, (a, b), differences in cases:
        gaps = differences(a, b, **options)
        row: dict[str, object] = {
            "what": what,
            "images": [len(a.ids), len(b.ids)],
            "scenes": [describe(a)["scenes"], describe(b)["scenes"]],
        }
        for name in METRICS:
            row[name] = {
                "random": [summarise(a, **options)[name], *intervals(a, **options)[name]],
                "disjoint": [summarise(b, **options)[name], *intervals(b, **options)[name]],
                "gap": [gaps[name].value, gaps[name].low, gaps[name].high],
            }
        rows.append(row)
    return rows


def baseline(result: Result, name: str) -> str:
    """Return a trivial baseline's abs_rel."""
    return f"{result.document['metrics'][name]['abs_rel']:.3f}"


def table(rows: list[dict], random: Result, disjoint: Result) -> str:  # type: ignore[type-arg]
    """Return the rows as Markdown."""
    other = disjoint.split["kind"]
    lines = [f"| | images | scenes | metric | random | {other} | gap |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        for name in METRICS:
            random_, disjoint_, gap = (row[name][side] for side in ("random", "disjoint", "gap"))
            cells = [f"{x[0]:.3f} [{x[1]:.3f}, {x[2]:.3f}]" for x in (random_, disjoint_)]
            first = name == METRICS[0]
            counts = [" / ".join(map(str, row[key])) if len(set(row[key])) > 1 else str(row[key][0]) for key in
                      ("images", "scenes")]  # fmt: skip
            head = [row["what"], *counts] if first else ["", "", ""]
            lines.append(f"| {' | '.join([*head, name, *cells, f'{gap[0]:+.3f} [{gap[1]:+.3f}, {gap[2]:+.3f}]'])} |")
    nearest = [baseline(result, "nearest_frame") for result in (random, disjoint)]
    mean = [baseline(result, "mean_depth_map") for result in (random, disjoint)]
    lines.append(f"| nearest training frame copied | | | abs_rel | {nearest[0]} | {nearest[1]} | |")
    lines.append(f"| mean depth map | | | abs_rel | {mean[0]} | {mean[1]} | |")
    return "\n".join(lines)


def main(random_run: Path, disjoint_run: Path, name: str) -> None:
    """Compare, and write both files."""
    random, disjoint = (find_result(run, "eigen") for run in (random_run, disjoint_run))
    rows = compare(random, disjoint)
    write_json(HERE / f"{name}.json", {"rows": rows, "protocol": random.stamp, "data": random.data})
    write_between(HERE / "README.md", name, table(rows, random, disjoint))
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
