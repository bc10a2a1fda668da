"""Record what a function launches on a GPU, and launch it all at once from then on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch

WARM_UPS = 3
"""How often a function runs as usual before it is recorded: libraries choose algorithms and allocate memory then."""


class Recording(NamedTuple):
    """A CUDA graph; ``replay`` computes, into the memory of ``results`` and whatever else the function changes."""

    replay: Callable[[], None]
    results: Any
    pool: Any
    """Memory that further recordings may share, as long as nobody reads the results of one after another ran."""


def has_graphs(device: torch.device) -> bool:
    """Return whether this kind of device can record."""
    return device.type == "cuda"


@contextmanager
def beside() -> Iterator[torch.cuda.Stream]:
    """Run on the stream that records: what a library or autograd sets up for a stream then exists there."""
    global _stream
    _stream = _stream or torch.cuda.Stream()  # type: ignore[no-untyped-call]
    _stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(_stream):
        yield _stream
    torch.cuda.current_stream().wait_stream(_stream)


_stream: torch.cuda.Stream | None = None


def record(function: Callable[[], Any], *, pool: Any = None) -> Recording:
    """Record a function that ran :data:`WARM_UPS` times in :func:`beside`; nothing is computed yet.

    Everything it reads must stay where it is. Raises RuntimeError if the function waits for the device, as ``.item()``
    does, or takes more memory than there is; whatever else it raises, too.
    """
    graph = torch.cuda.CUDAGraph()
    with beside() as stream, torch.cuda.graph(graph, pool=pool, stream=stream, capture_error_mode="thread_local"):
        results = function()
    return Recording(graph.replay, results, graph.pool())


def host_memory(like: torch.Tensor) -> torch.Tensor:
    """Return memory of the host that is page-locked, without which a copy from or to it cannot be recorded."""
    return torch.empty(like.shape, dtype=like.dtype, pin_memory=True)


def wait() -> None:
    """Wait for the device to finish what this thread launched."""
    torch.cuda.current_stream().synchronize()


def first_line(error: Exception) -> str:
    """Return why a recording failed, in at most 200 characters."""
    return next((line for line in str(error).splitlines() if line), type(error).__name__)[:200]
