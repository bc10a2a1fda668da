"""Functions of tensors as CUDA graphs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from hudepth.base.console import log
from hudepth.base.errors import first_line
from hudepth.cuda import graphs

Tensors = Mapping[str, Tensor]


class _Recorded(NamedTuple):
    inputs: dict[str, Tensor]
    recording: graphs.Recording


class Replayed:
    """Calls functions of named tensors, and replays those that were called before with tensors of the same shapes.

    ``what`` names them in the log, where a line says if they cannot be recorded; they then run as usual.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self._known: dict[Hashable, _Recorded] = {}
        self._seen: Counter[Hashable] = Counter()
        self._failed = False

    def __call__(
        self, function: Callable[[Tensors], dict[str, Tensor]], inputs: Tensors, *, setting: Hashable = None
    ) -> dict[str, Tensor]:
        """Return ``function(inputs)``; ``setting`` is whatever else the result depends on."""
        if self._failed or not all(graphs.has_graphs(x.device) for x in inputs.values()):
            return function(inputs)
        key = graphs.generation(), setting, tuple((name, x.shape, x.dtype) for name, x in inputs.items())
        if key not in self._known:
            self._seen[key] += 1
            if self._seen[key] <= graphs.WARM_UPS or not self._record(key, function, inputs):
                with graphs.beside():
                    return function(inputs)
        known = self._known[key]
        for name, x in inputs.items():
            known.inputs[name].copy_(x)
        known.recording.replay()
        return {name: x.clone() for name, x in known.recording.results.items()}  # the next replay overwrites them

    def _record(self, key: Hashable, function: Callable[[Tensors], dict[str, Tensor]], inputs: Tensors) -> bool:
        static = {name: torch.empty_like(x) for name, x in inputs.items()}
        try:
            self._known[key] = _Recorded(static, graphs.record(lambda: function(static)))
        except Exception as error:  # a function may do anything, and works without
            self._failed = True
            log.info("%s is not replayed as a CUDA graph, and slower: %s", self.what, first_line(error))
        return not self._failed
