from __future__ import annotations

import contextlib
import csv
import io
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hudepth.base import tables
from hudepth.base.tables import Cell, Table
from tests.terminal import WIDTHS, assert_fits


@pytest.fixture
def table() -> Table:
    table = Table(["name", "abs_rel ↓"], title="t", caption="c [m]")
    table.add("a|b & 50 %", Cell("0.1", bold=True))
    table.add("two\nlines", "0.2")
    return table


def test_markdown(table: Table) -> None:
    lines = table.to_markdown().splitlines()
    assert lines[1] == "|---|---:|"
    assert lines[2] == "| a&#124;b & 50 % | **0.1** |"
    assert len(lines) == 4


def test_csv_can_be_read_again(table: Table) -> None:
    rows = list(csv.reader(io.StringIO(table.to_csv())))
    assert rows == [["name", "abs_rel ↓"], ["a|b & 50 %", "0.1"], ["two\nlines", "0.2"]]


def test_latex_escapes_what_is_special(table: Table) -> None:
    text = table.to_latex()
    assert r"a|b \& 50 \% & \textbf{0.1} \\" in text
    assert r"abs\_rel \(\downarrow\)" in text
    assert r"\begin{tabular}{lr}" in text


def test_a_terminal_sees_brackets_as_they_are(table: Table, capsys: pytest.CaptureFixture[str]) -> None:
    table.show()
    assert "c [m]" in capsys.readouterr().out


def shown(table: Table, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    monkeypatch.setattr(tables, "LOG_WIDTH", width)
    capsys.readouterr()
    table.show()
    return capsys.readouterr().out


@pytest.mark.parametrize("width", WIDTHS)
def test_columns_that_do_not_fit_are_left_out_and_named(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = [f"metric_{i} [m] ↓" for i in range(15)]
    rank = [columns[3], *(name for name in columns if name != columns[3])]
    table = Table(["", *columns], rank=rank, rest="all.csv", title="t" * 20, caption="word " * 40)
    for row in ("model", "mean depth map"):
        table.add(row, *(f"{i}.{row.count('m')}25" for i in range(15)))
    text = shown(table, width, monkeypatch, capsys)
    assert_fits(text, width)
    left_out = re.findall(r"metric_\d+", " ".join(text.split("all.csv also has ")[1].split()))
    kept = [name for name in columns if name.split()[0] not in left_out]
    assert kept == [name for name in columns if name in rank[: len(kept)]]  # the first ones of the rank, in order
    assert len(kept) == (width - len("mean depth map")) // (len("metric_0") + 2)
    for row in ("model", "mean depth map"):
        (line,) = (line for line in text.splitlines() if line.startswith(row))
        expected = [f"{columns.index(name)}.{row.count('m')}25" for name in kept]
        assert line.removeprefix(row).split() == expected


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_left_out_without_need(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = Table(["", "a", "b"], rank=["a", "b"], rest="x")
    table.add("row", "1", "2" * (width - 8))  # two gaps of two letters, and 4 letters before
    text = shown(table, width, monkeypatch, capsys)
    assert "also has" not in text
    assert_fits(text, width)
    table.add("a row", "1", "2")
    assert "x also has b" in shown(table, width, monkeypatch, capsys)


words = st.text("abcdefg 01", min_size=1, max_size=30).map(str.strip).filter(bool)


@given(
    rows=st.lists(st.tuples(words, words, st.floats(-1e4, 1e4).map(lambda x: f"{x:.3f}")), min_size=1, max_size=4),
    width=st.integers(40, 140),
)
def test_words_and_numbers_are_whole_at_any_width(rows: list[tuple[str, str, str]], width: int) -> None:
    table = Table(["", "what it means", "value [m]"], left=2)
    for row in rows:
        table.add(*row)
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as out:
        patch.setattr(tables, "LOG_WIDTH", width)
        table.show()
    assert_fits(out.getvalue(), width)
    assert sorted(" ".join(out.getvalue().replace("─", "").split()).split()) == sorted(
        " ".join((*table.columns, *(cell for row in rows for cell in row))).split()
    )


def test_a_name_too_long_for_its_column_breaks_after_punctuation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "a_run_with_quite_a_long_name_that_somebody_chose_for_its_many_parts/2025-08-11_12-00-00"
    table = Table(["", "x"], rank=["x"])
    table.add(name, "0.5")
    text = shown(table, 80, monkeypatch, capsys)
    assert_fits(text, 80)
    first, second = text.splitlines()[2:]
    assert first.split() == ["a_run_with_quite_a_long_name_that_somebody_chose_for_its_many_parts/2025-", "0.5"]
    assert second.split() == ["08-11_12-00-00"]


def test_an_indented_label_stays_indented_when_it_is_broken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = Table(["", "x"])
    table.add("  with a training frame at most 2 frames away", "50.0%")
    lines = shown(table, 40, monkeypatch, capsys).splitlines()
    assert [line.rstrip() for line in lines[2:]] == ["  with a training frame at most 2  50.0%", "    frames away"]
