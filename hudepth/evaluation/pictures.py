"""Predictions of a network as panels, for pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from hudepth.base.errors import DataError
from hudepth.base.types import RawBatch
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.dataset import StoreDataset
from hudepth.data.preprocess import preprocess
from hudepth.data.store import DepthStore
from hudepth.evaluation.test_data import open_data
from hudepth.runs.checkpoint import load_checkpoint
from hudepth.viz.panels import Panel


def run_panels(
    run: Path, choose: Callable[[DepthDataModule], Sequence[int]], *, config: Mapping[str, Any]
) -> list[Panel]:
    """Predict pairs of a run's data with its best checkpoint; ``choose`` returns their positions in the depth store.

    ``config`` has ``paths``, ``data`` (overrides of the checkpoint's) and ``trust``. Raises HudepthError if the
    checkpoint or its data is missing or has changed.
    """
    checkpoint = load_checkpoint(str(run))
    typed = {"cache": config["paths"]["cache"], **config["data"]}
    datamodule, _ = open_data(checkpoint, typed, trust=config["trust"])
    net = checkpoint.build_net(trust=config["trust"])
    return make_panels(net, datamodule.store, choose(datamodule), max_depth_m=datamodule.max_depth_m)


def panels_beside(runs: Mapping[str, Path], ids: Sequence[str], *, config: Mapping[str, Any]) -> list[Panel]:
    """Predict the same images with several runs; return one panel per image and run, titled with the run's name.

    Raises HudepthError as :func:`run_panels`, or if a run's data lacks an image.
    """

    def positions(datamodule: DepthDataModule) -> list[int]:
        known = {record.id: position for position, record in enumerate(datamodule.store.records)}
        if missing := [image for image in ids if image not in known]:
            raise DataError(f"the data has no image '{missing[0]}'.")
        return [known[image] for image in ids]

    rows = [
        [replace(panel, title=f"{name}: {panel.title}") for panel in run_panels(run, positions, config=config)]
        for name, run in runs.items()
    ]
    return [panel for same in zip(*rows, strict=True) for panel in same]


@torch.inference_mode()
def make_panels(module: nn.Module, store: DepthStore, indices: Sequence[int], *, max_depth_m: float) -> list[Panel]:
    """Predict pairs of a store; the network turns a normalised image into depth / max_depth_m."""
    was_training = module.training
    module.eval()
    device = next(module.parameters()).device

    def predict(raw: RawBatch, truth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        image = preprocess(raw, max_depth_m=max_depth_m)["image"]
        unit: NDArray[np.float32] = module(image.to(device)).float().cpu()[0, 0].numpy()
        return unit * np.float32(max_depth_m)

    panels = draw_beside(predict, store, indices, max_depth_m=max_depth_m)
    module.train(was_training)
    return panels


def draw_beside(
    predict: Callable[[RawBatch, NDArray[np.float32]], NDArray[np.float32]],
    store: DepthStore,
    indices: Sequence[int],
    *,
    max_depth_m: float,
) -> list[Panel]:
    """Return panels of pairs of a store; ``predict`` returns depth [h, w] [m] for a batch of one and its truth [m]."""
    panels = []
    dataset = StoreDataset(store, indices)
    for position in range(len(dataset)):  # a DataLoader would advance the random generator of the training
        raw = dataset[position]
        truth_m = np.minimum(raw["stored_depth"][0].numpy() / np.float32(store.per_m), np.float32(max_depth_m))
        record = store.records[int(raw["index"][0])]
        panels.append(Panel(raw["image"][0].numpy(), truth_m, predict(raw, truth_m), title=record.id))
    return panels


def evenly_spaced(indices: Sequence[int], count: int) -> list[int]:
    """Return ``count`` of ``indices``, evenly spaced; all if there are fewer."""
    count = min(count, len(indices))
    return [indices[i * len(indices) // count] for i in range(count)]
