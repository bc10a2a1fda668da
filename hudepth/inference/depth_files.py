"""The file formats of a predicted depth map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from hudepth.base.errors import ConfigError, DataError
from hudepth.base.files import written_whole
from hudepth.inference.depth_map import DepthMap, jpeg
from hudepth.viz.point_cloud import PointCloud


@dataclass(frozen=True)
class Style:
    """What all pictures of a run have in common."""

    scale_m: tuple[float, float] | None = None  # ends of the colour scale [m]; None: each picture its own
    points: int | None = None  # at most so many in a point cloud
    edges: bool = False  # whether a point cloud has those of depth edges
    max_uncertainty: float | None = None  # of points, as a share of their depth; others are left out

    def points_of(self, depth: DepthMap) -> PointCloud:
        """Return the points of a depth map that are written."""
        cloud = depth.point_cloud(edges=self.edges, max_uncertainty=self.max_uncertainty)
        return cloud if self.points is None else cloud.thin(self.points)


FORMATS: dict[str, tuple[str, Callable[[DepthMap, IO[bytes], Style], object]]] = {
    "png16": ("_depth.png", lambda depth, file, _: file.write(depth.to_png16())),
    "npy": ("_depth.npy", lambda depth, file, _: file.write(depth.to_npy())),
    "uncertainty": ("_uncertainty.npy", lambda depth, file, _: file.write(depth.uncertainty_to_npy())),
    "colour": ("_depth.jpg", lambda depth, file, style: file.write(jpeg(depth.colourise(scale_m=style.scale_m)))),
    "side": ("_side.jpg", lambda depth, file, style: file.write(jpeg(depth.side_by_side(scale_m=style.scale_m)))),
    "ply": ("_depth.ply", lambda depth, file, style: file.write(style.points_of(depth).to_ply())),
    "glb": ("_depth.glb", lambda depth, file, style: file.write(style.points_of(depth).to_glb())),
}
"""By name: the file's ending, and what writes it: png16 in mm; npy, ply and glb in m; the others are pictures."""


def write_depth(stem: Path, depth: DepthMap, formats: Sequence[str], style: Style) -> None:
    """Write ``<stem>_depth.png`` and so on in formats of :data:`FORMATS`, each whole or not at all.

    Raises OSError, and DataError, once all others are written, with the formats that cannot hold this picture.
    """
    failed = []
    for name in formats:
        ending, write = FORMATS[name]
        try:
            with written_whole(stem.with_name(stem.name + ending), durable=False) as part, part.open("wb") as file:
                write(depth, file, style)
        except (DataError, ConfigError) as error:
            failed.append(f"no {name}: {error}")
    if failed:
        raise DataError(" ".join(failed))
