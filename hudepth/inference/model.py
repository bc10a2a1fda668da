"""A model to predict with: ``hudepth.load`` returns one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, overload

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import nn

from hudepth.base.camera import CameraChoice, CameraLike, CameraOption, Intrinsics
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.images import Photo
from hudepth.base.machine import torch_device, usable_cores
from hudepth.base.options import Range, Size, parse
from hudepth.inference.backends import EXPORTED, Backend, BackendName, Precision, TorchBackend, open_exported
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.image_fit import Fit, Fitted, camera_factor, fit_image, unfit_depth
from hudepth.inference.model_info import ModelInfo
from hudepth.inference.pictures import Picture, read_picture
from hudepth.inference.runtimes import OPENVINO_PRECISIONS
from hudepth.runs.checkpoint import load_checkpoint


class Prepared(NamedTuple):
    """A decoded image, and what the network sees of it."""

    photo: Photo
    fitted: Fitted
    camera: Intrinsics
    factor: float
    """By which depth is multiplied for this camera; 1 if it is only assumed."""


class Predicted(NamedTuple):
    """A prediction at the network's size [m]."""

    depth_m: Float[np.ndarray, "h w"]
    uncertainty_m: Float[np.ndarray, "h w"] | None = None
    """With ``flip``: half the difference from the prediction of the mirrored image."""


class DepthModel:
    """Predicts depth in metres from single images of any size; options as in :func:`load`."""

    def __init__(
        self, backend: Backend, *, fit: Fit = "stretch", flip: bool = False, camera: CameraLike | CameraChoice = "auto"
    ) -> None:
        self.backend, self.flip = backend, flip
        self.fit: Fit = fit
        self.camera = CameraChoice.of(camera)

    @property
    def info(self) -> ModelInfo:
        """Description of the model and its training."""
        return self.backend.info

    @property
    def network(self) -> nn.Module:
        """The network in the form in which it predicts: normalised images [b, 3, h, w] to depth / max_depth_m.

        Raises ConfigError for an exported file, which has none.
        """
        if not isinstance(self.backend, TorchBackend):
            raise ConfigError(f"checkpoint: {self.info.name} is an exported file. Load the run or bundle it is from.")
        network: nn.Module = self.backend.pipeline.net
        return network

    @overload
    def predict(self, image: list[Any], *, camera: CameraLike | None = None) -> list[DepthMap]: ...
    @overload
    def predict(self, image: Picture, *, camera: CameraLike | None = None) -> DepthMap: ...
    def predict(self, image: Picture | list[Any], *, camera: CameraLike | None = None) -> DepthMap | list[DepthMap]:
        """Predict the depth of one image, at its own size, or of a list of images, one after the other.

        ``camera`` is as in :func:`load`, by default the model's. Raises DataError if an image cannot be read,
        ConfigError if the camera cannot have taken it.
        """
        if isinstance(image, list):
            return [self.predict(each, camera=camera) for each in image]
        prepared = self.prepare(image, camera=camera)
        return self.finish(prepared, self.run([prepared])[0])

    def predict_many(self, images: Iterable[Picture], *, batch_size: int = 1) -> list[DepthMap]:
        """Predict the depth of several images, ``batch_size`` at a time; raises DataError if one cannot be read."""
        prepared = [self.prepare(image) for image in images]
        found = [p for at in range(0, len(prepared), batch_size) for p in self.run(prepared[at : at + batch_size])]
        return [self.finish(each, predicted) for each, predicted in zip(prepared, found, strict=True)]

    def prepare(self, image: Picture, *, camera: CameraLike | None = None) -> Prepared:
        """Decode an image and resize it to the network's input; see :meth:`predict`."""
        photo = read_picture(image)
        fitted = fit_image(photo.rgb, self.info.size, fit=self.fit, aspect=self.info.aspect)
        size = (photo.rgb.shape[0], photo.rgb.shape[1])
        choice = self.camera if camera is None else CameraChoice.of(camera)
        known, training = choice.of_picture(*size, photo.camera), self.info.training_focal
        if known is not None:
            return Prepared(photo, fitted, known, camera_factor(known, fitted, size, training) if training else 1.0)
        assumed = self.info.assumed_camera(*size)
        if choice.kind == "auto" and photo.camera:
            assumed = replace(assumed, origin=f"{assumed.origin}, since {photo.camera}")
        return Prepared(photo, fitted, assumed, 1.0)

    def run(self, batch: Sequence[Prepared]) -> list[Predicted]:
        """Predict at the network's size; raises CheckpointError if depth is not finite, or negative."""
        images = np.stack([each.fitted.rgb for each in batch])
        depth = self._depth(images)
        if not self.flip:
            return [Predicted(each) for each in depth]
        mirrored = self._depth(np.ascontiguousarray(images[:, :, ::-1]))[:, :, ::-1]
        mean: Float[np.ndarray, "b h w"] = (depth + mirrored) / np.float32(2)
        return [Predicted(*each) for each in zip(mean, np.abs(depth - mean), strict=True)]

    def _depth(self, images: UInt8[np.ndarray, "b h w 3"]) -> Float[np.ndarray, "b h w"]:
        depth = self.backend(images)
        if not 0 <= float(depth.min()) <= float(depth.max()) < np.inf:  # also NaN
            why = "its depths are not finite and positive, so its weights are damaged. Pass another model."
            raise CheckpointError(f"checkpoint: {self.info.name}: {why}")
        return depth

    def finish(self, prepared: Prepared, predicted: Predicted) -> DepthMap:
        """Resize the network's depth to the image's size, in the metres of its camera."""
        rgb = prepared.photo.rgb

        def at_size(map_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "H W"]:
            metres = unfit_depth(map_m, prepared.fitted.box, (rgb.shape[0], rgb.shape[1]))
            return metres if prepared.factor == 1 else metres * np.float32(prepared.factor)

        metres = at_size(predicted.depth_m)
        uncertainty = None if predicted.uncertainty_m is None else at_size(predicted.uncertainty_m)
        limit = self.info.farthest_m * prepared.factor
        return DepthMap(metres, rgb, limit, prepared.photo.notes, prepared.camera, prepared.factor, uncertainty)


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Which model predicts, and how; see :func:`load`."""

    checkpoint: str
    runs: Path = Path("runs")
    backend: BackendName = "auto"
    device: str = "auto"
    precision: Precision = "float32"
    threads: Annotated[int, Range(1)] | None = None
    size: Size | None = None
    fit: Fit = "stretch"
    flip: bool = False
    camera: CameraOption = "auto"
    trust: list[str] = field(default_factory=list)


def load(
    spec: str | Path,
    *,
    backend: str = "auto",
    device: str = "auto",
    precision: str = "float32",
    threads: int | None = None,
    size: tuple[int, int] | int | None = None,
    fit: str = "stretch",
    flip: bool = False,
    camera: CameraLike = "auto",
    trust: Iterable[str] = (),
    runs: str | Path = "runs",
) -> DepthModel:
    """Load a model to predict with.

    Args:
        spec: ``nyu`` or ``nyu_lite`` (bundled pretrained models), ``hf:owner/name`` (from the Hugging Face Hub), a
            checkpoint, run directory, bundle (folder or zip), exported ``.onnx``, ``.xml`` or ``.pt2`` file, or
            ``last`` for the newest run.
        backend: what runs an exported file: ``onnxruntime``, ``openvino``, ``torch``, or ``auto``.
        device: ``cpu``, ``cuda``, ``mps``, or ``auto`` (a GPU if there is one); for checkpoints only.
        precision: ``float32``, or faster but not exact: ``bfloat16`` on an NVIDIA GPU or in OpenVINO, ``float16`` on an
            NVIDIA GPU.
        threads: to compute with on a CPU; default: the cores this process may use.
        size: (height, width) of the network's input; default: that of its training. Exported files have a fixed one.
        fit: ``stretch`` or ``letterbox``.
        flip: average with the mirrored image's prediction: a little better, twice the time.
        camera: which took the images: ``auto`` (what EXIF states in a file, else the camera of the training images),
            ``training`` (always that), ``fov=62`` (horizontal field of view [degrees]), ``f35=26`` (focal length for
            35 mm film [mm]), ``f=1450`` (focal length [pixels]), (fx, fy, cx, cy) in pixels of the image, or a 3 x 3
            camera matrix. Depth is scaled for any other camera than that of the training.
        trust: further packages whose classes a checkpoint may name; ``pt2`` to load a ``.pt2`` file.
        runs: where ``last`` looks.

    Raises CheckpointError if it is missing, damaged, not trusted or not a model of hudepth, ConfigError for options.
    """
    values = {
        "checkpoint": str(spec), "backend": backend, "device": device, "precision": precision, "threads": threads,
        "size": size, "fit": fit, "flip": flip, "runs": runs,
        "camera": camera if isinstance(camera, str) else Intrinsics.of(camera).numbers,
        "trust": trust if isinstance(trust, str) else list(trust),
    }  # fmt: skip
    return load_model(parse(ModelOptions, values))


def load_model(chosen: ModelOptions) -> DepthModel:
    """Load the model that the options name; raises as :func:`load` does."""
    how: Any = {"fit": chosen.fit, "flip": chosen.flip, "camera": CameraChoice.of(chosen.camera)}
    path, threads = Path(chosen.checkpoint).expanduser(), chosen.threads or usable_cores()
    if path.suffix.lower() in EXPORTED and not path.is_dir():
        if chosen.size is not None:
            raise ConfigError(f"size: '{path.name}' has a fixed size. Leave size out.")
        if chosen.device not in ("auto", "cpu"):
            raise ConfigError(f"device={chosen.device}: exported files run on the CPU. Pass their checkpoint instead.")
        if not path.is_file():
            wanted = "a checkpoint, run directory, bundle or exported file"
            raise ConfigError(f"checkpoint: no file '{path}'. Pass {wanted}.")
        torch.set_num_threads(threads)
        graph = open_exported(
            path, backend=chosen.backend, threads=threads, trust=chosen.trust, precision=chosen.precision
        )
        return DepthModel(graph, **how)
    export = f"hudepth-export checkpoint={chosen.checkpoint} format=openvino"
    if chosen.backend not in ("auto", "torch"):
        raise ConfigError(f"backend={chosen.backend}: needs an exported file. Run {export} first.")
    device = torch_device(chosen.device)
    if chosen.precision != "float32" and device.type != "cuda":
        also = f", or run {export} first" if chosen.precision in OPENVINO_PRECISIONS else ""
        raise ConfigError(f"precision={chosen.precision}: needs an NVIDIA GPU. Pass precision=float32{also}.")
    if device.type == "cpu":
        torch.set_num_threads(threads)
    checkpoint = load_checkpoint(chosen.checkpoint, runs=chosen.runs)
    backend = TorchBackend.of_checkpoint(
        checkpoint, device=device, trust=chosen.trust, size=chosen.size, precision=chosen.precision
    )
    return DepthModel(backend, **how)
