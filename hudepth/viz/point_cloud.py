"""Depth as points in space, and the PLY and glTF files that hold them."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from hudepth import __version__
from hudepth.base.camera.intrinsics import Intrinsics
from hudepth.base.errors import DataError

STEEPEST = 15.0
"""Slope of a surface along the line of sight, over that across it, from which a pixel counts as a depth edge. A floor
seen from eye level has 10 at 15 m; what interpolates between two objects has 50 and more."""


@dataclass(frozen=True)
class PointCloud:
    """Points in the camera's frame: x right, y down, z forward [m]."""

    points_m: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"] | None
    """RGB."""
    comment: str = ""

    def to_ply(self) -> bytes:
        """Return a binary PLY file (little-endian), whose comment states axes, unit and camera.

        Raises DataError if there are no points.
        """
        self._check()
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

    def to_glb(self) -> bytes:
        """Return a binary glTF 2.0 file, which browsers, Blender and phones open: y up, z towards the viewer [m].

        Raises DataError if there are no points, which the format does not allow.
        """
        self._check()
        points = np.ascontiguousarray(self.points_m * np.array([1, -1, -1], np.float32), "<f4")
        opaque = np.full((len(points), 4), 255, np.uint8)
        if self.colours is not None:
            opaque[:, :3] = self.colours
        kinds = {"POSITION": (5126, "VEC3", points.tobytes()), "COLOR_0": (5121, "VEC4", opaque.tobytes())}
        accessors, views, binary = [], [], b""
        for number, (component, shape, data) in enumerate(kinds.values()):
            accessor = {"bufferView": number, "componentType": component, "count": len(points), "type": shape}
            accessors.append({**accessor, **({"normalized": True} if shape == "VEC4" else {})})
            views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data), "target": 34962})
            binary += data
        accessors[0] |= {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        names = {name: number for number, name in enumerate(kinds)}
        document = {
            "asset": {"version": "2.0", "generator": f"hudepth {__version__}", "extras": {"comment": self.comment}},
            "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": names, "mode": 0}]}],  # 0: points
            "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(binary)}],
        }  # fmt: skip
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _check(self) -> None:
        if not len(self.points_m):
            raise DataError("no point is left. Pass edges=true or a larger max_uncertainty.")

    def thin(self, points: int) -> PointCloud:
        """Return at most so many of the points, drawn evenly; the same ones each time."""
        if len(self.points_m) <= points:
            return self
        kept = np.sort(np.random.default_rng(0).choice(len(self.points_m), points, replace=False))
        colours = None if self.colours is None else self.colours[kept]
        return replace(self, points_m=self.points_m[kept], colours=colours)


def depth_edges(depth_m: Float[np.ndarray, "h w"], intrinsics: Intrinsics) -> Bool[np.ndarray, "h w"]:
    """Return which pixels lie on a surface steeper than :data:`STEEPEST` on the way to a neighbour.

    At a depth edge, a network's depth goes through values of neither surface, whose points fly between the two.
    """
    edges = np.zeros(depth_m.shape, bool)
    for axis, focal in ((0, intrinsics.fy), (1, intrinsics.fx)):
        before, after = (np.delete(depth_m, end, axis) for end in (-1, 0))
        steep = np.abs(after - before) > STEEPEST / focal * np.minimum(before, after)
        pad = [(0, 0), (0, 0)]
        for side in ((0, 1), (1, 0)):
            pad[axis] = side
            edges |= np.pad(steep, pad)
    return edges


def point_cloud(
    depth_m: Float[np.ndarray, "h w"],
    image: UInt8[np.ndarray, "h w 3"] | None,
    intrinsics: Intrinsics | None = None,
    *,
    edges: bool = True,
    kept: Bool[np.ndarray, "h w"] | None = None,
) -> PointCloud:
    """Lift each pixel to a point, coloured by the RGB image; pixels of depth 0 are left out.

    ``depth_m`` is measured along the optical axis; the intrinsics, in its pixels, are by default those of NYU, scaled.
    ``edges`` false also leaves out :func:`depth_edges`, and ``kept`` the pixels where it is false.
    """
    height, width = depth_m.shape
    camera = intrinsics or Intrinsics.of_photo(height, width)
    x = (np.arange(width, dtype=np.float32) - camera.cx) / camera.fx
    y = (np.arange(height, dtype=np.float32) - camera.cy) / camera.fy
    points = np.stack(np.broadcast_arrays(depth_m * x, depth_m * y[:, None], depth_m), axis=-1).reshape(-1, 3)
    points = np.asarray(points, np.float32)
    colours = None if image is None else image.reshape(-1, 3)
    seen = (depth_m > 0).reshape(-1)
    if kept is not None:
        seen &= kept.reshape(-1)
    if not edges:
        seen &= ~depth_edges(depth_m, camera).reshape(-1)
    if not seen.all():
        points, colours = points[seen], None if colours is None else colours[seen]
    whose = "" if camera.known else f", scaled to {width} x {height}: not this camera's own"
    comment = f"x right, y down, z forward, in metres\ncamera: {camera}{whose}"
    return PointCloud(points, colours, comment)
