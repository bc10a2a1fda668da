"""Read a whole store once, and a few pairs as their files hold them, for the figures that findings judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hudepth.base.console import track
from hudepth.base.errors import DataError
from hudepth.data.audit.duplicates import digest_pixels, hash_images
from hudepth.data.pairs import read_metres
from hudepth.data.sources.base import Record, Source
from hudepth.data.store import DepthStore

CHUNK = 64
"""Pairs read from a store at a time."""


@dataclass(frozen=True)
class Scan:
    """What one pass over a store collects."""

    hashes: NDArray[np.uint64]
    digests: list[bytes]
    """[n] equal for images of equal pixels."""
    histogram: NDArray[np.int64]
    """[65536] pixels of each depth, ``store.per_m`` to the metre; those at 0 are unmeasured."""
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
    """Share of measured pixels at the largest value of their type found in the sample; NaN if none is measured."""


def scan_store(store: DepthStore) -> Scan:
    """Read all images and depths of a store, once."""
    hashes: list[NDArray[np.uint64]] = []
    digests: list[bytes] = []
    constant: list[int] = []
    histogram = np.zeros(1 << 16, np.int64)
    starts = range(0, len(store), CHUNK)
    for start in track(starts, total=len(starts), what=f"auditing {store.info['source']}"):
        images, depths_mm = store.read(range(start, min(start + CHUNK, len(store))))
        hashes.append(hash_images(images))
        digests += digest_pixels(images)
        histogram += np.bincount(depths_mm.ravel(), minlength=1 << 16)
        flat = depths_mm.reshape(len(depths_mm), -1)
        smallest = np.where(flat > 0, flat, np.iinfo(np.uint16).max).min(axis=1)
        constant += (start + np.flatnonzero(smallest >= flat.max(axis=1))).tolist()
    return Scan(np.concatenate(hashes), digests, histogram, constant)


def sample_raw(source: Source, records: Sequence[Record], *, pairs: int = 16) -> RawSample:
    """Read some pairs, evenly spaced, to see how finely depth is stored. Pairs that cannot be read are left out.

    ``records`` are the source's and not a store's, which does not record where files are.
    """
    steps_mm, levels, total = [], 0, 0
    tops: list[tuple[str, float, int]] = []  # type, largest value, pixels at it
    for record in records[:: max(1, len(records) // pairs)][:pairs]:
        try:
            values, pixels = np.unique(source.read(record).depth, return_counts=True)
            depth_mm = 1000 * read_metres(source, record, values[None])[0].astype(np.float64)
        except DataError:
            continue
        measured = depth_mm > 0
        if not measured.any():
            continue
        tops.append((str(values.dtype), float(values[measured][-1]), int(pixels[measured][-1])))
        total += int(pixels[measured].sum())
        levels = max(levels, int(measured.sum()))
        if measured.sum() > 1:
            steps_mm.append(float(np.diff(depth_mm[measured]).min()))
    largest = {dtype: max(value for other, value, _ in tops if other == dtype) for dtype, _, _ in tops}
    at_largest = sum(count for dtype, value, count in tops if value == largest[dtype])
    nan = float("nan")
    return RawSample(float(np.median(steps_mm)) if steps_mm else nan, levels, at_largest / total if total else nan)
