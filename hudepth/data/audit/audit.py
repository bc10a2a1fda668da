"""hudepth-data audit: how much of a test split leaks from training, and what is odd about the data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hudepth.base.console import log
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.files import write_json
from hudepth.data.audit.findings import Finding, depth_findings, sample_raw, scan_store, split_finding
from hudepth.data.audit.hashes import NEAR_BITS, find_duplicates
from hudepth.data.audit.leakage import leakage
from hudepth.data.audit.leaks import Audited, worst_leaks
from hudepth.data.audit.tables import print_audit
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.prepare import store_path
from hudepth.data.sources.base import Record
from hudepth.data.splits import make_split
from hudepth.data.store import DepthStore

KINDS = ("random", "scene", "official")
SMALL = 5000
"""Sets of at most so many pairs are prepared for ``images=auto``: it takes minutes."""
LOOKED = 1000
"""About so many files are looked for, to tell a list of names from a whole set."""
TITLES = {
    "near": "test images with a near duplicate in training",
    "scene": "test images whose scene is in training",
    "other": "no leak found; the most similar images",
}
LEGEND = (
    f"Hash: 64 bits an image. Near duplicates (red) differ in at most {NEAR_BITS}, unrelated images in about 32.\n"
    "Orange: the most similar training image of the same scene. Grey: of other scenes."
)


def audit(config: dict[str, Any], datamodule: DepthDataModule) -> None:
    """Print what each kind of split leaks and what is odd about the data; write audit.json and leaks.png.

    Args:
        config: what conf/data.yaml and the command line compose to; ``output`` and ``images`` are used.
        datamodule: the set, with the split to judge.

    Raises:
        HudepthError: with one line for the user.
    """
    source = datamodule.source
    output = Path(config.get("output") or f"audit_{source.name}").expanduser()
    listed = source.records()
    store, refused = _prepared(config.get("images", "auto"), datamodule, listed)
    records = store.records if store else listed  # pairs that were skipped are in no split
    scan = scan_store(store) if store else None
    kinds: dict[str, Audited | str] = {}
    for kind in KINDS:
        try:
            split = make_split(records, kind=kind, seed=datamodule.split_seed, fractions=datamodule.fractions)
        except DataError as error:
            kinds[kind] = str(error)
            continue
        copies = find_duplicates(split, scan.hashes, scan.digests) if scan else None
        kinds[kind] = Audited(split, leakage(records, split), copies)
    chosen = kinds[datamodule.split_kind]
    findings = [_chosen_finding(datamodule.split_kind, chosen), *refused]
    leaks: list[dict[str, Any]] = []
    if store and scan:
        raw = sample_raw(source, listed)
        findings += depth_findings(store, scan, raw, indoor=source.indoor, max_depth_m=datamodule.max_depth_m)
        if isinstance(chosen, Audited):
            leaks = worst_leaks(records, chosen, scan.hashes)
    print_audit(source.name, len(records), kinds, datamodule.split_kind, findings)
    report = _report(datamodule, records, kinds, findings, leaks, images=store is not None)
    try:
        write_json(output / "audit.json", report)
        if store and leaks:
            _draw(output / "leaks.png", store, leaks, kind=datamodule.split_kind)
    except OSError as error:
        raise ConfigError(f"output: cannot write '{output}' ({error.strerror}). Pass output=<a folder>.") from error
    print(f"written to {output}: audit.json" + (", leaks.png" if leaks else ""))


def _prepared(
    wanted: object, datamodule: DepthDataModule, records: Sequence[Record]
) -> tuple[DepthStore | None, list[Finding]]:
    """Return the store if images are to be looked at, or the finding that says why the set cannot be prepared.

    Raises:
        DataError: if ``wanted`` is True and the set cannot be prepared.
    """
    if not _look_at_images(wanted, datamodule, records):
        return None, []
    datamodule.on_error = "skip"  # bad pairs are what an audit is for: they are listed, the others are looked at
    try:
        return datamodule.store, []
    except DataError as error:
        if wanted != "auto":
            raise
        return None, [Finding("images and depth", "warning", "cannot be prepared", str(error), {})]


def _look_at_images(wanted: object, datamodule: DepthDataModule, records: Sequence[Record]) -> bool:
    """Decide ``images=auto``, and say why where the images are left out."""
    if wanted not in ("auto", True, False):
        raise ConfigError(f"images: '{wanted}' is none of auto, true, false.")
    if wanted != "auto":
        if not wanted:
            log.info("images left out: no duplicates, nothing on depth. Pass images=true to look at them.")
        return bool(wanted)
    source = datamodule.source
    files = source.files()
    looked = files[:: max(1, len(files) // LOOKED)]
    missing = [file for file in looked if not file.exists()]
    if len(missing) > len(looked) / 2:  # a list without its files; a few lost ones are findings
        log.info(
            "images left out: %s of %s files that were looked for are missing, the first '%s'. Records tell what leaks "
            "by scene; for duplicates and depth, bring the files.",
            f"{len(missing):,}",
            f"{len(looked):,}",
            missing[0],
        )
        return False
    if len(records) <= SMALL:
        return True
    path = store_path(source, size=datamodule.size, native=datamodule.native, cache=datamodule.cache.expanduser())
    if path.exists():
        return True
    log.info(
        "images left out: %s pairs, not prepared at this size. Run hudepth-data prepare first, or pass images=true.",
        f"{len(records):,}",
    )
    return False


def _chosen_finding(kind: str, chosen: Audited | str) -> Finding:
    if isinstance(chosen, Audited):
        return split_finding(kind, chosen.leak, chosen.copies)
    meaning = "Training on this set needs another split: the reason stands above."
    return Finding(f"split={kind}", "warning", "not possible", meaning, {})


def _draw(path: Path, store: DepthStore, leaks: Sequence[Mapping[str, Any]], *, kind: str) -> None:
    from hudepth.data.audit.picture import Leak, save_leaks  # matplotlib, which a list of names does not need

    pictures = []
    for leak in leaks:
        (test, train), _ = store.read([leak["test"], leak["train"]])
        one, other = store.records[leak["test"]], store.records[leak["train"]]
        grade = "near" if leak["near"] else "other" if leak["frames_apart"] is None else "scene"
        pictures.append(Leak(test, train, _name(one), _name(other), _verdict(leak, one, other), grade))
    title = f"{store.info['source']}, split={kind}: {TITLES[pictures[0].grade]}\n{LEGEND}"
    save_leaks(path, pictures, title=title)


def _name(record: Record) -> str:
    return record.id if not record.scene or record.scene in record.id else f"{record.id} ({record.scene})"


def _verdict(leak: Mapping[str, Any], one: Record, other: Record) -> str:
    if leak["frames_apart"] is not None:
        where = f"same scene, {leak['frames_apart']} frame{'s' * (leak['frames_apart'] != 1)} apart"
    else:
        where = "different scenes" if one.scene and other.scene else "scene unknown"
    how = "equal pixels" if leak["equal"] else f"{leak['bits']} of 64 hash bits differ"
    return f"{how}\n{where}"


def _report(
    datamodule: DepthDataModule,
    records: Sequence[Record],
    kinds: Mapping[str, Audited | str],
    findings: Sequence[Finding],
    leaks: Sequence[Mapping[str, Any]],
    *,
    images: bool,
) -> Any:
    splits: dict[str, Any] = {}
    for kind, found in kinds.items():
        if isinstance(found, str):
            splits[kind] = {"not_possible": found}
            continue
        copies = found.copies
        splits[kind] = {
            **found.split.summary(),
            **asdict(found.leak),
            "exact_duplicates": copies.exact if copies else None,
            "near_duplicates": copies.near if copies else None,
        }
    return _plain(
        {
            "source": datamodule.source.name,
            "encoding": datamodule.source.encoding,
            "pairs": len(records),
            "scenes": len({record.scene for record in records if record.scene}),
            "images": images,
            "near_bits": NEAR_BITS,
            "configured_split": datamodule.split_kind,
            "splits": splits,
            "findings": [asdict(finding) for finding in findings],
            "leaks": [{**leak, "test": records[leak["test"]].id, "train": records[leak["train"]].id} for leak in leaks],
        }
    )


def _plain(value: Any) -> Any:
    """Turn NaN into None and keys into text, all the way down: JSON has no word for the first."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
