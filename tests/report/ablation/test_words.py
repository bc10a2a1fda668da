"""The finding of a sweep, in words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from hudepth.report.ablation.words import finding
from tests.report.ablation.conftest import VARIANTS, worked_out
from tests.report.ablation.synthetic import make_sweep


@pytest.mark.parametrize(
    ("rows", "step", "words"),
    [
        (["paper"], 0.0, r"^paper has abs_rel 0\.\d{4}; there is no other row to compare it with\.$"),
        (["paper", "no_smooth"], -0.05, r"^no_smooth \(0\.\d{4}\) is better than paper \(0\.\d{4}\) in abs_rel\.$"),
        (["paper", "no_smooth"], 0.0, r"^No row is better than paper .* For no_smooth .* no difference is shown\.$"),
        (list(VARIANTS), -0.05, r"^si\|log & <b> \(.*\), neither \(.*\), no_scale \(.*\) and 1 more are better"),
        (list(VARIANTS), 0.05, r"^No row is better than paper \(.*\) in abs_rel\. si\|log .* and 1 more are worse\.$"),
    ],
)  # fmt: skip
def test_the_finding(rows: list[str], step: float, words: str, tmp_path: Path) -> None:
    folder = make_sweep(tmp_path / "sweep", {name: VARIANTS[name] for name in rows}, seeds=3, step=step)
    assert re.search(words, finding(worked_out(folder)))
