"""The table of a test on the terminal: all protocols in one, and what the model's error consists of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hudepth.base.tables import Cell, Table, say
from hudepth.metrics.bootstrap import MIN_SCENES
from hudepth.metrics.catalogue import metric_info, metric_names

Metrics = dict[str, dict[str, float]]
"""By predictor and name."""
SCALE = ("abs_rel_aligned", "scale_sd", "rmse_pooled")
INTERVALS = 2
"""Most protocols whose intervals fit into the table of scales and depth edges."""


@dataclass(frozen=True)
class Scored:
    """The results of one protocol; its images are those of which a pixel counts."""

    protocol: str
    metrics: Metrics
    ranges: Mapping[str, tuple[float, float]]
    """95 % intervals of the first predictor's metrics."""
    images: int
    over: str
    """What was resampled: ``215 scenes``."""
    alignment: str = "none"


def print_results(results: Sequence[Scored], *, source: str, files: str) -> None:
    """Print the metrics of each protocol and predictor in one table, then scales and depth edges of the first one.

    Args:
        results: of at least one protocol.
        source: name of the data set.
        files: where all metrics are.
    """
    if not results:
        return
    results_table(results, source=source, files=files).show()
    say("")
    errors_table(results, files=files).show()


def results_table(results: Sequence[Scored], *, source: str, files: str) -> Table:
    """Return one row per protocol and predictor, the best of each protocol bold, and the first one's intervals."""
    infos = [metric_info(name) for name in metric_names("wide")]
    headline = [*metric_names("headline"), *metric_names("narrow"), *metric_names("wide")]
    several = len(results) > 1
    most = max(result.images for result in results)
    table = Table(
        ["", *(f"{info.label} {info.arrow}" for info in infos)],
        title=f"{'' if several else f'{results[0].protocol} protocol, '}{most} test images of {source}",
        rank=[f"{metric_info(name).label} {metric_info(name).arrow}" for name in dict.fromkeys(headline)],
        rest=files,
    )
    over = " or ".join(dict.fromkeys(result.over for result in results))
    known = any(map(_is_known, results))
    notes = [f"95 %: bootstrap over {over}" if known else f"no 95 % intervals: {over}, they need {MIN_SCENES}"]
    for result in results:
        if several:
            table.add(Cell(result.protocol, bold=True), *[""] * len(infos))
        _add_predictors(table, result, indent="  " * several)
        which = f"{result.protocol}: " * several
        if result.images < most:
            notes.append(f"{which}{result.images} of the images")
        if result.alignment != "none":
            notes.append(f"{which}each prediction aligned to its ground truth ({result.alignment})")
    table.caption = "; ".join(notes)
    return table


def _is_known(result: Scored) -> bool:
    """Return whether there are enough scenes for intervals."""
    return any(low == low for low, _ in result.ranges.values())


def _add_predictors(table: Table, result: Scored, *, indent: str) -> None:
    infos = [metric_info(name) for name in metric_names("wide")]
    rows = result.metrics
    best = {
        info.name: (max if info.higher_is_better else min)(row[info.name] for row in rows.values()) for info in infos
    }
    for number, (who, row) in enumerate(rows.items()):
        cells = [
            Cell(info.format(row[info.name]), bold=len(rows) > 1 and row[info.name] == best[info.name])
            for info in infos
        ]
        table.add(f"{indent}{who.replace('_', ' ')}", *cells)
        if number == 0 and _is_known(result):
            for word, side in (("  95 % from", 0), ("       to", 1)):
                ends = (Cell(info.format(result.ranges[info.name][side]), dim=True) for info in infos)
                table.add(Cell(f"{indent}{word}", dim=True), *ends)


def errors_table(results: Sequence[Scored], *, files: str) -> Table:
    """Return one row per measure of the first predictor's scales and depth edges, and a column per protocol."""
    first = next(iter(results[0].metrics))
    measured = set().union(*(result.metrics[first] for result in results))
    names = [name for name in (*SCALE, *metric_names("edges")) if name in measured]
    about = "abs_rel_aligned: each image at its median scale; rmse_pooled: all pixels at once"
    columns = [result.protocol for result in results]
    title = f"{first.replace('_', ' ')}: scale{' and depth edges' * (len(names) > len(SCALE))}"
    table = Table(["", *columns], title=title, caption=about, rank=columns, rest=files)
    for name in names:
        info, cells = metric_info(name), []
        for result in results:
            value, ends = result.metrics[first].get(name), result.ranges.get(name)
            text = "-" if value is None else info.format(value)
            if ends is not None and ends[0] == ends[0] and len(results) <= INTERVALS:
                text += f" [{info.format(ends[0])}, {info.format(ends[1])}]"
            cells.append(text)
        table.add(f"{info.label} {info.arrow}", *cells)
    return table
