"""One pass over a test subset: any number of predictors, scored under any number of protocols."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from hudepth.data.store import DepthStore
from hudepth.errors import ConfigError
from hudepth.metrics.protocol import Protocol
from hudepth.types import Batch


class ConstantDepth(nn.Module):
    """A trivial baseline: answers every image with the same unit depth map.

    Args:
        unit_depth: [1, 1, h, w].
    """

    unit_depth: Tensor

    def __init__(self, unit_depth: Float[Tensor, "1 1 h w"]) -> None:
        super().__init__()
        self.register_buffer("unit_depth", unit_depth)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return the map, once for each image."""
        return self.unit_depth.expand(len(image), -1, -1, -1)


def trivial_baselines(store: DepthStore, train: Sequence[int], *, max_depth_m: float) -> dict[str, nn.Module]:
    """Make the baselines any model must beat, from the training subset alone.

    Args:
        store: holds the truth.
        train: positions of the training pairs.
        max_depth_m: depth is clipped to it and divided by it.

    Returns:
        ``mean_depth_map``: each pixel's mean over the training set; ``mean_depth``: one mean for all pixels.
    """
    total = torch.zeros(store.size, dtype=torch.float64)
    count = torch.zeros(store.size, dtype=torch.float64)
    for start in range(0, len(train), 64):
        _, depth_mm = store.read(train[start : start + 64])
        unit = (torch.from_numpy(depth_mm).double() / (1000 * max_depth_m)).clamp_(max=1)
        total += unit.sum(dim=0)
        count += (unit > 0).sum(dim=0)
    mean = total.sum() / count.sum()
    mean_map = torch.where(count > 0, total / count.clamp(min=1), mean)
    return {
        "mean_depth_map": ConstantDepth(mean_map.float()[None, None]),
        "mean_depth": ConstantDepth(mean.expand(store.size).float()[None, None]),
    }


class Evaluation(LightningModule):
    """Collects, for each predictor and protocol, one row of sums an image. Run it with ``Trainer.test``.

    Args:
        predictors: by name; normalised image to unit depth.
        protocols: how to score.
        max_depth_m: what unit depth 1 stands for.

    Raises:
        ConfigError: if two protocols have one name, which would mix their rows.
    """

    def __init__(
        self, predictors: Mapping[str, nn.Module], protocols: Sequence[Protocol], *, max_depth_m: float
    ) -> None:
        super().__init__()
        self.predictors = nn.ModuleDict(dict(predictors))
        self.protocols = list(protocols)
        names = [protocol.name for protocol in protocols]
        if len(set(names)) < len(names):
            raise ConfigError(f"protocol: two have one name among {', '.join(names)}. Give each its own name.")
        self.max_depth_m = max_depth_m
        self._rows: dict[tuple[str, str], list[Tensor]] = {}
        self._indices: list[Tensor] = []
        self.indices: list[int] = []
        """Store positions of the scored images, in the order of the rows; known when the test has ended."""
        self.sums: dict[tuple[str, str], Float[Tensor, "n k"]] = {}
        """Rows by predictor and protocol, an image each; known when the test has ended."""

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Score a batch."""
        self._indices.append(batch["index"].cpu())
        for name, predictor in self.predictors.items():
            pred_m = predictor(batch["image"]).float() * self.max_depth_m
            for protocol in self.protocols:
                sums = protocol.score(pred_m, batch, max_depth_m=self.max_depth_m)
                self._rows.setdefault((name, protocol.name), []).append(sums.cpu())

    def on_test_epoch_end(self) -> None:
        """Collect the rows of all processes, in the order of the store."""
        indices = torch.cat(self._collected(self._indices))
        order = indices.argsort()
        self.indices = indices[order].tolist()
        self.sums = {key: torch.cat(self._collected(rows))[order] for key, rows in self._rows.items()}

    def _collected(self, own: list[Tensor]) -> list[Tensor]:
        if self.trainer.world_size == 1:
            return own
        everyone: list[list[Tensor]] = [[]] * self.trainer.world_size
        torch.distributed.all_gather_object(everyone, own)
        return [rows for process in everyone for rows in process]
