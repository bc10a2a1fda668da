"""What the paper states, as data: tables 1, 2, 3 and A1, and the figures of its text. Nothing here is measured.

H. Turkmen, D. Akgun. "A Hybrid UNet with Attention and a Perceptual Loss Function for Monocular Depth Estimation."
Mathematics 2025, 13(16), 2567.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

CITATION = "Turkmen and Akgun, Mathematics 2025, 13(16), 2567, doi:10.3390/math13162567"

SIDE_PX = 224
"""Input and output side (section 2.3)."""
MAX_DEPTH_M = 10.0
"""Depth is clipped to it and divided by it (section 2.3)."""
FRAMES = 50_688
"""35,481 + 5068 + 10,139 (section 2.3)."""
SPLIT_COUNTS = (35_481, 5_068, 10_139)
"""Training, validation and test frames (section 2.3)."""
FRACTIONS = (0.7, 0.1, 0.2)
"""Of the random split (section 2.3)."""
SPLIT_SEED = 42
"""Table 1."""
EPOCHS_TABLE_1, EPOCHS_SECTION_4 = 100, 30
PARAMETERS = 4_653_313
"""Table A1."""
MULT_ADDS_G, GFLOPS = 43.02, 86.04
"""Of one frame (section 4, Computational Complexity); table A1 prints the first under a batch of 8."""
TABLE_A1_BATCH = 8
SSIM = 0.998
LOSS_TRAIN, LOSS_VAL = 0.0005, 0.0006
"""Total loss after 100 epochs (section 4, figure 5)."""
LOSS_WEIGHTS = {"boundary": 3.0, "smoothness": 1.2, "scaling": 1.0}
"""Section 4."""
TEXT_DEEPEST_PX, TEXT_TRANSFORMER_LAYERS = 7, 4
"""Side of the deepest map and number of transformer layers in section 3.1."""
RTX_4090_TFLOPS = 82.6
"""Peak in float32 as its maker states it: 16,384 cores x 2.52 GHz x 2 operations. Not from the paper."""


@dataclass(frozen=True)
class ModelRow:
    """A row of table A1, and the module of :class:`hudepth.models.hybrid_unet.HybridUNet` that corresponds to it."""

    layer: str
    shape: tuple[int, ...]
    """Output, for a batch of 8."""
    parameters: int | None
    """None where the table leaves it blank."""
    module: str
    """Dotted name; empty for the whole network."""


def _block(layer: str, module: str, shape: tuple[int, ...], *parameters: int) -> list[ModelRow]:
    return [ModelRow(layer, shape, count, f"{module}.{number}") for number, count in enumerate(parameters)]


def _transformer(module: str, side: int, channels: int, *parameters: int) -> list[ModelRow]:
    tokens = (8, side * side, channels)
    layers = ("MultiheadAttention", "LayerNorm", "Sequential", "LayerNorm")
    names = ("attention", "norm1", "feed_forward", "norm2")
    rows = [
        ModelRow(layer, tokens, count, f"{module}.{name}")
        for layer, name, count in zip(layers, names, parameters, strict=True)
    ]
    return [ModelRow("TransformerAttention", (8, channels, side, side), None, module), *rows]


def _up(module: str, side: int, channels: int, *parameters: int) -> list[ModelRow]:
    shape = (8, channels, side, side)
    layers, names = ("Conv2d", "BatchNorm2d") * 2, ("conv1", "bn1", "conv2", "bn2")
    rows = [
        ModelRow(layer, shape, count, f"{module}.{name}")
        for layer, name, count in zip(layers, names, parameters, strict=True)
    ]
    return [ModelRow("UpsampleBlock", shape, None, module), *rows]


TABLE_A1 = (
    ModelRow("HybridDepthEstimationModel", (8, 1, 224, 224), None, ""),
    ModelRow("CNNEncoder", (8, 64, 56, 56), None, "encoder"),
    ModelRow("Sequential", (8, 64, 56, 56), None, "encoder.maxpool"),
    ModelRow("Conv2d", (8, 64, 112, 112), 9_408, "encoder.conv1"),
    ModelRow("BatchNorm2d", (8, 64, 112, 112), 128, "encoder.bn1"),
    ModelRow("ReLU", (8, 64, 112, 112), None, "encoder.relu"),
    ModelRow("MaxPool2d", (8, 64, 56, 56), None, "encoder.maxpool"),
    ModelRow("Sequential", (8, 64, 56, 56), None, "encoder.layer1"),
    *_block("BasicBlock", "encoder.layer1", (8, 64, 56, 56), 73_984, 73_984),
    ModelRow("Sequential", (8, 128, 28, 28), None, "encoder.layer2"),
    *_block("BasicBlock", "encoder.layer2", (8, 128, 28, 28), 230_144, 295_424),
    ModelRow("Sequential", (8, 256, 14, 14), None, "encoder.layer3"),
    *_block("BasicBlock", "encoder.layer3", (8, 256, 14, 14), 919_040, 1_180_672),
    *_transformer("attention_skip", 28, 128, 66_048, 256, 131_712, 256),
    *_transformer("attention_deepest", 14, 256, 263_168, 512, 525_568, 512),
    *_up("up1", 28, 128, 442_496, 256, 147_584, 256),
    *_up("up2", 56, 64, 110_656, 128, 36_928, 128),
    *_up("up3", 112, 64, 73_792, 128, 36_928, 128),
    ModelRow("ConvTranspose2d", (8, 32, 224, 224), 32_800, "head.up"),
    ModelRow("Conv2d", (8, 1, 224, 224), 289, "head.conv"),
)
"""Every row of table A1, top to bottom."""


@dataclass(frozen=True)
class MethodRow:
    """A row of table 2; None where the paper prints nothing."""

    method: str
    source: str
    """The paper's reference number."""
    abs_rel: float
    rmse: float
    """[m], if the figures are what the paper says."""
    log10: float | None
    delta1: float
    delta2: float
    delta3: float

    @property
    def deltas(self) -> tuple[float, float, float]:
        """Shares of pixels within 1.25, 1.25^2 and 1.25^3."""
        return self.delta1, self.delta2, self.delta3

    def metrics(self) -> dict[str, float | None]:
        """By name, as in :mod:`hudepth.metrics.depth`."""
        return {name: value for name, value in asdict(self).items() if name not in ("method", "source")}


TABLE_2 = (
    MethodRow("Mancini et al.", "[39]", 0.312, 0.565, 0.336, 0.809, 0.786, 0.911),
    MethodRow("Xu et al.", "[40]", 0.125, 0.593, 0.057, 0.806, 0.952, 0.986),
    MethodRow("Alhashim et al.", "[41]", 0.123, 0.465, 0.053, 0.846, 0.974, 0.994),
    MethodRow("Li et al. (VGG16)", "[42]", 0.152, 0.611, 0.064, 0.789, 0.955, 0.988),
    MethodRow("Li et al. (VGG19)", "[42]", 0.146, 0.617, 0.063, 0.795, 0.958, 0.991),
    MethodRow("Li et al. (ResNet50)", "[42]", 0.143, 0.635, 0.063, 0.788, 0.958, 0.991),
    MethodRow("Rudolph et al.", "[43]", 0.138, 0.501, 0.058, 0.823, 0.961, 0.990),
    MethodRow("Lee et al.", "[44]", 0.131, 0.538, None, 0.837, 0.971, 0.994),
    MethodRow("Guizilini et al.", "[45]", 0.072, 2.727, 0.120, 0.932, 0.984, 0.994),
    MethodRow("Basak et al.", "[46]", 0.103, 0.388, None, 0.892, 0.978, 0.995),
    MethodRow("Das et al. (Enc-Dec-IRv2)", "[47]", 0.064, 0.228, 0.032, 0.893, 0.967, 0.985),
    MethodRow("Ignatov et al.", "[48]", 0.090, 0.322, 0.039, 0.929, 0.991, 0.998),
    MethodRow("proposed", "the paper", 0.063, 0.237, 0.026, 0.982, 0.996, 0.998),
)
PROPOSED = TABLE_2[-1]


@dataclass(frozen=True)
class SpeedRow:
    """A row of table 3: inference on one RTX 4090 at 224 x 224."""

    batch: int
    images_per_s: float
    batches_per_s: float
    ms_per_image: float


TABLE_3 = (
    SpeedRow(1, 249.84, 249.84, 4.003),
    SpeedRow(4, 1011.47, 252.87, 0.989),
    SpeedRow(8, 1087.35, 135.92, 0.920),
    SpeedRow(16, 1176.84, 73.55, 0.850),
    SpeedRow(32, 1212.19, 37.88, 0.825),
)
