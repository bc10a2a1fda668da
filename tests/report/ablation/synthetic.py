"""Sweep folders without a training: what finished runs leave behind, from numbers made up."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hudepth.metrics.summary import ImageTable, per_image_csv, summarise

NAMES = (
    "abs_rel", "rmse", "log10", "delta1", "delta2", "delta3", "log_bias", "ssim", "edge_f1_0.25", "edge_f1_0.5",
)  # fmt: skip
CONFIG: dict[str, Any] = {
    "name": "x",
    "seed": 1,
    "monitor": "val/abs_rel",
    "data": {"_target_": "hudepth.data.datamodule.DepthDataModule", "size": [32, 48], "seed": 1, "root": "/nowhere"},
    "model": {"_target_": "hudepth.models.tiny.TinyUNet"},
    "loss": {"_target_": "hudepth.losses.badcl.BADCL", "boundary": 3.0, "smoothness": 1.0, "scaling": 1.0},
    "optim": {"_target_": "torch.optim.AdamW", "lr": 0.0001},
}
STAMP = {
    "name": "eigen", "resolution": "native", "crop": [45, 471, 41, 601], "averaging": "image",
    "silog": {"lambda": 1.0, "factor": 100.0},
}  # fmt: skip


def config(*, seed: int = 1, changes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a configuration; ``changes`` by dotted key, a whole group by its name."""
    found = deepcopy(CONFIG)
    found["seed"] = found["data"]["seed"] = seed
    found["name"] = f"run_{seed}"
    for key, value in (changes or {}).items():
        *parts, last = key.split(".")
        inner = found
        for part in parts:
            inner = inner[part]
        inner[last] = value
    return found


def image_table(
    *, seed: int = 0, shift: float = 0.0, images: int = 24, scenes: int = 8, names: tuple[str, ...] = NAMES
) -> ImageTable:
    """Return metrics of images that differ by image, the same in all tables, and by ``seed``; ``shift`` adds to all."""
    hard = np.random.default_rng(99).uniform(0.1, 0.5, (len(names), images))
    own = np.random.default_rng(seed).normal(0, 0.01, (len(names), images))
    return ImageTable(
        ids=[f"{i:05d}" for i in range(images)],
        scenes=[f"room_{i % scenes}" for i in range(images)],
        categories=["room"] * images,
        pixels=np.full(images, 100, dtype=np.int64),
        values={name: hard[row] + own[row] + shift for row, name in enumerate(names)},
    )


def make_run(
    path: Path,
    *,
    seed: int = 1,
    changes: Mapping[str, Any] | None = None,
    table: ImageTable | None = None,
    state: str = "finished",
    error: str | None = None,
    version: str = "0.1.0",
    document: Mapping[str, Any] | None = None,
    epochs: int = 3,
) -> Path:
    """Write a run directory; without a ``table`` it was never tested. ``document`` changes metrics.json."""
    path.mkdir(parents=True)
    (path / "config.yaml").write_text(yaml.safe_dump(config(seed=seed, changes=changes), sort_keys=False))
    status = {"state": state, "time": "2025-08-11T12:00:00+00:00", "pid": 1, **({"error": error} if error else {})}
    (path / "status.json").write_text(json.dumps(status))
    (path / "environment.json").write_text(json.dumps({"packages": {"hudepth": version, "torch": "2.6.0"}}))
    rows = [
        f"{e},{10 * e},{1 / e:.4f},{0.3 + seed / 100 + 0.2 / e:.4f},{0.8 - 0.2 / e:.4f}" for e in range(1, epochs + 1)
    ]
    (path / "metrics.csv").write_text("\n".join(["epoch,step,train/loss/total,val/abs_rel,val/delta1", *rows, ""]))
    if table is not None:
        write_test(path / "test" / "eigen", table, changes=document)
    return path


def write_test(folder: Path, table: ImageTable, *, changes: Mapping[str, Any] | None = None) -> None:
    """Write metrics.json and per_image.csv; ``changes`` by dotted key."""
    means = summarise(table, averaging="image")
    found: dict[str, Any] = {
        "metrics": {"model": {k: v if math.isfinite(v) else None for k, v in means.items()}},
        "protocol": deepcopy(STAMP),
        "images": len(table.ids),
        "data": {"source": "rooms", "fingerprint": "f" * 64, "encoding": None},
        "split": {"kind": "official", "sha256": "a" * 64, "counts": {"test": len(table.ids)}},
        "network_size": [32, 48],
        "max_depth_m": 10.0,
    }
    for key, value in (changes or {}).items():
        *parts, last = key.split(".")
        inner = found
        for part in parts:
            inner = inner[part]
        inner[last] = value
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(found))
    (folder / "per_image.csv").write_text(per_image_csv(table))


def write_sweep(folder: Path, jobs: list[dict[str, Any]], *, name: str = "losses") -> None:
    """Write sweep.yaml."""
    (folder / "sweep.yaml").write_text(yaml.safe_dump({"sweeps": {name: jobs}}, sort_keys=False))


def make_sweep(folder: Path, variants: Mapping[str, Mapping[str, Any]], *, seeds: int = 3, step: float = 0.05) -> Path:
    """Write a sweep of finished runs: each variant's metrics lie ``step`` above those of the one before it."""
    jobs = []
    for number, (variant, changes) in enumerate(variants.items()):
        for seed in range(1, seeds + 1):
            run = f"{variant}_s{seed}"
            make_run(
                folder / run,
                seed=seed,
                changes=changes,
                table=image_table(seed=10 * number + seed, shift=number * step),
            )
            jobs.append({"labels": {"variant": variant, "seed": str(seed)}, "run": run})
    write_sweep(folder, jobs)
    return folder
