"""Names and shapes of what flows through hudepth."""

from __future__ import annotations

from typing import NamedTuple, NotRequired, TypedDict

from jaxtyping import Bool, Float, Int, UInt8, UInt16
from torch import Tensor

DepthMap = Float[Tensor, "b 1 h w"]
Mask = Bool[Tensor, "b 1 h w"]


class RawBatch(TypedDict):
    """What the loader reads from the depth store, before it is moved to a device."""

    image: UInt8[Tensor, "b h w 3"]
    """RGB."""
    stored_depth: UInt16[Tensor, "b h w"]
    """Depth as the store holds it, 0 where unmeasured: ``per_m`` to the metre, or millimetres."""
    per_m: NotRequired[int]
    index: Int[Tensor, " b"]
    """Position in the depth store."""
    native_depth: NotRequired[list[Float[Tensor, "1 H W"]]]
    """Test batches only: truth at its native resolution [m], 0 where unmeasured."""
    teacher_m: NotRequired[Float[Tensor, "b h w"]]
    """Training batches with a teacher only: its depth, 0 where there is none [m, or as the teacher has it]."""


class Batch(TypedDict):
    """What the network, the losses and the metrics see."""

    image: Float[Tensor, "b 3 h w"]
    """RGB, normalised with ImageNet's mean and standard deviation."""
    unit_depth: Float[Tensor, "b 1 h w"]
    """Depth clipped to ``max_depth_m`` and divided by it, in [0, 1]; 0 where unmeasured."""
    valid: Bool[Tensor, "b 1 h w"]
    """True where the truth is measured."""
    index: Int[Tensor, " b"]
    """Position in the depth store."""
    teacher: NotRequired[Float[Tensor, "b 1 h w"]]
    """Training batches with a teacher only: its depth / ``max_depth_m``, not clipped; 0 where there is none."""
    emptied: NotRequired[Bool[Tensor, ""]]
    """Augmented batches only: whether there was measured depth before augmentation, and none is left."""
    small_image: NotRequired[Float[Tensor, "b 3 h2 w2"]]
    """Validation batches only, and only while the network trains at another size: ``image`` at that size."""
    native_depth: NotRequired[list[Float[Tensor, "1 H W"]]]
    """Test batches only: truth at its native resolution [m], 0 where unmeasured."""


class LossTerms(NamedTuple):
    """A loss and what it consists of."""

    total: Float[Tensor, ""]
    """What is minimised: the weighted sum."""
    terms: dict[str, Float[Tensor, ""]]
    """Each term by name, before its weight."""
