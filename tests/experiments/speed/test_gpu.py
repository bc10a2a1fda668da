"""The report on a GPU's use, on a machine without one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from experiments.speed import gpu


def test_what_there_is_no_time_for_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["gpu", "--output", str(tmp_path / "out"), "--seconds", "0"])
    gpu.main()
    content = json.loads((tmp_path / "out" / "gpu.json").read_text())
    assert content["rows"] == []
    assert any("badcl, batch 8: TimeoutError no time left" in line for line in content["missing"])
    assert "missing" in (tmp_path / "out" / "gpu.md").read_text()


@pytest.mark.parametrize("experiment", ["badcl", "strong"])
def test_the_bare_step_trains(experiment: str) -> None:
    step = gpu.bare_step(experiment, size=32, batch=2, device=torch.device("cpu"), bf16=False)
    assert gpu.rate(step, 2, seconds=0.01) > 0


def test_rows_without_a_gpu_have_bars_only_for_the_host(capsys: pytest.CaptureFixture[str]) -> None:
    report = gpu.Report(deadline=float("inf"), gpu=False)
    report.add("rate", 12.0, ">= 3")
    report.add("host time", 2.0, "<= 4", "ms")
    assert [row.bar for row in report.rows] == ["", "<= 4"]

    def broken() -> None:
        raise RuntimeError("first\nlast line")

    report.part("broken", broken)
    assert report.missing == ["broken: RuntimeError last line"]
    assert "host time: 2 ms (bar <= 4)" in capsys.readouterr().out
