"""Predictions of any model, read from a folder of depth maps: what ``hudepth-test predictions=`` scores."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hudepth.base.console import log
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.options import Range
from hudepth.base.types import Batch
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.encoding import PER_M
from hudepth.data.sources.base import Record
from hudepth.data.sources.decoding import read_depth
from hudepth.data.sources.pairing import walk_files
from hudepth.evaluation.pictures import evenly_spaced
from hudepth.metrics.alignment import align
from hudepth.metrics.protocol import Protocol

ALIGNMENT_OF = {"metric": "none", "affine_depth": "least_squares", "affine_disparity": "affine_inverse"}
"""By kind of prediction: the alignment that scores it, see :mod:`hudepth.metrics.alignment`."""
SUFFIXES = (".npy", ".pfm", ".png")
"""Files that are read; of several of one name the first kind is taken."""
ENDING = "_depth"
"""What ``hudepth-predict`` adds to a name; it may be missing."""
_SAMPLES = 16
_FAR_OFF, _OFF = 10.0, 2.0
"""Factors between the medians of predictions and truth that are refused, and warned of."""
_SMALLEST = 8
"""Times smaller than its image that a prediction may be: of a handful of pixels, any shape passes for the image's."""
_TELLING = 0.3  # correlation with the truth that says whether depth or its inverse was predicted


@dataclass(frozen=True, kw_only=True)
class PredictionOptions:
    """How files are read."""

    predictions: Path
    kind: Literal["metric", "affine_depth", "affine_disparity"] = "metric"
    """``metric``: depth; others are known up to a scale and a shift of each image: depth, or inverse depth."""
    per_m: Annotated[float, Range(0, above=True)] | None = None
    """Stored values per metre of metric depth; None: 1 in npy and PFM, 1000 in PNG."""


class FilePredictions(nn.Module):
    """One depth map per test pair, by its position in the store. Raises DataError if some are missing or make no sense.

    A pair's file is named by its id, or by its image, with or without folders, which may also be joined by ``_``.
    """

    def __init__(self, options: PredictionOptions, datamodule: DepthDataModule) -> None:
        super().__init__()
        if options.per_m is not None and options.kind != "metric":
            raise ConfigError(f"per_m: kind={options.kind} has no unit. Leave per_m out, or pass kind=metric.")
        self.options, self._store, self._size = options, datamodule.store, datamodule.size
        test = datamodule.split.test
        files = _find(options.predictions, [self._store.records[row] for row in test], self._store.records)
        self.files = dict(zip(test, files, strict=True))
        self._check([self._sample(row) for row in evenly_spaced(test, _SAMPLES)])

    @property
    def inverse(self) -> bool:
        """Whether they are inverse depths, up to scale and shift."""
        return self.options.kind == "affine_disparity"

    def stamp(self) -> dict[str, Any]:
        """Return what metrics.json states about them."""
        folder = str(self.options.predictions.resolve())
        return {"folder": folder, "kind": self.options.kind, "per_m": self.options.per_m, "files": len(self.files)}

    def protocol(self, protocol: Protocol) -> Protocol:
        """Return a protocol with the alignment that this kind needs; ConfigError if it does not fit them."""
        key = f"protocol={protocol.name}"
        if protocol.flip:
            fix = f"Pass protocol=eigen, or protocol.{protocol.name}.flip=false"
            raise ConfigError(f"{key} adds the prediction for the mirrored image, which files do not hold. {fix}.")
        needed = ALIGNMENT_OF[self.options.kind]
        if needed == "none" or protocol.alignment == needed:
            return protocol
        if protocol.alignment != "none":
            why = f"alignment={protocol.alignment} does not fit kind={self.options.kind}"
            raise ConfigError(f"{key}: {why}. Leave it out, or pass {needed}.")
        return replace(protocol, alignment=needed)

    def read(self, batch: Batch) -> list[Tensor]:
        """Return the predictions of a batch, [1, h, w] each, at the size of their files."""
        truths = batch.get("native_depth")
        rows, device = batch["index"].tolist(), batch["image"].device
        sizes = [None if truths is None else truths[i].shape[-2:] for i in range(len(rows))]
        return [torch.from_numpy(self._read(row, size))[None].to(device) for row, size in zip(rows, sizes, strict=True)]

    def beside(self, row: int, truth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a prediction [m] at the size of a truth [h, w] [m], aligned with it if its kind needs that."""
        height, width = truth_m.shape
        pred = cv2.resize(self._read(row, None), (width, height), interpolation=cv2.INTER_LINEAR)
        tensors = (torch.from_numpy(np.asarray(each, np.float32))[None, None] for each in (pred, truth_m))
        pred_m, target_m = tensors
        kind = ALIGNMENT_OF[self.options.kind]
        aligned = align(pred_m, target_m, target_m > 0, kind=kind, inverse=self.inverse)
        return np.asarray(aligned[0, 0].numpy(), np.float32)

    def _read(self, row: int, truth_size: Sequence[int] | None) -> NDArray[np.float32]:
        file = self.files[row]
        where = f"predictions: '{file}'"
        raw = read_depth(file, where=where)
        if raw.dtype.kind != "f" and raw.dtype.itemsize == 1:
            raise DataError(f"{where} holds 8-bit values, too coarse for depth. Save 16-bit PNG, or npy.")
        depth = raw.astype(np.float32)
        if not np.isfinite(depth).all():
            count = int(depth.size - np.isfinite(depth).sum())
            raise DataError(f"{where} is NaN or infinite at {count} of {depth.size} pixels. Fill them first.")
        self._check_size(depth.shape, truth_size, where)
        if self.options.kind != "metric":
            return depth
        per_m = self.options.per_m or (1000 if file.suffix.lower() == ".png" else 1)
        return depth / np.float32(per_m)

    def _check_size(self, found: Sequence[int], truth_size: Sequence[int] | None, where: str) -> None:
        """Refuse a prediction that cannot show the whole image (turned, cropped or padded), or that is tiny."""
        natives = [truth_size] if truth_size else self._store.info["native_sizes"]
        # less than a pixel of the prediction away from the image's shape: it was rounded to whole pixels
        alike = [size for size in natives if abs(found[0] * size[1] - found[1] * size[0]) < max(size)]
        if tuple(found) == self._size or any(max(found) * _SMALLEST >= max(size) for size in alike):
            return
        sizes = " or ".join(f"{height} x {width}" for height, width in (alike or natives)[:3])
        what = "less than an eighth of its image," if alike else "but its image is"
        raise DataError(
            f"{where} is {found[0]} x {found[1]}, {what} {sizes} (height x width). Resize it to that, "
            f"or pass data.size=[{found[0]},{found[1]}] if it shows the whole image."
        )

    def _sample(self, row: int) -> tuple[float, float, float, float]:
        """Return the medians of prediction and truth, their correlation, and the share of predictions of 0 and less."""
        if self._store.has_native:
            truth = self._store.read_native(row)
        else:
            truth = self._store.read([row])[1][0].astype(np.float32) / np.float32(self._store.per_m)
        size = truth.shape if self._store.has_native else None
        pred = cv2.resize(self._read(row, size), truth.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        p, t = pred[truth > 0], truth[truth > 0]
        if not p.size:
            return 0.0, 0.0, 0.0, 0.0
        covariance, spread = float(((p - p.mean()) * (t - t.mean())).mean()), float(p.std() * t.std())
        return float(np.median(p)), float(np.median(t)), covariance / (spread or 1.0), float(np.mean(p <= 0))

    def _check(self, sampled: Sequence[tuple[float, float, float, float]]) -> None:
        """Refuse or warn of predictions that are probably in another unit, or the inverse of what was stated."""
        kind, key = self.options.kind, f"predictions: kind={self.options.kind}"
        measured = np.array([each for each in sampled if each[1] > 0] or [(1.0, 1.0, 0.0, 0.0)])
        pred, truth, correlation, _ = np.median(measured, axis=0)
        if kind == "metric":
            ratio = float(pred / truth)
            text = f"{key}: they have a median of {pred:.3g} m where the truth has {truth:.3g} m. "
            text += f"Pass {self._likely_unit(ratio)}kind=affine_depth or affine_disparity if they are not in metres."
            if not 1 / _FAR_OFF < ratio < _FAR_OFF:
                raise DataError(text)
            if not 1 / _OFF < ratio < _OFF:
                log.warning("%s", text)
            if (empty := float(measured[:, 3].mean())) > 0:
                log.warning("%s: %.2g %% of them are 0 m or less, which counts as an error", key, 100 * empty)
        if (correlation if self.inverse else -correlation) > _TELLING:
            what, other = ("depth", "affine_depth or metric") if self.inverse else ("inverse depth", "affine_disparity")
            text = "%s: they look like %s (correlation with the truth %.2f). Pass kind=%s if so"
            log.warning(text, key, what, correlation, other)

    def _likely_unit(self, ratio: float) -> str:
        """Return the stored values per metre that would explain a ratio of medians, as a phrase; empty if none does."""
        png = next(iter(self.files.values())).suffix.lower() == ".png"
        now = self.options.per_m or (1000 if png else 1)
        off = {per_m: abs(np.log(now * ratio / per_m)) for per_m in {1, *PER_M.values()} - {now}} if ratio > 0 else {}
        best = min(off, key=lambda per_m: off[per_m], default=0)
        return f"per_m={best}, or " if off and off[best] < np.log(1.5) else ""


def _find(folder: Path, test: Sequence[Record], every: Sequence[Record]) -> list[Path]:
    """Return the file of each test pair; DataError if some have none, and a warning of files that are of no pair."""
    if not folder.is_dir():
        raise DataError(f"predictions: no folder '{folder}'. Pass predictions=<folder of npy or 16-bit png files>.")
    there = [path for path in walk_files(folder) if path.suffix.lower() in SUFFIXES]
    found = {f"{path.with_suffix('')}{path.suffix.lower()}": folder / path for path in there}
    shared = Counter(name for record in test for name in _names(record))
    names = ([f"{stem}{suffix}" for stem in _stems(record, shared) for suffix in SUFFIXES] for record in test)
    files = [next((found[name] for name in each if name in found), None) for each in names]
    if missing := [record for record, file in zip(test, files, strict=True) if file is None]:
        wanted = " or ".join(f"'{name}.npy'" for name in _names(missing[0])[:2])
        raise DataError(
            f"predictions: {len(missing)} of {len(test)} test pairs have no file in '{folder}', the first is "
            f"'{missing[0].id}': no {wanted}, nor .png. Predict them, or pass the data.split= they are of."
        )
    known = {stem for record in every for stem in _stems(record, Counter())}
    if strange := sorted(str(path) for path in there if path.with_suffix("").as_posix() not in known):
        text = "predictions: %d of %d files in '%s' are of no pair of the data, the first is '%s'; left out"
        log.warning(text, len(strange), len(there), folder, strange[0])
    return [file for file in files if file]


def _stems(record: Record, shared: Counter[str]) -> list[str]:
    """Return the names that a pair's file may have, without extension, and that no other pair's may."""
    return [f"{name}{ending}" for name in _names(record) if shared[name] <= 1 for ending in ("", ENDING)]


def _names(record: Record) -> list[str]:
    """Return the names a pair's file may have, without endings: by its id, by its image; each once."""
    image = Path(record.image).with_suffix("").as_posix() if record.image else record.id
    names = [record.id, record.id.replace("/", "_"), image, image.replace("/", "_"), image.rpartition("/")[2]]
    return list(dict.fromkeys(names))
