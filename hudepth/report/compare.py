"""hudepth-report compare: is one run better than another, and on which images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from hudepth.base.console import log
from hudepth.base.errors import DataError, HudepthError, did_you_mean
from hudepth.base.files import output_folder, write_json, write_text
from hudepth.base.options import Range
from hudepth.base.tables import Cell, Table, say
from hudepth.metrics.bootstrap import LEVEL, REPEATS, SEED, Difference, describe, paired_differences
from hudepth.metrics.catalogue import metric_info
from hudepth.metrics.summary import ImageTable
from hudepth.report.scatter import draw_comparison
from hudepth.runs.comparison import paired
from hudepth.runs.results import Result, find_result
from hudepth.runs.run import CHECKPOINTS
from hudepth.viz.panels import save_figure, save_panels

PER_IMAGE = ("abs_rel", "rmse")  # metrics of compare.csv, which is sorted by the first
SHOWN = 12  # images in the right half of compare.png
WORDS = {"a better": "a", "b better": "b", "no difference shown": "-"}  # of verdicts on a terminal
Place = Annotated[Path, "run directory | folder of test results"]


@dataclass(frozen=True)
class CompareOptions:
    """Options of ``hudepth-report compare``; conf/report.yaml explains them."""

    a: Place
    b: Place
    protocol: str = "eigen"
    output: Path | None = None
    repeats: Annotated[int, Range(100)] = REPEATS
    seed: Annotated[int, Range(0)] = SEED
    panels: Annotated[int, Range(0)] = 0
    paths: Mapping[str, Any] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)
    trust: list[str] = field(default_factory=list)


def compare(options: CompareOptions) -> None:
    """Compare two results on the same images; print the table, write compare.json, compare.csv and compare.png.

    images.png needs checkpoints and data. Raises HudepthError if the results are missing or cannot be paired.
    """
    a, b = (find_result(path, options.protocol) for path in (options.a, options.b))
    tables = paired(a, b)
    differences = paired_differences(*tables, **a.averaging, repeats=options.repeats, seed=options.seed)
    differences = {name: each for name, each in differences.items() if name in a.metrics and name in b.metrics}
    uncertainty = describe(tables[0], repeats=options.repeats, seed=options.seed)
    output = output_folder(options.output or "compare")
    write_json(output / "compare.json", _document(a, b, differences, uncertainty))
    write_text(output / "compare.csv", _per_image(*tables).to_csv())
    ids, values = tables[0].ids, [table.values[PER_IMAGE[0]] for table in tables]
    paths = [each.path.resolve() for each in (a, b)]
    # the run or study of a result is two folders above test/<protocol>
    parts = [path.parents[1].parts if path.parent.name == "test" else path.parts for path in paths]
    title = "\n".join(f"{side}: {Path(*each[-2:])}" for side, each in zip("ab", parts, strict=True))
    most = differing(a, b, SHOWN)
    save_figure(output / "compare.png", draw_comparison(ids, *values, shown=most, metric=PER_IMAGE[0], title=title))
    print_comparison(a, b, differences, uncertainty)
    _draw_images(output / "images.png", a, b, options)
    log.info("table and pictures: %s", output.resolve())


def _draw_images(path: Path, a: Result, b: Result, options: CompareOptions) -> None:
    """Draw the predictions of the images that differ most, if checkpoints and data are at hand."""
    runs = {name: result.path.parent.parent for name, result in (("a", a), ("b", b))}
    if not options.panels or not all((run / CHECKPOINTS).is_dir() for run in runs.values()):
        return
    if not (tested_on_training_data(a) and tested_on_training_data(b)):
        log.warning("no images.png: a run was tested on other data than its own, and only its own can be opened")
        return
    from hudepth.evaluation.pictures import panels_beside  # imports torch and lightning

    try:
        save_panels(path, panels_beside(runs, differing(a, b, options.panels), config=vars(options)))
    except HudepthError as error:
        log.warning("no images.png: %s", error)


def tested_on_training_data(result: Result) -> bool:
    """Tell whether a network was tested on the data set it was trained on, which is the one its run can open."""
    found = result.document.get("checkpoint")
    for key in ("trained_on", "fingerprint"):
        found = found.get(key) if isinstance(found, dict) else None
    return bool(found == result.data["fingerprint"])


def verdict(name: str, difference: Difference) -> str:
    """Return what an interval of b - a shows: ``a better``, ``b better``, ``no difference shown`` or ``undefined``."""
    if math.isnan(difference.low) or math.isnan(difference.high):
        return "undefined"
    if difference.low <= 0 <= difference.high:
        return "no difference shown"
    return "b better" if (difference.low > 0) == metric_info(name).higher_is_better else "a better"


def differing(a: Result, b: Result, count: int, *, metric: str = "abs_rel") -> list[str]:
    """Return the ids of the images whose metric differs most; DataError if there is none or they cannot be paired."""
    tables = paired(a, b)
    return [tables[0].ids[row] for row in _by_difference(*tables, metric=metric)[:count]]


def _by_difference(a: ImageTable, b: ImageTable, *, metric: str) -> list[int]:
    """Return the rows of two tables, largest difference first; NaN in one of them is the largest."""
    for table in (a, b):
        if metric not in table.values:
            raise DataError(f"no image has a metric '{metric}'.{did_you_mean(metric, table.values)}")
    x, y = a.values[metric], b.values[metric]
    with np.errstate(invalid="ignore"):
        size = np.abs(y - x)
    size[np.isnan(size)] = -1  # NaN in both, or infinity in both
    size[np.isfinite(x) != np.isfinite(y)] = np.inf
    return [int(row) for row in np.argsort(-size, kind="stable")]


def _document(a: Result, b: Result, differences: dict[str, Difference], uncertainty: dict[str, Any]) -> dict[str, Any]:
    metrics = {}
    for name, found in differences.items():
        values = (a.metrics[name], b.metrics[name], found.value, found.low, found.high)
        finite = (value if math.isfinite(value) else None for value in values)
        numbers = dict(zip(("a", "b", "difference", "low", "high"), finite, strict=True))
        metrics[name] = {**numbers, "verdict": verdict(name, found)}
    sides = {
        side: {"path": str(each.path), "split": each.split, "checkpoint": each.document.get("checkpoint")}
        for side, each in (("a", a), ("b", b))
    }
    return sides | {
        "images": len(a.table.ids),
        "protocol": a.stamp,
        "data": a.data,
        "uncertainty": uncertainty,
        "metrics": metrics,
    }


def _per_image(a: ImageTable, b: ImageTable) -> Table:
    names = [name for name in PER_IMAGE if name in a.values and name in b.values]
    columns = [f"{name}_{side}" for name in names for side in ("a", "b", "difference")]
    values = [x for name in names for x in (a.values[name], b.values[name], b.values[name] - a.values[name])]
    table = Table(["id", "scene", "category", "pixels", *columns])
    for row in _by_difference(a, b, metric=PER_IMAGE[0]):
        keys = (a.ids[row], a.scenes[row], a.categories[row], str(a.pixels[row]))
        table.add(*keys, *(f"{column[row]:.9g}" for column in values))
    return table


def print_comparison(a: Result, b: Result, differences: dict[str, Difference], uncertainty: dict[str, Any]) -> None:
    """Print one row per metric: both results, their difference with its interval, and the verdict."""
    kinds = " and ".join(dict.fromkeys(f"{result.split['kind']}" for result in (a, b)))
    count = uncertainty["scenes"]
    scenes = f"of {count} scene{'s' * (count != 1)}" if any(a.table.scenes) else "without scenes"
    images = f"{len(a.table.ids)} test images {scenes} of {a.data['source']}"
    say(f"a: {a.path}\nb: {b.path}\n{a.protocol_name} protocol, {images}, {kinds} split\n")
    level = f"{100 * LEVEL:.0f} %"
    table = Table(
        ["metric", "a", "b", "b - a", f"{level} interval", "better"],
        caption=f"{level} intervals, each metric by itself: {uncertainty['method']}, {uncertainty['repeats']} draws. "
        "They cover the choice of test scenes, not the seed of the training. ↑ higher is better, ↓ lower; "
        "-: no difference shown.",
    )
    for name, found in differences.items():
        before, after, info = a.metrics[name], b.metrics[name], metric_info(name)
        places = 4 if not max(abs(before), abs(after)) >= 10 else 2
        word = WORDS.get(verdict(name, found), "undefined")
        table.add(
            f"{info.label} {info.arrow}",
            *(f"{value:.{places}f}" for value in (before, after)),
            f"{found.value:+.{places}f}",
            f"{found.low:+.{places}f} to {found.high:+.{places}f}",
            Cell(word, bold=word in ("a", "b")),
        )
    table.show()
