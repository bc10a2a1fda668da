"""hudepth-predict: depth in metres for images, folders, videos or a camera."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
from omegaconf import DictConfig

from hudepth.base.camera import intrinsics
from hudepth.base.console import log, track
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.files import write_json
from hudepth.base.machine import usable_cores
from hudepth.base.options import output_folder, plain, several, whole_number
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.inputs import Inputs, Item, find_inputs
from hudepth.inference.model import DepthModel
from hudepth.inference.options import load_model
from hudepth.inference.stream import Stream, Tally
from hudepth.inference.video import FrameReader, VideoWriter
from hudepth.inference.writing import FORMATS, Style, write_depth

IMAGE_FORMATS, VIDEO_FORMATS, CAMERA_FORMATS = ["png16", "npy", "colour"], ["colour"], ["png16", "colour"]
"""What is written where nothing is said."""
PICTURES = {"colour": "_depth.mp4", "side": "_side.mp4"}
"""Formats that become a video where a video comes in, and how its name goes on."""


@dataclass(frozen=True)
class Job:
    """What is to be predicted, and how."""

    model: DepthModel
    output: Path
    formats: list[str] | None
    """None: what is usual for images, videos and cameras."""
    style: Style
    batch_size: int
    overlap: bool
    """Whether files are decoded and written while the network computes; see :class:`Stream`."""
    smoothing: float
    frames: int | None
    """Of each video or camera; None: all."""
    tally: Tally = field(default_factory=Tally)


def predict(cfg: DictConfig) -> None:
    """Predict all there is, then say what could not be.

    Args:
        cfg: what conf/predict.yaml and the command line compose to.

    Raises:
        HudepthError: with one line for the user; after everything else is done, if some input could not be read.
    """
    config = plain(cfg)
    inputs = find_inputs(str(config["input"]), recursive=bool(config["recursive"]))
    job = _job(config, inputs)
    start = time.monotonic()
    try:
        if inputs.images:
            _predict_images(job, inputs.images)
        for video in inputs.videos:
            _predict_frames(job, video.path, job.output / video.stem, VIDEO_FORMATS)
        if inputs.camera is not None:
            _predict_frames(job, inputs.camera, job.output / f"camera{inputs.camera}", CAMERA_FORMATS)
    except OSError as error:
        raise ConfigError(
            f"output: cannot write to '{job.output}' ({error.strerror or error}); {job.tally.done} were predicted. "
            "Make space or pass another output=<folder>."
        ) from error
    finally:
        _report(job, config, seconds=time.monotonic() - start)
    failed = len(job.tally.failed)
    if failed:
        raise DataError(
            f"{failed} of {failed + job.tally.done} could not be predicted, see above; the rest is in '{job.output}'."
        )


def _job(config: dict[str, Any], inputs: Inputs) -> Job:
    """Check all options, and that the output folder can be written, before the model is loaded."""
    formats = None if config["formats"] is None else several("formats", config["formats"], FORMATS)
    smoothing, camera = _smoothing(config["smoothing"]), intrinsics(config["intrinsics"])
    frames = None if config["frames"] is None else whole_number(config, "frames", default=1, least=1)
    output = _not_the_input(output_folder(config["output"]), inputs)
    model = load_model(config)
    _say(model)
    cv2.setNumThreads(1)  # decoding and writing have threads of their own
    return Job(
        model,
        output,
        formats,
        Style(_scale(config["scale_m"], model), camera),
        batch_size=_batch_size(config, model),
        overlap=_has_cores_to_spare(config, model),
        smoothing=smoothing,
        frames=frames,
    )


def _say(model: DepthModel) -> None:
    info = model.info
    log.info(
        "model: %s of %s parameters, trained on %s for %d epochs; %d x %d, up to %g m; %s, fit=%s",
        info.name, f"{info.parameters:,}", info.trained_on.get("source", "unknown data"), info.epoch,
        *info.size, info.max_depth_m, model.backend.name, model.fit,
    )  # fmt: skip


def _predict_images(job: Job, items: list[Item]) -> None:
    stems = {str(item.path): job.output / item.stem for item in items}

    def write(key: str, depth: DepthMap) -> None:
        write_depth(stems[key], depth, job.formats or IMAGE_FORMATS, job.style)

    stream: Stream[str] = Stream(job.model, write, tally=job.tally, batch_size=job.batch_size, overlap=job.overlap)
    pictures = ((str(item.path), item.path) for item in items)
    for _ in track(stream.run(pictures), total=len(items), what="predicting"):
        pass


def _predict_frames(job: Job, source: Path | int, stem: Path, usual: list[str]) -> None:
    """Predict frames: pictures of a video become a video, all else a folder of files a frame."""
    try:
        reader = FrameReader(source)
    except DataError as error:
        job.tally.failed[str(source)] = str(error)
        return
    formats = job.formats or usual
    pictures = [name for name in formats if name in PICTURES and not isinstance(source, int)]
    files = [name for name in formats if name not in pictures]
    with ExitStack() as stack:
        stack.callback(reader.close)
        videos = [stem.with_name(stem.name + PICTURES[name]) for name in pictures]
        writers = [stack.enter_context(VideoWriter(path, rate=reader.rate)) for path in videos]

        def write(frame: int, depth: DepthMap) -> None:
            for name, writer in zip(pictures, writers, strict=True):
                draw = depth.colourise if name == "colour" else depth.side_by_side
                writer.write(draw(scale_m=job.style.scale_m))
            if files:
                write_depth(stem / f"{frame:06d}", depth, files, job.style)

        # one thread keeps the frames in order
        stream: Stream[int] = Stream(job.model, write, tally=job.tally, smoothing=job.smoothing, workers=1)
        frames = islice(enumerate(reader), job.frames)
        total = job.frames or reader.expected or 0
        try:
            for _ in track(stream.run(frames), total=total, what=f"predicting {reader.name}"):
                pass
        except KeyboardInterrupt:
            log.info("%s: ended by Ctrl-C; what was predicted is kept", reader.name)
    if job.frames is None and (line := reader.shortfall()):
        job.tally.failed[str(source)] = f"{reader.name}: {line}."


def _report(job: Job, config: dict[str, Any], *, seconds: float) -> None:
    """Say what was done and what was not, and leave a file beside the results that states model, units and settings."""
    tally, info = job.tally, job.model.info
    for name, note in tally.notes.items():
        log.info("'%s': %s", name, note)
    for line in tally.failed.values():
        log.warning("%s", line)
    if not tally.done:
        return
    rate = tally.done / max(seconds, 1e-9)
    log.info("%d predicted in %.1f s (%.1f a second): %s", tally.done, seconds, rate, job.output.resolve())
    stated = {
        "model": {"name": info.name, "parameters": info.parameters, "epoch": info.epoch, **info.trained_on},
        "units": {"png16": "mm", "npy": "m", "ply": "m"},
        "network_size": list(info.size),
        "fit": job.model.fit,
        "max_depth_m": info.max_depth_m,
        "backend": job.model.backend.name,
        "settings": {key: config[key] for key in ("input", "intrinsics", "smoothing", "precision", "frames")},
        "scale_m": list(job.style.scale_m),
        "predicted": tally.done,
        "failed": tally.failed,
    }
    try:
        write_json(job.output / "predictions.json", stated)
    except OSError:
        log.warning("'%s' could not be written", job.output / "predictions.json")


def _not_the_input(output: Path, inputs: Inputs) -> Path:
    folders = {item.path.parent.resolve() for item in (*inputs.images, *inputs.videos)}
    if output.resolve() in folders:
        raise ConfigError(f"output: '{output}' is the folder of the input. Pass another, output=<folder>.")
    return output


def _on_gpu(model: DepthModel) -> bool:
    device = getattr(model.backend, "device", None)
    return device is not None and device.type != "cpu"


def _has_cores_to_spare(config: dict[str, Any], model: DepthModel) -> bool:
    return _on_gpu(model) or (config["threads"] is not None and config["threads"] < usable_cores())


def _batch_size(config: dict[str, Any], model: DepthModel) -> int:
    if config["batch_size"] is not None:
        return whole_number(config, "batch_size", default=1, least=1)
    return 16 if _on_gpu(model) else 1  # on CPUs larger batches are slower: caches overflow


def _smoothing(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1:
        raise ConfigError(f"smoothing: {value} is no share from 0 to less than 1. Pass smoothing=0.6, or 0 for none.")
    return float(value)


def _scale(value: Any, model: DepthModel) -> tuple[float, float]:
    if value is None:
        return 0.0, model.info.max_depth_m
    if isinstance(value, list) and len(value) == 2 and all(isinstance(end, int | float) for end in value):
        near, far = float(value[0]), float(value[1])
        if 0 <= near < far:
            return near, far
    raise ConfigError(f"scale_m: {value} is not two rising distances in metres. Pass scale_m=[0,10].")
