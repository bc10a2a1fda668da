"""Sets of laser scanners, indoors and outdoors: DIODE and ETH3D."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Annotated, ClassVar

import numpy as np

from hudepth.base.errors import DataError
from hudepth.base.images import read_bytes
from hudepth.base.options import Choice
from hudepth.data.encoding import Encoding
from hudepth.data.sources.base import RawPair, Record
from hudepth.data.sources.decoding import read_image
from hudepth.data.sources.files import inside
from hudepth.data.sources.sets.layout import SetSource


@dataclass(eq=False)
class DiodeSource(SetSource):
    """DIODE: 1024 x 768 pairs of a laser scanner with masks of what it measured (Vasiljevic et al. 2019).

    ``val/indoors/scene_00019/scan_00183/00019_00183_indoors_000_010.png`` with ``_depth.npy`` [m] and
    ``_depth_mask.npy``. ``part`` is ``indoors`` or ``outdoor``, whose depth reaches beyond 300 m. The set's validation
    pairs are the test, since those of its test are not public.
    """

    name: ClassVar[str] = "diode"
    homepage: ClassVar[str] = "https://diode-dataset.org/"
    licence: ClassVar[str] = "mit"
    terms: ClassVar[str] = "DIODE (Vasiljevic et al., arXiv:1908.00463), published under the MIT licence."
    key: ClassVar[str] = r"\g<pair>"
    scene: ClassVar[str] = r"\g<place>"

    _: KW_ONLY
    encoding: Encoding = "float_m"
    part: Annotated[str, Choice(("indoors", "outdoor"))] = "indoors"
    farthest_m: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.indoor = self.part == "indoors"
        self.farthest_m = self.farthest_m or (None if self.indoor else 350.0)
        self.usual_median_m = (0.8, 20.0) if self.indoor else (1.5, 80.0)

    @property
    def image_name(self) -> re.Pattern[str]:  # type: ignore[override]
        """Images of the chosen part."""
        return re.compile(rf"{self._pair}\.png")

    @property
    def depth_name(self) -> re.Pattern[str]:  # type: ignore[override]
        """Depths of the chosen part."""
        return re.compile(rf"{self._pair}_depth\.npy")

    @property
    def expects(self) -> str:  # type: ignore[override]
        """What the root holds."""
        return f"val/{self.part}/scene_*/scan_*/*.png with *_depth.npy and *_depth_mask.npy"

    @property
    def _pair(self) -> str:
        where = rf"(?:(?P<split>train)|val)/{self.part}/(?P<place>scene_\d+)"
        return rf"(?:.*/)?(?P<pair>{where}/scan_\d+/\d+_\d+_{self.part}_\d+_\d+)"

    def masks(self, record: Record) -> Sequence[str]:
        """Return the mask of what was measured."""
        return [f"{record.image.removesuffix('.png')}_depth_mask.npy"]


@dataclass(eq=False)
class Eth3dSource(SetSource):
    """ETH3D's high-resolution multi-view training set: 6048 x 4032 pairs of a laser scanner.

    ``courtyard/images/dslr_images/DSC_0286.JPG`` with ``courtyard/ground_truth_depth/dslr_images/DSC_0286.JPG``, which
    is no JPEG but rows of 32-bit floats [m], infinite where nothing was measured (Schöps et al., CVPR 2017).
    """

    name: ClassVar[str] = "eth3d"
    homepage: ClassVar[str] = "https://www.eth3d.net/"
    licence: ClassVar[str] = "cc-by-nc-sa-4.0"
    terms: ClassVar[str] = "ETH3D (Schöps et al., CVPR 2017), published under CC BY-NC-SA 4.0: not for commercial use."
    indoor = False
    usual_median_m = (0.5, 60.0)
    key: ClassVar[str] = r"\g<place>/\g<name>"
    scene: ClassVar[str] = r"\g<place>"
    expects: ClassVar[str] = "<scene>/images/dslr_images/*.JPG and <scene>/ground_truth_depth/dslr_images/*.JPG"
    image_name: ClassVar[re.Pattern[str]] = re.compile(
        r"(?:.*/)?(?P<place>[^/]+)/images/dslr_images/(?P<name>[^/]+)\.JPG"
    )
    depth_name: ClassVar[re.Pattern[str]] = re.compile(
        r"(?:.*/)?(?P<place>[^/]+)/ground_truth_depth/dslr_images/(?P<name>[^/]+)\.JPG"
    )

    _: KW_ONLY
    encoding: Encoding = "float_m"
    farthest_m: float | None = None

    def read(self, record: Record) -> RawPair:
        """Decode a pair; the size of its depth is that of the image."""
        image, depth = (inside(self.folder(), name, where="data.root") for name in (record.image, record.depth))
        rgb, data = read_image(image), read_bytes(depth)
        height, width = rgb.shape[:2]
        if len(data) != 4 * height * width:
            what = f"{len(data):,} bytes, but {width} x {height} floats are {4 * height * width:,}"
            raise DataError(f"'{depth}': {what}. Copy the file again.")
        return RawPair(rgb, np.frombuffer(data, "<f4").reshape(height, width).astype(np.float32))
