"""Depth as points in space, and the PLY files that hold them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from hudepth.base.camera.intrinsics import Intrinsics


@dataclass(frozen=True)
class PointCloud:
    """Points in the camera's frame: x right, y down, z forward [m]."""

    points_m: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"] | None
    """RGB."""
    comment: str = ""

    def to_ply(self) -> bytes:
        """Return a binary PLY file (little-endian), whose comment states axes, unit and camera."""
        kinds = [(name, "<f4") for name in ("x", "y", "z")]
        columns = list(self.points_m.T)
        if self.colours is not None:
            kinds += [(name, "u1") for name in ("red", "green", "blue")]
            columns += list(self.colours.T)
        vertices = np.empty(len(self.points_m), dtype=kinds)
        for (name, _), values in zip(kinds, columns, strict=True):
            vertices[name] = values
        types = {"<f4": "float", "u1": "uchar"}
        lines = [
            "ply", "format binary_little_endian 1.0",
            *(f"comment {line}" for line in self.comment.splitlines()),
            f"element vertex {len(vertices)}",
            *(f"property {types[kind]} {name}" for name, kind in kinds),
            "end_header",
        ]  # fmt: skip
        return "\n".join(lines).encode("ascii", "replace") + b"\n" + vertices.tobytes()


def point_cloud(
    depth_m: Float[np.ndarray, "h w"], image: UInt8[np.ndarray, "h w 3"] | None, intrinsics: Intrinsics | None = None
) -> PointCloud:
    """Lift each pixel to a point, coloured by the RGB image; pixels of depth 0 are left out.

    ``depth_m`` is measured along the optical axis; the intrinsics, in its pixels, are by default those of NYU, scaled.
    """
    height, width = depth_m.shape
    camera = intrinsics or Intrinsics.of_photo(height, width)
    x = (np.arange(width, dtype=np.float32) - camera.cx) / camera.fx
    y = (np.arange(height, dtype=np.float32) - camera.cy) / camera.fy
    points = np.stack(np.broadcast_arrays(depth_m * x, depth_m * y[:, None], depth_m), axis=-1).reshape(-1, 3)
    points = np.asarray(points, np.float32)
    colours = None if image is None else image.reshape(-1, 3)
    seen = depth_m.reshape(-1) > 0
    if not seen.all():
        points, colours = points[seen], None if colours is None else colours[seen]
    whose = "" if camera.known else f", scaled to {width} x {height}: not this camera's own"
    comment = f"x right, y down, z forward, in metres\ncamera: {camera}{whose}"
    return PointCloud(points, colours, comment)
