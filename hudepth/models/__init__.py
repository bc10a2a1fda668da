"""Networks from a normalised RGB image to unit depth."""

from hudepth.models.efficientnet import EfficientNetLite0Encoder
from hudepth.models.encoder import Encoder, Stage
from hudepth.models.hybrid_unet import HybridUNet
from hudepth.models.lite_unet import LiteUNet
from hudepth.models.resnet import ResNet18Encoder
from hudepth.models.resnet18_unet import ResNet18UNet
from hudepth.models.tiny import TinyUNet

__all__ = [
    "EfficientNetLite0Encoder",
    "Encoder",
    "HybridUNet",
    "LiteUNet",
    "ResNet18Encoder",
    "ResNet18UNet",
    "Stage",
    "TinyUNet",
]
