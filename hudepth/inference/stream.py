"""Run many images through one model, decoding and writing while it computes or in between, whichever is faster."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from hudepth.base.errors import DataError
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.model import DepthModel, Picture, Prepared

Key = TypeVar("Key")
LOT = 8
"""Images per thread that are decoded, predicted and written together: few enough for memory."""


@dataclass
class Tally:
    """The results of a stream."""

    done: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    """Images that could not be read, and why."""
    notes: dict[str, str] = field(default_factory=dict)
    """Remarks on images that were predicted."""


class Stream(Generic[Key]):
    """Predicts images one after another, in order, a lot at a time.

    A network that uses every core of a CPU is slowed down by any other work: its threads wait for each other, so one
    delayed thread delays all. There the steps alternate: a lot is decoded, then predicted, then written. With a GPU or
    spare cores (``overlap``), one lot is written and the next one decoded while another is predicted.

    Args:
        model: what predicts.
        write: called in a thread with each image's key and depth.
        tally: where to count results.
        batch_size: images that go through the network together.
        workers: threads that decode and write; one keeps the order.
        overlap: whether they work while the network computes.
        smoothing: of consecutive frames: the weight of the previous depth, from 0 (none) to less than 1.
    """

    def __init__(
        self,
        model: DepthModel,
        write: Callable[[Key, DepthMap], None],
        *,
        tally: Tally,
        batch_size: int = 1,
        workers: int = 2,
        overlap: bool = False,
        smoothing: float = 0.0,
    ) -> None:
        self._model, self._write = model, write
        self._batch_size, self._workers, self._overlap, self._smoothing = batch_size, workers, overlap, smoothing
        self._previous: Float[np.ndarray, "h w"] | None = None
        self.tally = tally

    def run(self, pictures: Iterable[tuple[Key, Picture]]) -> Iterator[Key]:
        """Predict and write; yield each key once its image has been predicted or found unreadable.

        Args:
            pictures: keys, which name an image in messages, and images. Unreadable images are noted in ``tally`` and
                skipped.

        Raises:
            OSError: if a result cannot be written; earlier results are kept.
        """
        with ThreadPoolExecutor(self._workers) as pool:
            writing: deque[Future[None]] = deque()
            try:
                for lot in self._lots(pool, pictures):
                    jobs = []
                    for key, job in self._predict(lot):
                        if job is not None:
                            jobs.append(job)
                        yield key
                    _wait(writing)  # for the previous lot
                    writing.extend(pool.submit(job) for job in jobs)
                    if not self._overlap:
                        _wait(writing)
                _wait(writing)
            finally:
                for future in writing:
                    future.cancel()

    def _lots(
        self, pool: ThreadPoolExecutor, pictures: Iterable[tuple[Key, Picture]]
    ) -> Iterator[list[tuple[Key, Prepared | DataError]]]:
        """Yield lots of decoded images; with ``overlap`` the next one is decoded meanwhile."""
        left = iter(pictures)
        size = max(LOT * self._workers, self._batch_size)

        def begin() -> list[tuple[Key, Future[Prepared | DataError]]]:
            return [(key, pool.submit(self._prepare, picture)) for key, picture in islice(left, size)]

        coming = begin()
        while coming:
            lot = [(key, future.result()) for key, future in coming]
            if self._overlap:
                coming = begin()
                yield lot
            else:
                yield lot
                coming = begin()

    def _prepare(self, picture: Picture) -> Prepared | DataError:
        try:
            return self._model.prepare(picture)
        except DataError as error:
            return error

    def _predict(self, lot: list[tuple[Key, Prepared | DataError]]) -> Iterator[tuple[Key, Callable[[], None] | None]]:
        """Yield each key of a lot with the function that writes its depth, None if it is unreadable."""
        good: list[tuple[Key, Prepared]] = []
        for key, prepared in lot:
            if isinstance(prepared, DataError):
                self.tally.failed[str(key)] = str(prepared)
                yield key, None
            else:
                good.append((key, prepared))
        for at in range(0, len(good), self._batch_size):
            batch = good[at : at + self._batch_size]
            depths = self._model.run([prepared for _, prepared in batch])
            for (key, prepared), depth in zip(batch, depths, strict=True):
                self.tally.done += 1
                if prepared.photo.notes:
                    self.tally.notes[str(key)] = "; ".join(prepared.photo.notes)
                yield key, partial(self._finish, key, prepared, self._smooth(depth))

    def _smooth(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        if self._smoothing and self._previous is not None:
            depth = (self._smoothing * self._previous + (1 - self._smoothing) * depth).astype(np.float32)
        self._previous = depth
        return depth

    def _finish(self, key: Key, prepared: Prepared, depth: Float[np.ndarray, "h w"]) -> None:
        self._write(key, self._model.finish(prepared, depth))


def _wait(futures: deque[Future[None]]) -> None:
    while futures:
        futures.popleft().result()
