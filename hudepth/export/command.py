"""hudepth-export: a checkpoint as files for other programs, each compared with it before it is kept."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from torch import nn

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.files import write_json
from hudepth.base.machine import usable_cores
from hudepth.base.options import output_folder, plain, several, size_option, whole_number
from hudepth.export.accuracy import int8_accuracy
from hudepth.export.bundle import halved, write_bundle, zip_folder
from hudepth.export.card import model_card
from hudepth.export.graphs import export_onnx, export_openvino, export_program
from hudepth.export.images import ExportImages, export_images
from hudepth.export.parity import Parity, check, compare
from hudepth.export.quantise import check_calibration, quantise
from hudepth.inference.backends import PT2, TorchBackend, info_of, open_exported
from hudepth.inference.info import ModelInfo
from hudepth.inference.model import DepthModel
from hudepth.models.inference import inference_form
from hudepth.runs.checkpoint import Checkpoint, load_checkpoint

FORMATS = ("onnx", "torch_export", "openvino", "int8", "bundle")


@dataclass(frozen=True)
class Work:
    """What all formats need."""

    checkpoint: Checkpoint
    net: nn.Module
    """In the form it shall run."""
    reference: TorchBackend
    info: ModelInfo
    images: ExportImages
    config: dict[str, Any]
    folder: Path
    """Where files are made before they are known to be good."""

    def onnx(self) -> Path:
        """Return the ONNX file with the processing inside, made on first use: other formats start from it."""
        path = self.folder / "processed.onnx"
        if not path.exists():
            export_onnx(self.net, path, info=replace(self.info, processing=True))
        return path


def export(cfg: DictConfig) -> None:
    """Export a checkpoint in the formats asked for.

    Args:
        cfg: what conf/export.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user; formats that were good before it are kept.
    """
    config = plain(cfg)
    formats = several("format", config["format"], FORMATS)
    tolerance_mm = _tolerance(config["tolerance_mm"])
    for key in ("compared", "calibration"):
        whole_number(config, key, default=50, least=1)
    checkpoint = load_checkpoint(str(config["checkpoint"]), runs=config["paths"]["runs"])
    net = checkpoint.build_net(trust=config["trust"])
    info = info_of(checkpoint, parameters=sum(p.numel() for p in net.parameters()), size=size_option(config["size"]))
    reference = _backend(net, info)  # as it was trained: what is exported is held against that
    info = replace(info, processing=bool(config["processing"]))
    images = export_images(checkpoint, config, size=info.size)
    output = output_folder(config["output"])
    if "bundle" in formats:
        _bundle_name(checkpoint, config, output)  # not after minutes
    log.info(
        "%s of %s parameters, %d x %d; compared on %d %s",
        info.name, f"{info.parameters:,}", *info.size, len(images.compared), images.origin,
    )  # fmt: skip
    record: dict[str, Any] = {}
    try:
        with tempfile.TemporaryDirectory(prefix=".export-", dir=output) as made:
            work = Work(checkpoint, inference_form(net, size=info.size), reference, info, images, config, Path(made))
            for name in formats:
                record[name] = MAKERS[name](work, output, tolerance_mm)
    except OSError as error:
        raise ConfigError(f"output: cannot write to '{output}' ({error.strerror or error}). Make space.") from error
    finally:
        if record:
            write_json(output / "export.json", {"images": images.origin, **record})


def _onnx(work: Work, output: Path, tolerance_mm: float) -> dict[str, Any]:
    path = work.folder / "model.onnx"
    if work.info.processing:
        shutil.copyfile(work.onnx(), path)
    else:
        export_onnx(work.net, path, info=work.info)
    parity = _compared(work, path, backend="onnxruntime", tolerance_mm=tolerance_mm)
    return _keep([path], output, parity)


def _torch_export(work: Work, output: Path, tolerance_mm: float) -> dict[str, Any]:
    path = work.folder / "model.pt2"
    export_program(work.net, path, info=work.info)
    return _keep([path], output, _compared(work, path, backend="torch", tolerance_mm=tolerance_mm))


def _openvino(work: Work, output: Path, tolerance_mm: float) -> dict[str, Any]:
    path, onnx = work.folder / "model.xml", work.folder / "for_openvino.onnx"
    if work.info.processing:
        onnx = work.onnx()
    else:
        export_onnx(work.net, onnx, info=work.info)
    export_openvino(onnx, path, info=work.info)
    parity = _compared(work, path, backend="openvino", tolerance_mm=tolerance_mm)
    return _keep([path, path.with_suffix(".bin")], output, parity)


def _int8(work: Work, output: Path, _tolerance_mm: float) -> dict[str, Any]:
    check_calibration(len(work.images.calibration))
    path, info = work.folder / "model_int8.xml", replace(work.info, processing=True)
    quantise(work.onnx(), path, info=info, images=work.images.calibration)
    backend = open_exported(path, backend="openvino", threads=usable_cores(), trust=[], precision="float32")
    parity = compare(backend, work.reference, work.images.compared)
    accuracy: dict[str, Any] = {}
    if work.config["accuracy"] and work.images.datamodule is not None:
        accuracy = int8_accuracy(work.checkpoint, work.reference, backend, work.images.datamodule, config=work.config)
    elif work.config["accuracy"]:
        log.warning("int8: its loss of accuracy is not measured, since the checkpoint's data is not here.")
    kept = _keep([path, path.with_suffix(".bin")], output, parity)
    return {**kept, "calibrated_on": len(work.images.calibration), "accuracy": accuracy}


def _bundle(work: Work, output: Path, tolerance_mm: float) -> dict[str, Any]:
    name = _bundle_name(work.checkpoint, work.config, output)
    info = replace(work.info, processing=True)
    if work.config["half"]:
        kept = halved(work.checkpoint)
        net = kept.build_net(trust=work.config["trust"])
        onnx, parity = None, compare(_backend(net, work.info), work.reference, work.images.compared)
    else:
        kept, onnx = work.checkpoint, work.onnx()
        parity = _compared(work, onnx, backend="onnxruntime", tolerance_mm=tolerance_mm)
    model = DepthModel(work.reference)
    samples = [model.predict(image) for image in work.images.compared[:: max(1, len(work.images.compared) // 3)][:3]]
    results = _results(work.checkpoint)
    card = model_card(
        work.checkpoint, info, name=name, results=results, parity=str(parity), half=bool(work.config["half"]),
        samples=f"## Samples\n\n{_pictures(len(samples))}\n\nFrom the {work.images.origin}, not picked by "
        "hand. Left the image at the network's size, right its depth.",
    )  # fmt: skip
    folder = work.folder / name
    write_bundle(folder, kept, info=info, onnx=onnx, card=card, results=results, samples=samples)
    if work.config["zip"]:
        zip_folder(folder, work.folder / f"{name}.zip")
        return _keep([work.folder / f"{name}.zip"], output, parity)
    return _keep([folder], output, parity)


def _bundle_name(checkpoint: Checkpoint, config: dict[str, Any], output: Path) -> str:
    name = str(config["name"] or checkpoint.config.get("name") or checkpoint.config["model"]["_target_"].split(".")[-1])
    if not name or name != Path(name).name or name.startswith("."):
        raise ConfigError(f"name: '{name}' is no name for a folder. Pass name=my_model.")
    if not config["zip"] and (output / name).exists():
        raise ConfigError(f"'{output / name}' exists. Remove it, or pass another name= or output=.")
    return name


def _pictures(count: int) -> str:
    return "\n".join(f"![image and predicted depth](samples/{number}.jpg)" for number in range(count))


MAKERS: dict[str, Callable[[Work, Path, float], dict[str, Any]]] = {
    "onnx": _onnx, "torch_export": _torch_export, "openvino": _openvino, "int8": _int8, "bundle": _bundle,
}  # fmt: skip


def _compared(work: Work, path: Path, *, backend: str, tolerance_mm: float) -> Parity:
    opened = open_exported(path, backend=backend, threads=usable_cores(), trust=[PT2], precision="float32")
    parity = compare(opened, work.reference, work.images.compared)
    check(parity, what=path.name, tolerance_mm=tolerance_mm)
    return parity


def _keep(paths: list[Path], output: Path, parity: Parity) -> dict[str, Any]:
    """Move what is good to where it was asked for."""
    for path in paths:
        path.replace(output / path.name)
    log.info("%s: %s", output / paths[0].name, parity)
    return {
        "files": [path.name for path in paths],
        "compared": {"images": parity.images, "worst_mm": parity.worst_mm, "mean_mm": parity.mean_mm},
    }


def _results(checkpoint: Checkpoint) -> dict[str, dict[str, Any]]:
    """Return what the run's own tests wrote, by protocol."""
    if checkpoint.run is None:
        return {}
    files = sorted((checkpoint.run / "test").glob("*/metrics.json"))
    return {file.parent.name: json.loads(file.read_text(encoding="utf-8")) for file in files}


def _tolerance(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise ConfigError(f"tolerance_mm: {value} is no positive number of millimetres. Leave it out for 1.")
    return float(value)


def _backend(net: Any, info: ModelInfo) -> TorchBackend:
    import torch

    torch.set_num_threads(usable_cores())
    return TorchBackend(net, info, device=torch.device("cpu"))
