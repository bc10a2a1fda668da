from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from PIL import Image

from hudepth.bench.plot import draw_bench, save_bench
from hudepth.bench.rows import Row

EAGER = Row(
    "eager", "backend", 224, 224, 1, 9, 10.0, 100.0, 90.0, 100.0, 120.0, 150.0, 1.0, 0.0, 300.0, 0.2, 9, 9.2, 92.0, 0.6
)
OPENVINO = replace(EAGER, contender="openvino", ms_per_image=50.0, p25_ms=49.0, p75_ms=51.0, times_eager=2.0)
PEER = replace(EAGER, contender="A $peer_", kind="peer", height=480, width=640, ms_per_image=900.0, p75_ms=950.0)


def test_a_line_a_backend_and_a_point_a_peer(tmp_path: Path) -> None:
    rows = [EAGER, replace(EAGER, batch=4, p25_ms=400, p75_ms=480), OPENVINO, PEER]
    backends, peers = draw_bench(rows, title="T").axes
    assert [text.get_text() for text in backends.get_legend().get_texts()] == ["eager", "openvino"]
    assert [text.get_text() for text in peers.get_yticklabels()] == [
        "this model, openvino", "this model, eager", "A $peer_, 480 x 640",
    ]  # fmt: skip
    points = [line.get_xdata()[0] for line in peers.lines if line.get_marker() == "o"]
    assert points == [50, 100, 900]
    save_bench(tmp_path / "bench.png", rows, title="T")
    assert Image.open(tmp_path / "bench.png").size[0] > 1000


def test_without_peers_there_is_one_plot() -> None:
    assert len(draw_bench([EAGER], title="T").axes) == 1
