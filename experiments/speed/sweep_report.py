"""How long does a report of 500 runs take?

Makes a sweep of finished runs in a temporary folder, 100 variants with 5 seeds each, with files as large as those of
the NYU test set (654 images of 215 scenes, 23 metrics, 30 epochs), and writes its report in a fresh process.

    python experiments/speed/sweep_report.py [--variants 100] [--seeds 5]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

IMAGES, SCENES, EPOCHS = 654, 215, 30
NAMES = (
    "abs_rel", "sq_rel", "mse", "rmse", "rmse_log", "log10", "silog", "mae", "delta1", "delta2", "delta3", "log_bias",
    "ssim", "edge_precision_0.25", "edge_recall_0.25", "edge_f1_0.25", "edge_precision_0.5", "edge_recall_0.5",
    "edge_f1_0.5", "edge_f1_1", "si_boundary_f1", "dbe_acc_px", "dbe_comp_px",
)  # fmt: skip
CONFIG: dict[str, Any] = {
    "name": "x", "seed": 0, "monitor": "val/abs_rel",
    "data": {"_target_": "hudepth.data.datamodule.DepthDataModule", "size": [224, 224], "seed": 0, "split": "official"},
    "model": {"_target_": "hudepth.models.hybrid_unet.HybridUNet", "attention": "both", "attention_heads": 8},
    "loss": {"_target_": "hudepth.losses.badcl.BADCL", "boundary": 0.0, "smoothness": 0.0, "scaling": 1.0},
    "optim": {"_target_": "torch.optim.AdamW", "lr": 1e-4, "weight_decay": 0.01},
    "trainer": {"max_epochs": EPOCHS, "precision": "32-true", "gradient_clip_val": None},
    "callbacks": {"panels": 2, "early_stopping": None, "extra": []},
}  # fmt: skip
DOCUMENT: dict[str, Any] = {
    "protocol": {"name": "eigen", "averaging": "image", "silog": {"lambda": 1.0, "factor": 100.0}},
    "images": IMAGES,
    "data": {"source": "nyu_labeled", "fingerprint": "f" * 64},
    "split": {"kind": "official", "sha256": "a" * 64},
}


def make_sweep(folder: Path, *, variants: int, seeds: int) -> None:
    """Write the run directories and sweep.yaml."""
    rng = np.random.default_rng(0)
    hard = rng.uniform(0.1, 0.5, (IMAGES, len(NAMES)))
    keys = [f"{i:05d},room_{i % SCENES},room,200000," for i in range(IMAGES)]
    jobs = []
    for number in range(variants):
        weights = {"boundary": float(number % 10), "smoothness": number // 10 / 10}
        for seed in range(1, seeds + 1):
            run = folder / f"v{number:03d}_s{seed}"
            values = hard + 0.0005 * number + rng.normal(0, 0.01, (1, len(NAMES)))
            write_run(run, seed, weights, values, keys)
            jobs.append({"labels": {"variant": f"v{number:03d}", "seed": str(seed)}, "run": run.name})
    (folder / "sweep.yaml").write_text(yaml.safe_dump({"sweeps": {"speed": jobs}}, sort_keys=False))


def write_run(run: Path, seed: int, weights: dict[str, float], values: np.ndarray[Any, Any], keys: list[str]) -> None:
    test = run / "test" / "eigen"
    test.mkdir(parents=True)
    config = {**CONFIG, "seed": seed, "data": {**CONFIG["data"], "seed": seed}, "loss": {**CONFIG["loss"], **weights}}
    (run / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    (run / "status.json").write_text(json.dumps({"state": "finished"}))
    (run / "environment.json").write_text(json.dumps({"packages": {"hudepth": "0.1.0"}}))
    names = ("train/loss/total", "val/loss/total", "val/abs_rel", "val/rmse", "val/delta1")
    history = [
        ",".join(map(str, (e, e * 88, *(0.2 + 0.5 / e + 0.01 * k for k in range(5))))) for e in range(1, EPOCHS + 1)
    ]
    (run / "metrics.csv").write_text("\n".join([f"epoch,step,{','.join(names)}", *history, ""]))
    lines = [key + ",".join([f"{x:.9g}" for x in row]) for key, row in zip(keys, values.tolist(), strict=True)]
    (test / "per_image.csv").write_text("\n".join([f"id,scene,category,pixels,{','.join(NAMES)}", *lines, ""]))
    means = dict(zip(NAMES, values.mean(axis=0).tolist(), strict=True))
    (test / "metrics.json").write_text(json.dumps({**DOCUMENT, "metrics": {"model": means}}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variants", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "sweep"
        start = time.perf_counter()
        make_sweep(folder, variants=options.variants, seeds=options.seeds)
        print(f"made in {time.perf_counter() - start:.1f} s", file=sys.stderr)
        script = Path(sys.executable).parent / "hudepth-report"
        start = time.perf_counter()
        subprocess.run([script, "sweep", f"dir={folder}", "panels=0"], stdout=subprocess.DEVNULL, check=True)
        wall, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        size = (folder / "report" / "report.html").stat().st_size
    runs = options.variants * options.seeds
    print(
        f"{runs} runs of {IMAGES} images and {len(NAMES)} metrics: {wall:.1f} s from start to report.html, "
        f"{used.ru_utime + used.ru_stime:.1f} s of processor time, {used.ru_maxrss / 1024:.0f} MiB, "
        f"page of {size / 2**20:.1f} MiB"
    )
    print(f"load of the machine meanwhile: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")


if __name__ == "__main__":
    main()
