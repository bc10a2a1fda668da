"""Cameras: the pinhole model, what EXIF says of the one that took a picture, and the option ``camera=``."""

from hudepth.base.camera.choice import CameraChoice, CameraLike, CameraOption
from hudepth.base.camera.intrinsics import NYU_FOCAL, Intrinsics

__all__ = ["NYU_FOCAL", "CameraChoice", "CameraLike", "CameraOption", "Intrinsics"]
