"""KITTI: street scenes with annotated lidar depth."""

from __future__ import annotations

import re
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

from hudepth.data.encoding import Encoding
from hudepth.data.sources.sets.layout import SetSource

_LINE = re.compile(
    r"(?:.*?/)?(?P<drive>\d{4}_\d\d_\d\d_drive_\d{4}_sync)"
    r"(?:/(?P<camera>image_0[23])/data/(?P<frame>\d{1,10})\.\w+(?:\s.*)?|\s+(?P<number>\d{1,10})(?:\s+(?P<side>[lr]))?)"
)


@dataclass(eq=False)
class KittiSource(SetSource):
    """KITTI's raw recordings with the annotated depth maps (Geiger et al. 2013; Uhrig et al. 2017).

    ``2011_09_26/2011_09_26_drive_0001_sync/image_02/data/0000000005.png`` (or ``.jpg``) of the raw recordings, and
    ``train`` or ``val`` ``/2011_09_26_drive_0001_sync/proj_depth/groundtruth/image_02/0000000005.png`` of
    ``data_depth_annotated.zip``, 16-bit PNG in 1/256 m, both anywhere below ``root``. Without lists the annotated
    ``train`` drives are the training set and ``val`` the test.

    Eigen's split is in lists that others publish; their lines may be as Monodepth2's (``<date>/<drive> 5 l``), BTS's or
    Godard's (paths of images). Frames without annotated depth are left out: 45 of Eigen's 697 test frames.
    """

    name: ClassVar[str] = "kitti"
    homepage: ClassVar[str] = "https://www.cvlibs.net/datasets/kitti/"
    licence: ClassVar[str] = "cc-by-nc-sa-3.0"
    terms: ClassVar[str] = (
        "KITTI (Geiger, Lenz, Stiller, Urtasun, IJRR 2013) with annotated depth (Uhrig et al., 3DV 2017), published "
        "under CC BY-NC-SA 3.0: not for commercial use."
    )
    indoor = False
    sparse = True
    usual_median_m = (5.0, 35.0)
    spare_images: ClassVar[bool] = True
    key: ClassVar[str] = r"\g<drive>/\g<camera>/\g<frame>"
    scene: ClassVar[str] = r"\g<drive>"
    expects: ClassVar[str] = "<date>/<drive>_sync/image_02/data and train/<drive>_sync/proj_depth/groundtruth/image_02"
    image_name: ClassVar[re.Pattern[str]] = re.compile(
        r"(?:.*/)?(?P<drive>\d{4}_\d\d_\d\d_drive_\d{4}_sync)/(?P<camera>image_0[23])/data/(?P<frame>\d{10})\.(?:png|jpg)"
    )
    depth_name: ClassVar[re.Pattern[str]] = re.compile(
        r"(?:.*/)?(?:(?P<split>train)|val)/(?P<drive>\d{4}_\d\d_\d\d_drive_\d{4}_sync)/proj_depth/groundtruth/"
        r"(?P<camera>image_0[23])/(?P<frame>\d{10})\.png"
    )

    _: KW_ONLY
    encoding: Encoding = "uint16_256"

    def entry(self, line: str) -> str | None:
        """Return ``<drive>/<camera>/<frame>``; see :class:`KittiSource` for the forms of a line."""
        match = _LINE.fullmatch(line)
        if match is None:
            return None
        camera = match["camera"] or ("image_03" if match["side"] == "r" else "image_02")
        return f"{match['drive']}/{camera}/{match['frame'] or match['number']:0>10}"
