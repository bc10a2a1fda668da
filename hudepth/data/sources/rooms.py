"""Built-in synthetic rooms: a data set with exact depth that needs no download and no files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hudepth.base.camera import Intrinsics
from hudepth.base.errors import ConfigError, DataError, did_you_mean
from hudepth.data.rooms.fittings import CATEGORIES
from hudepth.data.rooms.furnishing import VARIETIES
from hudepth.data.rooms.materials import noise
from hudepth.data.rooms.raycast import F32, pinhole_view
from hudepth.data.rooms.scene import build_room
from hudepth.data.rooms.shading import render
from hudepth.data.sources.base import RawPair, Record, Source

RENDERER_VERSION = 1
"""Raise it whenever a change alters any frame: prepared data with another version is out of date."""

_TEST_FRACTION = 0.2
_SIDE_PX = (16, 2048)
_BASELINE_M = 0.075
_KINECT_RANGE_M = 8.0


class RoomsSource(Source):
    """Furnished rooms, ray-cast with exact depth and the camera of NYU Depth V2.

    Each scene is one room with its own furniture, colours and lamps; its frames come from one camera that
    sways and looks about. Depth is z-depth: the distance along the optical axis in metres (NYU's convention),
    not the length of the ray. Frames depend on ``seed``, scene, frame and ``size`` alone.

    Args:
        scenes: number of rooms, at least 1. The last fifth (at least one room of two) is the ``test`` split.
        frames_per_scene: at least 1.
        size: (height, width) in pixels, each 16 to 2048. The field of view is NYU's whatever the size.
        seed: at least 0; another seed gives other rooms.
        variety: ``usual``, or ``wide``: rooms of more sizes, fuller, seen from nearer, farther, lower, higher and more
            steeply. To train on for real images: depths spread more as in NYU Depth V2.
        holes: take depth away (0) where a Kinect would not measure: in its projector's shadow, on grazing and
            dark surfaces, beyond 8 m, along the border, and in blobs. All else stays the same.

    Raises:
        ConfigError: if an option is out of range.
    """

    name: ClassVar[str] = "rooms"
    encoding: str = "float_m"

    def __init__(
        self,
        *,
        scenes: int = 48,
        frames_per_scene: int = 5,
        size: tuple[int, int] | list[int] = (240, 320),
        seed: int = 0,
        variety: str = "usual",
        holes: bool = False,
    ) -> None:
        self.scenes = _whole("scenes", scenes, at_least=1)
        self.frames_per_scene = _whole("frames_per_scene", frames_per_scene, at_least=1)
        self.seed = _whole("seed", seed, at_least=0)
        if not isinstance(size, (tuple, list)) or len(size) != 2 or not all(_is_side(side) for side in size):
            low, high = _SIDE_PX
            raise ConfigError(
                f"data.source.size: got {size!r}. Pass [height, width], two whole numbers from {low} to {high}, "
                "for example [240, 320]."
            )
        if variety not in VARIETIES:
            raise ConfigError(
                f"data.source.variety: no '{variety}'.{did_you_mean(str(variety), VARIETIES)} Pass usual or wide."
            )
        self.variety = variety
        if not isinstance(holes, bool):
            raise ConfigError(f"data.source.holes: got {holes!r}. Pass true or false.")
        self.size = (size[0], size[1])
        self.holes = holes

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera: row v, column u at depth z lies at x = (u - cx) z / fx, y = (v - cy) z / fy."""
        return Intrinsics.of_nyu(*self.size)

    def records(self) -> Sequence[Record]:
        """List all frames, scene by scene; nothing is rendered."""
        return [self._record(scene, frame) for scene in range(self.scenes) for frame in range(self.frames_per_scene)]

    def read(self, record: Record) -> RawPair:
        """Render one frame: image [H, W, 3] uint8 RGB, depth [H, W] float32 z-depth [m], 0 only in holes.

        Raises:
            DataError: if the record is not one of this source's.
        """
        scene = self._scene_number(record)
        room = build_room(self.seed, scene, self.variety)
        height, width = self.size
        view = pinhole_view(*room.path.pose(record.frame), height=height, width=width)
        frame_seed = np.random.SeedSequence([self.seed, scene, record.frame])
        image, depth = render(room.scene, view, np.random.default_rng(frame_seed))
        if self.holes:
            rng = np.random.default_rng(frame_seed.spawn(1)[0])
            depth[kinect_holes(depth, image, fx=self.intrinsics.fx, rng=rng)] = 0
        return RawPair(image, depth)

    def fingerprint(self) -> str:
        """sha256 over the records, everything else the frames depend on, and the renderer's version."""
        variety = [] if self.variety == "usual" else [self.variety]
        options = json.dumps([super().fingerprint(), self.size, self.seed, self.holes, RENDERER_VERSION, *variety])
        return hashlib.sha256(options.encode()).hexdigest()

    def _record(self, scene: int, frame: int) -> Record:
        tests = max(1, round(_TEST_FRACTION * self.scenes))
        split = "" if self.scenes < 2 else "test" if scene >= self.scenes - tests else "train"
        name = f"room_{scene:04d}"
        category = CATEGORIES[scene % len(CATEGORIES)]
        return Record(id=f"{name}/{frame:02d}", scene=name, frame=frame, split=split, category=category)

    def _scene_number(self, record: Record) -> int:
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

    Args:
        depth: [H, W] exact depth [m].
        image: [H, W, 3] RGB.
        fx: focal length [pixels].
        rng: draws which of the doubtful pixels fail.
    """
    height, width = depth.shape
    # The projector sits beside the camera: a pixel is in shadow if one right of it is lit from further left.
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
    border = np.zeros(depth.shape, np.bool_)
    edge_y, edge_x = max(1, round(height / 60)), max(1, round(width / 60))
    border[:edge_y] = border[-edge_y:] = True
    border[:, :edge_x] = border[:, -edge_x:] = True
    holes: NDArray[np.bool_] = shadow | grazing | dark | blobs | border | (depth > _KINECT_RANGE_M)
    return holes


def _whole(name: str, value: object, *, at_least: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < at_least:
        raise ConfigError(f"data.source.{name}: got {value!r}. Pass a whole number of at least {at_least}.")
    return value


def _is_side(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and _SIDE_PX[0] <= value <= _SIDE_PX[1]
