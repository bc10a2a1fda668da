"""Many images through one model: decoding and writing go on in other threads while it computes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import Float

from hudepth.errors import DataError
from hudepth.inference.depth_map import DepthMap
from hudepth.inference.model import DepthModel, Picture, Prepared

Key = TypeVar("Key")
AHEAD = 4
"""Images that wait, decoded or to be written, for each thread: enough to keep all busy, few enough for memory."""


@dataclass
class Tally:
    """What came of a stream."""

    done: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    """What could not be read, and why."""
    notes: dict[str, str] = field(default_factory=dict)
    """What was predicted, but not as one might think."""


class Stream(Generic[Key]):
    """Predicts images one after another, in order.

    Args:
        model: what predicts.
        write: called in a thread with each image's key and depth.
        tally: where to count what came of it.
        batch_size: images that go through the network together.
        workers: threads that decode, and as many that write.
        smoothing: of frames that follow each other: the share of the depth so far that is kept, from 0 (none) to less
            than 1.
    """

    def __init__(
        self,
        model: DepthModel,
        write: Callable[[Key, DepthMap], None],
        *,
        tally: Tally,
        batch_size: int = 1,
        workers: int = 2,
        smoothing: float = 0.0,
    ) -> None:
        self._model, self._write = model, write
        self._batch_size, self._workers, self._smoothing = batch_size, workers, smoothing
        self._so_far: Float[np.ndarray, "h w"] | None = None
        self.tally = tally

    def run(self, pictures: Iterable[tuple[Key, Picture]]) -> Iterator[Key]:
        """Predict and write; yield each key once its image is through the network or was found unreadable.

        Args:
            pictures: keys, whose text names an image in messages, and images. Images that cannot be read are noted in
                ``tally`` and left out.

        Raises:
            OSError: if a result cannot be written; what was predicted before is kept.
        """
        with ThreadPoolExecutor(self._workers) as decoding, ThreadPoolExecutor(self._workers) as encoding:
            waiting: deque[Future[None]] = deque()
            batch: list[tuple[Key, Prepared]] = []
            try:
                for key, prepared in self._decoded(decoding, pictures):
                    if isinstance(prepared, DataError):
                        self.tally.failed[str(key)] = str(prepared)
                        yield key
                        continue
                    batch.append((key, prepared))
                    if len(batch) == self._batch_size:
                        yield from self._predict(batch, encoding, waiting)
                        batch = []
                yield from self._predict(batch, encoding, waiting)
                while waiting:
                    waiting.popleft().result()
            finally:
                for future in waiting:
                    future.cancel()

    def _decoded(
        self, pool: ThreadPoolExecutor, pictures: Iterable[tuple[Key, Picture]]
    ) -> Iterator[tuple[Key, Prepared | DataError]]:
        """Yield prepared images in order, a few of them ahead of time."""
        ahead: deque[tuple[Key, Future[Prepared | DataError]]] = deque()
        try:
            for key, picture in pictures:
                ahead.append((key, pool.submit(self._prepare, picture)))
                if len(ahead) > AHEAD * self._workers:
                    first, future = ahead.popleft()
                    yield first, future.result()
            while ahead:
                first, future = ahead.popleft()
                yield first, future.result()
        finally:
            for _, future in ahead:
                future.cancel()

    def _prepare(self, picture: Picture) -> Prepared | DataError:
        try:
            return self._model.prepare(picture)
        except DataError as error:
            return error

    def _predict(
        self, batch: list[tuple[Key, Prepared]], pool: ThreadPoolExecutor, waiting: deque[Future[None]]
    ) -> Iterator[Key]:
        if not batch:
            return
        depths = self._model.run([prepared for _, prepared in batch])
        for (key, prepared), depth in zip(batch, depths, strict=True):
            waiting.append(pool.submit(self._finish, key, prepared, self._smoothed(depth)))
            self.tally.done += 1
            if prepared.photo.notes:
                self.tally.notes[str(key)] = "; ".join(prepared.photo.notes)
            while len(waiting) > AHEAD * self._workers:
                waiting.popleft().result()
            yield key

    def _smoothed(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        if self._smoothing and self._so_far is not None:
            depth = (self._smoothing * self._so_far + (1 - self._smoothing) * depth).astype(np.float32)
        self._so_far = depth
        return depth

    def _finish(self, key: Any, prepared: Prepared, depth: Float[np.ndarray, "h w"]) -> None:
        self._write(key, self._model.finish(prepared, depth))
