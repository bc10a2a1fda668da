"""Turn a source into a depth store: decode each pair once, check its units, resize, write.

This module and the sources import no torch, so that worker processes start fast.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from hudepth.console import log, track
from hudepth.data.encoding import check_range, to_metres
from hudepth.data.sources.base import Record, Source
from hudepth.data.store import VERSION, DepthStore, StoreWriter, to_mm
from hudepth.errors import ConfigError, DataError
from hudepth.files import written_whole

UNIT_SAMPLES = 16
"""Pairs whose depth is checked for plausible units before the others are read."""
POOL_FROM = 32
"""Fewer pairs than this are prepared in this process: starting others would take longer."""


@dataclass(frozen=True, slots=True)
class PreparedPair:
    """One pair, ready for the store."""

    image: NDArray[np.uint8]
    depth_mm: NDArray[np.uint16]
    native_png: NDArray[np.uint8] | None
    native_size: tuple[int, int]
    range_m: tuple[float, float, float]
    """Smallest, median and largest measured depth."""
    valid_fraction: float


def store_path(source: Source, *, size: tuple[int, int], native: bool, cache: Path) -> Path:
    """Where the store of this source, size and encoding lies: equal inputs give equal names, changed files new ones.

    Raises:
        DataError: if the source's root or index cannot be read.
    """
    newest = max((file.stat().st_mtime_ns for file in source.files() if file.exists()), default=0)
    key = [VERSION, source.name, source.fingerprint(), newest, size, source.encoding, native]
    return cache / f"{source.name}-{size[0]}x{size[1]}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.h5"


def prepare(
    source: Source,
    *,
    size: tuple[int, int],
    cache: str | Path,
    native: bool = True,
    on_error: str = "raise",
    workers: int | None = None,
) -> DepthStore:
    """Return the depth store of ``source``, preparing it unless that has been done.

    Safe to call from several jobs at once: one prepares, the others wait. Killed half-way, it leaves nothing that a
    later call would take for a store.

    Args:
        source: where the pairs come from.
        size: (height, width) of images and depths in the store; images are averaged over areas, depths take the
            nearest pixel, since a mean of two surfaces is the depth of neither.
        cache: folder of all stores.
        native: also keep the truth at its native resolution, which protocols like ``eigen`` score against.
        on_error: ``raise`` at the first bad pair, or ``skip`` bad pairs and list them.
        workers: processes; default one per core.

    Raises:
        ConfigError: for an unknown ``on_error``.
        DataError: for bad pairs, implausible units, or a folder that cannot be written.
    """
    if on_error not in ("raise", "skip"):
        raise ConfigError(f"data.on_error: no '{on_error}'. Pass raise or skip.")
    path = store_path(source, size=size, native=native, cache=Path(cache).expanduser())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_suffix(".lock")):
            if not path.exists():
                _remove_leftovers(path)
                _build(source, path, size=size, native=native, on_error=on_error, workers=workers)
    except OSError as error:
        raise DataError(
            f"paths.cache: cannot write '{path}' ({error.strerror or error}). "
            "Free some space, or pass paths.cache=<a folder you can write to>."
        ) from error
    store = DepthStore(path)
    if store.info["skipped"] and on_error == "raise":
        raise DataError(
            f"{source.name}: {len(store.info['skipped'])} pairs could not be read, the first: "
            f"{store.info['skipped'][0]} Mend them, or pass data.on_error=skip to go on without them."
        )
    return store


def _remove_leftovers(path: Path) -> None:
    """Remove what a killed run left; the lock is held, so nobody writes to it."""
    for leftover in path.parent.glob(f".{path.name}.*.part"):
        leftover.unlink(missing_ok=True)


def _build(
    source: Source, path: Path, *, size: tuple[int, int], native: bool, on_error: str, workers: int | None
) -> None:
    records = source.records()
    _check_units(source, records)
    skipped: list[str] = []
    pairs: list[PreparedPair] = []  # the small figures only: pixels are dropped once written
    with written_whole(path) as part:
        writer = StoreWriter(part, size=size, native=native)
        try:
            outcomes = _prepare_all(source, records, size, native=native, workers=workers)
            for record, outcome in track(outcomes, total=len(records), what=f"preparing {source.name}"):
                if isinstance(outcome, str):
                    if on_error == "raise":
                        raise DataError(f"{outcome} Mend it, or pass data.on_error=skip to go on without such pairs.")
                    skipped.append(outcome)
                    continue
                writer.append(record, outcome.image, outcome.depth_mm, outcome.native_png)
                pairs.append(_figures(outcome))
            if not pairs:
                raise DataError(f"{source.name}: none of {len(records)} pairs could be read; the first: {skipped[0]}")
            info = _info(source, pairs, skipped)
            writer.close(info)
        except BaseException:
            writer.abort()
            raise
    _report(source, info, path)


def _check_units(source: Source, records: Sequence[Record]) -> None:
    """Refuse implausible units before hours are spent on them."""
    if not records:
        raise DataError(f"{source.name}: the set is empty. Check data.root.")
    step = max(1, len(records) // UNIT_SAMPLES)
    depths = []
    for record in records[::step][:UNIT_SAMPLES]:
        try:
            raw = source.read(record).depth
        except DataError:
            continue  # a bad file is dealt with in its turn; a wrong encoding is wrong for all
        depths.append(_metres(source, record, raw))
    if any((depth > 0).any() for depth in depths):
        check_range(depths, indoor=source.indoor, encoding=source.encoding, name=source.name)


def _metres(source: Source, record: Record, raw: NDArray[np.generic]) -> NDArray[np.float32]:
    return to_metres(
        raw,
        source.encoding,
        scale_m=record.depth_scale_m,
        offset=record.depth_offset,
        auto_uint8=source.auto_uint8,
        where=record.depth or record.id,
    )


def prepare_pair(source: Source, record: Record, size: tuple[int, int], *, native: bool) -> PreparedPair:
    """Decode, check and resize one pair.

    Raises:
        DataError: if it cannot be read or holds no measured depth.
    """
    raw = source.read(record)
    depth_m = _metres(source, record, raw.depth)
    measured = depth_m[depth_m > 0]
    if not measured.size:
        raise DataError(f"'{record.depth or record.id}': the depth is zero everywhere, nothing is measured.")
    height, width = size
    shrinks = raw.image.shape[0] >= height and raw.image.shape[1] >= width
    image = cv2.resize(raw.image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    depth = cv2.resize(depth_m, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    png = cv2.imencode(".png", to_mm(depth_m), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel() if native else None
    return PreparedPair(
        image=image.astype(np.uint8, copy=False),
        depth_mm=to_mm(depth.astype(np.float32, copy=False)),
        native_png=None if png is None else png.astype(np.uint8, copy=False),
        native_size=(depth_m.shape[0], depth_m.shape[1]),
        range_m=(float(measured.min()), float(np.median(measured)), float(measured.max())),
        valid_fraction=measured.size / depth_m.size,
    )


def _figures(pair: PreparedPair) -> PreparedPair:
    empty = np.empty(0, np.uint8)
    return PreparedPair(empty, empty.astype(np.uint16), None, pair.native_size, pair.range_m, pair.valid_fraction)


def _prepare_all(
    source: Source, records: Sequence[Record], size: tuple[int, int], *, native: bool, workers: int | None
) -> Iterator[tuple[Record, PreparedPair | str]]:
    """Yield each record with its prepared pair, or with the line that says why there is none; in order."""
    workers = workers or len(os.sched_getaffinity(0))
    if workers == 1 or len(records) < POOL_FROM:
        for record in records:
            yield record, _outcome(source, record, size, native=native)
        return
    # spawn: a fork would copy the threads' locks of whatever the parent has loaded
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _start_worker, (source, size, native)) as pool:
        waiting: deque[tuple[Record, Future[PreparedPair | str]]] = deque()
        try:
            for record in records:
                waiting.append((record, pool.submit(_work, record)))
                if len(waiting) > 8 * workers:  # bounds the memory that finished pairs take
                    first, future = waiting.popleft()
                    yield first, future.result()
            while waiting:
                first, future = waiting.popleft()
                yield first, future.result()
        except BrokenProcessPool as error:
            raise DataError(
                f"{source.name}: a preparing process was killed (out of memory?). Pass data.prepare_workers=1."
            ) from error
        finally:
            for _, future in waiting:
                future.cancel()


def _outcome(source: Source, record: Record, size: tuple[int, int], *, native: bool) -> PreparedPair | str:
    try:
        return prepare_pair(source, record, size, native=native)
    except DataError as error:
        return str(error)


_worker: dict[str, Any] = {}


def _start_worker(source: Source, size: tuple[int, int], native: bool) -> None:  # noqa: FBT001
    cv2.setNumThreads(1)  # one process per core already
    _worker.update(source=source, size=size, native=native)


def _work(record: Record) -> PreparedPair | str:
    return _outcome(_worker["source"], record, _worker["size"], native=_worker["native"])


def _info(source: Source, pairs: Sequence[PreparedPair], skipped: list[str]) -> dict[str, Any]:
    ranges = np.array([pair.range_m for pair in pairs])
    return {
        "source": source.name,
        "fingerprint": source.fingerprint(),
        "encoding": source.encoding,
        "pairs": len(pairs),
        "depth_min_m": round(float(ranges[:, 0].min()), 3),
        "depth_median_m": round(float(np.median(ranges[:, 1])), 3),
        "depth_max_m": round(float(ranges[:, 2].max()), 3),
        "valid_fraction": round(float(np.mean([pair.valid_fraction for pair in pairs])), 4),
        "native_sizes": sorted({pair.native_size for pair in pairs})[:16],
        "skipped": skipped,
    }


def _report(source: Source, info: dict[str, Any], path: Path) -> None:
    log.info(
        "%s: %d pairs, depth %.2f to %.2f m (median %.2f m, encoding %s), %.1f %% of pixels measured; store %s",
        source.name, info["pairs"], info["depth_min_m"], info["depth_max_m"], info["depth_median_m"],
        info["encoding"], 100 * info["valid_fraction"], path,
    )  # fmt: skip
    if info["skipped"]:
        log.warning("%s: %d pairs skipped:", source.name, len(info["skipped"]))
        for line in info["skipped"]:
            log.warning("  %s", line)
