"""Networks from a normalised RGB image to unit depth."""

from hudepth.models.hybrid_unet import HybridUNet
from hudepth.models.resnet18_unet import ResNet18UNet
from hudepth.models.tiny import TinyUNet

__all__ = ["HybridUNet", "ResNet18UNet", "TinyUNet"]
