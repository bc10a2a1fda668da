"""The option ``camera=``: which camera took the pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from numpy.typing import NDArray

from hudepth.base.camera.exif import FILM_DIAGONAL_MM
from hudepth.base.camera.intrinsics import Intrinsics
from hudepth.base.errors import ConfigError

WORDS = "auto, training, fov=<degrees>, f35=<mm>, f=<pixels> or [fx,fy,cx,cy] in pixels of the image"
CameraOption = Annotated[str | tuple[float, float, float, float], WORDS]
"""A camera as an option; see :class:`CameraChoice`."""
CameraLike = str | Intrinsics | Sequence[float] | NDArray[Any]
"""What the library takes for one: the option, intrinsics, their four numbers, or a 3 x 3 camera matrix."""
_NUMBER = re.compile(r"(fov|f35|f)[=:](\d{1,9}(?:\.\d{0,20})?)")
_RANGES = {"fov": (6, 135), "f35": (8, 340), "f": (1, 1e6)}
"""What pictures of a usual shape can have; see :meth:`hudepth.base.camera.intrinsics.Intrinsics.fits`."""


@dataclass(frozen=True)
class CameraChoice:
    """Which camera took the pictures.

    ``auto`` is what EXIF states, else the training camera; ``training`` is always that. ``fov`` is the horizontal field
    of view of upright pictures [degrees], ``f35`` the focal length that has the same field of view on 35 mm film [mm],
    over the diagonal, and ``f`` the focal length in pixels. All mean square pixels and a principal point in the centre;
    ``given`` are all four numbers.
    """

    kind: str
    value: float = 0.0
    given: Intrinsics | None = None

    @classmethod
    def of(cls, option: CameraLike | CameraChoice, *, key: str = "camera") -> CameraChoice:
        """Read the option named ``key``; raises ConfigError for what is none, TypeError for arrays of other shapes."""
        if isinstance(option, CameraChoice):
            return option
        if not isinstance(option, str):
            return cls("given", given=Intrinsics.of(option))
        if option in ("auto", "training"):
            return cls(option)
        if found := _NUMBER.fullmatch(option.strip()):
            kind, value = found[1], float(found[2])
            low, high = _RANGES[kind]
            if low <= value <= high:
                return cls(kind, value)
            raise ConfigError(f"{key}: {kind}={value:g} is not {low} to {high:.0f}. Pass {key}={WORDS}.")
        raise ConfigError(f"{key}: '{option}' is not a camera. Pass {key}={WORDS}.")

    def over_sides(self, sizes: Sequence[Sequence[int]], *, key: str) -> tuple[float, float]:
        """Return the focal lengths over the sides of training pictures of these (height, width).

        Raises ConfigError, which names ``key``, if they differ from picture to picture or no camera is stated.
        """
        cameras = [(self.of_picture(height, width), height, width) for height, width in sizes]
        found = [(camera.fx / width, camera.fy / height) for camera, height, width in cameras if camera is not None]
        if not found:
            raise ConfigError(f"{key}: '{self.kind}' states no camera. Pass {key}=fov=<degrees>, or leave it out.")
        if any(abs(other / first - 1) > 0.02 for each in found for first, other in zip(found[0], each, strict=True)):
            raise ConfigError(f"{key}: pictures of several shapes have no camera in common. Leave {key} out.")
        return found[0]

    def of_picture(self, height: int, width: int, exif: Intrinsics | str = "") -> Intrinsics | None:
        """Return the camera of a picture of this size; None, with which the training camera is meant, if unstated.

        ``exif`` is what the file states; see :func:`hudepth.base.camera.exif.exif_camera`. Raises ConfigError if the
        camera that was given cannot have taken a picture of this size.
        """
        if self.kind in ("auto", "training"):
            return exif if self.kind == "auto" and isinstance(exif, Intrinsics) else None
        if self.given is not None:
            camera = self.given
        else:
            focal = self.value
            if self.kind == "fov":
                focal = width / 2 / math.tan(math.radians(self.value / 2))
            elif self.kind == "f35":
                focal *= math.hypot(height, width) / FILM_DIAGONAL_MM
            stated = f"{self.kind}={self.value:g}"
            camera = Intrinsics.centred(focal, focal, height, width, origin=f"as given, {stated}")
            if not camera.fits(height, width):
                raise ConfigError(
                    f"camera: {stated} cannot be of a picture of {width} x {height}, whose focal length would be "
                    f"{focal:.0f} pixels. Pass another camera=."
                )
        camera.check_fit(height, width)
        return camera
