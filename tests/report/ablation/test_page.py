from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from hudepth.report.ablation.page import page
from hudepth.report.ablation.pictures import Picture
from hudepth.report.ablation.report import Report
from hudepth.report.ablation.words import finding
from tests.browser import chromium

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)
VOID = ("meta", "link", "input", "img", "wbr", "br")


@pytest.fixture(scope="module")
def html(report: Report) -> str:
    picture = Picture(PNG, 'A "picture"', "of <nothing>")
    return page(report, title="Sweep <x> & y", pictures=[picture], notes=["skipped: '<script>alert(1)</script>'"])


class Tags(HTMLParser):
    """Opens and closes, and what asks for something from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.styles: list[str] = []
        self.policy = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.sources += [str(found[key]) for key in ("src", "href", "action", "data", "srcset") if key in found]
        self.styles += [key for key in found if key == "style" or key.startswith("on")]
        if found.get("http-equiv") == "Content-Security-Policy":
            self.policy = str(found["content"])
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def parsed(html: str) -> Tags:
    tags = Tags()
    tags.feed(html)
    return tags


def test_the_page_is_whole_and_asks_for_nothing(html: str) -> None:
    tags = parsed(html)
    assert tags.open == []
    assert tags.styles == []
    assert all(source.startswith(("data:", "#")) for source in tags.sources)
    assert "url(" not in html
    assert "@import" not in html


def test_the_policy_allows_the_pages_own_style_and_script_alone(html: str) -> None:
    policy = parsed(html).policy
    assert policy.startswith("default-src 'none'; img-src data:; ")
    for tag in ("style", "script"):
        (inside,) = re.findall(rf"<{tag}>(.*?)</{tag}>", html, flags=re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert "unsafe" not in policy


def test_names_are_escaped(html: str) -> None:
    assert "<b>" not in html
    assert "si|log &amp; &lt;b&gt;" in html
    assert "loss is &lt;nan&gt; &amp; more" in html
    assert "alert(1)</script>" not in html
    assert "<title>Sweep &lt;x&gt; &amp; y</title>" in html


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


@pytest.fixture
def tab(browser: Any, html: str, tmp_path: Path) -> Iterator[Any]:
    """The page, opened; nothing may be said in its console or asked of anybody."""
    file = tmp_path / "report.html"
    file.write_text(html, encoding="utf-8")
    tab = browser.new_page()
    said: list[str] = []
    asked: list[str] = []
    tab.on("console", lambda message: said.append(message.text))
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(file.as_uri())
    yield tab
    assert said == []
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    tab.close()


def column(tab: Any, place: int) -> list[str]:
    cells = tab.locator(f"#results tbody tr > :nth-child({place})")
    return [str(cell) for cell in cells.evaluate_all("cells => cells.map(cell => cell.dataset.value)")]


def head(tab: Any, name: str) -> tuple[Any, int]:
    heads = tab.locator("#results thead th")
    names = [text.strip() for text in heads.all_inner_texts()]
    place = next(i for i, text in enumerate(names) if text.startswith(name))
    return heads.nth(place), place + 1


def test_headings_sort_numbers_both_ways(tab: Any, report: Report) -> None:
    means = sorted(row.estimates["rmse"].mean for row in report.rows)
    th, place = head(tab, "rmse")
    assert th.get_attribute("aria-sort") is None
    th.locator("button").click()
    assert [float(value) for value in column(tab, place)] == means
    assert th.get_attribute("aria-sort") == "ascending"
    th.locator("button").press("Enter")
    assert [float(value) for value in column(tab, place)] == means[::-1]
    assert th.get_attribute("aria-sort") == "descending"


def test_what_is_missing_stays_last_both_ways(tab: Any) -> None:
    th, place = head(tab, "smoothness")
    for values in (["0", "0", "1", "1", ""], ["1", "1", "0", "0", ""]):
        th.locator("button").click()
        assert column(tab, place) == values


def test_names_sort_and_only_one_heading_says_so(tab: Any, report: Report) -> None:
    for name in ("rmse", "row"):
        head(tab, name)[0].locator("button").click()
    assert column(tab, 1) == sorted(row.label for row in report.rows)
    assert tab.locator("#results [aria-sort]").count() == 1


def test_the_filter_hides_rows_of_both_tables(tab: Any) -> None:
    tab.fill("#filter", "NO_ scale")
    assert tab.locator("#results tbody tr:visible").count() == 1
    assert tab.locator("#differences tbody tr:visible").count() == 1
    assert tab.inner_text("#filtered") == "1 of 5 rows"
    tab.fill("#filter", "")
    assert tab.locator("#results tbody tr:visible").count() == 5


def test_the_finding_comes_first(tab: Any, report: Report) -> None:
    assert tab.inner_text("main, header").count(finding(report)) == 1
    tops = [tab.locator(part).bounding_box()["y"] for part in (".lead", "#results table", ".facts", "#differences")]
    assert tops == sorted(tops)


@pytest.mark.parametrize("width", [360, 768, 1000, 1280, 1920])
def test_no_width_hides_a_column(tab: Any, width: int) -> None:
    tab.set_viewport_size({"width": width, "height": 800})
    tab.wait_for_function(f"document.documentElement.scrollWidth <= {width}", timeout=5000)
    for box in tab.locator("#results tbody td").evaluate_all(
        "cells => cells.map(cell => [cell.getBoundingClientRect().left, cell.getBoundingClientRect().right])"
    ):
        assert 0 <= box[0] < box[1] <= width
    scrolling = "all => all.filter(e => /auto|scroll/.test(getComputedStyle(e).overflow)).length"
    assert tab.locator("main *").evaluate_all(scrolling) == 0


def test_a_phone_shows_the_first_metric_by_its_name(tab: Any) -> None:
    tab.set_viewport_size({"width": 390, "height": 800})
    first = tab.locator("#results tbody td:not(.factor)").first
    assert first.get_attribute("data-name") == "abs_rel ↓"
    assert first.bounding_box()["y"] + first.bounding_box()["height"] < 800
    assert not tab.locator("#results thead").is_visible()


def test_the_picture_is_shown(tab: Any) -> None:
    assert tab.evaluate("document.querySelector('img').naturalWidth") == 1
