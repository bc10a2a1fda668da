"""hudepth-predict: depth in metres for images, folders, videos or a camera."""

from __future__ import annotations

import errno
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2

from hudepth.base.console import log, track
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.files import output_folder, write_json
from hudepth.base.machine import usable_cores
from hudepth.base.options import Choice, Range, parse
from hudepth.base.wording import more_room
from hudepth.inference.depth_files import FORMATS, Style, write_depth
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.inputs import Item, find_inputs
from hudepth.inference.model import DepthModel, ModelOptions, load_model
from hudepth.inference.stream import Stream, Tally
from hudepth.inference.video import FrameReader, VideoWriter

IMAGE_FORMATS, VIDEO_FORMATS, CAMERA_FORMATS = ["png16", "npy", "colour"], ["colour"], ["png16", "colour"]  # defaults
PICTURES = {"colour": "_depth", "side": "_side"}  # formats that make a video of a video, and what its name adds

MOST_WORKERS = 16  # threads that decode and write beside a GPU

_FOR_ALL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}  # what ends a run: a full or broken disk


@dataclass(frozen=True, kw_only=True)
class PredictOptions(ModelOptions):
    """Options of hudepth-predict; conf/predict.yaml explains them."""

    input: str | None = None
    output: str = "predictions"
    formats: list[Annotated[str, Choice(tuple(FORMATS))]] | None = None
    recursive: bool = False
    scale_m: Annotated[tuple[float, float], "two rising distances [near,far] in metres"] | Literal["auto"] = "auto"
    points: Annotated[int, Range(1)] | None = None
    edges: bool = False
    max_uncertainty: Annotated[float, Range(0, above=True)] | None = None
    smoothing: Annotated[float, Range(0, 1, below=True)] = 0.0
    frames: Annotated[int, Range(1)] | None = None
    batch_size: Annotated[int, Range(1)] | None = None

    def __post_init__(self) -> None:
        if self.scale_m != "auto" and not 0 <= self.scale_m[0] < self.scale_m[1]:
            near, far = self.scale_m
            raise ConfigError(f"scale_m: [{near:g},{far:g}] is not rising distances in metres. Pass scale_m=[0,10].")
        asks = "formats: uncertainty" if "uncertainty" in (self.formats or []) else ""
        if not self.flip and (asks := "max_uncertainty" if self.max_uncertainty else asks):
            raise ConfigError(f"{asks} needs the mirrored image's prediction, too. Pass flip=true.")

    @property
    def style(self) -> Style:
        """What pictures and point clouds have in common."""
        scale_m = None if self.scale_m == "auto" else self.scale_m
        return Style(scale_m, points=self.points, edges=self.edges, max_uncertainty=self.max_uncertainty)


@dataclass(frozen=True)
class Job:
    """A model, where its predictions go, and what has become of them so far."""

    model: DepthModel
    output: Path
    style: Style
    options: PredictOptions
    tally: Tally = field(default_factory=Tally)
    cameras: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By input, the camera it was predicted for; that of the first frame for a video."""

    @property
    def on_gpu(self) -> bool:
        """Whether the network does not compute on the CPU."""
        device = getattr(self.model.backend, "device", None)
        return device is not None and device.type != "cpu"

    @property
    def batch_size(self) -> int:
        """Images that go through the network together: one on a CPU, whose caches overflow with more."""
        return self.options.batch_size or (16 if self.on_gpu else 1)

    def note_camera(self, name: str, depth: DepthMap) -> None:
        """Record which camera an input was predicted for."""
        if name not in self.cameras and depth.camera is not None:
            camera = {"intrinsics": list(depth.camera.numbers), "origin": depth.camera.origin}
            self.cameras[name] = {**camera, "known": depth.camera.known, "depth_factor": depth.camera_factor}


def predict(config: dict[str, Any]) -> None:
    """Predict all inputs of conf/predict.yaml; raises HudepthError, for unreadable inputs once all others are done."""
    options = parse(PredictOptions, {**config, "runs": config["paths"]["runs"]})
    model = load_model(options)
    if not options.input:
        raise ConfigError("input is not set. Pass input=<image | folder | video | camera>.")
    inputs = find_inputs(options.input, recursive=options.recursive, output=Path(options.output).expanduser())
    output = output_folder(options.output)
    for line in inputs.left_out:
        log.info("%s", line)
    if output.resolve() in {item.path.parent.resolve() for item in (*inputs.images, *inputs.videos)}:
        raise ConfigError(f"output: '{output}' is the folder of the input. Pass another, output=<folder>.")
    log.info("model: %s; %s, fit=%s", model.info, model.backend.name, model.fit)
    cv2.setNumThreads(1)  # decoding and writing have threads of their own
    job = Job(model, output, options.style, options)
    start = time.monotonic()
    try:
        if inputs.images:
            _predict_images(job, inputs.images)
        for video in inputs.videos:
            try:
                _predict_frames(job, video.path, output / video.stem, VIDEO_FORMATS)
            except (DataError, OSError) as error:
                job.tally.failed[str(video.path)] = f"'{video.path}': {_own_fault(error)}"
        if inputs.camera is not None:
            _predict_frames(job, inputs.camera, output / f"camera{inputs.camera}", CAMERA_FORMATS)
    except OSError as error:
        rest = f"{job.tally.done} were predicted. {more_room(error)}, or pass another output=<folder>."
        raise ConfigError(f"output: cannot write to '{output}' ({error.strerror or error}); {rest}") from error
    finally:
        _report(job, seconds=time.monotonic() - start)
    if failed := len(job.tally.failed):
        rest = f"; the rest is in '{output}'" if job.tally.done else ""
        raise DataError(f"{failed} failed, in whole or in part, see above{rest}.")


def _predict_images(job: Job, items: list[Item]) -> None:
    options, stems = job.options, {str(item.path): job.output / item.stem for item in items}
    unwritten: dict[str, str] = {}

    def write(key: str, depth: DepthMap) -> None:
        job.note_camera(key, depth)
        try:
            write_depth(stems[key], depth, options.formats or IMAGE_FORMATS, job.style)
        except (DataError, OSError) as error:
            unwritten[key] = f"'{key}': {_own_fault(error)}"

    stream: Stream[str] = Stream(
        job.model,
        write,
        tally=job.tally,
        batch_size=job.batch_size,
        workers=max(2, min(usable_cores(), MOST_WORKERS)) if job.on_gpu else 2,  # a GPU outruns one that decodes
        overlap=job.on_gpu or (options.threads or usable_cores()) < usable_cores(),
    )
    for _ in track(stream.run((str(i.path), i.path) for i in items), total=len(items), what="predicting"):
        pass
    job.tally.failed.update(unwritten)
    job.tally.done -= len(unwritten)


def _own_fault(error: DataError | OSError) -> str:
    """Return why one input's results cannot be written; raises the error if no other's could either."""
    if isinstance(error, DataError):
        return str(error)
    if error.errno in _FOR_ALL:
        raise error
    return f"its results cannot be written ({error.strerror or error}). Pass another output=<folder>."


def _predict_frames(job: Job, source: Path | int, stem: Path, default: list[str]) -> None:
    """Predict frames: pictures of a video become a video, everything else a folder with files for each frame."""
    try:
        reader = FrameReader(source)
    except DataError as error:
        job.tally.failed[str(source)] = str(error)
        return
    formats, limit = job.options.formats or default, job.options.frames
    style = replace(job.style, scale_m=job.style.scale_m or (0.0, job.model.info.farthest_m))  # the same in all frames
    pictures = [name for name in formats if name in PICTURES and not isinstance(source, int)]
    files = [name for name in formats if name not in pictures]
    with ExitStack() as stack:
        stack.callback(reader.close)
        videos = [stem.with_name(stem.name + PICTURES[name]) for name in pictures]
        writers = [stack.enter_context(VideoWriter(path, rate=reader.rate)) for path in videos]

        def write(frame: int, depth: DepthMap) -> None:
            job.note_camera(str(source), depth)
            for name, writer in zip(pictures, writers, strict=True):
                draw = depth.colourise if name == "colour" else depth.side_by_side
                writer.write(draw(scale_m=style.scale_m))
            if files:
                write_depth(stem / f"{frame:06d}", depth, files, style)

        # one thread keeps the frames in order
        stream: Stream[int] = Stream(
            job.model, write, tally=job.tally, smoothing=job.options.smoothing, workers=1, batch_size=job.batch_size,
            overlap=job.on_gpu,
        )  # fmt: skip
        frames = stream.run(islice(enumerate(reader), limit))
        try:
            for _ in track(frames, total=limit or reader.expected or 0, what=f"predicting {reader.name}"):
                pass
        except KeyboardInterrupt:
            log.info("%s: stopped by Ctrl-C; finished predictions are kept", reader.name)
    for each in writers:
        if each.codec is not None:
            log.info("%s: %s", each.path.name, each.codec.words)
    if limit is None and (line := reader.shortfall()):
        job.tally.failed[str(source)] = f"{reader.name}: {line}."


def _report(job: Job, *, seconds: float) -> None:
    """Log what was done and what failed; record model, units and settings next to the results."""
    tally, info, options = job.tally, job.model.info, job.options
    for name, note in tally.notes.items():
        log.info("'%s': %s", name, note)
    for line in tally.failed.values():
        log.warning("%s", line)
    if not tally.done:
        return
    _report_cameras(job)
    rate = tally.done / max(seconds, 1e-9)
    log.info("%d predicted in %.1f s (%.1f per second): %s", tally.done, seconds, rate, job.output.resolve())
    record = {
        "model": {"name": info.name, "parameters": info.parameters, "epoch": info.epoch, **info.trained_on},
        "units": {"png16": "mm", "npy": "m", "uncertainty": "m", "ply": "m", "glb": "m"},
        "network_size": list(info.size), "fit": job.model.fit, "max_depth_m": info.max_depth_m,
        "calibration": info.calibration and asdict(info.calibration), "backend": job.model.backend.name,
        "settings": {
            "input": options.input, "camera": options.camera, "smoothing": options.smoothing,
            "precision": options.precision, "frames": options.frames, "max_uncertainty": options.max_uncertainty,
        },
        "cameras": job.cameras, "scale_m": options.scale_m, "predicted": tally.done, "failed": tally.failed,
    }  # fmt: skip
    try:
        write_json(job.output / "predictions.json", record)
    except OSError as error:
        log.warning("'%s' could not be written (%s)", job.output / "predictions.json", error.strerror or error)


def _report_cameras(job: Job) -> None:
    """Log which cameras the depths are for: the commonest three, and what to pass where one was assumed."""
    used = Counter((each["origin"], round(each["depth_factor"], 3)) for each in job.cameras.values())
    for (origin, factor), count in used.most_common(3):
        log.info("camera: %s; depth x %g (%d of %d)", origin, factor, count, len(job.cameras))
    if len(used) > 3:
        log.info("camera: %d others, see predictions.json", len(used) - 3)
    known, scaled = [each["known"] for each in job.cameras.values()], job.model.info.training_focal is not None
    if any(known) and not scaled:
        log.warning("camera: depth is not scaled, since that of this model's training or calibration is not known.")
    elif scaled and job.options.camera == "auto" and not all(known):
        log.info("camera: metres change with the field of view; state it with camera=fov=<degrees> or f35=<mm>")
