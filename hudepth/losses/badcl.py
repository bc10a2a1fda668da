"""Boundary-Aware Depth Consistency Loss (Turkmen and Akgun 2025, sections 3.2 to 3.4)::

    L_boundary   = 1/N sum_i B(i) |D^(i) - D(i)|        B(i) = exp(sqrt(Ix^2 + Iy^2))
    L_smoothness = 1/N sum_i |D^_x(i)| exp(-|Ix(i)|) + |D^_y(i)| exp(-|Iy(i)|)
    L_scaling    = 1/N sum_i s |D^(i) - D(i)|           s = sum_i D(i) / (sum_i D^(i) + eps)
    L_BADCL      = 3.0 L_boundary + 1.2 L_smoothness + 1.0 L_scaling

D is the ground truth, D^ the prediction, I the image. N counts the valid pixels of the batch, and all pixels in
L_smoothness, which concerns the prediction only. What the paper leaves open is an option of :class:`BADCL`.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from hudepth.base.masked import masked_mean, masked_sum
from hudepth.base.normalise import denormalise_image
from hudepth.base.options import Choice, Range, convert
from hudepth.base.types import DepthMap, Mask
from hudepth.losses.base import Loss, check_weights, difference

CHOICES = {
    "boundary_sign": ("plus", "minus"),
    "image_space": ("unit", "normalised"),
    "image_channels": ("grey", "colour"),
    "scale_per": ("image", "batch"),
    "scale_mode": ("weight", "align"),
    "scale_gradient": ("flow", "stop"),
}
"""The named options of :class:`BADCL` and their values, the default first."""

BT601_LUMA = (0.299, 0.587, 0.114)
"""Weights of R, G and B in luma (ITU-R BT.601)."""


def check_choices(**options: str) -> None:
    """Raise :class:`ConfigError` if an option's value is not among its :data:`CHOICES`."""
    for option, value in options.items():
        convert(f"loss.{option}", value, Annotated[str, Choice(CHOICES[option])], default=CHOICES[option][0])


def forward_difference(x: Float[Tensor, "b c h w"], *, dim: int) -> Float[Tensor, "b c h w"]:
    """Next pixel minus this one along ``dim`` (-1: horizontal, -2: vertical); 0 in the last column or row."""
    return torch.diff(x, dim=dim, append=x.narrow(dim, -1, 1))


def luma(image: Float[Tensor, "b 3 h w"]) -> DepthMap:
    """BT.601 luma of an RGB image, in the image's units."""
    red, green, blue = image.unbind(dim=1)
    return (BT601_LUMA[0] * red + BT601_LUMA[1] * green + BT601_LUMA[2] * blue).unsqueeze(1)


def boundary_weight(
    image_dx: Float[Tensor, "b c h w"], image_dy: Float[Tensor, "b c h w"], *, sign: str = "plus"
) -> DepthMap:
    """``B = exp(+-|grad I|)``, the gradient's magnitude averaged over channels (equation 2).

    The differences of the image are expected without gradient: the root has none at 0. ``sign``: "plus" stresses edges,
    as the paper says of B; "minus" spares them. Raises ConfigError if it is neither.
    """
    check_choices(boundary_sign=sign)
    magnitude = torch.hypot(image_dx, image_dy).mean(dim=1, keepdim=True)
    return torch.exp(magnitude if sign == "plus" else -magnitude)


def boundary_loss(pred: DepthMap, target: DepthMap, weight: DepthMap, valid: Mask) -> Float[Tensor, ""]:
    """Mean over valid pixels of the absolute error times its :func:`boundary_weight` (equation 1)."""
    return masked_mean(weight * difference(pred, target, valid).abs(), valid)


def smoothness_loss(
    pred: DepthMap, image_dx: Float[Tensor, "b c h w"], image_dy: Float[Tensor, "b c h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference of neighbouring predictions, damped where the image has edges (equation 3).

    It is averaged over all pixels, so it also acts where the ground truth is unmeasured. Over several channels the
    magnitudes of the image's differences are averaged.
    """
    weight_x, weight_y = (torch.exp(-x.abs().mean(dim=1, keepdim=True)) for x in (image_dx, image_dy))
    horizontal = forward_difference(pred, dim=-1).abs() * weight_x
    vertical = forward_difference(pred, dim=-2).abs() * weight_y
    return (horizontal + vertical).mean()


def scaling_factor(
    pred: DepthMap, target: DepthMap, valid: Mask, *, per: str = "image", eps: float = 1e-8
) -> Float[Tensor, "n 1 1 1"]:
    """The factor s = sum D / (sum D^ + eps) of equation 5, over the valid pixels of each "image" or of the "batch" (n =
    1).

    A negative sum of predictions, which unit depth cannot have, counts as 0: s stays finite and not negative. Raises
    ConfigError if ``per`` is neither "image" nor "batch".
    """
    check_choices(scale_per=per)
    dim = (1, 2, 3) if per == "image" else (0, 1, 2, 3)
    return masked_sum(target, valid, dim=dim) / (masked_sum(pred, valid, dim=dim).clamp_min(0) + eps)


def scaling_loss(
    pred: DepthMap,
    target: DepthMap,
    valid: Mask,
    *,
    per: str = "image",
    mode: str = "weight",
    gradient: str = "flow",
    eps: float = 1e-8,
) -> Float[Tensor, ""]:
    """Mean over valid pixels of an error that is scaled by s (equation 4; see :func:`scaling_factor`), on unit depth.

    ``mode`` is "weight": ``s |D^ - D|``, as printed; or "align": ``|s D^ - D|``, the usual alignment of scale.
    ``gradient`` is "flow" through s, or "stop" there. Raises ConfigError if an option is unknown.
    """
    check_choices(scale_mode=mode, scale_gradient=gradient)
    factor = scaling_factor(pred, target, valid, per=per, eps=eps)
    if gradient == "stop":
        factor = factor.detach()
    if mode == "weight":
        return masked_mean(factor * difference(pred, target, valid).abs(), valid)
    return masked_mean(difference(factor * pred, target, valid).abs(), valid)


class BADCL(Loss):
    """The paper's loss: boundary, smoothness and scaling terms, weighted and summed (section 3.3).

    Args:
        boundary, smoothness, scaling: weights of the terms, at least 0. A term of weight 0 is not computed.
        eps: added to the sum of predictions in the scaling factor, at least 1e-12.
        boundary_sign: "plus" or "minus" in the exponent of the boundary weight.
        image_space: "unit": the image in [0, 1] guides both weights; "normalised": as the network sees it.
        image_channels: "grey": gradients of the luma; "colour": their magnitudes averaged over channels.
        scale_per: one scaling factor per "image" or per "batch".
        scale_mode, scale_gradient: as in :func:`scaling_loss`.

    Raises:
        ConfigError: if an option is unknown, a weight negative or not finite, all are 0, or eps is too small.
    """

    def __init__(
        self,
        *,
        boundary: float = 3.0,
        smoothness: float = 1.2,
        scaling: float = 1.0,
        eps: float = 1e-8,
        boundary_sign: str = "plus",
        image_space: str = "unit",
        image_channels: str = "grey",
        scale_per: str = "image",
        scale_mode: str = "weight",
        scale_gradient: str = "flow",
    ) -> None:
        super().__init__()
        self.weights = {"boundary": boundary, "smoothness": smoothness, "scaling": scaling}
        check_weights("loss", self.weights)
        convert("loss.eps", eps, Annotated[float, Range(1e-12)], default=1e-8)  # smaller ones vanish in float32
        check_choices(boundary_sign=boundary_sign, image_space=image_space, image_channels=image_channels)
        check_choices(scale_per=scale_per, scale_mode=scale_mode, scale_gradient=scale_gradient)
        self.boundary_sign, self.image_space, self.image_channels = boundary_sign, image_space, image_channels
        self.scaling_loss = partial(scaling_loss, per=scale_per, mode=scale_mode, gradient=scale_gradient, eps=eps)

    def terms(self, pred: Tensor, target: Tensor, image: Tensor, valid: Tensor) -> dict[str, Tensor]:
        """Return the terms whose weight is not 0; finite for any prediction and target in [0, 1]."""
        terms = {}
        if self.weights["boundary"] or self.weights["smoothness"]:
            guide = denormalise_image(image) if self.image_space == "unit" else image
            guide = luma(guide) if self.image_channels == "grey" else guide
            dx, dy = forward_difference(guide, dim=-1), forward_difference(guide, dim=-2)
        if self.weights["boundary"]:
            weight = boundary_weight(dx, dy, sign=self.boundary_sign)
            terms["boundary"] = boundary_loss(pred, target, weight, valid)
        if self.weights["smoothness"]:
            terms["smoothness"] = smoothness_loss(pred, dx, dy)
        if self.weights["scaling"]:
            terms["scaling"] = self.scaling_loss(pred, target, valid)
        return terms
