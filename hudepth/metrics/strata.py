"""Where a depth network errs: by depth, by distance to a depth edge, by image region, by scene category.

Each group parts the valid pixels of an image; sums over a bin add up over images, and metrics are pooled over its
pixels.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from numpy.typing import NDArray
from torch import Tensor

from hudepth.base.masked import full_precision, widen
from hudepth.base.types import DepthMap, Mask
from hudepth.metrics.depth import DELTAS, MIN_DEPTH_M

DEPTH_EDGES_M = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Between bins of ground-truth depth; a depth on an edge belongs to the farther bin."""
EDGE_DISTANCES_PX = (2.0, 5.0, 10.0, 20.0, 40.0)
"""Between bins of distance to the nearest depth edge, in pixels of the scored ground truth."""
EDGE_RATIO = 1.1
"""Two neighbours form a depth edge where one is over this many times as far as the other."""
_SIDES = (("top", "middle", "bottom"), ("left", "centre", "right"))


def _labels(edges: Sequence[float], unit: str) -> list[str]:
    low = (0.0, *edges)
    return [*(f"{a:g}-{b:g} {unit}" for a, b in zip(low, edges, strict=False)), f"{edges[-1]:g} {unit} and more"]


STRATA: tuple[tuple[str, str], ...] = (
    *(("depth", label) for label in _labels(DEPTH_EDGES_M, "m")),
    *(("edge distance", label) for label in _labels(EDGE_DISTANCES_PX, "px")),
    *(("region", f"{row} {column}") for row in _SIDES[0] for column in _SIDES[1]),
)
"""Group and label of each bin, in order."""
STRATUM_SUMS = ("count", "abs_rel", "squared", "absolute", "delta1")
"""Columns of :func:`strata_sums`; the first is in pixels."""
MAX_CATEGORIES = 12
"""Scene categories that are listed by name."""
_SIZES = (len(DEPTH_EDGES_M) + 1, len(EDGE_DISTANCES_PX) + 1, 9)
"""Bins of each group."""
_CELLS = math.prod(_SIZES)


@dataclass(frozen=True)
class Stratum:
    """Metrics of a network on a part of the pixels; rmse and mae in metres."""

    group: str
    label: str
    images: int
    """How many images have a pixel of it."""
    share: float
    """Of the group's pixels, in [0, 1]."""
    abs_rel: float
    rmse: float
    mae: float
    delta1: float


def strata_sums(pred_m: DepthMap, target_m: DepthMap, valid: Mask) -> Float[Tensor, "b bins 5"]:
    """Sum errors of depths [m] over each bin of :data:`STRATA`, image by image; columns as in :data:`STRATUM_SUMS`."""
    pred, target = (torch.where(valid, full_precision(x), 1.0) for x in (pred_m, target_m))
    error = (pred - target).abs()
    positive = pred.clamp_min(MIN_DEPTH_M)
    close = torch.maximum(positive / target, target / positive) < DELTAS[0]
    terms = [error / target, error.square(), error, close]
    index = np.empty((len(valid), target[0].numel()), np.int64)
    for image, (mask, depth) in enumerate(zip(valid[:, 0].cpu().numpy(), target[:, 0].cpu().numpy(), strict=True)):
        index[image] = np.where(mask, _cells(depth, mask), _CELLS).ravel()
    index += (_CELLS + 1) * np.arange(len(index))[:, None]
    return _binned(torch.from_numpy(index).to(error.device), terms)


def _binned(index: Int[Tensor, "b n"], terms: Sequence[Shaped[Tensor, "b 1 h w"]]) -> Float[Tensor, "b bins k"]:
    """Sum over cells, then over the cells of each bin: one pass over the pixels serves all groups."""
    size, places = len(index) * (_CELLS + 1), index.flatten().long()
    weights = [widen(torch.ones_like(places)), *(widen(term).flatten() for term in terms)]
    # not bincount, whose weights have no deterministic form on GPUs
    empty = torch.zeros(size, dtype=weights[0].dtype, device=index.device)
    sums = torch.stack([empty.index_add(0, places, weight) for weight in weights], dim=-1)
    cells = sums.reshape(len(index), _CELLS + 1, -1)[:, :_CELLS].reshape(len(index), *_SIZES, -1)
    return torch.cat([cells.sum(dim=others) for others in ((2, 3), (1, 3), (1, 2))], dim=1)


def _cells(depth_m: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.int16]:
    """Return which combination of a bin of each group every pixel lies in, [h, w]."""
    height, width = depth_m.shape
    rows, columns = (3 * np.arange(size) // size for size in (height, width))
    cells: NDArray[np.int16] = (3 * rows[:, None] + columns).astype(np.int16)
    for edge in DEPTH_EDGES_M:
        cells += np.int16(_SIZES[1] * _SIZES[2]) * (depth_m >= edge)
    distance_px = edge_distance_px(depth_m, valid)
    for edge in EDGE_DISTANCES_PX:
        cells += np.int16(_SIZES[2]) * (distance_px >= edge)
    return cells


def edge_distance_px(depth_m: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return each pixel's distance to the nearest pixel at a depth edge, [h, w].

    A pixel is at an edge where it and a valid neighbour above, below or beside it differ by more than
    :data:`EDGE_RATIO`. Infinite if the image has no edge, which puts it in the last bin.
    """
    edge = np.zeros(depth_m.shape, np.bool_)
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        step = ((depth_m[a] > EDGE_RATIO * depth_m[b]) | (depth_m[b] > EDGE_RATIO * depth_m[a])) & valid[a] & valid[b]
        edge[a] |= step
        edge[b] |= step
    if not edge.any():
        return np.full(depth_m.shape, np.inf, np.float32)
    return np.asarray(cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def summarise_strata(sums: Float[Tensor, "n bins 5"], categories: Sequence[str]) -> list[Stratum]:
    """Turn the sums of a subset's images into metrics of each bin, pooled over its pixels; empty bins are left out.

    ``categories``: kind of scene of each image, empty where unknown. If any is known, the group ``category`` comes
    last: at most :data:`MAX_CATEGORIES`, most pixels first, the rest as ``other``.
    """
    rows = [(*STRATA[i], sums[:, i]) for i in range(len(STRATA))]
    if any(categories):
        # any group will do: each adds up to all valid pixels
        whole = sums[:, : len(DEPTH_EDGES_M) + 1].sum(dim=1)
        rows += [("category", label, whole[members]) for label, members in _by_category(whole[:, 0], categories)]
    pixels: dict[str, float] = {}
    for group, _, part in rows:
        pixels[group] = pixels.get(group, 0.0) + part[:, 0].sum().item()
    strata = []
    for group, label, part in rows:
        count, abs_rel, squared, absolute, delta1 = part.sum(dim=0).tolist()
        if count:
            strata.append(
                Stratum(
                    group=group, label=label, images=int((part[:, 0] > 0).sum()), share=count / pixels[group],
                    abs_rel=abs_rel / count, rmse=(squared / count) ** 0.5, mae=absolute / count, delta1=delta1 / count,
                )
            )  # fmt: skip
    return strata


def _by_category(pixels: Float[Tensor, " n"], categories: Sequence[str]) -> list[tuple[str, list[int]]]:
    members: dict[str, list[int]] = {}
    for image, category in enumerate(categories):
        members.setdefault(category or "unknown", []).append(image)
    ordered = sorted(members.items(), key=lambda item: -pixels[item[1]].sum().item())
    if len(ordered) <= MAX_CATEGORIES:
        return ordered
    shown, rest = ordered[: MAX_CATEGORIES - 1], ordered[MAX_CATEGORIES - 1 :]
    return [*shown, ("other", [image for _, images in rest for image in images])]


def strata_csv(rows: Sequence[Stratum]) -> str:
    """Return the rows as CSV, under the names of :class:`Stratum`'s fields."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(Stratum)])
    writer.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in astuple(row)] for row in rows)
    return text.getvalue()
