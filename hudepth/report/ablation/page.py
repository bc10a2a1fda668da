"""A report of a sweep as one page that needs nothing else: no network, no other file, no further permissions."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from string import Template

from hudepth.report.ablation import words
from hudepth.report.ablation.estimates import NOT_SHOWN
from hudepth.report.ablation.factors import ABSENT, config_differences
from hudepth.report.ablation.pictures import Picture
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.rows import Row


class _Page(Template):
    delimiter = "@@"  # a dollar sign means something in JavaScript


class Html(str):
    """Text that is markup already and is not escaped again."""

    __slots__ = ()


def tag(name: str, *inside: str, **attributes: str | None) -> Html:
    """Return an element; everything in it that is not :class:`Html` is escaped, attributes of None are left out.

    Underscores in the names of attributes become hyphens, those at the end go: ``class_``, ``data_value``.
    """
    found = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items() if value is not None}
    words = "".join(f' {key}="{escape(value)}"' for key, value in found.items())
    return Html(f"<{name}{words}>{_join(inside)}</{name}>")


Cell = Callable[[Row, str, int], Html]  # of a row, a metric and its decimals


def page(
    report: Report,
    *,
    title: str,
    pictures: Sequence[Picture] = (),
    notes: Sequence[str] = (),
    facts: Mapping[str, str] | None = None,
) -> str:
    """Return report.html, pictures in it; ``notes`` list what was skipped, ``facts`` join those at the top."""
    troubles = [(each.run or "-", each.row, each.seed, each.state, each.why or "-") for each in report.troubles]
    columns = ("run", "row", "seed", "state", "why")
    parts = [
        ("differences", f"Differences from {report.reference.label}", _differences(report)),
        ("pictures", "Pictures", _join(map(_figure, pictures))),
        ("not-counted", "Not counted", _listing("Runs that are in no mean", columns, troubles, long=(4,))),
        ("notes", "Notes", _list(notes, class_="plain") if notes else Html()),
        ("configurations", "Configurations", _configurations(report)),
    ]
    parts = [part for part in parts if part[2]]
    notice = tag("div", _list(report.warnings), class_="notice", role="note")
    about = words.about(report)
    template = files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    return _Page(template).substitute(
        policy=_policy(template),
        title=escape(title),
        finding=escape(words.finding(report)),
        about=escape(about[0].upper() + about[1:]),
        facts=_facts(report, facts or {}),
        warnings=notice if report.warnings else "",
        results=_results(report),
        links=_join(tag("a", name, href=f"#{key}") for key, name, _ in parts),
        sections=_join(tag("section", tag("h2", name), inside, id=key) for key, name, inside in parts),
        method=escape(words.method(report)),
    )


def _policy(template: str) -> str:
    """Allow the page's own style and script by their digests, pictures within the page, and nothing else."""
    sources = ""
    for kind in ("style", "script"):
        (inside,) = re.findall(rf"<{kind}>(.*?)</{kind}>", template, flags=re.DOTALL)
        sources += f"{kind}-src 'sha256-{base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()}'; "
    return f"default-src 'none'; img-src data:; {sources}base-uri 'none'; form-action 'none'"


def _join(parts: Iterable[str]) -> Html:
    return Html("".join(part if isinstance(part, Html) else escape(part) for part in parts))


def _list(lines: Iterable[str], *, class_: str | None = None) -> Html:
    return tag("ul", *(tag("li", line[:1].upper() + line[1:]) for line in lines), class_=class_)


def _facts(report: Report, more: Mapping[str, str]) -> Html:
    facts = {
        "Protocol": report.protocol,
        "Data": f"{report.first.data['source']} ({str(report.first.data['fingerprint'])[:8]})",
        "Split": f"{report.first.split['kind']} ({str(report.first.split['sha256'])[:8]})",
        "Rows": f"{len(report.rows)}, {words.seeds(report)}",
        "Reference": report.reference.label,
        "hudepth": ", ".join(report.versions),
        **more,
    }
    return tag("dl", *(tag("div", tag("dt", term), tag("dd", text)) for term, text in facts.items()), class_="facts")


def _results(report: Report) -> Html:
    factors = report.factors if any(row.named for row in report.rows) else []  # else they are the row's name
    leads: dict[str, list[Html]] = {row.label: [] for row in report.rows}
    heads = []
    for factor in factors:
        is_number = all(x == ABSENT or re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", x) for x in factor.shown)
        heads.append(_sorter(factor.name, is_number=is_number))
        for cells, value in zip(leads.values(), factor.shown, strict=True):
            sorted_by = "" if is_number and value == ABSENT else value
            cells.append(tag("td", value, data_value=sorted_by, class_="factor" if is_number else "factor text"))
    for row in report.rows:
        leads[row.label].append(tag("td", row.counted, data_value=str(len(row.runs)), class_="factor"))
    return _metrics("Results", report, leads, _result, *heads, _sorter("seeds"))


def _differences(report: Report) -> Html:
    note = (
        "Row minus reference, paired by seed and by image; below it the 95 % intervals over seeds and over scenes. "
        "Better or worse: both exclude 0. Among many rows some differ by chance."
    )
    rows: dict[str, list[Html]] = {row.label: [] for row in report.rows if row.contrasts}
    table = _metrics("Differences", report, rows, _difference)
    return _join([table, tag("p", note, class_="quiet")] if rows else [])


def _metrics(name: str, report: Report, leads: Mapping[str, list[Html]], cell: Cell, *heads: Html) -> Html:
    """Return a sortable table: by label of the row, the cells that lead it, then a cell for each metric."""
    digits = words.places(report)
    heads = (_sorter("row", is_number=False), *heads, *(_sorter(words.heading(name)) for name in report.metrics))
    body = []
    for row in (row for row in report.rows if row.label in leads):
        reference = [Html(" "), tag("span", "reference", class_="tag")] if row.is_reference else []
        differs = [tag("small", f"differs: {'; '.join(row.differs)}", class_="caution")] if row.differs else []
        head = tag("th", _breakable(row.label), *reference, *differs, scope="row", data_value=row.label)
        cells = (cell(row, metric, digits[metric]) for metric in report.metrics)
        words_of_row = " ".join([row.label, *row.factors]).lower()
        body.append(tag("tr", head, *leads[row.label], *cells, data_filter=words_of_row))
    return _table(name, heads, body, class_="sortable wide" if len(heads) > 9 else "sortable")


def _sorter(name: str, *, is_number: bool = True) -> Html:
    kind, align = ("number", None) if is_number else ("text", "text")
    button = tag("button", _breakable(f"{name} "), type="button")
    return tag("th", button, scope="col", data_kind=kind, class_=align)


def _breakable(name: str) -> Html:
    """Let a long name break between its words."""
    return Html(escape(name).replace("_", "_<wbr>"))


def _table(name: str, heads: Sequence[str], rows: Sequence[str], *, class_: str | None = None) -> Html:
    table = tag("table", tag("thead", tag("tr", *heads)), tag("tbody", *rows), class_=class_)
    return tag("div", table, class_="table", role="region", aria_label=name)


def _result(row: Row, name: str, digits: int) -> Html:
    found = row.estimates.get(name)
    if found is None or found.mean != found.mean:
        return tag("td", "–", data_value="")
    texts = (words.half_width(found.seeds, digits), words.between(found.scenes, digits))
    value = tag("span", words.number(found.mean, digits), class_="value")
    best = "best" if name in row.best else None
    return tag("td", value, *(tag("small", x) for x in texts if x), data_value=repr(found.mean), class_=best)


def _difference(row: Row, name: str, digits: int) -> Html:
    found = row.contrasts.get(name)
    if found is None or found.value != found.value:
        return tag("td", "–", data_value="")
    is_shown = found.verdict != NOT_SHOWN  # then at least one interval is known
    alone = "" if found.seeds.known and found.scenes.known else f"{'scenes' if found.scenes.known else 'seeds'} alone"
    arrow = (" ▲" if found.value > 0 else " ▼") if is_shown else ""
    value = tag("span", f"{words.number(found.value, digits, sign=True)}{arrow}", class_="value")
    word = tag("small", f"{found.verdict}, {alone}" if alone and is_shown else found.verdict, class_="word")
    ends = (("seeds", found.seeds), ("scenes", found.scenes))
    small = (tag("small", f"{what} {words.between(each, digits, sign=True)}") for what, each in ends if each.known)
    kind = found.verdict if is_shown else None
    return tag("td", value, word, *small, data_value=repr(found.value), class_=kind)


def _figure(picture: Picture) -> Html:
    source = f"data:image/png;base64,{base64.b64encode(picture.png).decode()}"
    image = Html(f'<img src="{source}" alt="{escape(picture.title)}">')
    caption = tag("figcaption", tag("strong", f"{picture.title}."), f" {picture.caption}")
    return tag("figure", tag("div", image, class_="wide"), caption)


def _configurations(report: Report) -> Html:
    parts = []
    for row in report.rows:
        if row is not report.reference:
            changes = config_differences(report.reference.config, row.config)
            count = f"{len(changes)} key{'s' * (len(changes) != 1)} differ{'s' * (len(changes) == 1)}"
            lines = [[tag("code", text) for text in change] for change in changes]
            table = _listing(f"Configuration of {row.label}", ("key", "reference", "this row"), lines, long=(1, 2))
            parts.append(tag("details", tag("summary", f"{row.label}: {count}"), table))
    lead = f"How each row differs from {report.reference.label}, apart from seeds, names and paths."
    return _join([tag("p", lead, class_="quiet"), *parts] if parts else [])


def _listing(name: str, heads: Sequence[str], rows: Sequence[Sequence[str]], *, long: Sequence[int]) -> Html:
    """Return a table of texts, nothing if it has no rows; ``long`` columns wrap."""
    body = []
    for first, *others in rows:
        cells = (tag("td", x, class_="text long" if i in long else "text") for i, x in enumerate(others, start=1))
        body.append(tag("tr", tag("th", first, scope="row"), *cells))
    return _table(name, [tag("th", head, scope="col", class_="text flat") for head in heads], body) if body else Html()
