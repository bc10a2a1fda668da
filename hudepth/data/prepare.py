"""Turn a source into a depth store: decode each pair once, check its unit, resize, write."""

from __future__ import annotations

import errno
import hashlib
import shutil
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from hudepth.base.console import log, track
from hudepth.base.errors import ConfigError, DataError
from hudepth.base.files import written_whole
from hudepth.base.machine import largest_file
from hudepth.base.options import Range, convert, parse
from hudepth.base.wording import more_room
from hudepth.data.pairs import PreparedPair, prepare_pairs, read_metres, values_per_metre
from hudepth.data.sources.base import Record, Source
from hudepth.data.sources.contents import hash_contents
from hudepth.data.sources.plausible import FAR_INDOORS_M, check_range, looks_swapped, suggest
from hudepth.data.store import MAX_STORED, VERSION, DepthStore, StoreWriter

MAX_SIZES = 16
"""Largest number of image sizes that a store lists."""
UNIT_SAMPLES = 16
"""Number of pairs whose depth is checked for a plausible unit beforehand."""

OnError = Literal["raise", "skip"]


@dataclass(frozen=True)
class _Info:
    """What commands read of a store's ``info``."""

    source: str
    fingerprint: str
    encoding: str
    pairs: int
    depth_min_m: float
    depth_median_m: float
    depth_max_m: float
    valid_fraction: float
    native_sizes: list[Annotated[tuple[int, int], Range(1)]]
    skipped: list[str]
    depth_percentiles_m: list[float] | None = None
    no_reading: float = 0.0


_NONE = np.empty(0, np.uint8)


def store_path(source: Source, *, size: tuple[int, int], native: bool, cache: Path) -> Path:
    """Return the path of the store of this source and size: equal inputs give equal names, changed contents new ones.

    Raises DataError if the source's root, its index or a file cannot be read.
    """
    contents = hash_contents(source.name, source.files(), cache=cache)
    unit = [source.encoding, values_per_metre(source), source.depth_scale_m, source.invalid]
    unit += ["sparse"] * source.sparse
    key = [VERSION, source.name, source.fingerprint(), contents, size, unit, native]
    return cache / f"{source.name}-{size[0]}x{size[1]}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.h5"


def build_once(path: Path, build: Callable[[Path], None]) -> None:
    """Build a file of the cache if it does not exist: one of several jobs builds it, the others wait.

    Raises DataError if it cannot be written.
    """
    if path.exists() and not path.is_file():  # opening a pipe would wait for its writer
        raise DataError(f"paths.cache: '{path}' is no regular file. Delete it and prepare again.")
    try:
        if not path.exists():  # try without the lock first, for caches that are read-only
            path.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(path.with_suffix(".lock")):
                if not path.exists():
                    for leftover in path.parent.glob(f".{path.name}.*.part"):  # of a run that was killed
                        leftover.unlink(missing_ok=True)
                    build(path)
    except OSError as error:
        raise DataError(
            f"paths.cache: cannot write '{path}' ({error.strerror or error}). "
            f"{more_room(error)}, or pass paths.cache=<a folder you can write to>."
        ) from error


def prepare(
    source: Source,
    *,
    size: tuple[int, int],
    cache: str | Path,
    native: bool = True,
    on_error: str = "raise",
    workers: int | None = None,
) -> DepthStore:
    """Return the depth store of ``source``, and prepare it first if it does not exist.

    Safe to call from several jobs at once. A call that is killed leaves no store. Raises ConfigError for an unknown
    ``on_error``; DataError for bad pairs, implausible units, or a folder that cannot be written.

    Args:
        size: (height, width) of images and depths in the store; images are averaged over areas, depths take the
            nearest pixel, since a mean of two surfaces is the depth of neither.
        native: also keep the ground truth at its native resolution, for protocols like ``eigen``.
        on_error: ``raise`` at the first bad pair, or ``skip`` bad pairs and list them.
        workers: processes; one per core by default.
    """
    convert("data.on_error", on_error, OnError)
    path = store_path(source, size=size, native=native, cache=Path(cache).expanduser())
    build_once(path, partial(_build, source, size=size, native=native, on_error=on_error, workers=workers))
    store = DepthStore(path)
    try:
        store.info["skipped"] = parse(_Info, store.info).skipped
    except ConfigError as error:
        what = str(error).partition(". ")[0]
        raise DataError(f"'{path}' is damaged: its info's {what}. Delete it and prepare again.") from error
    if (skipped := store.info["skipped"]) and on_error == "raise":
        raise DataError(
            f"{source.name}: {len(skipped)} pairs could not be read, the first: "
            f"{skipped[0]} Fix them, or pass data.on_error=skip to leave them out."
        )
    return store


def _build(
    source: Source, path: Path, *, size: tuple[int, int], native: bool, on_error: str, workers: int | None
) -> None:
    records = source.records()
    _check_units(source, records)
    needed, free = 5 * len(records) * size[0] * size[1], shutil.disk_usage(path.parent).free
    if needed > free:  # for images and depths
        raise OSError(errno.ENOSPC, f"it takes {needed / 1e6:,.1f} MB or more, {free / 1e6:,.1f} MB are free")
    if needed + 12_288 > (limit := largest_file()):  # HDF5 crashes if it cannot write its first headers
        raise OSError(errno.EFBIG, f"it takes {needed / 1e6:,.1f} MB or more, ulimit -f is {limit / 1e6:,.1f} MB")
    skipped = list(source.unpaired or ())
    histogram = np.zeros(MAX_STORED + 1, np.int64)
    pairs: list[PreparedPair] = []  # without their pixels
    with written_whole(path) as part:
        writer = StoreWriter(part, size=size, native=native, per_m=values_per_metre(source))
        try:
            # closing: an error below must end the processes at once, not when its traceback is forgotten
            with closing(prepare_pairs(source, records, size, native=native, workers=workers)) as outcomes:
                for record, outcome in track(outcomes, total=len(records), what=f"preparing {source.name}"):
                    if isinstance(outcome, str):
                        if on_error == "raise":
                            raise DataError(f"{outcome} Fix it, or pass data.on_error=skip to leave out such pairs.")
                        skipped.append(outcome)
                        continue
                    writer.append(record, outcome.image, outcome.stored_depth, outcome.native_png)
                    histogram += np.bincount(outcome.stored_depth.ravel(), minlength=len(histogram))
                    pairs.append(replace(outcome, image=_NONE, stored_depth=_NONE.astype(np.uint16), native_png=None))
            if not pairs:
                raise DataError(f"{source.name}: none of {len(records)} pairs could be read; the first: {skipped[0]}")
            info = _info(source, pairs, skipped, histogram)
            writer.close(info)
        except BaseException:
            writer.abort()
            raise
    _report(source, info, path)


def _check_units(source: Source, records: Sequence[Record]) -> None:
    """Refuse implausible units before spending hours on them."""
    if not records:
        raise DataError(f"{source.name}: the set is empty. Check data.root.")
    step = max(1, len(records) // UNIT_SAMPLES)
    depths, raws, refused = [], [], []
    for record in records[::step][:UNIT_SAMPLES]:
        try:
            raw = source.read(record).depth
        except DataError:  # reported later, in its turn
            continue
        if looks_swapped(raw):
            where = record.depth or record.id
            raise DataError(f"'{where}': 16-bit values with their bytes swapped. Write them in the file's byte order.")
        try:
            depths.append(read_metres(source, record, raw))
            raws.append(raw)
        except DataError as error:
            refused.append(error)
    if refused and not depths:  # the wrong encoding, not one bad file
        raise refused[0]
    if not any((depth > 0).any() for depth in depths):
        return
    own_scale = source.depth_scale_m is not None or any(record.depth_scale_m is not None for record in records)
    shown = [] if own_scale else raws
    name, encoding = source.name, source.encoding
    usual = source.usual_median_m
    found = check_range(depths, indoor=source.indoor, encoding=encoding, name=name, usual_m=usual, raws=shown)
    if source.indoor and found.median_m > FAR_INDOORS_M and encoding != "paper_literal":
        fix = suggest(shown) or "data.source.indoor=false if it is not indoors"
        log.warning("%s: a median depth of %.3g m is far for rooms. Meant is perhaps %s", name, found.median_m, fix)


def share_beyond(store: DepthStore, max_depth_m: float) -> float:
    """Return the share of measured pixels of a store beyond a depth, to 1 %; 0 if the store does not know."""
    percentiles = store.info.get("depth_percentiles_m") or [0.0]
    return float(np.mean(np.asarray(percentiles, np.float64) > max_depth_m))


def _info(
    source: Source, pairs: Sequence[PreparedPair], skipped: list[str], histogram: NDArray[np.int64]
) -> dict[str, Any]:
    ranges = np.array([pair.range_m for pair in pairs])
    below = histogram[1:].cumsum()
    percentiles = np.searchsorted(below, np.maximum(1, np.linspace(0, 1, 101) * below[-1])) + 1
    return {
        "source": source.name,
        "fingerprint": source.fingerprint(),
        "encoding": source.encoding,
        "pairs": len(pairs),
        "depth_min_m": round(float(ranges[:, 0].min()), 3),
        "depth_median_m": round(float(np.median(ranges[:, 1])), 3),
        "depth_max_m": round(float(ranges[:, 2].max()), 3),
        "depth_percentiles_m": (percentiles / values_per_metre(source)).round(3).tolist(),
        "no_reading": round(float(np.mean([pair.no_reading for pair in pairs])), 4),
        "valid_fraction": round(float(np.mean([pair.valid_fraction for pair in pairs])), 4),
        "native_sizes": sorted({pair.native_size for pair in pairs})[:MAX_SIZES],
        "skipped": skipped,
    }


def _report(source: Source, info: dict[str, Any], path: Path) -> None:
    log.info(
        "%s: %d pairs, depth %.2f to %.2f m (median %.2f m, encoding %s), %.1f %% of pixels measured; store %s",
        source.name, info["pairs"], info["depth_min_m"], info["depth_max_m"], info["depth_median_m"],
        info["encoding"], 100 * info["valid_fraction"], path,
    )  # fmt: skip
    if info["no_reading"] > 0:
        log.warning(
            "%s: %.1f %% of pixels hold the largest value of their type and count as unmeasured; "
            "data.invalid=[<value>, ...] states such values, data.invalid=[] takes all for depths",
            source.name, 100 * info["no_reading"],
        )  # fmt: skip
    if info["skipped"]:
        log.warning("%s: %d pairs skipped:", source.name, len(info["skipped"]))
        for line in info["skipped"]:
            log.warning("  %s", line)
