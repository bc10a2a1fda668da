"""Heads that only a training has: they predict normals and edges of the ground truth from the decoder's last map.

What a map must know to tell them helps depth, too; the network that is tested and exported is without them.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from hudepth.base.camera.intrinsics import NYU_FOCAL
from hudepth.base.errors import ConfigError
from hudepth.base.masked import full_precision, masked_mean
from hudepth.base.types import DepthMap, LossTerms, Mask
from hudepth.losses.base import check_weights

EDGE_RATIO = 1.15
"""Of the farthest to the nearest depth among 3 x 3 pixels, from which on there is an edge between them."""
CHANNELS = {"normals": 3, "edges": 1}


def surface_normals(depth: DepthMap) -> Float[Tensor, "b 3 h-2 w-2"]:
    """Return unit normals towards the camera, x right, y down, z forward, of all pixels but the outermost.

    Depth has any unit; the camera is NYU's, its principal point the centre. Normals come from central differences, so
    they mean nothing at an edge.
    """
    height, width = depth.shape[-2:]
    x = ((torch.arange(width, device=depth.device) + 0.5) / width - 0.5) / NYU_FOCAL[0]
    y = ((torch.arange(height, device=depth.device) + 0.5) / height - 0.5) / NYU_FOCAL[1]
    points = torch.cat([x * depth, y[:, None] * depth, depth], dim=1)
    across = points[:, :, 1:-1, 2:] - points[:, :, 1:-1, :-2]
    down = points[:, :, 2:, 1:-1] - points[:, :, :-2, 1:-1]
    return functional.normalize(torch.linalg.cross(down, across, dim=1), dim=1)


def depth_edges(depth: DepthMap) -> Bool[Tensor, "b 1 h-2 w-2"]:
    """Return where depth jumps by :data:`EDGE_RATIO` among 3 x 3 pixels, of all pixels but the outermost."""
    log = depth.clamp_min(1e-6).log()
    return functional.max_pool2d(log, 3, 1) + functional.max_pool2d(-log, 3, 1) > math.log(EDGE_RATIO)


class AuxiliaryHeads(nn.Module):
    """Convolutions that predict :func:`surface_normals` and :func:`depth_edges` at half the image's size.

    ``normals`` is the weight of one minus the cosine between predicted and true normal, where there is no edge;
    ``edges`` that of the binary cross-entropy. 0 leaves a head out. Raises ConfigError if a weight is negative or not
    finite, or both are 0.
    """

    def __init__(self, *, normals: float = 0.5, edges: float = 0.5) -> None:
        super().__init__()
        weights = {"normals": normals, "edges": edges}
        check_weights("auxiliary", weights)
        self.weights = {name: float(weight) for name, weight in weights.items() if weight}
        self._map: Tensor | None = None

    def attach(self, net: nn.Module) -> AuxiliaryHeads:
        """Add the heads to what goes into the head of a UNet; raises ConfigError if ``net`` is none."""
        head = getattr(net, "head", None)
        channels = getattr(getattr(head, "up", None), "in_channels", None)
        if head is None or channels is None:
            raise ConfigError(f"auxiliary: {type(net).__name__} has no decoder's map to use. Pass auxiliary=none.")
        self.heads = nn.ModuleDict({name: nn.Conv2d(channels, CHANNELS[name], 3, padding=1) for name in self.weights})
        head.register_forward_pre_hook(self._keep)
        return self

    def forward(self, unit_depth: DepthMap, valid: Mask) -> LossTerms:
        """Return the losses of the last pass of the network in training, for its ground truth.

        Depth that was clipped to 1 has lost its shape and does not count.
        """
        seen, self._map = self._map, None
        assert seen is not None
        with torch.autocast(seen.device.type, enabled=False):
            seen = full_precision(seen)
            size = seen.shape[-2:]
            valid = valid & (unit_depth < 1)
            depth = torch.where(valid, full_precision(unit_depth), 0.0)
            known = functional.interpolate(valid.to(depth), size, mode="area") > 0.999
            depth = torch.where(known, functional.interpolate(depth, size, mode="area"), 1.0)
            known = -functional.max_pool2d(-known.to(depth), 3, 1) > 0  # with all its neighbours
            edges = depth_edges(depth)
            found = {name: head(seen)[:, :, 1:-1, 1:-1] for name, head in self.heads.items()}
            terms = {}
            if "normals" in found:
                cosine = functional.cosine_similarity(found["normals"], surface_normals(depth), dim=1)[:, None]
                terms["normals"] = masked_mean(1 - cosine, known & ~edges)
            if "edges" in found:
                entropy = functional.binary_cross_entropy_with_logits(found["edges"], edges.to(depth), reduction="none")
                terms["edges"] = masked_mean(entropy, known)
            return LossTerms(torch.stack([self.weights[name] * each for name, each in terms.items()]).sum(), terms)

    def _keep(self, head: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        if head.training:  # else nothing would ask for it, and a copy of the network would copy it
            self._map = inputs[0]
