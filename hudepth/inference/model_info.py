"""The description that every model file carries: all that is needed to use it, and what it was trained on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

from hudepth.base.camera import NYU_FOCAL, Intrinsics
from hudepth.base.errors import CheckpointError, ConfigError
from hudepth.base.options import Range, parse
from hudepth.inference.calibration import Calibration, Focal
from hudepth.runs.checkpoint import Checkpoint

CALIBRATION = "calibration"  # key of a calibrated bundle's data
VERSION = 1  # of the description that exported files carry
USUAL_ASPECT = 4 / 3  # width over height if a checkpoint does not record it: that of NYU Depth V2 and most sensors
NYU_SOURCES = ("nyu_labeled", "nyu_mat", "nyu_raw", "densedepth", "rooms")  # taken or rendered with NYU's camera
MAX_SIDE = 8192  # descriptions that ask for larger images are refused


@dataclass(frozen=True)
class ModelInfo:
    """What is known about a model."""

    name: str  #: class of the network, for example HybridUNet
    size: Annotated[tuple[int, int], Range(1, MAX_SIDE)]  #: (height, width) of the images the network takes
    max_depth_m: Annotated[float, Range(0, 1e6, above=True)]
    """Maximum depth [m]; the network predicts depth / max_depth_m."""
    parameters: int
    epoch: int  #: finished epochs of training
    trained_on: dict[str, Any] = field(default_factory=dict)  #: source, fingerprint, encoding and split of the data
    aspect: Annotated[float, Range(0.01, 100)] = USUAL_ASPECT  #: width over height of the original training images
    focal: tuple[Focal, Focal] | None = None
    """Focal lengths of the training camera over the sides of its pictures, horizontal and vertical; see
    :attr:`training_focal`."""
    calibration: Calibration | None = None  #: is applied to the metres that the network predicts
    processing: bool = True  #: whether a graph maps RGB bytes to metres, else normalised images to unit depth

    def __str__(self) -> str:
        source, size = self.trained_on.get("source") or "unknown data", f"{self.size[0]} x {self.size[1]}"
        network = f"{self.name} of {self.parameters:,} parameters"
        words = f"{network}, trained on {source} for {self.epoch} epochs; {size}, up to {self.farthest_m:.4g} m"
        return f"{words}; {self.calibration}" if self.calibration else words

    @property
    def farthest_m(self) -> float:
        """Largest depth it predicts for a picture of the training camera [m]."""
        return self.calibration.apply(self.max_depth_m) if self.calibration else self.max_depth_m

    @property
    def training_focal(self) -> tuple[float, float] | None:
        """``focal``, NYU's for its data sets and the rooms; None if the training camera is not known.

        Of a calibrated model, the camera that it was calibrated for.
        """
        if self.calibration is not None:
            return self.calibration.focal
        return self.focal or (NYU_FOCAL if self.trained_on.get("source") in NYU_SOURCES else None)

    def assumed_camera(self, height: int, width: int) -> Intrinsics:
        """Return the training camera for a picture of this size; NYU's if that is not known.

        It has square pixels, and the field of view of the longer side, where the shapes differ.
        """
        focal = self.focal if self.calibration is None else self.calibration.focal
        if focal is None or focal == NYU_FOCAL:
            return Intrinsics.of_photo(height, width)
        fx, fy = focal[0] * width, focal[1] * height
        if abs(width / height / (focal[1] / focal[0]) - 1) >= 0.01:
            fx = fy = min(focal) * max(height, width)
        return Intrinsics.centred(fx, fy, height, width, known=False, origin="the training camera, assumed")

    def to_json(self) -> str:
        """Return the description as JSON."""
        return json.dumps({"version": VERSION, **asdict(self)}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str, *, where: str) -> ModelInfo:
        """Read what :meth:`to_json` wrote; raises CheckpointError for anything else and for values out of range."""
        try:
            content = json.loads(text)
            if not isinstance(content, Mapping) or content.get("version") != VERSION:
                raise ValueError("unknown version")
            info = parse(cls, content)
        except (ValueError, RecursionError, ConfigError) as error:
            message = f"its model description cannot be read ({error}). Export it again with hudepth-export."
            raise CheckpointError(f"{where}: {message}") from error
        return replace(info, name=" ".join(info.name[:100].split()))

    @classmethod
    def of_checkpoint(
        cls, checkpoint: Checkpoint, *, parameters: int, size: tuple[int, int] | None = None
    ) -> ModelInfo:
        """Describe a checkpoint, by default at its training's size; raises CheckpointError if it records no data."""
        data: Any = checkpoint.config.get("data")
        try:
            height, width = size or data["size"]
            native = checkpoint.data.get("native_sizes") or []
            trained_on = {key: value for key, value in checkpoint.data.items() if key != CALIBRATION}
            values = {
                "name": str(checkpoint.config["model"].get("_target_", "")).rpartition(".")[2],
                "size": [int(height), int(width)],
                "max_depth_m": float(data["max_depth_m"]),
                "parameters": parameters,
                "epoch": checkpoint.epoch,
                "trained_on": {**trained_on, "split": checkpoint.split},
                "calibration": checkpoint.data.get(CALIBRATION),
                "focal": checkpoint.data.get("focal"),
                "aspect": native[0][1] / native[0][0] if len(native) == 1 else USUAL_ASPECT,
            }
            return parse(cls, values, prefix="data." if size is None else "")
        except ConfigError as error:
            if size is not None:
                raise
            raise CheckpointError(f"'{checkpoint.path}' is refused: {error}") from error
        except (TypeError, KeyError, ValueError, IndexError, ZeroDivisionError, OverflowError) as error:
            raise CheckpointError(f"'{checkpoint.path}' does not record what data it was trained on.") from error
