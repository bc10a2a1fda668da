"""Splits: which pairs train, validate and test. Named, seeded, hashed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from hudepth.base.errors import ConfigError, DataError, did_you_mean
from hudepth.base.files import read_json, write_json
from hudepth.data.sources.base import Record

SUBSETS = ("train", "val", "test")


@dataclass(frozen=True)
class Split:
    """Positions in a store for each subset, and how they were chosen."""

    kind: str
    seed: int
    fractions: tuple[float, float, float]
    train: list[int]
    val: list[int]
    test: list[int]
    sha256: str
    """Over the ids of each subset, in order: equal hashes mean equal subsets."""

    def __getitem__(self, subset: str) -> list[int]:
        return {"train": self.train, "val": self.val, "test": self.test}[subset]

    def summary(self) -> dict[str, Any]:
        """Return kind, seed, fractions, counts and hash, for metric files."""
        counts = {subset: len(self[subset]) for subset in SUBSETS}
        known = {"kind": self.kind, "seed": self.seed, "fractions": list(self.fractions)}
        return {**known, "counts": counts, "sha256": self.sha256}


def split_counts(n: int, fractions: Sequence[float]) -> tuple[int, int, int]:
    """Return the sizes of the subsets as the paper cuts them: int(f0 n), int(f1 n), the rest."""
    train, val = int(fractions[0] * n), int(fractions[1] * n)
    return train, val, n - train - val


def make_split(
    records: Sequence[Record], *, kind: str, seed: int = 42, fractions: Sequence[float] = (0.7, 0.1, 0.2)
) -> Split:
    """Split records into train, val and test.

    Args:
        records: all pairs of a store.
        kind: ``random`` (the paper: frames at random), ``scene`` (no scene in two subsets), or ``official`` (the
            set's own test and val pairs; without val pairs, validation is taken by scene from its training pairs), or
            ``test`` (all pairs are test). If all pairs are test, also by ``fractions``, train and val may be empty.
        seed: of the permutation of frames or scenes.
        fractions: of train, val and test; they sum to 1. ``official`` uses only the ratio of the first two.

    Raises ConfigError as :func:`check_split`; DataError if the records lack what the kind needs, or a subset is empty.
    """
    check_split(kind, fractions)
    subsets = dict(zip(SUBSETS, _KINDS[kind](records, seed, fractions), strict=True))
    for name, indices in subsets.items():
        if not indices and (name == "test" or len(subsets["test"]) < len(records) or not records):
            raise DataError(
                f"data.split={kind}: the {name} subset is empty ({len(records)} pairs, "
                f"{len({r.scene for r in records})} scenes, fractions {list(fractions)}). "
                "Pass other data.fractions, another data.split, or more data."
            )
    train, val, test = fractions
    sha256 = _hash({name: [records[i].id for i in indices] for name, indices in subsets.items()})
    return Split(kind=kind, seed=seed, fractions=(train, val, test), **subsets, sha256=sha256)


def check_split(kind: str, fractions: Sequence[float]) -> None:
    """Check the arguments of :func:`make_split`: ConfigError for an unknown kind or fractions that do not sum to 1."""
    if kind not in _KINDS:
        raise ConfigError(f"data.split: no '{kind}'.{did_you_mean(kind, _KINDS)} Pass one of {', '.join(_KINDS)}.")
    # "not <=" rather than ">": a NaN is refused too
    if len(fractions) != 3 or min(fractions) < 0 or not abs(sum(fractions) - 1) <= 1e-6:
        raise ConfigError(f"data.fractions: {list(fractions)} are not three shares that sum to 1, as [0.7,0.1,0.2] do.")


def _permutation(n: int, seed: int) -> list[int]:
    """Return what torch.utils.data.random_split draws for the same seed."""
    return list(torch.randperm(n, generator=torch.Generator().manual_seed(seed)).tolist())


def _random(records: Sequence[Record], seed: int, fractions: Sequence[float]) -> tuple[list[int], ...]:
    order = _permutation(len(records), seed)
    train, val, _ = split_counts(len(records), fractions)
    return order[:train], order[train : train + val], order[train + val :]


def _by_scene(
    records: Sequence[Record], indices: Sequence[int], seed: int, wanted: Sequence[float]
) -> tuple[list[int], ...]:
    """Deal scenes, in seeded order, each to the subset that lacks most frames, so that sizes come near ``wanted``."""
    scenes: dict[str, list[int]] = {}
    for index in indices:
        scenes.setdefault(records[index].scene, []).append(index)
    if "" in scenes:
        raise DataError(
            f"data.split: {len(scenes[''])} pairs name no scene, so scenes cannot be kept apart. "
            "Add a scene column to the manifest, or pass data.split=random."
        )
    names = sorted(scenes)
    dealt: tuple[list[int], ...] = tuple([] for _ in wanted)
    for position in _permutation(len(names), seed):
        lacking = [share * len(indices) - len(subset) for share, subset in zip(wanted, dealt, strict=True)]
        dealt[lacking.index(max(lacking))].extend(scenes[names[position]])
    return tuple(sorted(subset) for subset in dealt)


def _official(records: Sequence[Record], seed: int, fractions: Sequence[float]) -> tuple[list[int], ...]:
    own_train, val, test = ([i for i, record in enumerate(records) if record.split == name] for name in SUBSETS)
    if unknown := len(records) - len(own_train) - len(val) - len(test):
        raise DataError(
            f"data.split=official: {unknown} of {len(records)} pairs are in neither 'train' nor 'test' of the set's "
            "own split. Pass data.split=scene or data.split=random."
        )
    if val:
        return own_train, val, test
    share = fractions[0] + fractions[1]
    if not own_train or not share:
        return [], [], test
    return *_by_scene(records, own_train, seed, [fractions[0] / share, fractions[1] / share]), test


_KINDS: Mapping[str, Callable[[Sequence[Record], int, Sequence[float]], tuple[list[int], ...]]] = {
    "random": _random,
    "scene": lambda records, seed, fractions: _by_scene(records, range(len(records)), seed, fractions),
    "official": _official,
    "test": lambda records, seed, fractions: ([], [], list(range(len(records)))),
}


def _hash(ids: Mapping[str, Sequence[str]]) -> str:
    return hashlib.sha256(json.dumps({name: list(ids[name]) for name in SUBSETS}).encode()).hexdigest()


def save_split(path: Path, split: Split, records: Sequence[Record]) -> None:
    """Write split.json: the summary and the ids of each subset."""
    write_json(path, {**split.summary(), "ids": {name: [records[i].id for i in split[name]] for name in SUBSETS}})


def load_split(path: Path, records: Sequence[Record]) -> Split:
    """Read split.json and find its ids among ``records``.

    Raises DataError if the file is damaged, its hash does not fit its ids, or a pair it names is not there.
    """
    try:
        saved = read_json(path)
        ids: dict[str, list[str]] = {name: [str(i) for i in saved["ids"][name]] for name in SUBSETS}
        kind, seed, sha256 = str(saved["kind"]), int(saved["seed"]), str(saved["sha256"])
        train, val, test = (float(share) for share in saved["fractions"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise DataError(f"'{path}' is not a split.json ({type(error).__name__}: {error}).") from error
    if _hash(ids) != sha256:
        raise DataError(f"'{path}': its ids do not have the hash it states; it was edited. Restore it, or train again.")
    position = {record.id: i for i, record in enumerate(records)}
    if lost := [i for name in SUBSETS for i in ids[name] if i not in position]:
        raise DataError(
            f"'{path}' names {len(lost)} pairs that this data set does not have, the first is '{lost[0]}'. "
            "Pass the data= and data.root= it was trained on."
        )
    found = {name: [position[i] for i in ids[name]] for name in SUBSETS}
    return Split(kind=kind, seed=seed, fractions=(train, val, test), **found, sha256=sha256)
