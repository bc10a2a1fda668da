"""Decode, check and resize pairs, one after another or in a process per core.

This module and the sources import no torch, so that worker processes start fast.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from math import ceil
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.base.images import resize_image
from hudepth.base.machine import usable_cores
from hudepth.data.encoding import is_invalid, to_metres
from hudepth.data.sources.base import Record, Source
from hudepth.data.store import MAX_STORED, OUTDOOR_PER_M, SCALES, to_stored

POOL_FROM = 32
"""Fewer pairs than this are prepared in this process: starting others would take longer."""


@dataclass(frozen=True, slots=True)
class PreparedPair:
    """One pair, ready for the store, which holds its depth times :func:`values_per_metre`."""

    image: NDArray[np.uint8]
    stored_depth: NDArray[np.uint16]
    native_png: NDArray[np.uint8] | None
    native_size: tuple[int, int]
    range_m: tuple[float, float, float]
    """Smallest, median and largest measured depth."""
    valid_fraction: float
    no_reading: float
    """Share of pixels that hold the largest value of their type, taken as unmeasured because nothing else was said."""


def read_metres(source: Source, record: Record, raw: NDArray[np.generic]) -> NDArray[np.float32]:
    """Turn a pair's stored depth into metres, 0 where unmeasured; DataError if the encoding does not fit it."""
    return to_metres(
        raw,
        source.encoding,
        scale_m=source.depth_scale_m if record.depth_scale_m is None else record.depth_scale_m,
        offset=record.depth_offset,
        auto_uint8=source.auto_uint8,
        invalid=source.invalid,
        where=record.depth or record.id,
    )


def values_per_metre(source: Source) -> int:
    """Return how many stored values make a metre: indoors 1000, else 256, or fewer if ``farthest_m`` needs them."""
    scales = SCALES if source.indoor else SCALES[SCALES.index(OUTDOOR_PER_M) :]
    return next(per_m for per_m in scales if (source.farthest_m or 0) <= MAX_STORED / per_m)


def prepare_pair(source: Source, record: Record, size: tuple[int, int], *, native: bool) -> PreparedPair:
    """Decode, check and resize one pair; DataError if it cannot be read, or its depth is unmeasured or too far."""
    raw = source.read(record)
    depth_m = read_metres(source, record, raw.depth)
    measured = depth_m[depth_m > 0]
    if not measured.size:
        raise DataError(f"'{record.depth or record.id}': {unmeasured(raw.depth)}")
    per_m = values_per_metre(source)
    if round(float(measured.max()) * per_m) > MAX_STORED:
        raise DataError(f"'{record.depth or record.id}': {_too_far(float(measured.max()), source)}")
    height, width = size
    image = resize_image(raw.image, size)
    if source.sparse:
        depth = nearest_measured(depth_m, size)
    else:
        resized = cv2.resize(depth_m, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        depth = resized.astype(np.float32, copy=False)
    png = None
    if native:
        png = cv2.imencode(".png", to_stored(depth_m, per_m), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel()
    return PreparedPair(
        image=image,
        stored_depth=to_stored(depth, per_m),
        native_png=None if png is None else png.astype(np.uint8, copy=False),
        native_size=(depth_m.shape[0], depth_m.shape[1]),
        range_m=(float(measured.min()), float(np.median(measured)), float(measured.max())),
        valid_fraction=measured.size / depth_m.size,
        no_reading=0.0 if source.invalid is not None else float(is_invalid(raw.depth, None).mean()),
    )


def nearest_measured(depth_m: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Resize depths [H, W] to ``size`` (height, width); each pixel takes the measured one nearest to its centre.

    Only pixels within its own area count, as the nearest pixel does: where none is measured, it stays 0. Where the map
    grows, a measured pixel keeps to one pixel, so that sparse depth stays sparse.
    """
    (rows, columns), (height, width) = depth_m.shape, size
    y, x = np.nonzero(depth_m > 0)
    top, left = (y + 0.5) * height / rows, (x + 0.5) * width / columns  # in pixels of the result
    to_row, to_column = top.astype(np.int64), left.astype(np.int64)
    off_centre = (top - to_row - 0.5) ** 2 + (left - to_column - 0.5) ** 2
    order = np.argsort(-off_centre, kind="stable")  # of several, the last one written stays
    result = np.zeros(size, np.float32)
    result[to_row[order], to_column[order]] = depth_m[y[order], x[order]]
    return result


def unmeasured(raw: NDArray[np.generic]) -> str:
    """Say why no value of a depth map is a depth."""
    numbers = raw[np.isfinite(raw)] if raw.dtype.kind == "f" else raw.ravel()
    if not numbers.size:
        return "nothing is measured, no value is a finite number."
    low, high = numbers.min(), numbers.max()
    if low == high == 0:
        return "the depth is zero everywhere, nothing is measured."
    held = f"nothing is measured, its {raw.dtype} values lie in {low:g} to {high:g}"
    return f"{held}. {'Check data.encoding and data.invalid.' if high > 0 else 'Store depths without their sign.'}"


def _too_far(largest_m: float, source: Source) -> str:
    most = MAX_STORED / values_per_metre(source)
    fix = f"data.source.farthest_m={ceil(largest_m)} if it is real, "
    if source.indoor and largest_m <= MAX_STORED / OUTDOOR_PER_M:
        fix = "data.source.indoor=false for up to 255.996 m, "
    return (
        f"its largest depth, {largest_m:.6g} m, is beyond the {most:.6g} m that a store holds. Pass {fix}another "
        "data.encoding if the unit is wrong, or data.invalid=[<value>] if it stands for no reading."
    )


def prepare_pairs(
    source: Source, records: Sequence[Record], size: tuple[int, int], *, native: bool, workers: int | None
) -> Generator[tuple[Record, PreparedPair | str], None, None]:
    """Yield each record with its prepared pair, or with the line that states why it failed; in order."""
    workers = workers or usable_cores()
    if workers == 1 or len(records) < POOL_FROM:
        for record in records:
            yield record, _work(record, source=source, size=size, native=native)
        return
    context = multiprocessing.get_context("spawn")  # a fork would copy locks of the parent's threads
    with ProcessPoolExecutor(workers, context, _start_worker, (source, size, native)) as pool:
        waiting: deque[tuple[Record, Future[PreparedPair | str]]] = deque()
        try:
            for record in records:
                waiting.append((record, pool.submit(_work, record)))
                if len(waiting) > 8 * workers:  # bounds the memory that finished pairs take
                    first, future = waiting.popleft()
                    yield first, future.result()
            for first, future in waiting:
                yield first, future.result()
        except BrokenProcessPool as error:
            raise DataError(
                f"{source.name}: a preparing process was killed (out of memory?). Pass data.prepare_workers=1."
            ) from error
        finally:
            for _, future in waiting:
                future.cancel()


_worker: dict[str, Any] = {}


def _start_worker(source: Source, size: tuple[int, int], native: bool) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)  # one process per core already
    _worker.update(source=source, size=size, native=native)


def _end_with_parent() -> None:
    """End with the parent: a pool's processes would outlive one that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(record: Record, **options: Any) -> PreparedPair | str:
    try:
        return prepare_pair(record=record, **(options or _worker))
    except DataError as error:
        return str(error)
