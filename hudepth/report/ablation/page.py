"""A report of a sweep as one page that needs nothing else: no network, no other file, no leave to run anything more."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from hudepth.report.ablation import words
from hudepth.report.ablation.estimates import NOT_SHOWN
from hudepth.report.ablation.factors import config_differences
from hudepth.report.ablation.page_parts import SCRIPT, STYLE
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.row import Row


@dataclass(frozen=True)
class Picture:
    """A picture on the page."""

    png: bytes
    title: str
    caption: str


def page(
    report: Report,
    *,
    title: str,
    pictures: Sequence[Picture] = (),
    notes: Sequence[str] = (),
    facts: Mapping[str, str] | None = None,
) -> str:
    """Return report.html.

    Args:
        report: what it says.
        title: of the page.
        pictures: in their order; they become part of the page.
        notes: a line each, of what was left alone in the folder.
        facts: further ones, for the top of the page, like its date.
    """
    parts = [
        ("results", "Results", _results(report)),
        ("differences", f"Differences from {report.reference.label}", _differences(report)),
        ("pictures", "Pictures", "".join(map(_figure, pictures))),
        ("not-counted", "Not counted", _troubles(report)),
        ("notes", "Notes", _list(notes)),
        ("configurations", "Configurations", _configurations(report)),
    ]
    parts = [part for part in parts if part[2]]
    links = "".join(f'<a href="#{key}">{_text(name)}</a>' for key, name, _ in parts)
    sections = "".join(f'<section id="{key}"><h2>{_text(name)}</h2>{inside}</section>' for key, name, inside in parts)
    return (
        f"{_head(title)}<body><header><h1>{_text(title)}</h1>"
        f'<p class="lead">{_text(_sentence(words.about(report)))}.</p>{_facts(report, facts or {})}'
        f'{_warnings(report.warnings)}<nav aria-label="Parts of this page">{links}</nav></header>'
        f'<main>{sections}</main><footer><p class="quiet">{_text(words.method(report))}</p></footer>'
        f"<script>{SCRIPT}</script></body></html>\n"
    )


def _head(title: str) -> str:
    def source(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    policy = (
        f"default-src 'none'; img-src data:; style-src {source(STYLE)}; script-src {source(SCRIPT)}; "
        "base-uri 'none'; form-action 'none'"
    )
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="referrer" content="no-referrer"><link rel="icon" href="data:,">'
        f"<title>{_text(title)}</title><style>{STYLE}</style></head>"
    )


def _text(value: str) -> str:
    return escape(value, quote=True)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _facts(report: Report, more: Mapping[str, str]) -> str:
    shas = (str(report.first.data["fingerprint"])[:8], str(report.first.split["sha256"])[:8])
    facts = {
        "Protocol": report.protocol,
        "Data": f"{report.first.data['source']} ({shas[0]})",
        "Split": f"{report.first.split['kind']} ({shas[1]})",
        "Rows": f"{len(report.rows)}, {words.seeds(report)}",
        "Reference": report.reference.label,
        "hudepth": ", ".join(report.versions),
        **more,
    }
    cells = "".join(f"<div><dt>{_text(term)}</dt><dd>{_text(text)}</dd></div>" for term, text in facts.items())
    return f'<dl class="facts">{cells}</dl>'


def _warnings(lines: Sequence[str]) -> str:
    return f'<div class="notice" role="note"><ul>{_items(lines)}</ul></div>' if lines else ""


def _items(lines: Iterable[str]) -> str:
    return "".join(f"<li>{_text(_sentence(line))}</li>" for line in lines)


def _list(lines: Sequence[str]) -> str:
    return f'<ul class="plain">{_items(lines)}</ul>' if lines else ""


def _results(report: Report) -> str:
    tools = (
        '<div class="tools"><label for="filter">Filter rows</label>'
        '<input id="filter" type="search" autocomplete="off" placeholder="name or value">'
        '<output id="filtered" for="filter" class="quiet" aria-live="polite"></output></div>'
    )
    named = any(row.variant.named for row in report.rows)
    factors = report.factors if named else []
    digits = words.places(report)
    heads = [
        _sorter("row", "text"),
        *(_sorter(factor.name, _kind(factor.shown)) for factor in factors),
        _sorter("seeds", "number"),
        *(_sorter(words.heading(name), "number") for name in report.metrics),
    ]
    rows = "".join(_result_row(row, report, digits, with_factors=named) for row in report.rows)
    note = (
        '<p class="quiet">Mean over seeds; ± half of the 95 % interval over seeds; below it the 95 % interval over '
        "scenes. The best of each column is underlined. rmse in metres. Headings sort.</p>"
    )
    return tools + _table(heads, rows, name="Results", classes="sortable") + note


def _kind(shown: Sequence[str]) -> str:
    """Sort a factor as numbers if all its values are."""
    try:
        [float(value) for value in shown if value != "-"]
    except ValueError:
        return "text"
    return "number"


def _sorter(name: str, kind: str) -> str:
    align = ' class="text"' if kind == "text" else ""
    return f'<th scope="col" data-kind="{kind}"{align}><button type="button">{_text(name)} </button></th>'


def _table(heads: Sequence[str], rows: str, *, name: str, classes: str = "") -> str:
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{_text(name)}"><table class="{classes}">'
        f"<thead><tr>{''.join(heads)}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _row_open(row: Row) -> str:
    searched = " ".join([row.label, *row.variant.factors]).lower()
    tag = ' <span class="tag">reference</span>' if row.is_reference else ""
    differs = f'<small class="caution">differs: {_text("; ".join(row.differs))}</small>' if row.differs else ""
    label = _text(row.label).replace("_", "_<wbr>")  # a long name breaks between its words
    head = f'<th scope="row" data-value="{_text(row.label)}">{label}{tag}{differs}</th>'
    return f'<tr data-filter="{_text(searched)}">{head}'


def _result_row(row: Row, report: Report, digits: Mapping[str, int], *, with_factors: bool) -> str:
    cells = []
    if with_factors:
        for factor, shown in zip(report.factors, row.variant.factors, strict=True):
            number = _kind(factor.shown) == "number"
            value = "" if number and shown == "-" else shown
            align = "" if number else ' class="text"'
            cells.append(f'<td data-value="{_text(value)}"{align}>{_text(shown)}</td>')
    cells.append(f'<td data-value="{len(row.runs)}">{_text(row.counted)}</td>')
    for name in report.metrics:
        found = row.estimates.get(name)
        if found is None or found.mean != found.mean:
            cells.append('<td data-value="">–</td>')
            continue
        scenes = words.between(found.scenes, digits[name])
        small = "".join(
            f"<small>{text}</small>" for text in (words.half_width(found.seeds, digits[name]), scenes) if text
        )
        best = ' class="best"' if name in row.best else ""
        value = words.number(found.mean, digits[name])
        cells.append(f'<td data-value="{found.mean!r}"{best}><span class="value">{value}</span>{small}</td>')
    return f"{_row_open(row)}{''.join(cells)}</tr>"


def _differences(report: Report) -> str:
    rows = [row for row in report.rows if row.contrasts]
    if not rows:
        return ""
    digits = words.places(report)
    heads = [_sorter("row", "text"), *(_sorter(words.heading(name), "number") for name in report.metrics)]
    body = "".join(
        f"{_row_open(row)}{''.join(_difference(row, n, digits[n]) for n in report.metrics)}</tr>" for row in rows
    )
    note = (
        '<p class="quiet">Row minus reference, paired by seed and by image; below it the 95 % intervals over seeds and '
        "over scenes. Better or worse: both leave out 0. Among many rows some differ by chance.</p>"
    )
    return _table(heads, body, name="Differences", classes="sortable") + note


def _difference(row: Row, name: str, digits: int) -> str:
    found = row.contrasts.get(name)
    if found is None or found.value != found.value:
        return '<td data-value="">–</td>'
    seeds, scenes = (words.between(each, digits, sign=True) for each in (found.seeds, found.scenes))
    arrow = "" if found.verdict == NOT_SHOWN else " ▲" if (found.value > 0) else " ▼"
    alone = words.rests_on(found)
    word = found.verdict + (f", {alone}" if alone and found.verdict != NOT_SHOWN else "")
    small = f'<small class="word">{word}</small>' + "".join(
        f"<small>{what} {text}</small>" for what, text in (("seeds", seeds), ("scenes", scenes)) if text
    )
    kind = "" if found.verdict == NOT_SHOWN else f' class="{found.verdict}"'
    value = words.number(found.value, digits, sign=True)
    return f'<td data-value="{found.value!r}"{kind}><span class="value">{value}{arrow}</span>{small}</td>'


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.png).decode()
    return (
        f'<figure><div class="wide"><img src="data:image/png;base64,{data}" alt="{_text(picture.title)}"></div>'
        f"<figcaption><strong>{_text(picture.title)}.</strong> {_text(picture.caption)}</figcaption></figure>"
    )


def _troubles(report: Report) -> str:
    if not report.troubles:
        return ""
    heads = [f'<th scope="col" class="text flat">{name}</th>' for name in ("run", "row", "seed", "state", "why")]
    rows = "".join(
        f'<tr><th scope="row">{_text(each.run or "-")}</th><td class="text">{_text(each.row)}</td>'
        f'<td class="text">{_text(each.seed)}</td><td class="text">{_text(each.state)}</td>'
        f'<td class="text long">{_text(each.why or "-")}</td></tr>'
        for each in report.troubles
    )
    return _table(heads, rows, name="Runs that are in no mean")


def _configurations(report: Report) -> str:
    heads = [f'<th scope="col" class="text flat">{name}</th>' for name in ("key", "reference", "this row")]
    parts = []
    for row in report.rows:
        if row is report.reference:
            continue
        changes = config_differences(report.reference.variant.config, row.variant.config)
        lines = "".join(
            f'<tr><th scope="row"><code>{_text(key)}</code></th><td class="text long"><code>{_text(before)}</code></td>'
            f'<td class="text long"><code>{_text(after)}</code></td></tr>'
            for key, before, after in changes
        )
        count = f"{len(changes)} key{'s' * (len(changes) != 1)} differ{'s' * (len(changes) == 1)}"
        inside = _table(heads, lines, name=f"Configuration of {row.label}")
        parts.append(f"<details><summary>{_text(row.label)}: {count}</summary>{inside}</details>")
    lead = f"In what each row differs from {report.reference.label}, seeds, names and places aside."
    return f'<p class="quiet">{_text(lead)}</p>{"".join(parts)}' if parts else ""
