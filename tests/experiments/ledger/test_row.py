from __future__ import annotations

import pytest

from experiments.ledger.row import Row, not_measured


def test_a_row_takes_known_verdicts_only() -> None:
    with pytest.raises(AssertionError, match="plausible"):
        Row("key", "claim", "says", "measured", "how", "plausible")


def test_what_is_not_measured_says_why() -> None:
    row = not_measured("key", "claim", "says", why="pass --runs A", how="so")
    assert (row.measured, row.verdict) == ("not measured: pass --runs A", "not measured")
