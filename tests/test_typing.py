"""What type checkers find in hudepth from a program outside the repository."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """\
import torch

import hudepth
from hudepth.base.camera import Intrinsics
from hudepth.data import NYUDepth
from hudepth.losses import BADCL
from hudepth.metrics import DepthMetrics
from hudepth.models import HybridUNet
from hudepth.training.module import DepthModule

model: hudepth.DepthModel = hudepth.load("nyu", device="cpu")
depth: hudepth.DepthMap = model.predict("photo.jpg", camera=Intrinsics(500.0, 500.0, 320.0, 240.0))
nearest: float = float(depth.metres.min())
pairs = NYUDepth("nyu", split="test")
net = HybridUNet(attention="both", output="sigmoid")
image = torch.rand(2, 3, 64, 64)
unit_depth: torch.Tensor = net(image)
loss = BADCL(boundary=3.0)(unit_depth, unit_depth.detach(), image, unit_depth > 0)
total: torch.Tensor = loss.total
metrics = DepthMetrics(averaging="pooled")
metrics.update(10 * unit_depth, 10 * unit_depth, unit_depth > 0)
print(nearest, len(pairs), total, loss.terms["depth"].item(), metrics.compute()["abs_rel"])
"""
WRONG = (
    "hudepth.lod('nyu')",
    "hudepth.load(3)",
    "hudepth.load('nyu').predict('photo.jpg').meters",
    "hudepth.metrics.Depthmetrics()",
    "hudepth.data.NYUDepth('nyu', split=3)",
    "loss.totals",
)
"""Mistakes that a checker can see only if it knows the types."""
CACHE = Path(__file__).parents[1] / ".mypy_cache"
"""Which ``make lint`` has filled."""
CHECKERS = {
    "mypy": [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", f"--cache-dir={CACHE}"],
    "pyright": [sys.executable, "-m", "pyright", "--pythonpath", sys.executable],
}


@pytest.mark.slow
@pytest.mark.parametrize("checker", CHECKERS)
def test_a_users_program_passes_and_its_mistakes_are_found(checker: str, tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(SCRIPT)
    (tmp_path / "wrong.py").write_text("\n".join([SCRIPT, *WRONG]))
    command = [*CHECKERS[checker], "program.py", "wrong.py"]
    done = subprocess.run(command, cwd=tmp_path, text=True, capture_output=True, check=False)
    found = re.findall(r"(\w+\.py):(\d+):.*error", done.stdout)
    first = SCRIPT.count("\n") + 2
    assert found == [("wrong.py", f"{first + i}") for i in range(len(WRONG))], done.stdout + done.stderr
