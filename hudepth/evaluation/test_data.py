"""The data to test a checkpoint on: its own test split, or another data set."""

from __future__ import annotations

from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError, ConfigError, DataError, did_you_mean
from hudepth.data.build import build_data
from hudepth.data.datamodule import DepthDataModule
from hudepth.evaluation.lineage import recorded_split, refuse_training_pairs
from hudepth.runs.checkpoint import Checkpoint


def open_data(
    checkpoint: Checkpoint, typed: dict[str, Any], *, overrides: list[str], trust: list[str]
) -> tuple[DepthDataModule, bool]:
    """Return the data to test a checkpoint on, with the very split it was trained with, or another set.

    Args:
        checkpoint: says what it was trained on.
        typed: keys of ``data`` that stand above the checkpoint's, ``cache`` among them.
        overrides: the command line.
        trust: packages whose classes the configuration may name.

    Returns:
        The data, and whether it is another set or split than that of the training.

    Raises:
        HudepthError: if it cannot be built, or test pairs were trained on.
    """
    datamodule = build_data(_data_config(checkpoint, typed, overrides), trust=trust)
    other_data = "_target_" in typed or any(key.startswith(("split", "fractions")) for key in typed)
    if other_data:
        refuse_training_pairs(checkpoint, datamodule, subsets=("test",))
    else:
        _restore_split(checkpoint, datamodule)
    return datamodule, other_data


def _data_config(checkpoint: Checkpoint, typed: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """Return the data configuration to test on: the checkpoint's with what was typed, or another set's.

    A network keeps the input size it was trained at, unless another is typed, and the scale of its output in any case.
    """
    trained = checkpoint.config.get("data")
    if not isinstance(trained, dict):
        raise CheckpointError(f"'{checkpoint.path}' does not say what data it was trained on.")
    if "_target_" in typed:
        keys = {override.lstrip("+").partition("=")[0] for override in overrides}
        data = {**typed, **{k: trained[k] for k in ("size", "max_depth_m") if k in trained and f"data.{k}" not in keys}}
    else:
        unknown = [key for key in typed if key not in trained]
        if unknown:
            raise ConfigError(
                f"data.{unknown[0]}: the checkpoint's data has no such key.{did_you_mean(unknown[0], trained)} "
                "To test on another data set pass data=<name>."
            )
        source = {**trained.get("source", {}), **typed.get("source", {})}
        data = {**trained, **typed, "source": source}
    if data.get("max_depth_m") != trained.get("max_depth_m"):
        raise ConfigError(
            f"data.max_depth_m: the network was trained for {trained.get('max_depth_m')} m and answers in shares of "
            f"it, not of {data.get('max_depth_m')} m. Leave data.max_depth_m out."
        )
    return data


def _restore_split(checkpoint: Checkpoint, datamodule: DepthDataModule) -> None:
    """Use the very split of the training run: from its split.json, else made again and compared by hash."""
    recorded = recorded_split(checkpoint, datamodule)
    if recorded:
        datamodule.split = recorded
    if datamodule.store.info["fingerprint"] != checkpoint.data.get("fingerprint"):
        log.warning("the files of %s have changed since the checkpoint was trained", datamodule.source.name)
    if datamodule.split.sha256 != checkpoint.split.get("sha256"):
        raise DataError(
            f"'{checkpoint.path}': the split of {datamodule.source.name} is not the one it was trained on, so "
            "test pairs may have been trained on. "
            "Pass the data.root it was trained on, or data=<name> to test on other data."
        )
