"""A model to predict with: ``hudepth.load`` returns one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image

from hudepth.base.errors import ConfigError
from hudepth.base.images import Photo, as_rgb, read_photo
from hudepth.base.machine import usable_cores
from hudepth.inference.backends import EXPORTED, Backend, check_backend, open_exported, torch_backend
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.fit import Fitted, check_fit, fit_image, unfit_depth
from hudepth.inference.info import ModelInfo
from hudepth.runs.checkpoint import load_checkpoint

Picture = str | Path | bytes | NDArray[Any] | Image.Image
"""An image: a path, the bytes of a file, an array (grey, RGB or RGBA of 8 or 16 bits), or a Pillow image."""


class Prepared(NamedTuple):
    """An image on its way to the network."""

    photo: Photo
    fitted: Fitted


class DepthModel:
    """Predicts depth in metres from single images of any size.

    Args:
        backend: what computes.
        fit: how an image comes to the network's size; see :data:`hudepth.inference.fit.FITS`.
        flip: average with the mirrored image's prediction, which takes twice the time.

    Raises:
        ConfigError: if there is no such fit.
    """

    def __init__(self, backend: Backend, *, fit: str = "stretch", flip: bool = False) -> None:
        self.backend, self.fit, self.flip = backend, check_fit(fit), flip

    @property
    def info(self) -> ModelInfo:
        """What the model is, and what it was trained on."""
        return self.backend.info

    def predict(self, image: Picture) -> DepthMap:
        """Predict the depth of one image, at its own size.

        Args:
            image: a path, the bytes of a file, an array [h, w(, channels)] or a Pillow image.

        Raises:
            DataError: if the image cannot be read.
        """
        prepared = self.prepare(image)
        return self.finish(prepared, self.run([prepared])[0])

    def predict_many(self, images: Iterable[Picture], *, batch_size: int = 1) -> list[DepthMap]:
        """Predict the depth of several images.

        Args:
            images: as :meth:`predict` takes them.
            batch_size: images that go through the network together.

        Raises:
            DataError: if one cannot be read.
        """
        prepared = [self.prepare(image) for image in images]
        depths = [d for at in range(0, len(prepared), batch_size) for d in self.run(prepared[at : at + batch_size])]
        return [self.finish(each, depth) for each, depth in zip(prepared, depths, strict=True)]

    def prepare(self, image: Picture) -> Prepared:
        """Decode an image and bring it to the network's size.

        Raises:
            DataError: if it cannot be read.
        """
        if isinstance(image, Image.Image):
            image = np.asarray(image if image.mode in ("L", "RGB", "RGBA") else image.convert("RGB"))
        photo = Photo(as_rgb(image), ()) if isinstance(image, np.ndarray) else read_photo(image)
        return Prepared(photo, fit_image(photo.rgb, self.info.size, fit=self.fit, aspect=self.info.aspect))

    def run(self, batch: Sequence[Prepared]) -> Float[np.ndarray, "b h w"]:
        """Return depth [m] at the network's size."""
        images = np.stack([each.fitted.rgb for each in batch])
        depth = self.backend(images)
        if not self.flip:
            return depth
        mirrored = self.backend(np.ascontiguousarray(images[:, :, ::-1]))[:, :, ::-1]
        mean: Float[np.ndarray, "b h w"] = (depth + mirrored) / np.float32(2)
        return mean

    def finish(self, prepared: Prepared, depth_m: Float[np.ndarray, "h w"]) -> DepthMap:
        """Bring the network's depth to the image's size."""
        rgb = prepared.photo.rgb
        metres = unfit_depth(depth_m, prepared.fitted.box, (rgb.shape[0], rgb.shape[1]))
        return DepthMap(metres, rgb, self.info.max_depth_m, prepared.photo.notes)


def load(
    spec: str | Path,
    *,
    backend: str = "auto",
    device: str = "auto",
    precision: str = "float32",
    threads: int | None = None,
    size: tuple[int, int] | None = None,
    fit: str = "stretch",
    flip: bool = False,
    trust: Iterable[str] = (),
    runs: str | Path = "runs",
) -> DepthModel:
    """Load a model to predict with.

    Args:
        spec: a checkpoint, run directory, bundle (folder or zip), exported ``.onnx``, ``.xml`` or ``.pt2`` file, or
            ``last`` for the newest run.
        backend: ``auto``, or what shall run an exported file: ``onnxruntime``, ``openvino`` or ``torch``.
        device: ``auto`` (a GPU if there is one), ``cpu``, ``cuda`` or ``mps``; checkpoints alone can choose.
        precision: ``float32``, or ``bfloat16`` in OpenVINO, which is faster and not exact.
        threads: to compute with on a CPU; the cores this process may use by default.
        size: (height, width) of the network's input; that of the training by default. Exported files have theirs.
        fit: ``stretch`` or ``letterbox``.
        flip: average with the mirrored image's prediction: a little better, twice the time.
        trust: further packages whose classes a checkpoint may name; ``pt2`` to load a ``.pt2`` file.
        runs: where ``last`` looks.

    Raises:
        CheckpointError: if it is missing, damaged, not trusted, or no model of hudepth's.
        ConfigError: if an option does not fit.
    """
    check_fit(fit)
    check_backend(backend, precision)
    count = usable_cores() if threads is None else threads
    if count < 1:
        raise ConfigError(f"threads: {count} is less than 1. Leave it out for {usable_cores()}.")
    path, names = Path(spec).expanduser(), list(trust)
    if path.suffix.lower() in EXPORTED and not path.is_dir():
        if size is not None:
            raise ConfigError(f"size: '{path.name}' has the size it was exported with. Leave it out.")
        if not path.is_file():
            raise ConfigError(
                f"checkpoint: no file '{path}'. Pass a checkpoint, run directory, bundle or exported file."
            )
        torch.set_num_threads(count)
        exported = open_exported(path, backend=backend, threads=count, trust=names, precision=precision)
        return DepthModel(exported, fit=fit, flip=flip)
    if backend not in ("auto", "torch") or precision != "float32":
        what = f"backend={backend}" if backend not in ("auto", "torch") else f"precision={precision}"
        raise ConfigError(
            f"{what}: needs an exported file. Run hudepth-export checkpoint={spec} format=openvino first."
        )
    where = _device(device)
    if where.type == "cpu":
        torch.set_num_threads(count)
    checkpoint = load_checkpoint(str(spec), runs=runs)
    return DepthModel(torch_backend(checkpoint, device=where, trust=names, size=size), fit=fit, flip=flip)


def _device(name: str) -> torch.device:
    there = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if name == "auto":
        name = next(kind for kind in ("cuda", "mps", "cpu") if there[kind])
    if not there.get(name):
        raise ConfigError(
            f"device: no '{name}' here. Pass device={' or '.join(k for k, is_there in there.items() if is_there)}."
        )
    return torch.device(name)
