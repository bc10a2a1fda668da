"""hudepth-export: a checkpoint as files for other programs, each compared with it before it is kept."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import nn

from hudepth.base.console import log
from hudepth.base.errors import ConfigError
from hudepth.base.files import output_folder, write_json
from hudepth.base.machine import usable_cores
from hudepth.base.options import Choice, Range, Size, parse
from hudepth.base.wording import more_room
from hudepth.export.bundle import halve, write_bundle, zip_folder
from hudepth.export.card import HERE, model_card
from hudepth.export.comparison_images import ComparisonImages, find_images
from hudepth.export.graphs import INPUT, export_onnx, export_openvino, export_program
from hudepth.export.int8_accuracy import measure_int8
from hudepth.export.parity import Parity, check, compare
from hudepth.export.quantise import check_calibration, quantise
from hudepth.inference.backends import PT2, GraphBackend, TorchBackend, fast_form, open_exported
from hudepth.inference.model import DepthModel
from hudepth.inference.model_info import ModelInfo
from hudepth.inference.runtimes import onnx_session
from hudepth.runs import hub
from hudepth.runs.checkpoint import Checkpoint, load_checkpoint
from hudepth.runs.results import read_metrics

OWN = [PT2, "onnx", "xml"]  # files made here are read without suspicion
FORMATS = ("onnx", "onnx_any_size", "torch_export", "openvino", "int8", "bundle")


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of hudepth-export; conf/export.yaml explains them."""

    checkpoint: str
    runs: Path
    cache: str
    format: list[Annotated[str, Choice(FORMATS)]]
    output: str
    protocol: Mapping[str, Any]
    processing: bool = True
    size: Size | None = None
    tolerance_mm: Annotated[float, Range(0, above=True)] = 1.0
    images: str | None = None
    compared: Annotated[int, Range(1)] = 50
    calibration: Annotated[int, Range(1)] = 128
    accuracy: bool = True
    half: bool = False
    zip: bool = False
    name: str | None = None
    push: str | None = None
    private: bool = False
    data: Mapping[str, Any] = field(default_factory=dict)
    trust: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Work:
    """What all formats are made from."""

    options: ExportOptions
    checkpoint: Checkpoint
    net: nn.Module  # in the form in which it runs
    reference: TorchBackend  # the network as trained, with which exports are compared
    info: ModelInfo
    images: ComparisonImages
    output: Path
    folder: Path  # where files are made before they are checked

    def onnx(self, info: ModelInfo) -> Path:
        """Return an ONNX file, from which other formats start, with or without processing as ``info`` states."""
        path = self.folder / f"processing_{info.processing}.onnx"
        if not path.exists():
            export_onnx(self.net, path, info=info)
        return path

    def compare(self, path: Path, *, backend: str) -> Parity:
        """Compare a file with the checkpoint; raises CheckpointError if it differs by more than the tolerance."""
        opened = open_exported(path, backend=backend, threads=usable_cores(), trust=OWN)
        parity = compare(opened, self.reference, self.images.compared)
        check(parity, what=path.name, tolerance_mm=self.options.tolerance_mm)
        return parity

    def keep(self, *paths: Path, parity: Parity) -> dict[str, Any]:
        """Move checked files to the output folder; return their entry in export.json."""
        for path in paths:
            path.replace(self.output / path.name)
        log.info("%s: %s", self.output / paths[0].name, parity)
        return {"files": [path.name for path in paths], "compared": asdict(parity)}


def export(config: dict[str, Any]) -> None:
    """Export a checkpoint as conf/export.yaml states; raises HudepthError, and keeps formats exported before it."""
    options = parse(ExportOptions, {**config, **config["paths"]})
    if "int8" in options.format:
        check_calibration(options.calibration)
    checkpoint = load_checkpoint(options.checkpoint, runs=options.runs)
    trained = checkpoint.build_net(trust=options.trust)
    parameters = sum(each.numel() for each in trained.parameters())
    info = ModelInfo.of_checkpoint(checkpoint, parameters=parameters, size=options.size)
    torch.set_num_threads(usable_cores())
    net = fast_form(trained, size=info.size)
    reference = TorchBackend(trained, info, device=torch.device("cpu"))
    images = find_images(
        checkpoint, folder=options.images, size=info.size, compared=options.compared,
        calibration=options.calibration if "int8" in options.format else 1,  # only int8 needs them
        data={"cache": options.cache, **options.data}, trust=options.trust,
    )  # fmt: skip
    output = output_folder(options.output)
    _check_bundle(checkpoint, options)  # before minutes of work
    log.info("model: %s; compared on %d %s", info, len(images.compared), images.origin)
    info = replace(info, processing=options.processing)
    record: dict[str, Any] = {}
    try:
        with tempfile.TemporaryDirectory(prefix=f".export-{os.getpid()}-", dir=output) as folder:
            work = Work(options, checkpoint, net, reference, info, images, output, Path(folder))
            for name in options.format:
                record[name] = MAKERS[name](work)
    except OSError as error:
        reason = error.strerror or error
        raise ConfigError(f"output: cannot write to '{output}' ({reason}). {more_room(error)}.") from error
    finally:
        if record:
            write_json(output / "export.json", {"images": images.origin, **record})


def _onnx(work: Work) -> dict[str, Any]:
    path = Path(shutil.copyfile(work.onnx(work.info), work.folder / "model.onnx"))
    return work.keep(path, parity=work.compare(path, backend="onnxruntime"))


def _onnx_any_size(work: Work) -> dict[str, Any]:
    """Compare at the network's size, where resizing changes nothing; elsewhere rounding to bytes decides."""
    path, info = work.folder / "model_any_size.onnx", replace(work.info, processing=True)
    export_onnx(work.net, path, info=info, any_size=True)
    session = onnx_session(path, threads=usable_cores())
    opened = GraphBackend("onnxruntime", info, lambda rgb: session.run(None, {INPUT: rgb})[0])
    parity = compare(opened, work.reference, work.images.compared)
    check(parity, what=path.name, tolerance_mm=work.options.tolerance_mm)
    return work.keep(path, parity=parity)


def _torch_export(work: Work) -> dict[str, Any]:
    path = work.folder / "model.pt2"
    export_program(work.net, path, info=work.info)
    return work.keep(path, parity=work.compare(path, backend="torch"))


def _openvino(work: Work) -> dict[str, Any]:
    path = work.folder / "model.xml"
    export_openvino(work.onnx(work.info), path, info=work.info)
    return work.keep(path, path.with_suffix(".bin"), parity=work.compare(path, backend="openvino"))


def _int8(work: Work) -> dict[str, Any]:
    options, images = work.options, work.images
    check_calibration(len(images.calibration))
    path, info = work.folder / "model_int8.xml", replace(work.info, processing=True)
    quantise(work.onnx(info), path, info=info, images=images.calibration)
    quantised = open_exported(path, backend="openvino", threads=usable_cores(), trust=OWN)
    parity = compare(quantised, work.reference, images.compared)
    accuracy: dict[str, Any] = {}
    if options.accuracy and images.datamodule is not None:
        accuracy = measure_int8(
            work.checkpoint, work.reference, quantised, images.datamodule,
            protocols=options.protocol, trust=options.trust,
        )  # fmt: skip
    elif options.accuracy:
        log.warning("int8: its loss of accuracy was not measured, since the checkpoint's data is not here.")
    kept = work.keep(path, path.with_suffix(".bin"), parity=parity)
    return {**kept, "calibrated_on": len(images.calibration), "accuracy": accuracy}


def _bundle(work: Work) -> dict[str, Any]:
    options, images = work.options, work.images
    name, info = _bundle_name(work.checkpoint, options), replace(work.info, processing=True)
    if options.half:
        kept, onnx = halve(work.checkpoint), None
        halved = TorchBackend(kept.build_net(trust=options.trust), work.info, device=torch.device("cpu"))
        parity = compare(halved, work.reference, images.compared)
    else:
        kept, onnx = work.checkpoint, work.onnx(info)
        parity = work.compare(onnx, backend="onnxruntime")
    model = DepthModel(work.reference)
    samples = [model.predict(image) for image in images.compared[:: max(1, len(images.compared) // 3)][:3]]
    run = work.checkpoint.run
    files = sorted((run / "test").glob("*/metrics.json")) if run else []
    results = {file.parent.name: read_metrics(file) for file in files}
    folder = work.folder / name
    card = model_card(
        work.checkpoint, info, name=name, results=results, parity=str(parity), half=options.half,
        samples=len(samples), origin=images.origin, trust=options.trust,
        address=f"{hub.PREFIX}{options.push}" if options.push else HERE,
    )  # fmt: skip
    write_bundle(folder, kept, info=info, onnx=onnx, card=card, results=results, samples=samples)
    if options.zip:
        zip_folder(folder, work.folder / f"{name}.zip")
        folder = work.folder / f"{name}.zip"
    record = work.keep(folder, parity=parity)
    if options.push:
        record["published"] = hub.push(work.output / name, options.push, private=options.private)
        log.info("published: %s; use it as checkpoint=%s%s", record["published"], hub.PREFIX, options.push)
    return record


MAKERS: dict[str, Callable[[Work], dict[str, Any]]] = {
    "onnx": _onnx, "onnx_any_size": _onnx_any_size, "torch_export": _torch_export, "openvino": _openvino,
    "int8": _int8, "bundle": _bundle,
}  # fmt: skip


def _check_bundle(checkpoint: Checkpoint, options: ExportOptions) -> None:
    if "bundle" in options.format:
        _bundle_name(checkpoint, options)
    if options.push:
        if "bundle" not in options.format or options.zip:
            raise ConfigError("push: the Hub takes a bundle's folder. Pass format=bundle zip=false.")
        hub.check_login(options.push)


def _bundle_name(checkpoint: Checkpoint, options: ExportOptions) -> str:
    config = checkpoint.config
    name = str(options.name or config.get("name") or config["model"]["_target_"].split(".")[-1])
    if name != Path(name).name or name.startswith("."):
        raise ConfigError(f"name: '{name}' cannot name a folder. Pass name=my_model.")
    folder = Path(options.output).expanduser() / name
    if not options.zip and folder.exists():
        raise ConfigError(f"'{folder}' exists. Remove it, or pass another name= or output=.")
    return name
