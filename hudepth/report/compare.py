"""hudepth-report compare: is one run better than another, and on which images."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hudepth.base.console import log
from hudepth.base.errors import ConfigError, DataError, HudepthError, did_you_mean
from hudepth.base.files import write_json, write_text
from hudepth.base.options import whole_number
from hudepth.metrics.bootstrap import LEVEL, REPEATS, SEED, Difference, describe, paired_differences
from hudepth.metrics.summary import ImageTable, higher_is_better
from hudepth.report.scatter import save_comparison
from hudepth.runs.results import Result, find_result, paired
from hudepth.runs.run_dir import CHECKPOINTS
from hudepth.viz.panels import save_panels

UNITS = {"mae": "m", "rmse": "m", "sq_rel": "m", "mse": "m²"}
PER_IMAGE = ("abs_rel", "rmse")
"""Metrics of compare.csv; its rows are in the order of the first."""
SHOWN = 12
"""Images in the right half of the picture."""


def compare(config: dict[str, Any]) -> None:
    """Compare two results on the same images; print the table, write compare.json, compare.csv and compare.png;
    and images.png, where checkpoints and data are at hand.

    Args:
        config: ``a`` and ``b`` (run directories, or folders that hold test results), and perhaps ``protocol`` (its
            name), ``output`` (a folder), ``repeats`` and ``seed`` of the bootstrap; for images.png ``panels`` (how
            many images), ``paths``, ``data`` and ``trust``.

    Raises:
        HudepthError: with one line for the user.
    """
    for key in ("a", "b"):
        if not config.get(key):
            raise ConfigError(f"{key} is not set. Pass {key}=<run directory | folder of test results>.")
    protocol = str(config.get("protocol") or "eigen")
    repeats, seed = (
        whole_number(config, "repeats", default=REPEATS, least=100),
        whole_number(config, "seed", default=SEED),
    )
    a, b = (find_result(str(config[key]), protocol) for key in ("a", "b"))
    tables = paired(a, b)
    differences = paired_differences(*tables, **a.averaging, repeats=repeats, seed=seed)
    differences = {name: each for name, each in differences.items() if name in a.metrics and name in b.metrics}
    uncertainty = describe(tables[0], repeats=repeats, seed=seed)
    output = Path(config.get("output") or "compare").expanduser()
    try:
        write_json(output / "compare.json", _document(a, b, differences, uncertainty))
        write_text(output / "compare.csv", _per_image(*tables))
        _draw(output / "compare.png", a, b, tables)
    except OSError as error:
        raise ConfigError(f"output: cannot write '{output}' ({error.strerror}). Pass output=<a folder>.") from error
    print_comparison(a, b, differences, uncertainty)
    _draw_images(output / "images.png", a, b, config)
    log.info("table and pictures: %s", output.resolve())


def _draw_images(path: Path, a: Result, b: Result, config: dict[str, Any]) -> None:
    """Draw what both networks see in the images that differ most, if checkpoints and data are at hand."""
    runs = {name: result.path.parent.parent for name, result in (("a", a), ("b", b))}
    if not whole_number(config, "panels", default=0) or not all((run / CHECKPOINTS).is_dir() for run in runs.values()):
        return
    if not all(of_training_data(result) for result in (a, b)):
        log.warning(
            "no images.png: tested on other data than that of the training, which is what runs know how to open"
        )
        return
    from hudepth.evaluation.pictures import panels_beside  # torch and lightning, which only this picture needs

    try:
        panels = panels_beside(runs, differing(a, b, config["panels"]), config=config)
    except HudepthError as error:
        log.warning("no images.png: %s", error)
        return
    save_panels(path, panels)


def of_training_data(result: Result) -> bool:
    """Tell whether a network was tested on the data it was trained on, which is what its run knows how to open."""
    trained_on = result.document.get("checkpoint")
    for key in ("trained_on", "fingerprint"):
        trained_on = trained_on.get(key) if isinstance(trained_on, dict) else None
    return bool(trained_on == result.data["fingerprint"])


def verdict(name: str, difference: Difference) -> str:
    """Say what an interval of b - a shows: ``a better``, ``b better``, ``no difference shown`` or ``undefined``."""
    if math.isnan(difference.low) or math.isnan(difference.high):
        return "undefined"
    if difference.low <= 0 <= difference.high:
        return "no difference shown"
    return "b better" if (difference.low > 0) == higher_is_better(name) else "a better"


def differing(a: Result, b: Result, count: int, *, metric: str = "abs_rel") -> list[str]:
    """Return the ids of the ``count`` images whose metric differs most, most first.

    Raises:
        DataError: if the results are not of the same images, or one does not have the metric.
    """
    tables = paired(a, b)
    return [tables[0].ids[row] for row in _by_difference(*tables, metric=metric)[:count]]


def _by_difference(a: ImageTable, b: ImageTable, *, metric: str) -> list[int]:
    """Return the rows of two tables, that of the largest difference first; NaN in one of them is the largest."""
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
    return {
        **{key: _origin(result) for key, result in (("a", a), ("b", b))},
        "images": len(a.table.ids),
        "protocol": a.stamp,
        "data": a.data,
        "uncertainty": uncertainty,
        "metrics": {
            name: {
                "a": _finite(a.metrics[name]),
                "b": _finite(b.metrics[name]),
                "difference": _finite(difference.value),
                "low": _finite(difference.low),
                "high": _finite(difference.high),
                "verdict": verdict(name, difference),
            }
            for name, difference in differences.items()
        },
    }


def _origin(result: Result) -> dict[str, Any]:
    return {"path": str(result.path), "split": result.split, "checkpoint": result.document.get("checkpoint")}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _per_image(a: ImageTable, b: ImageTable) -> str:
    names = [name for name in PER_IMAGE if name in a.values and name in b.values]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{name}_{side}" for name in names for side in ("a", "b", "difference")]
    writer.writerow(["id", "scene", "category", "pixels", *columns])
    values = [x for name in names for x in (a.values[name], b.values[name], b.values[name] - a.values[name])]
    for row in _by_difference(a, b, metric=PER_IMAGE[0]):
        keys = (a.ids[row], a.scenes[row], a.categories[row], a.pixels[row])
        writer.writerow([*keys, *(f"{column[row]:.9g}" for column in values)])
    return text.getvalue()


def _draw(path: Path, a: Result, b: Result, tables: tuple[ImageTable, ImageTable]) -> None:
    metric = PER_IMAGE[0]
    values = [table.values[metric] for table in tables]
    title = f"a: {_name(a)}\nb: {_name(b)}"
    ids = tables[0].ids
    shown = [ids[row] for row in _by_difference(*tables, metric=metric)[:SHOWN]]
    save_comparison(path, ids, *values, shown=shown, metric=metric, title=title)


def _name(result: Result) -> str:
    """Return the run or study of a result, which its folder lies in as test/<protocol>."""
    path = result.path.resolve()
    parts = path.parent.parent.parts if path.parent.name == "test" else path.parts
    return str(Path(*parts[-2:]))


def print_comparison(a: Result, b: Result, differences: dict[str, Difference], uncertainty: dict[str, Any]) -> None:
    """Print a row a metric to standard output: both results, their difference with its interval, and what it shows."""
    out = Console()
    if not out.is_terminal:
        out = Console(width=130)  # a log should not wrap what a wide terminal would show
    kinds = " and ".join(dict.fromkeys(f"{result.split['kind']}" for result in (a, b)))
    count = uncertainty["scenes"]
    scenes = f"of {count} scene{'s' * (count != 1)}" if any(a.table.scenes) else "without scenes"
    out.print(
        f"a: {a.path}\nb: {b.path}\n{a.protocol_name} protocol, {len(a.table.ids)} test images {scenes} of "
        f"{a.data['source']}, {kinds} split",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    level = f"{100 * LEVEL:.0f} %"
    table = Table(
        caption=f"{level} intervals, each metric by itself: {uncertainty['method']}, {uncertainty['repeats']} draws. "
        "They cover which scenes were tested, not which seed a network was trained with. ↑ higher is better, ↓ lower.",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),  # all of it fits into 80 columns
        show_edge=False,
    )
    table.add_column("metric")
    for name in ("a", "b", "b - a", f"{level} interval"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("verdict")
    for name, difference in differences.items():
        before, after = a.metrics[name], b.metrics[name]
        places = 4 if not max(abs(before), abs(after)) >= 10 else 2
        word = verdict(name, difference)
        table.add_row(
            escape(name + (f" [{UNITS[name]}]" if name in UNITS else "")) + (" ↑" if higher_is_better(name) else " ↓"),
            f"{before:.{places}f}",
            f"{after:.{places}f}",
            f"{difference.value:+.{places}f}",
            f"{difference.low:+.{places}f} to {difference.high:+.{places}f}",
            f"[bold]{word}[/]" if word.endswith("better") else word,
        )
    out.print("", table, sep="\n")
