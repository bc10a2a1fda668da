"""What a network was trained on: no model is evaluated on data that it, or what it started from, was trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import CheckpointError, DataError
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.splits import Split, load_split, make_split
from hudepth.metrics.protocol import Protocol
from hudepth.runs import run_dir
from hudepth.runs.checkpoint import Checkpoint

BEFORE = "before"
"""Key of a checkpoint's ``data``: what the network it started from was trained on, oldest last."""


def lineage(checkpoint: Checkpoint) -> list[dict[str, Any]]:
    """Return data and split that a checkpoint was trained on, then those of the networks it started from.

    Raises CheckpointError if it does not state them in a known form.
    """
    own = {key: value for key, value in checkpoint.data.items() if key != BEFORE}
    before = checkpoint.data.get(BEFORE, [])
    if not isinstance(before, list) or not all(isinstance(past, dict) for past in before):
        raise CheckpointError(f"'{checkpoint.path}' is damaged: it does not state what it was trained on.")
    return [{**own, "split": checkpoint.split}, *before]


def read_split(checkpoint: Checkpoint, datamodule: DepthDataModule) -> Split | None:
    """Read split.json of the training run, None if the checkpoint was moved out of it."""
    file = checkpoint.run / "split.json" if checkpoint.run else None
    return load_split(file, datamodule.store.records) if file and file.is_file() else None


def refuse_training_pairs(checkpoint: Checkpoint, datamodule: DepthDataModule, *, subsets: tuple[str, ...]) -> None:
    """Raise DataError if one of the ``subsets`` would evaluate a network on pairs it has seen.

    A test must not contain validation pairs either: the best epoch was chosen on them. ``checkpoint`` is the network,
    or what it starts from.
    """
    for number, past in enumerate(lineage(checkpoint)):
        if past.get("fingerprint") != datamodule.store.info["fingerprint"]:
            if past.get("source") == datamodule.source.name:
                unknown = "so whether it has seen pairs of this one cannot be checked"
                log.warning("'%s' was trained on another version of %s, %s", checkpoint.path, past["source"], unknown)
            if past.get("pictures"):
                unknown = "which were not compared with this data"
                log.warning("'%s' also learned from %s pictures, %s", checkpoint.path, past["pictures"], unknown)
            continue
        trained = (read_split(checkpoint, datamodule) if number == 0 else None) or _remake_split(past, datamodule)
        for subset in subsets:
            _refuse_shared(datamodule.split, subset, trained.train, f"trained on, under data.split={trained.kind}")
        if "test" in subsets:
            _refuse_shared(datamodule.split, "test", trained.val, f"validated on, under data.split={trained.kind}")


def _refuse_shared(split: Split, subset: str, seen: Sequence[int], how: str) -> None:
    shared = set(seen) & set(split[subset])
    if shared:
        name = {"val": "validation"}.get(subset, subset)
        raise DataError(
            f"data.split={split.kind}: {len(shared)} of {len(split[subset])} {name} pairs were {how}. "
            "Leave data.split out to test on held-out pairs; in training, pass the same data.split or init=null."
        )


def _remake_split(past: Mapping[str, Any], datamodule: DepthDataModule) -> Split:
    try:
        split = past["split"]
        kind, seed, fractions = str(split["kind"]), int(split["seed"]), [float(share) for share in split["fractions"]]
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            "checkpoint, init: it was trained on this data, but does not state the split, so the training pairs are "
            "unknown. Pass another checkpoint, or init=null."
        ) from error
    return make_split(datamodule.store.records, kind=kind, seed=seed, fractions=fractions)


def note_scored(checkpoint: Checkpoint, datamodule: DepthDataModule, protocols: Sequence[Protocol]) -> list[int] | None:
    """Record in the run that its network was evaluated on test images; return its other epochs that were before.

    Returns None if they are unknown: the checkpoint was moved out of its run, or the run cannot be written.
    """
    if checkpoint.run is None:
        return None
    try:
        data, split = datamodule.source.name, datamodule.split.sha256
        names = [protocol.name for protocol in protocols]
        return run_dir.note_scored(checkpoint.run, epoch=checkpoint.epoch, data=data, split=split, protocols=names)
    except OSError as error:
        log.warning("'%s' cannot record this evaluation on test images (%s)", checkpoint.run, error.strerror)
        return None
