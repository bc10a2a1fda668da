"""One pass over a test subset that scores predictors under protocols."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from hudepth.base.errors import ConfigError
from hudepth.base.types import Batch
from hudepth.evaluation.baselines import Baseline
from hudepth.evaluation.predictions import FilePredictions
from hudepth.evaluation.scoring import BatchScores, BatchTruth
from hudepth.metrics.protocol import Protocol


class Evaluation(LightningModule):
    """Collects one row of sums per image for each predictor and protocol. Run it with ``Trainer.test``.

    Predictors turn a normalised image into depth / max_depth_m, or are read from files. Boundaries and strata are
    measured of the ``detailed`` one alone, if a protocol asks for them. Raises ConfigError if two protocols have one
    name.
    """

    def __init__(
        self,
        predictors: Mapping[str, nn.Module],
        protocols: Sequence[Protocol],
        *,
        max_depth_m: float,
        detailed: str | None = None,
    ) -> None:
        super().__init__()
        self.predictors = nn.ModuleDict(dict(predictors))
        self.protocols = list(protocols)
        names = [protocol.name for protocol in protocols]
        if len(set(names)) < len(names):
            raise ConfigError(f"protocol: two have the same name among {', '.join(names)}. Give each its own name.")
        self.max_depth_m, self.detailed = max_depth_m, detailed
        self._collected: dict[tuple[str, ...], list[Tensor]] = {}
        # known when the test has ended:
        self.indices: list[int] = []
        """Store positions of the scored images, in the order of the rows."""
        self.sums: dict[tuple[str, str], Float[Tensor, "n k"]] = {}
        """By predictor and protocol; the others by protocol, of the detailed predictor."""
        self.boundary: dict[str, Float[Tensor, "n k"]] = {}
        self.uncertainty: dict[str, Float[Tensor, "n k"]] = {}
        self.strata: dict[str, Float[Tensor, "n bins k"]] = {}

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Score a batch."""
        self._keep(batch["index"], "index")
        truth = BatchTruth(batch, max_depth_m=self.max_depth_m)
        for name, predictor in self.predictors.items():
            if isinstance(predictor, FilePredictions):
                plain_scores = flipped_scores = BatchScores(predictor.read(batch), truth, inverse=predictor.inverse)
                spread = None
            else:
                plain, flipped = self._predict(predictor, batch["image"])
                plain_scores = BatchScores(plain, truth)
                flipped_scores = plain_scores if flipped is None else BatchScores(flipped, truth)
                spread = None if flipped is None else BatchScores((plain - flipped).abs(), truth)
            for protocol in self.protocols:
                scores = flipped_scores if protocol.flip else plain_scores
                self._keep(scores.sums(protocol), "sums", name, protocol.name)
                if name == self.detailed and protocol.boundary:
                    self._keep(scores.boundary(protocol), "boundary", protocol.name)
                if name == self.detailed and protocol.flip and spread is not None:
                    self._keep(scores.uncertainty(protocol, spread), "uncertainty", protocol.name)
                if name == self.detailed and protocol.strata:
                    self._keep(scores.strata(protocol), "strata", protocol.name)

    def _predict(self, predictor: nn.Module, image: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the prediction [m], and its mean with that of the mirrored image if a protocol needs it."""
        plain: Tensor = predictor(image).float() * self.max_depth_m
        if isinstance(predictor, Baseline) or not any(protocol.flip for protocol in self.protocols):
            return plain, None
        mirrored: Tensor = predictor(image.flip(-1)).float() * self.max_depth_m
        return plain, (plain + mirrored.flip(-1)) / 2

    def _keep(self, rows: Tensor, *key: str) -> None:
        self._collected.setdefault(key, []).append(rows.cpu())

    def on_test_epoch_end(self) -> None:
        """Collect the rows of all processes, in the order of the store."""
        gathered = {key: torch.cat(self._gathered(rows)) for key, rows in self._collected.items()}
        indices = gathered.pop(("index",))
        order = indices.argsort()
        self.indices = indices[order].tolist()
        for (kind, *rest), rows in gathered.items():
            if kind == "sums":
                self.sums[rest[0], rest[1]] = rows[order]
            else:
                getattr(self, kind)[rest[0]] = rows[order]

    def _gathered(self, own: list[Tensor]) -> list[Tensor]:
        if self.trainer.world_size == 1:
            return own
        everyone: list[list[Tensor]] = [[]] * self.trainer.world_size
        torch.distributed.all_gather_object(everyone, own)
        return [rows for process in everyone for rows in process]
