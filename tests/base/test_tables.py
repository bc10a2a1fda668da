from __future__ import annotations

import csv
import io

import pytest

from hudepth.base.tables import Cell, Table


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
