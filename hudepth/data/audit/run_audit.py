"""hudepth-data audit: how much of a test split leaks from training, and what is odd about the data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from hudepth.base.console import log
from hudepth.base.errors import DataError
from hudepth.base.files import output_folder, write_json
from hudepth.base.options import parse
from hudepth.base.tables import say
from hudepth.data.audit.audit_tables import print_audit
from hudepth.data.audit.duplicates import NEAR_BITS, find_duplicates
from hudepth.data.audit.findings import Finding, judge_depth, judge_split
from hudepth.data.audit.leakage import AuditedSplit, Leak, find_worst_leaks, measure_leakage
from hudepth.data.audit.scan import Scan, sample_raw, scan_store
from hudepth.data.datamodule import DepthDataModule
from hudepth.data.prepare import store_path
from hudepth.data.sources.base import Record
from hudepth.data.splits import make_split
from hudepth.data.store import DepthStore

KINDS = ("random", "scene", "official")
SMALL = 5000
"""Sets of at most this many pairs are prepared for ``images=auto``: it takes minutes."""
SAMPLED_FILES = 1000
"""About so many files are checked for existence, to tell a list of names from a complete set."""
TITLES = {
    "near": "test images with a near duplicate in training",
    "scene": "test images whose scene is in training",
    "other": "no leak found; the most similar images",
}
LEGEND = (
    f"Hash: 64 bits per image. Near duplicates (red) differ in at most {NEAR_BITS}, unrelated images in about 32.\n"
    "Orange: the most similar training image of the same scene. Grey: of other scenes."
)


@dataclass(frozen=True)
class AuditOptions:
    """Options of hudepth-data audit."""

    output: Path | None = None
    images: Annotated[bool | Literal["auto"], "one of auto, true, false"] = "auto"


def audit(config: Mapping[str, Any], datamodule: DepthDataModule) -> None:
    """Print what each kind of split leaks and what is odd about the data; write audit.json and leaks.png.

    Raises HudepthError with one line for the user.
    """
    options = parse(AuditOptions, config)
    source, kind = datamodule.source, datamodule.split_kind
    source.unpaired = []  # files without partner are findings, too
    listed = source.records()
    output = output_folder(options.output or f"audit_{source.name}")
    store, refused = _prepare(options.images, datamodule, listed)
    records = store.records if store else listed  # skipped pairs are in no split
    scan = scan_store(store) if store else None
    splits = {name: _audit_split(name, datamodule, records, scan) for name in KINDS}
    chosen = splits.get(kind)
    if isinstance(chosen, AuditedSplit):
        findings = [judge_split(kind, chosen.leak, chosen.copies)]
    else:
        meaning = "Training on this set needs another split; the reason is given above."
        findings = [Finding(f"split={kind}", "warning", "not possible", meaning, {})]
    findings += refused
    leaks: list[Leak] = []
    if store and scan:
        raw = sample_raw(source, listed)
        findings += judge_depth(store, scan, raw, indoor=source.indoor, max_depth_m=datamodule.max_depth_m)
        if isinstance(chosen, AuditedSplit) and chosen.copies:
            leaks = find_worst_leaks(records, chosen.split, chosen.copies, scan.hashes)
    print_audit(source.name, len(records), splits, kind, findings)
    report = {
        "source": source.name,
        "encoding": source.encoding,
        "pairs": len(records),
        "scenes": len({record.scene for record in records if record.scene}),
        "images": store is not None,
        "near_bits": NEAR_BITS,
        "configured_split": kind,
        "splits": {name: _summarise(found) for name, found in splits.items()},
        "findings": [asdict(finding) for finding in findings],
        "leaks": [asdict(leak) | {"test": records[leak.test].id, "train": records[leak.train].id} for leak in leaks],
    }
    write_json(output / "audit.json", _to_json(report))
    if store and leaks:
        _draw(output / "leaks.png", store, leaks, kind=kind)
    say(f"written to {output}: audit.json" + (", leaks.png" if leaks else ""))


def _audit_split(
    kind: str, datamodule: DepthDataModule, records: Sequence[Record], scan: Scan | None
) -> AuditedSplit | str:
    """Return what a kind of split leaks, or why it is not possible."""
    try:
        split = make_split(records, kind=kind, seed=datamodule.split_seed, fractions=datamodule.fractions)
    except DataError as error:
        return str(error)
    if not split.train:
        return f"data.split={kind}: no pair trains, so nothing leaks."
    copies = find_duplicates(split, scan.hashes, scan.digests) if scan else None
    return AuditedSplit(split, measure_leakage(records, split), copies)


def _prepare(
    images: bool | str, datamodule: DepthDataModule, records: Sequence[Record]
) -> tuple[DepthStore | None, list[Finding]]:
    """Return the store if images are to be read, or a finding if ``auto`` could not prepare the set."""
    if images == "auto":
        reason = _find_reason_to_skip(datamodule, records)
    else:
        reason = "" if images else "no duplicates, nothing on depth. Pass images=true to read them."
    if reason:
        log.info("images left out: %s", reason)
        return None, []
    datamodule.on_error = "skip"  # bad pairs are what an audit looks for: they are listed, the others are read
    try:
        return datamodule.store, []
    except DataError as error:
        if images != "auto":
            raise
        return None, [Finding("images and depth", "warning", "cannot be prepared", str(error), {})]


def _find_reason_to_skip(datamodule: DepthDataModule, records: Sequence[Record]) -> str:
    """Return why ``images=auto`` does not read the images; empty if it does."""
    source = datamodule.source
    files = source.files()
    sampled = files[:: max(1, len(files) // SAMPLED_FILES)]
    missing = [file for file in sampled if not file.exists()]
    if len(missing) > len(sampled) / 2:  # a list without its files; a few lost ones are findings
        return (
            f"{len(missing):,} of {len(sampled):,} files checked are missing, the first '{missing[0]}'. "
            "Leaks by scene come from the list alone; for duplicates and depth, add the files."
        )
    path = store_path(source, size=datamodule.size, native=datamodule.native, cache=datamodule.cache.expanduser())
    if len(records) <= SMALL or path.exists():
        return ""
    return f"{len(records):,} pairs, not prepared at this size. Run hudepth-data prepare first, or pass images=true."


def _draw(path: Path, store: DepthStore, leaks: Sequence[Leak], *, kind: str) -> None:
    from hudepth.data.audit.leak_picture import LeakRow, draw_leaks  # matplotlib: only needed with images
    from hudepth.viz.panels import save_figure

    rows = []
    for leak in leaks:
        images, _ = store.read([leak.test, leak.train])
        records = [store.records[leak.test], store.records[leak.train]]
        names = [r.id if not r.scene or r.scene in r.id else f"{r.id} ({r.scene})" for r in records]
        grade = "near" if leak.near else "other" if leak.frames_apart is None else "scene"
        if leak.frames_apart is not None:
            where = f"same scene, {leak.frames_apart} frame{'s' * (leak.frames_apart != 1)} apart"
        else:
            where = "different scenes" if all(record.scene for record in records) else "scene unknown"
        how = "equal pixels" if leak.equal else f"{leak.bits} of 64 hash bits differ"
        rows.append(LeakRow(images, names, f"{how}\n{where}", grade))
    title = f"{store.info['source']}, split={kind}: {TITLES[rows[0].grade]}\n{LEGEND}"
    save_figure(path, draw_leaks(rows, title=title))


def _summarise(found: AuditedSplit | str) -> dict[str, Any]:
    if isinstance(found, str):
        return {"not_possible": found}
    exact, near = (found.copies.exact, found.copies.near) if found.copies else (None, None)
    return {**found.split.summary(), **asdict(found.leak), "exact_duplicates": exact, "near_duplicates": near}


def _to_json(value: Any) -> Any:
    """Turn NaN into None, which JSON can state, and keys into text, recursively."""
    if isinstance(value, Mapping):
        return {str(key): _to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value
