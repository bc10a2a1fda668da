"""What is odd about a data set: its unit and range, steps, holes, saturation, sizes, copies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hudepth.base.console import track
from hudepth.base.errors import DataError
from hudepth.data.audit.hashes import Duplicates, perceptual_hashes, pixel_digests
from hudepth.data.audit.leakage import Leakage
from hudepth.data.encoding import INDOOR_MEDIAN_M
from hudepth.data.pairs import read_metres
from hudepth.data.sources.base import Record, Source
from hudepth.data.store import DepthStore

CHUNK = 64
"""Pairs read from a store at a time."""
COARSE_MM = 10.0
"""Depth stored in larger steps is worth a note: errors of good networks are a few centimetres."""


@dataclass(frozen=True)
class Finding:
    """Something found out about a data set, and what follows from it."""

    about: str
    severity: str
    """``ok``, ``note`` (know it) or ``warning`` (do something)."""
    found: str
    """The figures, as text."""
    meaning: str
    """One sentence: what it means and what to do."""
    values: Mapping[str, Any]
    """The figures, as plain types."""


@dataclass(frozen=True)
class Scan:
    """What one pass over a store collects."""

    hashes: NDArray[np.uint64]
    """[n] perceptual hash of each image."""
    digests: list[bytes]
    """[n] equal for images of equal pixels."""
    histogram: NDArray[np.int64]
    """[65536] pixels of each depth [mm]; those at 0 are unmeasured."""
    constant: list[int]
    """Positions of pairs whose measured depth is the same everywhere."""


@dataclass(frozen=True)
class RawSample:
    """Depth of some pairs as their files hold it."""

    step_mm: float
    """Smallest step between two depths of a pair, median over the pairs [mm]; NaN if no pair has two depths."""
    levels: int
    """Most distinct depths in one pair."""
    at_largest: float
    """Share of measured pixels that hold the largest value of their type found in the sample; NaN if none is."""


def scan_store(store: DepthStore) -> Scan:
    """Read all images and depths of a store, once."""
    hashes: list[NDArray[np.uint64]] = []
    digests: list[bytes] = []
    constant: list[int] = []
    histogram = np.zeros(1 << 16, np.int64)
    starts = range(0, len(store), CHUNK)
    for start in track(starts, total=len(starts), what=f"auditing {store.info['source']}"):
        images, depths_mm = store.read(range(start, min(start + CHUNK, len(store))))
        hashes.append(perceptual_hashes(images))
        digests += pixel_digests(images)
        histogram += np.bincount(depths_mm.ravel(), minlength=1 << 16)
        flat = depths_mm.reshape(len(depths_mm), -1)
        smallest = np.where(flat > 0, flat, np.iinfo(np.uint16).max).min(axis=1)
        constant += (start + np.flatnonzero(smallest >= flat.max(axis=1))).tolist()
    return Scan(np.concatenate(hashes), digests, histogram, constant)


def sample_raw(source: Source, records: Sequence[Record], *, pairs: int = 16) -> RawSample:
    """Read some pairs, evenly spaced, to see how finely depth is stored. Pairs that cannot be read are left out.

    Args:
        source: where the pairs come from.
        records: of the source, not of a store, which does not know where files lie.
        pairs: how many to read.
    """
    steps_mm, levels, total = [], 0, 0
    largest: dict[str, tuple[float, int]] = {}
    for record in records[:: max(1, len(records) // pairs)][:pairs]:
        try:
            values, pixels = np.unique(source.read(record).depth, return_counts=True)
            depth_mm = 1000 * read_metres(source, record, values[None])[0].astype(np.float64)
        except DataError:
            continue
        measured = depth_mm > 0
        if not measured.any():
            continue
        top, count, dtype = float(values[measured][-1]), int(pixels[measured][-1]), str(values.dtype)
        known, so_far = largest.get(dtype, (top, 0))
        largest[dtype] = (top, count) if top > known else (known, so_far + count * (top == known))
        total += int(pixels[measured].sum())
        levels = max(levels, int(measured.sum()))
        if measured.sum() > 1:
            steps_mm.append(float(np.diff(depth_mm[measured]).min()))
    at_largest = sum(count for _, count in largest.values()) / total if total else float("nan")
    return RawSample(float(np.median(steps_mm)) if steps_mm else float("nan"), levels, at_largest)


def split_finding(kind: str, leak: Leakage, copies: Duplicates | None) -> Finding:
    """Say whether the split tests on what it trains on.

    Args:
        kind: of the split.
        leak: of this split.
        copies: of this split, None if the images were not looked at.
    """
    near = copies.near if copies else 0.0
    values = {"scene_seen": leak.scene_seen, "near": copies.near if copies else None}
    about, images = f"split={kind}", f", near copies of {near:.1%} there" if copies else ""
    if np.isnan(leak.scene_seen):
        meaning = (
            "The test frames name no scene, so only their images can tell whether training holds their neighbours."
        )
        return Finding(about, "note", f"scenes of the test frames unknown{images}", meaning, values)
    found = f"{leak.scene_seen:.1%} of test frames from scenes in training{images}"
    if leak.scene_seen > 0:
        meaning = (
            "The test measures memory of known rooms as well as skill in new ones: "
            "pass data.split=scene to measure the latter."
        )
        return Finding(about, "warning", found, meaning, values)
    if near > 0:
        meaning = "Scenes are kept apart by name, yet some test images look as training images do: see leaks.png."
        return Finding(about, "note", found, meaning, values)
    return Finding(about, "ok", found, "No scene is both trained on and tested on.", values)


def depth_findings(store: DepthStore, scan: Scan, raw: RawSample, *, indoor: bool, max_depth_m: float) -> list[Finding]:
    """Judge the depth of a set: unit, step, holes, clipping, maps that say nothing, sizes, files left out.

    Args:
        store: the prepared set.
        scan: of the store.
        raw: of its source.
        indoor: whether the set shows rooms.
        max_depth_m: training clips depth to it.
    """
    return [
        _unit(store.info, indoor=indoor),
        _step(raw),
        _holes(scan.histogram),
        _clipped(scan.histogram, max_depth_m),
        _saturated(raw),
        _constant([store.records[i].id for i in scan.constant], len(store)),
        _sizes(store.info["native_sizes"]),
        _repeated(scan.digests),
        _skipped(store.info["skipped"]),
    ]


def _unit(info: Mapping[str, Any], *, indoor: bool) -> Finding:
    low, median, high = (info[f"depth_{name}_m"] for name in ("min", "median", "max"))
    found = f"{low:g} to {high:g} m, median {median:g} m; encoding {info['encoding']}"
    values = {"min_m": low, "median_m": median, "max_m": high, "encoding": info["encoding"]}
    if not indoor:
        return Finding("depth and unit", "ok", found, "Not indoors: check the range against what you know.", values)
    if INDOOR_MEDIAN_M[0] <= median <= INDOOR_MEDIAN_M[1]:
        return Finding("depth and unit", "ok", found, "A median as rooms have it: the unit is plausible.", values)
    meaning = "No room has this median depth: the unit is wrong, so pass another data.encoding."
    return Finding("depth and unit", "warning", found, meaning, values)


def _step(raw: RawSample) -> Finding:
    values = {"step_mm": raw.step_mm, "levels": raw.levels}
    if np.isnan(raw.step_mm):
        return Finding(
            "step of depth", "note", "none", "No sampled pair holds two depths, so no step is known.", values
        )
    step = "under 0.01" if raw.step_mm < 0.01 else f"{raw.step_mm:.3g}"
    found = f"{step} mm, at most {raw.levels:,} depths in a pair"
    if raw.step_mm < COARSE_MM:
        return Finding("step of depth", "ok", found, "Finer than any error worth reporting.", values)
    meaning = (
        f"Depth is stored coarsely: the truth itself is off by up to {raw.step_mm / 2:.0f} mm, "
        "so do not read meaning into smaller errors."
    )
    return Finding("step of depth", "note", found, meaning, values)


def _holes(histogram: NDArray[np.int64]) -> Finding:
    share = float(histogram[0] / histogram.sum())
    values = {"share": share}
    if share == 0:
        meaning = "Every pixel counts; if a sensor took the depth, its holes have been filled with guesses."
        return Finding("holes", "ok", "none", meaning, values)
    meaning = "Unmeasured pixels are left out of loss and metrics, so nothing is known of errors there."
    return Finding("holes", "note" if share > 0.01 else "ok", f"{share:.2%} of pixels", meaning, values)


def _clipped(histogram: NDArray[np.int64], max_depth_m: float) -> Finding:
    measured = histogram.copy()
    measured[0] = 0
    largest_m = float(np.flatnonzero(measured).max(initial=0) / 1000)
    share = float(measured[round(1000 * max_depth_m) :].sum() / max(1, measured.sum()))
    found = f"{share:.2%} of measured pixels at {max_depth_m:g} m or more"
    values = {"share": share, "max_depth_m": max_depth_m, "largest_m": largest_m}
    if share > 0.01:
        meaning = "Training clips these depths; raise data.max_depth_m if the set reaches beyond it."
        return Finding("clipping", "warning" if share > 0.1 else "note", found, meaning, values)
    if 0 < largest_m < max_depth_m / 2:
        meaning = (
            f"No depth is above {largest_m:g} m, so most of the network's range lies idle; lower data.max_depth_m."
        )
        return Finding("clipping", "note", found, meaning, values)
    return Finding("clipping", "ok", found, "Clipping to it changes next to nothing.", values)


def _saturated(raw: RawSample) -> Finding:
    values = {"share": raw.at_largest}
    if np.isnan(raw.at_largest):
        return Finding("saturation", "note", "unknown", "No pair of the sample holds a depth.", values)
    found = f"{raw.at_largest:.2%} of measured pixels at the largest value"
    if raw.at_largest > 0.01:
        meaning = "So many pixels at one value mean that depth was cut off there: what lies farther looks nearer."
        return Finding("saturation", "note", found, meaning, values)
    return Finding("saturation", "ok", found, "Depth was not cut off when it was stored.", values)


def _constant(ids: Sequence[str], n: int) -> Finding:
    values = {"ids": list(ids)}
    if not ids:
        return Finding("constant depth", "ok", f"0 of {n:,} maps", "Every map holds more than one depth.", values)
    listed = ", ".join(ids[:5]) + (", ..." if len(ids) > 5 else "")
    meaning = "A map of one depth teaches nothing and was hardly measured: leave these pairs out."
    return Finding("constant depth", "warning", f"{len(ids):,} of {n:,} maps: {listed}", meaning, values)


def _sizes(sizes: Sequence[Sequence[int]]) -> Finding:
    found = ", ".join(f"{width} x {height}" for height, width in sizes[:4]) + (", ..." if len(sizes) > 4 else "")
    values = {"sizes": [list(size) for size in sizes]}
    if len(sizes) == 1:
        return Finding("native size", "ok", found, "One size throughout.", values)
    meaning = (
        "Sizes differ; where shapes do too, resizing distorts some pairs more than others, so crop them alike first."
    )
    return Finding("native size", "note", found, meaning, values)


def _repeated(digests: Sequence[bytes]) -> Finding:
    copies = len(digests) - len(set(digests))
    values = {"copies": copies}
    if not copies:
        return Finding("repeated images", "ok", "none", "No image occurs twice, pixel for pixel.", values)
    meaning = "Images that occur more than once weigh more and leak between subsets: keep one of each."
    return Finding("repeated images", "warning", f"{copies:,} of {len(digests):,}", meaning, values)


def _skipped(lines: Sequence[str]) -> Finding:
    values = {"skipped": list(lines)}
    if not lines:
        return Finding("unreadable pairs", "ok", "none", "Every listed pair was read.", values)
    meaning = "They are in no subset, so splits differ from those of the whole set: mend the files."
    return Finding("unreadable pairs", "warning", f"{len(lines):,}, the first: {lines[0]}", meaning, values)
