"""What a model file says of itself: all that is needed to use it, and where it comes from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from hudepth.base.errors import CheckpointError

VERSION = 1
"""Of the description; exported files carry it as JSON under the key :data:`KEY`."""
KEY = "hudepth"
USUAL_ASPECT = 4 / 3
"""Width over height of training images where a checkpoint does not tell: that of NYU Depth V2, and of most sensors."""
MAX_SIDE = 8192
"""A description that asks for larger images is refused."""


@dataclass(frozen=True)
class ModelInfo:
    """What is known of a model."""

    name: str
    """Class of the network, as in ``HybridUNet``."""
    size: tuple[int, int]
    """(height, width) of the images the network takes."""
    max_depth_m: float
    """What unit depth 1 stands for."""
    parameters: int
    epoch: int
    """Finished epochs of training."""
    trained_on: dict[str, Any] = field(default_factory=dict)
    """Source, fingerprint, encoding and split of the training data."""
    aspect: float = USUAL_ASPECT
    """Width over height of the training images before they were resized."""
    processing: bool = True
    """Whether an exported graph takes RGB bytes and answers in metres (else normalised images, unit depth)."""

    def to_json(self) -> str:
        """Return the description as JSON."""
        return json.dumps({"version": VERSION, **asdict(self)}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str, *, where: str) -> ModelInfo:
        """Read what :meth:`to_json` wrote; nothing of it is believed that is out of range.

        Raises:
            CheckpointError: if it is no such description.
        """
        try:
            content = json.loads(text)
            if not isinstance(content, Mapping) or content.get("version") != VERSION:
                raise ValueError("another version")
            height, width = (int(side) for side in content["size"])
            depth, aspect = float(content["max_depth_m"]), float(content["aspect"])
            if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and 0 < depth < 1e6 and 0.01 < aspect < 100):
                raise ValueError("values out of range")
            return cls(
                name=str(content["name"])[:100],
                size=(height, width),
                max_depth_m=depth,
                parameters=int(content["parameters"]),
                epoch=int(content["epoch"]),
                trained_on=dict(content["trained_on"]),
                aspect=aspect,
                processing=bool(content["processing"]),
            )
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise CheckpointError(
                f"{where}: its description of the model cannot be read ({error}). Export it again with hudepth-export."
            ) from error
