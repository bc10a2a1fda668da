"""Write a bundle; :mod:`hudepth.runs.bundles` describes and reads them."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hudepth import __version__
from hudepth.inference.depth_map import DepthMap, jpeg
from hudepth.inference.model_info import ModelInfo
from hudepth.runs.bundles import CARD, CONFIG, KIND, ONNX, WEIGHTS
from hudepth.runs.checkpoint import VERSION, Checkpoint

PLACES = ("root", "cache")  # keys of data that name paths on the machine of the training; they are not published
PARTS = ("name", "seed", "model", "data", "loss", "optim", "schedule")  # of a run's configuration


def write_bundle(
    folder: Path,
    checkpoint: Checkpoint,
    *,
    info: ModelInfo,
    onnx: Path | None,
    card: str,
    results: Mapping[str, Mapping[str, Any]],
    samples: Sequence[DepthMap],
) -> None:
    """Write a bundle into a new folder; ``results`` are contents of ``metrics.json`` by protocol."""
    from safetensors.torch import save

    folder.mkdir(parents=True)
    state = {name: tensor.contiguous() for name, tensor in checkpoint.state.items()}
    (folder / WEIGHTS).write_bytes(save(state, metadata={"format": "pt", "hudepth": info.to_json()}))
    config = {key: checkpoint.config[key] for key in PARTS if key in checkpoint.config}
    if isinstance(config.get("model"), dict) and "weights" in config["model"]:
        config["model"] = {**config["model"], "weights": None}  # the encoder's initial weights, which may be a path
    if isinstance(config.get("data"), dict):
        config["data"] = {key: None if key in PLACES else value for key, value in config["data"].items()}
    record = {
        "kind": KIND, "version": VERSION, "hudepth": __version__, "epoch": checkpoint.epoch,
        "config": config, "split": checkpoint.split, "data": checkpoint.data,
    }  # fmt: skip
    (folder / CONFIG).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    if onnx is not None:
        shutil.copyfile(onnx, folder / ONNX)
    (folder / CARD).write_text(card, encoding="utf-8")
    for protocol, result in results.items():
        (folder / "metrics").mkdir(exist_ok=True)
        (folder / "metrics" / f"{protocol}.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    for number, sample in enumerate(samples):
        (folder / "samples").mkdir(exist_ok=True)
        (folder / "samples" / f"{number}.jpg").write_bytes(jpeg(sample.side_by_side()))


def halve(checkpoint: Checkpoint) -> Checkpoint:
    """Return a checkpoint whose kernels and matrices are 16-bit floats: half the size, about three digits.

    Norms and biases keep 32 bits: they are few, and variances may exceed the range of 16.
    """
    state = {name: tensor.half() if tensor.ndim > 1 else tensor for name, tensor in checkpoint.state.items()}
    return replace(checkpoint, state=state)


def zip_folder(folder: Path, path: Path) -> None:
    """Put a folder into a zip, under its own name, uncompressed, since weights do not compress."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, Path(folder.name) / file.relative_to(folder))
