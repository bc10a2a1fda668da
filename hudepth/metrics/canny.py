"""Edges of depth maps by Canny's detector, and distances between them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_CANNY_SCALE = 8000  # unit depth in int16: its Sobel response is at most 4 * 8000 < 2^15


def canny_edges(
    depth: NDArray[np.float32], valid: NDArray[np.bool_], *, sigma_px: float, low: float, high: float
) -> NDArray[np.bool_]:
    """Return edge pixels of a depth map [h, w] as in :func:`hudepth.metrics.boundary.depth_boundary_errors`.

    Invalid pixels may have any value.
    """
    if not valid.any():
        return np.zeros_like(valid)
    least, largest = depth.min(where=valid, initial=np.inf), depth.max(where=valid, initial=-np.inf)
    measured = valid.astype(np.float32)
    unit = (np.where(valid, depth, least) - least) / max(largest - least, np.finfo(np.float32).tiny)
    smooth, weight = (cv2.GaussianBlur(x, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE) for x in (unit, measured))
    levels = np.rint(smooth * _CANNY_SCALE / np.maximum(weight, 1e-6)).astype(np.int16)
    window = np.ones((3, 3), np.uint8)
    whole = cv2.erode(valid.astype(np.uint8), window)
    across, down = (cv2.Sobel(levels, cv2.CV_16S, *axes) * whole for axes in ((1, 0), (0, 1)))
    edges = cv2.Canny(across, down, low * _CANNY_SCALE, high * _CANNY_SCALE, L2gradient=True)
    # a gradient cut off at the mask has a maximum there, which is not an edge
    return np.asarray((edges > 0) & (cv2.erode(whole, window) > 0))


def chamfer_px(pred: NDArray[np.bool_], target: NDArray[np.bool_], *, reach_px: float) -> tuple[float, float]:
    """Return acc_px and comp_px of ``depth_boundary_errors`` between two edge maps [h, w]."""
    if not target.any():
        return np.nan, np.nan
    if not pred.any():
        return reach_px, reach_px
    to_target, to_pred = _nearest_px(pred, target), _nearest_px(target, pred)
    near = to_target[to_target < reach_px]
    accuracy = near.mean() if near.size else reach_px
    apart = np.minimum(np.concatenate([to_target, to_pred]), reach_px)
    return float(accuracy), float(apart.mean())


def _nearest_px(edges: NDArray[np.bool_], others: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance of each edge pixel to the nearest of the others."""
    distances = cv2.distanceTransform((~others).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # squared distances are whole numbers; OpenCV's last bit depends on where the array lies in memory
    return np.sqrt(np.rint(np.square(distances[edges].astype(np.float64))))
