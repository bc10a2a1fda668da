"""From array to array through a GPU, as CUDA graphs."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hudepth.base.console import log
from hudepth.base.errors import first_line
from hudepth.cuda import graphs

MOST = 8
"""How many shapes are kept recorded; those that were not used for longest go first."""

_ONE_AT_A_TIME = threading.Lock()
"""While one thread records, nothing else may be launched on its stream, and the arrays of a recording are shared."""


class _Recorded(NamedTuple):
    """A recording between two tensors in page-locked memory."""

    source: Tensor
    result: Tensor
    recording: graphs.Recording


class ArrayGraphs:
    """Computes a function of one array on a GPU; from the fourth array of a shape on, it replays a CUDA graph.

    The copies to the GPU and back are part of the graph. Shapes that cannot be recorded are computed as usual, after
    one line in the log. Threads may share it: they compute one after the other.

    Args:
        function: from a tensor on ``device`` to another; it needs no gradients.
        device: a GPU.
        what: names it in the log.
    """

    def __init__(self, function: Callable[[Tensor], Tensor], device: torch.device, *, what: str) -> None:
        self.function, self.device, self.what = function, device, what
        self.wanted = True
        self._known: OrderedDict[Any, _Recorded] = OrderedDict()
        self._seen: Counter[Any] = Counter()
        self._pool: Any = None

    def __call__(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return the function's result; raises torch.OutOfMemoryError if the GPU has too little memory."""
        with _ONE_AT_A_TIME, torch.inference_mode():
            key = graphs.generation(), array.shape, array.dtype
            if known := self._known.get(key):
                self._known.move_to_end(key)
                known.source.copy_(torch.from_numpy(array))  # by several threads, unlike NumPy's copies
                known.recording.replay()
                graphs.wait()
                return np.asarray(known.result.clone().numpy())  # the next replay overwrites it
            result = self._usual(array)
            self._seen[key] += 1
            if self.wanted and self._seen[key] >= graphs.WARM_UPS:
                self._record(key, array, result)
            return result

    def _usual(self, array: NDArray[Any]) -> NDArray[Any]:
        try:
            return self._compute(array)
        except torch.OutOfMemoryError as error:
            if not self._known:
                raise
            self._give_up(error)
        self._known.clear()  # recordings hold memory
        return self._compute(array)

    def _compute(self, array: NDArray[Any]) -> NDArray[Any]:
        with graphs.beside():
            result = self.function(torch.from_numpy(array).to(self.device))
        return np.asarray(result.cpu().numpy())

    def _record(self, key: Any, array: NDArray[Any], result: NDArray[Any]) -> None:
        """Record the function right after it ran as usual in this thread, for which libraries are then set up."""
        try:
            source, target = (graphs.host_memory(torch.from_numpy(each)) for each in (array, result))

            def compute() -> None:
                target.copy_(self.function(source.to(self.device, non_blocking=True)), non_blocking=True)

            # nothing in this memory outlives a replay, so all shapes may share it
            recording = graphs.record(compute, pool=self._pool)
        except Exception as error:  # a network may do anything, and works without
            self._give_up(error)
            return
        self._pool = recording.pool
        self._known[key] = _Recorded(source, target, recording)
        if len(self._known) > MOST:
            oldest, _ = self._known.popitem(last=False)
            del self._seen[oldest]

    def _give_up(self, error: Exception) -> None:
        log.info("%s is not replayed as a CUDA graph, and slower: %s", self.what, first_line(error))
        self.wanted = False
