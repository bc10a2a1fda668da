"""Rows on table 2: whether its figures go together, and the same table with runs next to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.ledger import tables
from experiments.ledger.bounds import MIN_DEPTH_M, largest_log10, largest_rmse_m, rising
from experiments.ledger.row import Row, Sheet
from experiments.ledger.runs import Run
from experiments.ledger.tables import MethodRow

LOWER_IS_BETTER = ("abs_rel", "rmse", "log10")
NAMES = (*LOWER_IS_BETTER, "delta1", "delta2", "delta3")


def best_row(table: Sequence[MethodRow] = tables.TABLE_2) -> Row:
    """Whether the proposed row is the best of each column."""
    beaten: dict[str, list[str]] = {}
    proposed = table[-1].metrics()
    for other in table[:-1]:
        for name, value in other.metrics().items():
            own = proposed[name]
            if value is not None and own is not None and (value < own if name in LOWER_IS_BETTER else value > own):
                beaten.setdefault(name, []).append(f"{other.method} {value}")
    found = "; ".join(f"{name} {proposed[name]}, but {', '.join(who)}" for name, who in beaten.items())
    return Row(
        "best_of_table_2",
        "Better than all others",
        "'The proposed model outperforms the others' (caption of table 2)",
        f"Within the table itself: {found or 'the proposed row is the best, or shares the best, of every column'}",
        "The last row of table 2 against each of the others, column by column, as printed.",
        "contradicted" if beaten else "holds",
        {"beaten": beaten},
    )


def deltas_row(table: Sequence[MethodRow] = tables.TABLE_2) -> Row:
    """Whether delta1 <= delta2 <= delta3 in every row."""
    falling = [row for row in table if not rising(row.deltas)]
    found = "; ".join(f"{row.method} {row.source}: {row.delta1}, {row.delta2}, {row.delta3}" for row in falling)
    return Row(
        "falling_deltas",
        "delta1, delta2, delta3 of one row",
        f"{len(table)} rows of shares of pixels within 1.25, 1.25^2 and 1.25^3 (table 2)",
        f"Fall where they must rise in {len(falling)} of {len(table)} rows: {found}"
        if falling
        else "rise in every row",
        "A pixel within 1.25 is within 1.25^2 too, so delta1 <= delta2 <= delta3 for any data.",
        "cannot be" if falling else "holds",
        {"rows": [row.method for row in falling]},
    )


def bounds_row(table: Sequence[MethodRow] = tables.TABLE_2) -> Row:
    """Whether each row's RMSE and log10 are possible with its ARE and deltas indoors."""
    cells, broken = [], []
    for row in table:
        if not rising(row.deltas):
            cells.append(
                [row.method, row.source, f"{row.rmse}", "-", format_value(row.log10), "-", "deltas fall, see above"]
            )
            continue
        rmse = largest_rmse_m(row.abs_rel, row.deltas, max_depth_m=tables.MAX_DEPTH_M)
        log10 = largest_log10(row.abs_rel, row.deltas, max_depth_m=tables.MAX_DEPTH_M)
        too_much = [
            f"{name} {value:.3f} where at most {bound:.3f} is possible"
            for name, value, bound in (("RMSE", row.rmse, rmse), ("log10", row.log10, log10))
            if value is not None and value > bound + 0.0005
        ]
        if too_much:
            broken.append(f"{row.method} {row.source}: {' and '.join(too_much)}")
        verdict = "**cannot be**" if too_much else "possible"
        cells.append(
            [row.method, row.source, f"{row.rmse}", f"{rmse:.3f}", format_value(row.log10), f"{log10:.3f}", verdict]
        )
    header = ("method", "source", "RMSE", "largest possible", "log10", "largest possible", "verdict")
    tested = sum(rising(row.deltas) for row in table)
    return Row(
        "figures_of_one_row",
        "RMSE and log10 next to ARE and deltas",
        f"{len(table)} rows compared on NYU Depth V2 (table 2), whose depth is clipped to {tables.MAX_DEPTH_M:g} m",
        f"Figures that no depth within {tables.MAX_DEPTH_M:g} m can give together: in {len(broken)} of {tested} rows"
        + (
            f". {'; '.join(broken)}. Such a row is from another data set, outdoors, or another metric" if broken else ""
        ),
        f"Upper bounds for any data with ground truth and prediction from {MIN_DEPTH_M:g} to {tables.MAX_DEPTH_M:g} m, "
        "pooled or averaged over images, printed digits rounded in the row's favour; derivation in bounds.py. "
        "'Possible' does not mean right.",
        "cannot be" if broken else "holds",
        {"broken": broken, "tested": tested},
        [Sheet("Table 2 within 10 m", header, cells)],
    )


def protocol_row(runs: Sequence[Run]) -> Row:
    """Figures without a protocol, and how far the protocol moves them."""
    cells, spans = [], []
    for run in runs:
        scored = {p: run.metric(p, "abs_rel") for p in run.tests}
        known = {p: value for p, value in scored.items() if value is not None}
        for protocol in known:
            values = [run.metric(protocol, name) for name in NAMES]
            cells.append([run.name, protocol, _stamp(run.tests[protocol]), *map(format_value, values)])
        if len(known) > 1:
            low, high = min(known, key=lambda p: known[p]), max(known, key=lambda p: known[p])
            spans.append(
                (known[high] / known[low] - 1, f"{run.name}: ARE {known[low]:.3f} ({low}), {known[high]:.3f} ({high})")
            )
    found = max(spans)[1] if spans else "not measured: pass --runs <a run tested under two protocols>"
    sources = len({row.source for row in tables.TABLE_2}) - 1
    header = ("run", "protocol", "what it scores", *NAMES)
    return Row(
        "protocol",
        "One protocol for all rows of table 2",
        f"{len(tables.TABLE_2) - 1} rows from {sources} cited works next to the proposed one; crop, depth cap, "
        "resolution and test images are stated for none, and the proposed row is scored on frames of the training set "
        "(section 2.3)",
        f"The same predictions under different protocols: {found}" if spans else found,
        "hudepth-test scores one checkpoint under several protocols; each metrics.json states its own in full. "
        "What the cited rows were scored on must be looked up in the works themselves.",
        "measured" if spans else "not measured",
        {"largest_change_of_abs_rel": max(spans)[0] if spans else None},
        [Sheet("The same predictions under different protocols", header, cells)] if spans else [],
    )


def table_2_with_runs(runs: Sequence[Run]) -> Sheet:
    """Return table 2 with a row for each test of each run.

    Args:
        runs: with or without results.
    """
    header = ("method", "source", "data, split, protocol", *NAMES)
    cells = [
        [
            row.method,
            row.source,
            "NYU, random frames of the training set; protocol not stated"
            if row is tables.PROPOSED
            else "as cited by the paper; protocol not stated",
            *map(format_value, row.metrics().values()),
        ]
        for row in tables.TABLE_2
    ]
    for run in runs:
        for protocol, test in run.tests.items():
            values = [run.metric(protocol, name) for name in NAMES]
            cells.append([run.name, "measured", describe_test(test, protocol), *map(format_value, values)])
    return Sheet("Table 2 as printed, with the runs given to this command", header, cells)


def describe_test(test: Mapping[str, Any], protocol: str) -> str:
    """Say what a test result is about: data, split, number of images, protocol."""
    data, split = test.get("data", {}), test.get("split", {})
    misread = ", depth misread" if data.get("encoding") == "paper_literal" else ""
    return (
        f"{data.get('source', '?')}{misread}, {split.get('kind', '?')} split, {test.get('images', '?')} images, "
        f"protocol {protocol}"
    )


def _stamp(test: Mapping[str, Any]) -> str:
    stamp = test.get("protocol", {})
    crop = "no crop" if not stamp.get("crop") else f"crop {stamp['crop']}"
    return f"{stamp.get('resolution', '?')} resolution, {crop}, {stamp.get('valid', '?')}"


def format_value(value: float | None, *, digits: int = 3) -> str:
    """Return a number for a table; empty for None."""
    return "" if value is None else f"{value:.{digits}f}"
