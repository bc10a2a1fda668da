"""Run many images through one model, decoding and writing while it computes or in between, whichever is faster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from hudepth.base.errors import ConfigError, DataError
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.model import DepthModel, Predicted, Prepared
from hudepth.inference.pictures import Picture

Key = TypeVar("Key")
LOT, MOST = 8, 64  # images that are decoded, predicted and written together, per thread and in all: memory holds three


@dataclass
class Tally:
    """The results of a stream."""

    done: int = 0  # inputs that were predicted and written
    failed: dict[str, str] = field(default_factory=dict)  # inputs that could not be read or written, and why
    notes: dict[str, str] = field(default_factory=dict)  # remarks on images that were predicted


@dataclass
class Stream(Generic[Key]):
    """Predicts images one after another, in order, a lot at a time.

    A network that uses every core of a CPU is slowed down by any other work: its threads wait for each other, so one
    delayed thread delays all. There the steps alternate: a lot is decoded, then predicted, then written. With a GPU or
    spare cores (``overlap``), one lot is written and the next one decoded while another is predicted.
    """

    model: DepthModel
    write: Callable[[Key, DepthMap], None]  # called in a thread with each image's key and depth
    tally: Tally = field(kw_only=True)
    batch_size: int = field(default=1, kw_only=True)
    workers: int = field(default=2, kw_only=True)  # threads that decode and write; one keeps the order
    overlap: bool = field(default=False, kw_only=True)  # whether they work while the network computes
    smoothing: float = field(default=0.0, kw_only=True)  # weight of the previous frame's depth, in [0, 1)
    _previous: Float[np.ndarray, "h w"] | None = field(default=None, init=False)

    def run(self, pictures: Iterable[tuple[Key, Picture]]) -> Iterator[Key]:
        """Predict and write; yield each key once its image is predicted, or noted in ``tally`` as unreadable.

        Keys name images in messages. Raises OSError if a result cannot be written; earlier results are kept.
        """
        with ThreadPoolExecutor(self.workers) as pool:
            writing: list[Future[None]] = []
            try:
                for lot in self._lots(pool, pictures):
                    jobs = []
                    for key, job in self._predict(lot):
                        if job is not None:
                            jobs.append(job)
                        yield key
                    self._count(writing)  # of the previous lot
                    writing = [pool.submit(job) for job in jobs]
                    if not self.overlap:
                        self._count(writing)
                        writing = []
                self._count(writing)
            finally:
                for future in writing:
                    future.cancel()

    def _lots(
        self, pool: ThreadPoolExecutor, pictures: Iterable[tuple[Key, Picture]]
    ) -> Iterator[list[tuple[Key, Prepared | DataError]]]:
        """Yield lots of decoded images; with ``overlap`` the next one is decoded meanwhile."""
        left, size = iter(pictures), max(min(LOT * self.workers, MOST), self.batch_size)
        size -= size % self.batch_size  # whole batches: on a GPU each other size is recorded anew

        def begin() -> list[tuple[Key, Future[Prepared | DataError]]]:
            return [(key, pool.submit(self._prepare, picture)) for key, picture in islice(left, size)]

        coming = begin()
        while coming:
            lot = [(key, future.result()) for key, future in coming]
            if self.overlap:
                coming = begin()
            yield lot
            if not self.overlap:
                coming = begin()

    def _prepare(self, picture: Picture) -> Prepared | DataError:
        try:
            return self.model.prepare(picture)
        except DataError as error:
            return error
        except ConfigError as error:  # the camera cannot have taken this picture
            return DataError(str(error))

    def _predict(self, lot: list[tuple[Key, Prepared | DataError]]) -> Iterator[tuple[Key, Callable[[], None] | None]]:
        """Yield each key of a lot with the function that writes its depth, None if it is unreadable."""
        good: list[tuple[Key, Prepared]] = []
        for key, prepared in lot:
            if isinstance(prepared, DataError):
                self.tally.failed[str(key)] = str(prepared)
                yield key, None
            else:
                good.append((key, prepared))
        for at in range(0, len(good), self.batch_size):
            batch = good[at : at + self.batch_size]
            found = self.model.run([prepared for _, prepared in batch])
            for (key, prepared), predicted in zip(batch, found, strict=True):
                if prepared.photo.notes:
                    self.tally.notes[str(key)] = "; ".join(prepared.photo.notes)
                yield key, partial(self._finish, key, prepared, self._smooth(predicted))

    def _smooth(self, predicted: Predicted) -> Predicted:
        depth = predicted.depth_m
        if self.smoothing and self._previous is not None:
            depth = (self.smoothing * self._previous + (1 - self.smoothing) * depth).astype(np.float32)
        self._previous = depth
        return predicted._replace(depth_m=depth)

    def _finish(self, key: Key, prepared: Prepared, predicted: Predicted) -> None:
        self.write(key, self.model.finish(prepared, predicted))

    def _count(self, writing: list[Future[None]]) -> None:
        """Wait for what is being written, and count it; raise the first error."""
        wait(writing)
        self.tally.done += sum(future.exception() is None for future in writing)
        for future in writing:
            future.result()
