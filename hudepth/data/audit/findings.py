"""Judge a data set: leaks of its split, unit and range of depth, steps, holes, saturation, sizes, copies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hudepth.data.audit.duplicates import Duplicates
from hudepth.data.audit.leakage import Leakage
from hudepth.data.audit.scan import RawSample, Scan
from hudepth.data.sources.plausible import INDOOR_MEDIAN_M
from hudepth.data.store import DepthStore

COARSE_MM = 10.0
"""Depth stored in larger steps is worth a note: good networks are off by a few centimetres."""

Verdict: TypeAlias = tuple[str, str, str, dict[str, Any]]
"""Severity, found, meaning and values of a :class:`Finding`."""


@dataclass(frozen=True)
class Finding:
    """A property of a data set, and what follows from it."""

    about: str
    severity: str
    """``ok``, ``note`` (be aware) or ``warning`` (act)."""
    found: str
    """The figures as text; ``values`` has them as plain types."""
    meaning: str
    values: Mapping[str, Any]


def judge_split(kind: str, leak: Leakage, copies: Duplicates | None) -> Finding:
    """Judge whether a split of a kind tests on what it trains on; ``copies`` is None if no image was read."""
    return Finding(f"split={kind}", *_leaks(leak, copies))


def judge_depth(store: DepthStore, scan: Scan, raw: RawSample, *, indoor: bool, max_depth_m: float) -> list[Finding]:
    """Judge the depth of a set: unit, step, holes, clipping, constant maps, sizes, skipped files."""
    verdicts = {
        "depth and unit": _unit(store.info, indoor=indoor),
        "step of depth": _step(raw),
        "holes": _holes(scan.histogram),
        "clipping": _clipped(scan.histogram, store.per_m, max_depth_m),
        "saturation": _saturated(raw.at_largest),
        "constant depth": _constant([store.records[i].id for i in scan.constant], len(store)),
        "native size": _sizes(store.info["native_sizes"]),
        "repeated images": _repeated(scan.digests),
        "unreadable pairs": _skipped(store.info["skipped"]),
    }
    return [Finding(about, *verdict) for about, verdict in verdicts.items()]


def _leaks(leak: Leakage, copies: Duplicates | None) -> Verdict:
    values = {"scene_seen": leak.scene_seen, "near": copies.near if copies else None}
    images = f", near copies of {copies.near:.1%} there" if copies else ""
    if np.isnan(leak.scene_seen):
        meaning = "The test frames name no scene: only their images can show whether training has neighbours of theirs."
        return "note", f"scenes of the test frames unknown{images}", meaning, values
    found = f"{leak.scene_seen:.1%} of test frames from scenes in training{images}"
    if leak.scene_seen > 0:
        meaning = "The test also rewards memory of known rooms: pass data.split=scene to test on new ones alone."
        return "warning", found, meaning, values
    if copies and copies.near > 0:
        meaning = "Scene names differ, but some test images look like training images: see leaks.png."
        return "note", found, meaning, values
    return "ok", found, "No scene is both trained on and tested on.", values


def _unit(info: Mapping[str, Any], *, indoor: bool) -> Verdict:
    low, median, high = (info[f"depth_{name}_m"] for name in ("min", "median", "max"))
    found = f"{low:g} to {high:g} m, median {median:g} m; encoding {info['encoding']}"
    values = {"min_m": low, "median_m": median, "max_m": high, "encoding": info["encoding"]}
    if not indoor:
        return "ok", found, "Not indoors: check that the range is plausible.", values
    if INDOOR_MEDIAN_M[0] <= median <= INDOOR_MEDIAN_M[1]:
        return "ok", found, "A median typical of rooms: the unit is plausible.", values
    return "warning", found, "No room has this median depth: the unit is wrong, so pass another data.encoding.", values


def _step(raw: RawSample) -> Verdict:
    values = {"step_mm": raw.step_mm, "levels": raw.levels}
    if np.isnan(raw.step_mm):
        return "note", "none", "No sampled pair has two different depths, so the step is unknown.", values
    step = "under 0.01" if raw.step_mm < 0.01 else f"{raw.step_mm:.3g}"
    found = f"{step} mm, at most {raw.levels:,} depths in a pair"
    if raw.step_mm < COARSE_MM:
        return "ok", found, "Finer than any error worth reporting.", values
    off = f"The ground truth itself is off by up to {raw.step_mm / 2:.0f} mm: do not interpret smaller errors."
    return "note", found, off, values


def _holes(histogram: NDArray[np.int64]) -> Verdict:
    share = float(histogram[0] / histogram.sum())
    if share == 0:
        return "ok", "none", "Every pixel has a depth; if a sensor took it, its holes were filled in.", {"share": share}
    meaning = "Unmeasured pixels are left out of loss and metrics, so errors there are unknown."
    return "note" if share > 0.01 else "ok", f"{share:.2%} of pixels", meaning, {"share": share}


def _clipped(histogram: NDArray[np.int64], per_m: int, max_depth_m: float) -> Verdict:
    measured = np.append(0, histogram[1:])
    largest_m = float(np.flatnonzero(measured).max(initial=0) / per_m)
    share = float(measured[round(per_m * max_depth_m) :].sum() / max(1, measured.sum()))
    found = f"{share:.2%} of measured pixels at {max_depth_m:g} m or more"
    values = {"share": share, "max_depth_m": max_depth_m, "largest_m": largest_m}
    if share > 0.01:
        meaning = "Training clips these depths; raise data.max_depth_m if the set reaches beyond it."
        return "warning" if share > 0.1 else "note", found, meaning, values
    if 0 < largest_m < max_depth_m / 2:
        unused = f"No depth is above {largest_m:g} m: most of the network's range is unused. Lower data.max_depth_m."
        return "note", found, unused, values
    return "ok", found, "Clipping to it changes next to nothing.", values


def _saturated(share: float) -> Verdict:
    values = {"share": share}
    if np.isnan(share):
        return "note", "unknown", "No sampled pair has a depth.", values
    found = f"{share:.2%} of measured pixels at the largest value"
    if share > 0.01:
        return "note", found, "Depth was cut off at this value: anything farther appears nearer than it is.", values
    return "ok", found, "Depth was not cut off when it was stored.", values


def _constant(ids: Sequence[str], n: int) -> Verdict:
    values = {"ids": list(ids)}
    if not ids:
        return "ok", f"0 of {n:,} maps", "Every map has more than one depth.", values
    listed = ", ".join(ids[:5]) + (", ..." if len(ids) > 5 else "")
    meaning = "A map of one depth teaches nothing and was hardly measured: leave these pairs out."
    return "warning", f"{len(ids):,} of {n:,} maps: {listed}", meaning, values


def _sizes(sizes: Sequence[Sequence[int]]) -> Verdict:
    found = ", ".join(f"{width} x {height}" for height, width in sizes[:4]) + (", ..." if len(sizes) > 4 else "")
    values = {"sizes": [list(size) for size in sizes]}
    if len(sizes) == 1:
        return "ok", found, "All images have one size.", values
    return "note", found, "If shapes differ too, resizing distorts them unequally: crop the images first.", values


def _repeated(digests: Sequence[bytes]) -> Verdict:
    copies = len(digests) - len(set(digests))
    if not copies:
        return "ok", "none", "No image occurs twice, pixel for pixel.", {"copies": copies}
    meaning = "Repeated images weigh more and leak between subsets: keep one of each."
    return "warning", f"{copies:,} of {len(digests):,}", meaning, {"copies": copies}


def _skipped(lines: Sequence[str]) -> Verdict:
    values = {"skipped": list(lines)}
    if not lines:
        return "ok", "none", "Every listed pair was read.", values
    meaning = "They are in no subset, so the splits differ from those of the whole set: fix the files."
    return "warning", f"{len(lines):,}, the first: {lines[0]}", meaning, values
