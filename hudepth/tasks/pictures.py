"""Panels of a finished run, drawn anew from its checkpoint and its data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hudepth.callbacks import make_panels
from hudepth.checkpoint import load_checkpoint
from hudepth.data.datamodule import DepthDataModule
from hudepth.errors import DataError
from hudepth.tasks.test import open_data
from hudepth.viz.panels import Panel


def run_panels(
    run: Path, choose: Callable[[DepthDataModule], Sequence[int]], *, config: Mapping[str, Any]
) -> list[Panel]:
    """Predict some pairs of a run's data with its best checkpoint.

    Args:
        run: the run directory.
        choose: returns the positions of the pairs in the depth store.
        config: with ``paths``, ``data`` (keys that stand above the checkpoint's) and ``trust``.

    Raises:
        HudepthError: if the checkpoint or the data is not there or not what it was.
    """
    checkpoint = load_checkpoint(str(run))
    typed = {"cache": config["paths"]["cache"], **config["data"]}
    datamodule, _ = open_data(checkpoint, typed, overrides=[], trust=config["trust"])
    net = checkpoint.build_net(trust=config["trust"])
    return make_panels(net, datamodule.store, choose(datamodule), max_depth_m=datamodule.max_depth_m)


def panels_beside(runs: Mapping[str, Path], ids: Sequence[str], *, config: Mapping[str, Any]) -> list[Panel]:
    """Predict the same images with several runs: for each image a row a run, titled with the run's name.

    Args:
        runs: run directories by the name to show.
        ids: of the images.
        config: as for :func:`run_panels`.

    Raises:
        HudepthError: as :func:`run_panels`, or if a run's data does not have an image.
    """

    def positions(datamodule: DepthDataModule) -> list[int]:
        known = {record.id: position for position, record in enumerate(datamodule.store.records)}
        lacking = [image for image in ids if image not in known]
        if lacking:
            raise DataError(f"the data has no image '{lacking[0]}'.")
        return [known[image] for image in ids]

    rows = [
        [replace(panel, title=f"{name}: {panel.title}") for panel in run_panels(run, positions, config=config)]
        for name, run in runs.items()
    ]
    return [panel for same in zip(*rows, strict=True) for panel in same]
