"""Copy a benchmark's tables here, and write its figures at batch 1 and 8 between the markers of docs/deployment.md.

hudepth-bench checkpoint=<run> repeats=3 seconds=0.7 output=inference
python -m experiments.speed.inference_table inference
"""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path

from experiments.studies import to_webp
from hudepth.base.files import write_between

ROOT = Path(__file__).parents[2]

KEPT = ("bench.md", "bench.csv", "bench.json")
SHOWN = {
    "eager": "plain PyTorch", "channels_last": "channels-last", "default": "what `predict` and `test` use",
    "compile": "the same, `torch.compile`", "onnxruntime": "ONNX Runtime", "openvino": "OpenVINO",
    "openvino_bf16": "OpenVINO, bfloat16 (not exact)", "int8": "OpenVINO, int8 (not exact)",
}  # fmt: skip


def table(rows: list[dict[str, str]]) -> str:
    """Return the backends' figures as Markdown."""
    lines = [
        "| 224 x 224, two CPU cores | ms/image, batch 1 | x plain | ms/image, batch 8 | x plain |",
        "|---|---|---|---|---|",
    ]
    found = {(row["contender"], int(row["batch"])): row for row in rows if row["kind"] == "backend"}
    for name, words in SHOWN.items():
        cells = []
        for batch in (1, 8):
            row = found.get((name, batch))
            cells += [f"{float(row['ms_per_image']):.1f}", f"{float(row['times_eager']):.2f}"] if row else ["-", "-"]
        lines.append(f"| {words} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    target = ROOT / "experiments" / "speed" / "inference"
    target.mkdir(exist_ok=True)
    for name in KEPT:
        shutil.copyfile(Path(sys.argv[1]) / name, target / name)
    (target / "bench.webp").write_bytes(to_webp((Path(sys.argv[1]) / "bench.png").read_bytes()))
    with (target / "bench.csv").open(encoding="utf-8") as file:
        write_between(ROOT / "docs" / "deployment.md", "speed", table(list(csv.DictReader(file))))
