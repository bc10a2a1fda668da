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
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hudepth.base.errors import DataError
from hudepth.base.images import resize_image
from hudepth.base.machine import usable_cores
from hudepth.data.encoding import to_metres
from hudepth.data.sources.base import Record, Source
from hudepth.data.store import to_mm

POOL_FROM = 32
"""Fewer pairs than this are prepared in this process: starting others would take longer."""


@dataclass(frozen=True, slots=True)
class PreparedPair:
    """One pair, ready for the store; ``range_m`` is its smallest, median and largest measured depth."""

    image: NDArray[np.uint8]
    depth_mm: NDArray[np.uint16]
    native_png: NDArray[np.uint8] | None
    native_size: tuple[int, int]
    range_m: tuple[float, float, float]
    valid_fraction: float


def read_metres(source: Source, record: Record, raw: NDArray[np.generic]) -> NDArray[np.float32]:
    """Turn a pair's stored depth into metres, 0 where unmeasured; DataError if the encoding does not fit it."""
    return to_metres(
        raw,
        source.encoding,
        scale_m=record.depth_scale_m,
        offset=record.depth_offset,
        auto_uint8=source.auto_uint8,
        where=record.depth or record.id,
    )


def prepare_pair(source: Source, record: Record, size: tuple[int, int], *, native: bool) -> PreparedPair:
    """Decode, check and resize one pair; DataError if it cannot be read or holds no measured depth."""
    raw = source.read(record)
    depth_m = read_metres(source, record, raw.depth)
    measured = depth_m[depth_m > 0]
    if not measured.size:
        raise DataError(f"'{record.depth or record.id}': the depth is zero everywhere, nothing is measured.")
    height, width = size
    image = resize_image(raw.image, size)
    depth = cv2.resize(depth_m, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    png = cv2.imencode(".png", to_mm(depth_m), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].ravel() if native else None
    return PreparedPair(
        image=image,
        depth_mm=to_mm(depth.astype(np.float32, copy=False)),
        native_png=None if png is None else png.astype(np.uint8, copy=False),
        native_size=(depth_m.shape[0], depth_m.shape[1]),
        range_m=(float(measured.min()), float(np.median(measured)), float(measured.max())),
        valid_fraction=measured.size / depth_m.size,
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
