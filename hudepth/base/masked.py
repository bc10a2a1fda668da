"""Sums and means over valid pixels, in full precision: the reductions of every loss and metric."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

WITHOUT_FLOAT64 = {"mps"}


def full_precision(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return ``x`` as float32, or as it is if float64: half precision cannot hold a sum over an image."""
    return x if x.dtype == torch.float64 else x.float()


def widest_float(device: torch.device) -> torch.dtype:
    """Return float64, in which sums over images are kept, or float32 on MPS, which has no float64."""
    return torch.float32 if device.type in WITHOUT_FLOAT64 else torch.float64


def widen(x: Shaped[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return ``x`` in the :func:`widest_float` of its device."""
    return x.to(widest_float(x.device))


def masked_sum(
    x: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"], *, dim: tuple[int, ...] | None = None
) -> Float[Tensor, "*reduced"]:
    """Sum ``x`` where ``valid``: over all dimensions, or over ``dim``, which then stay with size 1.

    Invalid values may be NaN or infinite: they reach neither the sum nor the gradient of ``x``. But 0 times
    NaN is NaN in the gradient of what computed ``x``: mask its inputs where they enter the arithmetic.
    """
    return torch.where(valid, x, 0.0).sum(dim=dim, keepdim=dim is not None)


def masked_mean(x: Float[Tensor, "*shape"], valid: Bool[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Mean of ``x`` where ``valid``, over all dimensions; 0 with zero gradient where nothing is valid."""
    return masked_sum(x, valid) / valid.sum().clamp_min(1)
