from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from experiments.ledger.ledger import COLOURS, markdown, plain_ledger, terminal_table
from experiments.ledger.row import VERDICTS, Row, Sheet
from experiments.ledger.runs import read_run

ROWS = [
    Row("a", "First", "x [1] | y", "2", "by hand", "holds", {"n": 2}, [Sheet("Small", ("p", "q"), [["1", "2"]])]),
    Row("b", "Second", "z", "3", "likewise", "cannot be"),
]
TABLE_2 = Sheet("Table 2", ("method",), [["proposed"]])
ENVIRONMENT = {"device": "a CPU", "packages": {"torch": "2.6"}, "command": ["python", "-m", "experiments.ledger"]}


def test_every_verdict_has_a_colour() -> None:
    assert COLOURS.keys() == VERDICTS.keys()


def test_the_page_holds_every_row_and_table() -> None:
    page = markdown(ROWS, table_2=TABLE_2, runs=[], environment=ENVIRONMENT)
    assert "2 rows: 1 holds, 1 cannot be." in page
    assert r"| 1 | First | x [1] \| y | 2 | **holds** |" in page
    assert (
        "## 2. Second\n\n*The paper says:* z.\n\n*Measured:* 3.\n\n*How:* likewise\n\n*Verdict:* **cannot be**." in page
    )
    assert "**Small**\n\n| p | q |\n| --- | --- |\n| 1 | 2 |" in page
    assert "computed by `python -m experiments.ledger`" in page
    assert "None were given" in page
    assert "- device: a CPU\n- packages: torch 2.6" in page


def test_problems_of_runs_are_listed(make_run: Callable[..., Path]) -> None:
    run = read_run(make_run("one"))
    page = markdown(ROWS, table_2=TABLE_2, runs=[run], environment=ENVIRONMENT)
    assert f"- badcl (one): `{run.path}`\n  - problem: '{run.path}' holds no readable test result." in page


def test_plain_types_survive_json() -> None:
    ledger = plain_ledger(ROWS, table_2=TABLE_2, runs=[], environment=ENVIRONMENT)
    assert json.loads(json.dumps(ledger, allow_nan=False)) == ledger
    assert ledger["rows"][0]["values"] == {"n": 2}
    assert ledger["rows"][0]["tables"] == [{"title": "Small", "header": ["p", "q"], "cells": [["1", "2"]]}]


def test_brackets_survive_the_terminal() -> None:
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(terminal_table(ROWS))
    text = console.export_text()
    assert "x [1] | y" in text
    assert "cannot be" in text
    assert max(map(len, text.splitlines())) <= 120
