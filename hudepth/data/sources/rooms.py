"""Built-in synthetic rooms: a data set with exact depth that needs no download and no files."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from hudepth.base.camera.intrinsics import NYU_FOCAL, Intrinsics
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.options import Broadcast, Choice, Range, convert
from hudepth.data.rooms.fittings import CATEGORIES
from hudepth.data.rooms.furnishing import VARIETIES
from hudepth.data.rooms.materials import noise
from hudepth.data.rooms.raycast import F32, pinhole_view
from hudepth.data.rooms.scene import build_room
from hudepth.data.rooms.shading import render
from hudepth.data.sources.base import RawPair, Record, Source

RENDERER_VERSION = 1
"""Raise it whenever a change alters any frame: prepared data with another version is out of date."""

MAX_PAIRS = 1_000_000
_FURTHER = "further_room_"
_COUNT = Annotated[int, Range(1)]
_SIZE = Annotated[tuple[int, int], Range(16, 2048), Broadcast(), "[height,width], each from 16 to 2048"]
_FOV = Annotated[tuple[float, float], Range(20, 120), "[lowest,highest] within 20 and 120 degrees"]
_CAMERA = (0, 1)
"""Ends the seed of a room's camera, which is longer than any other seed."""
_TEST_FRACTION = 0.2
_BASELINE_M = 0.075
_KINECT_RANGE_M = 8.0


class RoomsSource(Source):
    """Furnished rooms, ray-cast with exact depth and the camera of NYU Depth V2.

    Each scene is one room with its own furniture, colours and lamps, seen by one moving camera. Depth is z-depth:
    the distance along the optical axis in metres (NYU's convention), not the length of the ray. Frames depend only on
    ``seed``, scene, frame and ``size``.

    Args:
        scenes: number of rooms. The last fifth (at least one room of two) is the ``test`` split.
        size: (height, width) in pixels, each 16 to 2048.
        seed: at least 0; each seed gives other rooms.
        variety: ``usual``; ``wide``: more sizes of rooms, fuller, seen from more distances, heights and angles, so
            that depths are distributed more as in NYU Depth V2; or ``homes``: as ``wide``, with loose things
            everywhere, mixed light and a worse camera.
        fov_deg: lowest and highest horizontal field of view [degrees] of the rooms' cameras; None is always NYU's. A
            picture looks as if NYU's camera had seen everything nearer or farther away, and this is the depth it has:
            the true one times NYU's focal length over its own, as a zoomed crop has.
        holes: remove depth (0) where a Kinect would not measure: in its projector's shadow, on grazing and
            dark surfaces, beyond 8 m, along the border, and in blobs. Everything else stays the same.

    Raises ConfigError if an option is out of range.
    """

    name: ClassVar[str] = "rooms"
    licence: ClassVar[str] = "mit"
    terms: ClassVar[str] = "Synthetic rooms that hudepth ray-casts itself (MIT, like hudepth): no photograph was used."

    encoding: str = "float_m"

    def __init__(
        self,
        *,
        scenes: int = 48,
        frames_per_scene: int = 5,
        size: int | Sequence[int] = (240, 320),
        seed: int = 0,
        variety: str = "usual",
        fov_deg: Sequence[float] | None = None,
        holes: bool = False,
    ) -> None:
        self.scenes: int = convert("data.source.scenes", scenes, _COUNT)
        self.frames_per_scene: int = convert("data.source.frames_per_scene", frames_per_scene, _COUNT)
        if self.scenes * self.frames_per_scene > MAX_PAIRS:
            raise ConfigError(
                f"data.source.scenes: {self.scenes} x {self.frames_per_scene} frames are over {MAX_PAIRS:,}."
            )
        self.pairs_per_scene = self.frames_per_scene
        self.size: tuple[int, int] = convert("data.source.size", size, _SIZE)
        self.seed: int = convert("data.source.seed", seed, Annotated[int, Range(0)])
        self.variety: str = convert("data.source.variety", variety, Annotated[str, Choice(tuple(VARIETIES))])
        self.fov_deg = None if fov_deg is None else convert("data.source.fov_deg", fov_deg, _FOV)
        if self.fov_deg is not None and self.fov_deg[0] > self.fov_deg[1]:
            raise ConfigError(f"data.source.fov_deg: {list(self.fov_deg)} is not [lowest,highest]. Pass [45,75].")
        self.holes: bool = convert("data.source.holes", holes, bool)

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera: row v, column u at depth z is at x = (u - cx) z / fx, y = (v - cy) z / fy."""
        return Intrinsics.of_nyu(*self.size)

    def records(self) -> Sequence[Record]:
        """List all frames, scene by scene, without rendering any."""
        return [self._record(scene, frame) for scene in range(self.scenes) for frame in range(self.frames_per_scene)]

    def generated(self, number: int) -> Record:
        """Return the record of a frame in a further room: any number from 0 on, scene by scene."""
        scene, frame = divmod(number, self.frames_per_scene)
        name = f"{_FURTHER}{scene:07d}"
        category = CATEGORIES[(self.scenes + scene) % len(CATEGORIES)]
        return Record(id=f"{name}/{frame:02d}", scene=name, frame=frame, split="train", category=category)

    def read(self, record: Record) -> RawPair:
        """Render one frame: image [H, W, 3] uint8 RGB, depth [H, W] float32 z-depth [m], 0 only in holes.

        Raises DataError if the record is not one of this source's.
        """
        scene = self._scene_number(record)
        room = build_room(self.seed, scene, self.variety)
        height, width = self.size
        zoom = self._zoom(scene)
        view = pinhole_view(*room.path.pose(record.frame), height=height, width=width, zoom=zoom)
        frame_seed = np.random.SeedSequence([self.seed, scene, record.frame])
        image, depth = render(room.scene, view, np.random.default_rng(frame_seed))
        if self.holes:
            rng = np.random.default_rng(frame_seed.spawn(1)[0])
            depth[kinect_holes(depth, image, fx=zoom * self.intrinsics.fx, rng=rng)] = 0
        return RawPair(image, depth if zoom == 1 else (depth / zoom).astype(np.float32))

    def fingerprint(self) -> str:
        """sha256 over the records, everything else the frames depend on, and the renderer's version."""
        further = [] if self.variety == "usual" else [self.variety]
        further += [] if self.fov_deg is None else [f"fov_deg={list(self.fov_deg)}"]
        options = json.dumps([super().fingerprint(), self.size, self.seed, self.holes, RENDERER_VERSION, *further])
        return hashlib.sha256(options.encode()).hexdigest()

    def _zoom(self, scene: int) -> float:
        """Return the focal length of a room's camera over that of NYU's."""
        if self.fov_deg is None:
            return 1.0
        rng = np.random.default_rng([self.seed, scene, *_CAMERA])
        return 0.5 / NYU_FOCAL[0] / math.tan(math.radians(rng.uniform(*self.fov_deg)) / 2)

    def _record(self, scene: int, frame: int) -> Record:
        tests = max(1, round(_TEST_FRACTION * self.scenes))
        split = "" if self.scenes < 2 else "test" if scene >= self.scenes - tests else "train"
        name = f"room_{scene:04d}"
        category = CATEGORIES[scene % len(CATEGORIES)]
        return Record(id=f"{name}/{frame:02d}", scene=name, frame=frame, split=split, category=category)

    def _scene_number(self, record: Record) -> int:
        further = record.scene.removeprefix(_FURTHER)
        if further.isdecimal() and record == self.generated(int(further) * self.frames_per_scene + record.frame):
            return self.scenes + int(further)
        digits = record.scene.removeprefix("room_")
        scene = int(digits) if digits.isdecimal() else self.scenes
        known = scene < self.scenes and 0 <= record.frame < self.frames_per_scene
        if not known or record.id != self._record(scene, record.frame).id:
            raise DataError(
                f"rooms: no frame '{record.id}' in {self.scenes} scenes of {self.frames_per_scene} frames. "
                "Pass a record that records() of the same source returned."
            )
        return scene


def kinect_holes(depth: F32, image: NDArray[np.uint8], *, fx: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return where a Kinect would measure nothing, [H, W].

    Takes exact depth [H, W] in metres, the image [H, W, 3] and the focal length ``fx`` [pixels]; ``rng`` draws which of
    the doubtful pixels fail.
    """
    height, width = depth.shape
    # The projector sits next to the camera: a pixel is in shadow if one right of it is lit from further left.
    lit_from = np.arange(width, dtype=np.float32) - np.float32(fx * _BASELINE_M) / depth
    leftmost = np.minimum.accumulate(lit_from[:, ::-1], axis=1)[:, ::-1]
    shadow = lit_from > leftmost + 0.5

    slope = np.hypot(*np.gradient(depth)) * fx / depth
    period = np.float32(240 / height)
    u, v = (np.arange(n, dtype=np.float32) * period + rng.uniform(0, 512) for n in (width, height))
    columns, rows = np.meshgrid(u, v)
    patches = noise(columns, rows)
    grazing = slope > 6 - 4 * patches
    dark = image.max(2) < 55 * patches
    blobs = patches > 0.93
    border = np.ones(depth.shape, np.bool_)
    edge_y, edge_x = max(1, round(height / 60)), max(1, round(width / 60))
    border[edge_y:-edge_y, edge_x:-edge_x] = False
    holes: NDArray[np.bool_] = shadow | grazing | dark | blobs | border | (depth > _KINECT_RANGE_M)
    return holes
