from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from PIL import Image

from hudepth.bench.plot import draw_bench
from hudepth.viz.panels import save_figure
from tests.bench.test_rows import rows_of


def test_one_line_per_backend(tmp_path: Path) -> None:
    eager, openvino = rows_of(eager=0.1, openvino=0.05)
    rows = [openvino, eager, replace(eager, batch=4, p25_ms=400, p75_ms=480), replace(eager, kind="peer")]
    (axis,) = draw_bench(rows, title="T").axes
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["eager", "openvino"]
    save_figure(tmp_path / "bench.png", draw_bench(rows, title="T"))
    assert Image.open(tmp_path / "bench.png").size[0] > 1000
