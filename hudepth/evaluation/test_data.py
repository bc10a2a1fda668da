"""The data to test a checkpoint on: its own test split, or another data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError, ConfigError, DataError, did_you_mean
from hudepth.data.build import build_data
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.lineage import read_split, refuse_training_pairs
from hudepth.runs.checkpoint import Checkpoint


def open_data(
    checkpoint: Checkpoint, overrides: Mapping[str, Any], *, typed: Sequence[str] = (), trust: list[str]
) -> tuple[DepthDataModule, bool]:
    """Return the data to test a checkpoint on, and whether data set or split differ from those of the training.

    ``overrides`` replace keys of the checkpoint's ``data``, or with ``_target_`` all of it; ``typed`` are the
    command-line overrides, which tell a chosen size from the data set's default. Raises HudepthError if the data cannot
    be built, or if test pairs were trained on.
    """
    datamodule = build_data(_data_config(checkpoint, overrides, typed), trust=trust)
    other_data = "_target_" in overrides or any(key.startswith(("split", "fractions")) for key in overrides)
    if other_data:
        refuse_training_pairs(checkpoint, datamodule, subsets=("test",))
    else:
        _restore_split(checkpoint, datamodule)
    return datamodule, other_data


def _data_config(checkpoint: Checkpoint, overrides: Mapping[str, Any], typed: Sequence[str]) -> dict[str, Any]:
    """Return the data to test on, at the input size of the training unless overridden, and always at its scale."""
    trained = checkpoint.config.get("data")
    if not isinstance(trained, dict):
        raise CheckpointError(f"'{checkpoint.path}' does not state what data it was trained on. Pass another.")
    if "_target_" in overrides:
        keys = {override.lstrip("+").partition("=")[0] for override in typed}
        kept = [key for key in ("size", "max_depth_m") if key in trained and f"data.{key}" not in keys]
        data = {**overrides, **{key: trained[key] for key in kept}}
    else:
        if unknown := [key for key in overrides if key not in trained]:
            hint = f"{did_you_mean(unknown[0], trained)} To test on another data set pass data=<name>."
            raise ConfigError(f"data.{unknown[0]}: the checkpoint's data has no such key.{hint}")
        data = {**trained, **overrides, "source": {**trained.get("source", {}), **overrides.get("source", {})}}
    if (before_m := trained.get("max_depth_m")) != (now_m := data.get("max_depth_m")):
        raise ConfigError(
            f"data.max_depth_m: the network was trained for {before_m} m, which scales its output, not for {now_m} m. "
            "Leave data.max_depth_m out."
        )
    return data


def _restore_split(checkpoint: Checkpoint, datamodule: DepthDataModule) -> None:
    """Use the split of the training: from its split.json, else made again and compared by hash."""
    datamodule.split = read_split(checkpoint, datamodule) or datamodule.split
    if datamodule.store.info["fingerprint"] != checkpoint.data.get("fingerprint"):
        log.warning("the files of %s have changed since the checkpoint was trained", datamodule.source.name)
    if datamodule.split.sha256 != checkpoint.split.get("sha256"):
        raise DataError(
            f"'{checkpoint.path}': the split of {datamodule.source.name} is not the one it was trained with, so test "
            "pairs may have been trained on. "
            "Pass the data.root it was trained on, or data=<name> to test on other data."
        )
