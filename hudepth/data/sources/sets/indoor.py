"""Indoor sets: SUN RGB-D, iBims-1, ScanNet."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from hudepth.base.errors import DataError
from hudepth.base.images import check_file
from hudepth.base.options import Choice, Range
from hudepth.data.encoding import Encoding
from hudepth.data.sources.base import RawPair, Record
from hudepth.data.sources.decoding import read_depth, read_image
from hudepth.data.sources.files import inside, make_pair
from hudepth.data.sources.sets.layout import SetSource, with_stem


@dataclass(eq=False)
class SunRgbdSource(SetSource):
    """SUN RGB-D as in ``SUNRGBD.zip``: 10,335 pairs of four sensors (Song, Lichtenberg and Xiao, CVPR 2015).

    ``kv1/NYUdata/NYU0001/image/NYU0001.jpg`` with a PNG in ``depth`` (as measured) or ``depth_bfx`` (holes filled).
    Lists hold the folders of pairs, with or without what comes before the sensor's name, or are ``allsplit.mat`` of the
    set's toolbox, 5,285 and 5,050 pairs. Only the videos of ``sun3ddata`` have scenes.
    """

    name: ClassVar[str] = "sunrgbd"
    homepage: ClassVar[str] = "https://rgbd.cs.princeton.edu/"
    usual_median_m = (0.8, 8.0)
    key: ClassVar[str] = r"\g<pair>"
    scene: ClassVar[str] = r"\g<video>"
    image_name: ClassVar[re.Pattern[str]] = re.compile(
        r"(?:.*/)?(?P<pair>(?:kv1|kv2|realsense|xtion)/(?:(?P<video>sun3ddata/.+)/[^/]+|.+))/image/[^/]+\.jpg"
    )

    _: KW_ONLY
    encoding: Encoding = "sunrgbd"
    depth: Annotated[str, Choice(("depth", "depth_bfx"))] = "depth_bfx"

    @property
    def depth_name(self) -> re.Pattern[str]:  # type: ignore[override]
        """The chosen kind of depth."""
        return re.compile(rf"(?:.*/)?(?P<pair>(?:kv1|kv2|realsense|xtion)/.+)/{self.depth}/[^/]+\.png")

    @property
    def expects(self) -> str:  # type: ignore[override]
        """What the root holds."""
        return f"kv1/.../image/*.jpg and {self.depth}/*.png"

    def lines(self, root: Path, name: str | None, *, split: str) -> Iterator[tuple[int, str]]:
        """Yield the lines of a list, or the folders of a split of ``allsplit.mat``."""
        if name is None or not name.endswith(".mat"):
            return super().lines(root, name, split=split)
        from scipy.io import loadmat
        from scipy.io.matlab import MatReadError

        path, key = root / Path(name).expanduser(), f"data.source.{split}_list"
        check_file(path)
        try:
            cells = loadmat(path, variable_names=[f"all{split}"])[f"all{split}"].ravel()
            return enumerate((str(cell.item()) for cell in cells), 1)
        except (OSError, ValueError, KeyError, AttributeError, NotImplementedError, TypeError, MatReadError):
            raise DataError(f"{key}: '{path}' is not the allsplit.mat of SUN RGB-D's toolbox.") from None

    def entry(self, line: str) -> str | None:
        """Return a folder from the sensor's name on."""
        match = re.fullmatch(r"(?:.*/)?((?:kv1|kv2|realsense|xtion)/.+?)(?:/image/[^/]+)?/?", line)
        return match and match[1]


@dataclass(eq=False)
class IbimsSource(SetSource):
    """iBims-1, ``ibims1_core_raw``: 100 pairs of a laser scanner, for tests alone (Koch et al., ECCVW 2018).

    ``rgb/<name>.png``, ``depth/<name>.png`` (16 bits, 65535 is 50 m) and the masks ``mask_invalid`` and
    ``mask_transp``, 0 where depth does not count.
    """

    name: ClassVar[str] = "ibims"
    homepage: ClassVar[str] = "https://www.asg.ed.tum.de/lmf/ibims1/"
    usual_median_m = (1.0, 15.0)
    key: ClassVar[str] = r"\g<name>"
    scene: ClassVar[str] = r""
    expects: ClassVar[str] = "rgb, depth, mask_invalid and mask_transp"
    image_name: ClassVar[re.Pattern[str]] = re.compile(r"(?:.*/)?rgb/(?P<name>[^/]+)\.png")
    depth_name: ClassVar[re.Pattern[str]] = re.compile(r"(?:.*/)?depth/(?P<name>[^/]+)\.png")

    _: KW_ONLY
    encoding: Encoding = "linear"
    depth_scale_m: float | None = 50 / 65535
    invalid: Sequence[float] | None = ()

    def masks(self, record: Record) -> Sequence[str]:
        """Return both masks."""
        return [with_stem(record.depth, folder, ".png") for folder in ("mask_invalid", "mask_transp")]


@dataclass(eq=False)
class ScannetSource(SetSource):
    """ScanNet, its ``.sens`` files extracted by its SensReader (Dai et al., CVPR 2017).

    ``scene0000_00/color/0.jpg``, 1296 x 968, and ``scene0000_00/depth/0.png``, 640 x 480, millimetres. Lists hold
    scenes, as ``scannetv2_train.txt`` does. ``every``: take each such frame only, since neighbours are alike.
    """

    name: ClassVar[str] = "scannet"
    homepage: ClassVar[str] = "http://www.scan-net.org/"
    usual_median_m = (0.8, 6.0)
    key: ClassVar[str] = r"\g<scan>/\g<frame>"
    scene: ClassVar[str] = r"\g<scan>"
    expects: ClassVar[str] = "scene0000_00/color/0.jpg and scene0000_00/depth/0.png"
    image_name: ClassVar[re.Pattern[str]] = re.compile(
        r"(?:.*/)?(?P<scan>scene\d{4}_\d\d)/color/(?P<frame>\d+)\.(?:jpg|png)"
    )
    depth_name: ClassVar[re.Pattern[str]] = re.compile(r"(?:.*/)?(?P<scan>scene\d{4}_\d\d)/depth/(?P<frame>\d+)\.png")

    _: KW_ONLY
    encoding: Encoding = "uint16_mm"
    every: Annotated[int, Range(1)] = 1

    def records(self) -> Sequence[Record]:
        """List each ``every``-th frame of each scene."""
        return [record for record in super().records() if record.frame % self.every == 0]

    def read(self, record: Record) -> RawPair:
        """Decode a pair, whose aspect ratios differ by 0.4 %: ScanNet scales one to the other."""
        image, depth = (inside(self.folder(), name, where="data.root") for name in (record.image, record.depth))
        rgb, raw = read_image(image), read_depth(depth)
        aspect = rgb.shape[1] * raw.shape[0] / (rgb.shape[0] * raw.shape[1])
        if abs(aspect - 1) < 0.01:
            return RawPair(rgb, raw)
        return make_pair(rgb, raw, image_where=f"'{image}'", depth_where=f"'{depth}'", unequal=True)
