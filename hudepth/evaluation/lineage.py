"""What a network has seen before: no pair that it, or what it started from, learned or was chosen by may score it."""

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
"""Key of a checkpoint's ``data``: what the network that it started from was trained on, oldest last."""


def lineage(checkpoint: Checkpoint) -> list[dict[str, Any]]:
    """Return what a checkpoint was trained on, then what it had started from: data, split and, if known, split.json.

    Raises:
        CheckpointError: if it says so in no form that we know.
    """
    own = {key: value for key, value in checkpoint.data.items() if key != BEFORE}
    before = checkpoint.data.get(BEFORE, [])
    if not isinstance(before, list) or not all(isinstance(past, dict) for past in before):
        raise CheckpointError(f"'{checkpoint.path}' is damaged: it does not say what it was trained on.")
    return [{**own, "split": checkpoint.split}, *before]


def recorded_split(checkpoint: Checkpoint, datamodule: DepthDataModule) -> Split | None:
    """Return the split of the training run from its split.json, if the checkpoint still lies beside it."""
    file = checkpoint.run / "split.json" if checkpoint.run else None
    return load_split(file, datamodule.store.records) if file and file.is_file() else None


def refuse_training_pairs(checkpoint: Checkpoint, datamodule: DepthDataModule, *, subsets: tuple[str, ...]) -> None:
    """Refuse a split that would judge a network by pairs it has seen, where the data is a set of its training.

    Training pairs were seen, and for a test so were validation pairs: its best epoch was chosen by them.

    Args:
        checkpoint: the network, or what it starts from.
        datamodule: with the split.
        subsets: which of its subsets judge.

    Raises:
        DataError: if a pair is in both.
    """
    for number, past in enumerate(lineage(checkpoint)):
        if past.get("fingerprint") != datamodule.store.info["fingerprint"]:
            if past.get("source") == datamodule.source.name:
                log.warning(
                    "'%s' was trained on another set of %s, or on other files of this one: if some of its pairs are "
                    "among those that judge it now, nobody can tell",
                    checkpoint.path, past["source"],
                )  # fmt: skip
            continue
        trained = (recorded_split(checkpoint, datamodule) if number == 0 else None) or _split_again(past, datamodule)
        looks = [(subset, trained.train, "trained on") for subset in subsets]
        looks += [("test", trained.val, "validated on")] if "test" in subsets else []
        for subset, seen, how in looks:
            shared = set(seen) & set(datamodule.split[subset])
            if shared:
                name = {"val": "validation"}.get(subset, subset)
                raise DataError(
                    f"data.split={datamodule.split.kind}: {len(shared)} of {len(datamodule.split[subset])} {name} "
                    f"pairs were {how}, under data.split={trained.kind}. "
                    + (
                        "Leave data.split out to test on what was held out."
                        if subsets == ("test",)
                        else "Pass the same data.split, or init=null."
                    )
                )


def _split_again(past: Mapping[str, Any], datamodule: DepthDataModule) -> Split:
    """Make the split of a training again, as its checkpoint describes it."""
    try:
        split = past["split"]
        kind, seed, fractions = str(split["kind"]), int(split["seed"]), [float(share) for share in split["fractions"]]
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            "checkpoint, init: a training on this very data is named without its split, so what was trained on cannot "
            "be told. Pass another checkpoint, or init=null."
        ) from error
    return make_split(datamodule.store.records, kind=kind, seed=seed, fractions=fractions)


def note_scored(checkpoint: Checkpoint, datamodule: DepthDataModule, protocols: Sequence[Protocol]) -> list[int] | None:
    """Note in the run that its test images are looked at.

    Returns:
        The other epochs that were scored on them before. None: this cannot be told, since the file was moved away from
        its run, or nothing can be written there.
    """
    if checkpoint.run is None:
        return None
    try:
        return run_dir.note_scored(
            checkpoint.run,
            epoch=checkpoint.epoch,
            data=datamodule.source.name,
            split=datamodule.split.sha256,
            protocols=[protocol.name for protocol in protocols],
        )
    except OSError as error:
        log.warning("'%s' cannot note that its test images were looked at (%s)", checkpoint.run, error.strerror)
        return None
