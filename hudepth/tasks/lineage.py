"""What a network has seen before: no pair that it, or what it started from, was trained on may score it."""

from __future__ import annotations

from typing import Any

from hudepth.checkpoint import Checkpoint
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.splits import Split, load_split, make_split
from hudepth.errors import DataError

BEFORE = "before"
"""Key of a checkpoint's ``data``: what the network that it started from was trained on, oldest last."""


def lineage(checkpoint: Checkpoint) -> list[dict[str, Any]]:
    """Return what a checkpoint was trained on, then what it had started from: data, split and, if known, split.json."""
    own = {key: value for key, value in checkpoint.data.items() if key != BEFORE}
    return [{**own, "split": checkpoint.split}, *checkpoint.data.get(BEFORE, [])]


def recorded_split(checkpoint: Checkpoint, datamodule: DepthDataModule) -> Split | None:
    """Return the split of the training run from its split.json, if the checkpoint still lies beside it."""
    file = checkpoint.run / "split.json" if checkpoint.run else None
    return load_split(file, datamodule.store.records) if file and file.is_file() else None


def refuse_training_pairs(checkpoint: Checkpoint, datamodule: DepthDataModule, *, subsets: tuple[str, ...]) -> None:
    """Refuse a split that would judge a network by pairs it was trained on, where the data is a set of its training.

    Args:
        checkpoint: the network, or what it starts from.
        datamodule: with the split.
        subsets: which of its subsets judge.

    Raises:
        DataError: if a pair is in both.
    """
    for number, past in enumerate(lineage(checkpoint)):
        if past.get("fingerprint") != datamodule.store.info["fingerprint"]:
            continue
        split = past["split"]
        trained = (recorded_split(checkpoint, datamodule) if number == 0 else None) or make_split(
            datamodule.store.records, kind=split["kind"], seed=split["seed"], fractions=split["fractions"]
        )
        for subset in subsets:
            shared = set(trained.train) & set(datamodule.split[subset])
            if shared:
                name = {"val": "validation"}.get(subset, subset)
                raise DataError(
                    f"data.split={datamodule.split.kind}: {len(shared)} of {len(datamodule.split[subset])} {name} "
                    f"pairs were trained on, under data.split={trained.kind}. "
                    + (
                        "Leave data.split out to test on what was held out."
                        if subsets == ("test",)
                        else "Pass the same data.split, or init=null."
                    )
                )
